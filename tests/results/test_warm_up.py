"""Kernels that are compiled ahead, by a server whose page is empty and in the container's image."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import ROOT

from spackle.formats.html import read_page_file
from spackle.runtime.task_process import TaskFunction
from spackle.web.jobs import WARM_UP
from spackle.web.work import SceneWork

WARM = "from spackle.results.warm_up import compile_kernels; compile_kernels()"


def test_server_and_image_compile_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    devices: list[str] = []
    monkeypatch.setattr("spackle.web.work.compile_kernels", devices.append)
    work: TaskFunction = SceneWork()
    work(WARM_UP, pytest.fail)
    assert devices == ["auto"]
    assert f'python -c "{WARM}"' in (ROOT / "Dockerfile").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_photo_after_the_warm_up_compiles_nothing(tmp_path: Path) -> None:
    cache = tmp_path / "kernels"
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(cache),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    photo = tmp_path / "coffee.jpg"
    photo.write_bytes(read_page_file("coffee.jpg"))
    predict = [sys.executable, "-m", "spackle", "predict", photo, "-o", tmp_path / "out"]
    outputs = "scene.ply,scene.spz,scene.sog,scene.glb,scene.html,video.mp4"

    compiled: list[set[Path]] = []
    for command in (
        [sys.executable, "-c", WARM],
        [*predict, "--base", "lite", "--seconds", "0.1", "--outputs", outputs],
    ):
        subprocess.run(command, env=environment, check=True, cwd=tmp_path)
        compiled.append(set(cache.rglob("*.nbc")))
    assert compiled[0]
    assert compiled[1] == compiled[0]
