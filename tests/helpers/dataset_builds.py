"""Photos with depth, and builds of datasets, also killed ones."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from helpers.command import Run, run
from helpers.photos import metres, picture, write_depth

VIEWS = 4
SHORT = ["--base", "rgbd", "--views", VIEWS, "--shard-size", 2, "--threads", 1]


def write_inputs(place: Path, count: int = 5, width: int = 72, height: int = 54) -> Path:
    """Write photos into a folder and its subfolder, and their depth maps."""
    for number in range(count):
        name = f"{'deep/' if number == 1 else ''}{number}"
        path = place / "photos" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.clip(picture(width, height).astype(int) + 8 * number, 0, 255).astype(np.uint8)
        Image.fromarray(pixels).save(path)
        write_depth(place / "depth" / f"{name}.npy", metres(width, height))
    return place


def words_of(place: Path, output: Path, *more: object) -> list[object]:
    inputs = [place / "photos", "--depth", place / "depth"]
    return ["dataset", "build", *inputs, "-o", output, *SHORT, *more]


def build(place: Path, output: Path, *more: object) -> Run:
    return run(*words_of(place, output, *more))


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def dying_build(
    script: Path, patch: str, place: Path, output: Path, *more: object
) -> subprocess.Popen[bytes]:
    """Start a build in a new process, where `patch` installs calls of `die()`."""
    script.write_text(f"""
import multiprocessing, os, subprocess, sys
import spackle.paper.dataset.build as build
sys.argv = {["spackle", *map(str, words_of(place, output, *more))]!r}
def die(*arguments):
    os.kill(os.getpid(), 9)
if __name__ == "__main__":
{chr(10).join("    " + line for line in patch.splitlines())}
    from spackle.cli import main
    main()
""")
    return subprocess.Popen([sys.executable, script], stderr=subprocess.DEVNULL)


def is_alive(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
