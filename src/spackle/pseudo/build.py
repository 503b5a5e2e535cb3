"""One photo to the bytes of its sample: base, views, targets, files (paper, "Dataset")."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

from spackle.bases.protocol import BasePrediction
from spackle.camera_path import DepthRange, TrajectoryKind
from spackle.errors import InputError
from spackle.image import Photo, load_photo, resize_photo
from spackle.pseudo.archive import pack
from spackle.pseudo.inpainters import Inpainter
from spackle.pseudo.photos import PhotoFile
from spackle.pseudo.sample import to_members
from spackle.pseudo.views import DISPARITY, VIEWS, PathChoice, ViewStack, draw_path, path_cameras, render_views
from spackle.render import Renderer
from spackle.residual.hole_features import MASK_THRESHOLD

Seconds = dict[str, float]  # of each stage
Predict = Callable[[Photo], BasePrediction]


@dataclasses.dataclass(frozen=True)
class ViewChoices:
    """What decides which views a photo gets."""

    seed: int = 0
    views: int = VIEWS  # of a photo, its own among them
    trajectory: TrajectoryKind | None = None  # drawn for each photo where None
    disparity: tuple[float, float] = DISPARITY  # drawn between these
    threshold: float = MASK_THRESHOLD


def key_of(index: int) -> str:
    """How a photo's files begin: its place among the photos."""
    return f"{index:06d}"


def make_sample(
    photo: PhotoFile,
    key: str,
    predict: Predict,
    renderer: Renderer,
    inpainter: Inpainter,
    choices: ViewChoices,
    seconds: Seconds,
) -> bytes:
    """Everything that a dataset holds of a photo, as a stretch of a tar archive.

    Args:
        photo: the file.
        key: how its files begin.
        predict: the base.
        renderer: draws the views.
        inpainter: completes them.
        choices: which views.
        seconds: the time of each stage is added to it.

    Raises:
        InputError: a photo, or its depth, that cannot be used.
    """
    with timed("load", seconds):
        loaded = load_photo(photo.path)
    with timed("base", seconds):
        prediction = predict(loaded)
        if not all(bool(torch.isfinite(tensor).all()) for tensor in prediction.gaussians.tensors):
            raise InputError(f"{photo.path}: the base's Gaussians leave the range of float32: check its depth")
    with timed("render", seconds):
        path, stack = _draw(photo, prediction, renderer, choices)
    with timed("inpaint", seconds):
        targets = inpainter.complete(stack)
    with timed("encode", seconds):
        facts = _facts(photo, loaded, prediction, inpainter)
        picture = resize_photo(loaded).rgb
        return pack(to_members(key, picture, stack, targets, choices.threshold, path, facts))


def _draw(
    photo: PhotoFile, prediction: BasePrediction, renderer: Renderer, choices: ViewChoices
) -> tuple[PathChoice, ViewStack]:
    path = draw_path(choices.seed, photo.sha256, choices.trajectory, choices.disparity)
    gaussians, camera = prediction.gaussians, prediction.camera
    even = camera.even()
    try:
        cameras = path_cameras(path, even, DepthRange.of(gaussians), choices.views)
    except ValueError as error:
        raise InputError(f"{photo.path}: no camera path: {error}") from error
    return path, render_views(gaussians, camera, cameras, renderer, choices.threshold)


def _facts(photo: PhotoFile, loaded: Photo, prediction: BasePrediction, inpainter: Inpainter) -> dict[str, Any]:
    """What the JSON says of the photo, besides its views."""
    return {
        "photo": {
            "name": photo.name,
            "sha256": photo.sha256,
            "width": loaded.width,
            "height": loaded.height,
            "focal_source": prediction.lens_source or loaded.focal_source,
        },
        "base": {"gaussians": len(prediction.gaussians), **prediction.notes},
        "inpainter": {"name": inpainter.name, "version": inpainter.version},
    }


@contextlib.contextmanager
def timed(stage: str, seconds: Seconds) -> Iterator[None]:
    """Add the block's time to `seconds[stage]`."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
