"""A base without a network, for tests of what happens around the photos."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import spackle
from spackle.bases.depth import lift_rgbd

FLAT = ("--base", "helpers.flat_base:Flat", "--fill", "none")  # also without a fill
QUICK = (*FLAT, "--no-render", "--threads", "1")


class Flat:
    """A wall at 3 m in place of a depth map."""

    name = "flat"

    def predict(
        self, photo: spackle.Photo, progress: Callable[[int, int], None] | None = None
    ) -> spackle.BasePrediction:
        die_if_told(photo.path)
        metres = torch.full((photo.height, photo.width), 3.0)
        depth = spackle.DepthMap(metres, metres > 0, None, None, "depth", photo.path)
        return lift_rgbd(photo.rgb, depth, photo.camera)


def die_if_told(photo: Path) -> None:
    """Kill the process that a file NAME.kill beside the photo names, and remove this file.

    "worker" is the calling process, and "command" the one that started it.
    """
    order = photo.with_suffix(".kill")
    if not order.exists():
        return
    # Not the system's parent, which may be a server that forks processes for the command.
    command = multiprocessing.parent_process()
    assert command is not None
    assert command.pid is not None
    number = {"worker": os.getpid(), "command": command.pid}[order.read_text()]
    order.unlink()
    os.kill(number, signal.SIGKILL)


def write_small_photos(folder: Path, *names: str) -> Path:
    """Write photos of 48×36 pixels, each of a colour of its own."""
    for number, name in enumerate(names):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.full((36, 48, 3), 7 * number % 256, np.uint8)
        pixels[:, :24, 1] = 200
        Image.fromarray(pixels).save(file)
    return folder
