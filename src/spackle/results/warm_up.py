"""Kernels compiled ahead, so that the first photo need not wait for them."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console

from spackle.bases.lite import LiteBase
from spackle.bases.settings import BaseSettings
from spackle.pipeline import FillOptions, Pipeline, PipelineOptions
from spackle.results.photo_folder import PhotoOptions, predict_photo
from spackle.runtime.progress import Reporter
from spackle.scene import Scene
from spackle.views import PathOptions

PHOTO_SIZE_PX = (128, 96)  # width and height of the made-up photo


def compile_kernels(device: str = "auto") -> None:
    """Compile the functions that complete, show and export a photo, where they are not yet.

    A small made-up photo is completed, in a folder that is removed at the end. Videos and exports
    need no others.

    Args:
        device: the device of networks and renderer; on a GPU less is compiled.
    """
    reporter = Reporter(False, Console(quiet=True, force_terminal=False))
    options = PipelineOptions(
        base=BaseSettings(name=LiteBase.name, device=device),
        path=PathOptions(),
        fill=FillOptions(),
    )
    with tempfile.TemporaryDirectory(prefix="spackle-warm-up-") as folder:
        photo = Path(folder) / "photo.png"
        results = Path(folder) / "results"
        Image.fromarray(_thing_before_a_wall()).save(photo)
        photo_options = PhotoOptions(lens={}, render=False)
        predict_photo(photo, results, Pipeline.open(options), reporter, photo_options)
        Scene.load(results / "scene.ply").page("photo")


def _thing_before_a_wall() -> NDArray[np.uint8]:
    """[H, W] grey values 0..255: a white thing before a slope of greys.

    Outlines, and the holes behind them, have kernels of their own.
    """
    width, height = PHOTO_SIZE_PX
    rows, columns = np.indices((height, width))
    is_thing = (abs(rows - 60) < 30) & (abs(columns - width // 2) < 20)
    grey: NDArray[np.uint8] = np.where(is_thing, 255, rows + columns).astype(np.uint8)
    return grey
