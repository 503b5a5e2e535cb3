"""The Dockerfile without Docker: its files, and its steps in a shell, in an empty environment under
another root.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest
from helpers.command import page_of
from helpers.photos import write_photo

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def steps() -> list[tuple[str, str]]:
    lines = [line for line in TEXT.splitlines() if line.strip() and not line.startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines)).splitlines()
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in joined)]


def test_copied_files_exist_and_are_not_ignored() -> None:
    copied = [name for word, rest in steps() if word == "COPY" for name in rest.split()[:-1]]
    assert all((ROOT / name).exists() for name in copied)
    kept = {
        line.removeprefix("!")
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if line[0] == "!"
    }
    assert set(copied) == kept


@pytest.mark.skipif(os.environ.get("SPACKLE_EMPTY") != "1", reason="fetches torch: make test-wheel")
def test_its_steps_install_a_command_that_predicts_and_views(tmp_path: Path) -> None:
    root = tmp_path / "image"
    venv.create(root / "python", with_pip=True)
    place, variables = (
        root,
        {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "NUMBA"))},
    )
    variables["PATH"] = f"{root / 'python' / 'bin'}:{variables['PATH']}"
    under = lambda text: text.replace("/opt/spackle", f"{root}/opt/spackle")  # noqa: E731
    for word, rest in steps():
        if word in ("ENV", "ARG"):
            variables |= dict(pair.split("=", 1) for pair in shlex.split(under(rest)))
        elif word == "WORKDIR":
            place = Path(under(rest))
            place.mkdir(parents=True, exist_ok=True)
        elif word == "COPY":
            *names, target = rest.split()
            for name in names:
                source = ROOT / name
                if source.is_dir():
                    shutil.copytree(source, place / target, dirs_exist_ok=True)
                else:
                    shutil.copy(source, place / target)
        elif word == "RUN":
            command = under(rest)
            if sys.version_info[:2] < (3, 11):
                command = command.replace("--constraint constraints.txt", "")
            subprocess.run(
                ["sh", "-ec", command], cwd=place, env=variables, check=True, timeout=1800
            )
    assert list((root / "opt/spackle/kernels").rglob("*.nbi"))
    write_photo(place / "photo.png")
    spackle = root / "python" / "bin" / "spackle"
    words = ["predict", "photo.png", "-o", "out", "--frames", "2"]
    subprocess.run([spackle, *words], cwd=place, env=variables, check=True, timeout=300)
    assert (place / "out" / "photo" / "scene.ply").is_file()
    words = ["view", "out/photo/scene.ply", "--host", "0.0.0.0", "--port", "0", "--no-open"]
    assert b"<canvas" in page_of([spackle, *words], cwd=place, env=variables)
