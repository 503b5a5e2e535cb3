"""A dataset built by workers on a Ray cluster: the same bytes, whoever dies, and a line where that cannot be."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command import Run, names_in, refuses
from dataset_builds import build, content

from spackle import workers as on_ray
from spackle.bases.settings import BaseSettings
from spackle.dataset.build import DatasetOptions, Maker
from spackle.dataset.photos import PhotoFile
from spackle.workers import RemoteWorker

ray = pytest.importorskip("ray")

CLUSTER = """
import ray, sys
context = ray.init("local", num_cpus=2, num_gpus=0, include_dashboard=False, log_to_driver=False, logging_level="error")
print(context.address_info["address"], flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a cluster with room for two workers; it ends with the process that holds it."""
    with subprocess.Popen([sys.executable, "-c", CLUSTER], stdin=-1, stdout=-1, stderr=-3, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.communicate()


def dying(times: int, notes: Path, where: str = "make") -> type[RemoteWorker]:
    """Workers of which the first few are killed when they have made the photo number 2, or as they begin."""

    def turn(here: str) -> None:
        turns = len(list(notes.iterdir()))
        if here == where and turns < times:
            (notes / str(turns)).touch()
            os.kill(os.getpid(), signal.SIGKILL)

    class Dying(RemoteWorker):
        def begin(self, expected: Any) -> None:
            turn("begin")
            super().begin(expected)

        def make(self, job: PhotoFile, expected: object) -> Any:
            answer = super().make(job, expected)
            turn("make" if job.index == 2 else "")
            return answer

    notes.mkdir()
    return Dying


def on(address: str, place: Path, output: Path, *more: object) -> Run:
    return build(place, output, "--ray", address, "--workers", 2, *more)


@pytest.mark.slow
def test_a_local_cluster_makes_the_same_bytes_and_ends(place: Path, whole: Path, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    done = on("local", place, tmp_path / "out")
    assert (done.code, done.out, len(done.lines)) == (0, "", 2), done.err  # nothing of Ray's own
    assert content(tmp_path / "out") == content(whole)
    assert not ray.is_initialized()
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_killed_workers_photos_are_made_again(
    place: Path, whole: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_ray, "RemoteWorker", dying(1, tmp_path / "notes"))
    done = on(address, place, tmp_path / "out")
    assert (done.code, done.out, len(done.lines)) == (0, "", 3), done.err
    assert f"{place}/photos/3.png: at this photo a worker died, and another takes its place" in done.lines[0]
    assert names_in(tmp_path / "notes") == {"0"}  # one was killed
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "line"), [("make", "photos/3.png: at this photo a worker died"), ("begin", "as it started a worker died")]
)
def test_what_kills_every_worker_ends_the_build(
    place: Path, whole: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, line: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(on_ray, "RemoteWorker", dying(99, tmp_path / "notes", where))
        done = on(address, place, tmp_path / "out")
    assert (done.code, done.out, len(done.lines)) == (2, "", 4)
    assert f"{line} for the 4th time" in done.lines[-1]
    assert build(place, tmp_path / "out").code == 0
    assert content(tmp_path / "out") == content(whole)


def test_a_silent_address_and_a_full_cluster_are_a_line(
    place: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuses(on(address, place, tmp_path / "out", "--workers", 3), f"--ray {address}: room for 2 of 3 workers")
    refuses(on("nowhere", place, tmp_path / "out"), "--ray nowhere: no cluster: ValueError: ")
    monkeypatch.setattr(on_ray, "ANSWER_S", 1.0)
    with socket.socket() as nobody:  # takes the port, and no calls
        nobody.bind(("127.0.0.1", 0))
        closed = f"127.0.0.1:{nobody.getsockname()[1]}"
        refuses(on(closed, place, tmp_path / "out"), f"--ray {closed}: no cluster: no answer within 1 seconds")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "instead", "line"),
    [
        ("inputs", ["another", "photo"], "0.png: node {node} does not find this photo or its depth map"),
        ("setup", {"spackle": "0.0"}, 'would give other results (base: null -> {{"name'),
    ],
)
def test_a_node_that_is_not_like_the_others_is_a_line(
    place: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, instead: Any, line: str
) -> None:
    monkeypatch.setattr(Maker, name, instead if name == "setup" else lambda *arguments: instead)
    refuses(on(address, place, tmp_path / "out"), line.format(node=socket.gethostname()))
    assert names_in(tmp_path / "out" / "parts") == set()


def test_a_worker_takes_a_gpu_only_where_a_network_uses_one() -> None:
    def gpus(base: str, device: str = "auto", inpainter: str = "exemplar", **node: Any) -> int:
        options = DatasetOptions(BaseSettings(base, device=device), inpainter=inpainter, ray="auto")
        without = {"Alive": True, "Resources": {"CPU": 4.0}}
        return on_ray.gpus_of(options.processes, [without, {"Alive": True, "Resources": {"GPU": 1.0}} | node])

    assert (gpus("sharp"), gpus("rgbd", inpainter="propainter")) == (1, 1)
    assert (gpus("rgbd"), gpus("sharp", "cpu")) == (0, 0)
    assert (gpus("sharp", Resources={"GPU": 0.0}), gpus("sharp", Alive=False)) == (0, 0)
