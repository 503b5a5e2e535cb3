"""The moge base: lift the depth of MoGe-2, with MoGe-2's focal length if the photo's is unknown.

The network predicts points up to a shift along z. `to_view` finds the shift and the focal length
with which the points project to their pixels, and turns the points into depth in metres.
"""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.bases import BasePrediction, is_plausible_focal
from spackle.bases.depth import lift_predicted_depth
from spackle.bases.moge.network import (
    PIXELS_PER_TOKEN,
    MogeNetwork,
    MogeOutput,
    load_network,
    token_grid,
    view_plane,
)
from spackle.core.camera import Camera
from spackle.core.photo import Photo, resize_photo
from spackle.depth.depth_map import DepthMap
from spackle.runtime.device import (
    Precision,
    pick_device,
    pick_dtype,
    report_memory_shortage,
    without_autocast_or_tf32,
)
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Progress

USUAL_TOKENS = 1800  # for a photo, limited to the checkpoint's range
SAMPLES_PER_SIDE = 64  # points along each side of the map that determine focal length and shift
MAX_SHIFT_STEPS = 200  # of the search for the shift along z
SHIFT_TOLERANCE = 1e-9  # the search ends at a smaller step, relative to 1 + |shift|
SKY_DISTANCE_FACTOR = 10.0  # distance of the sky, as a multiple of the farthest surface's distance

Floats = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class MogeView:
    """MoGe's depth of a photo, on a grid [h, w] over the photo."""

    depth: Tensor  # [h, w] float32 z in metres, also where `surface` is false
    surface: Tensor  # [h, w] bool: the network's mask, false in the sky
    focal_px: float  # in pixels of the photo
    shift: float  # of the network's points along z

    def depth_map(self, path: Path) -> DepthMap:
        """The view as a depth map, in which the sky lies behind all surfaces; path: the photo.

        InputError if there is no surface with a depth.
        """
        known = self.surface & (self.depth > 0) & self.depth.isfinite()
        if not known.any():
            raise InputError(f"{path}: MoGe finds no surface: give another photo, or `base` lite")
        # The sky has no depth, but must not leave a hole.
        sky_depth = SKY_DISTANCE_FACTOR * self.depth[known].max()
        depth = torch.where(self.surface, self.depth.where(known, 0.0), sky_depth)
        return DepthMap(
            depth, known | ~self.surface, K=None, quantum=None, quantity="depth", path=path
        )


class MogeBase:
    """MoGe-2 (Wang et al. 2025), frozen."""

    name = "moge"

    def __init__(self, network: MogeNetwork, precision: str) -> None:
        """Use a loaded network on its device; `precision` is its name in the report."""
        self.network = network
        self.precision = precision

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        precision: Precision = "auto",
        device: torch.device | str | None = None,
    ) -> MogeBase:
        """Read MoGe-2's model.pt.

        `device` is cpu or a CUDA device; None: CUDA if available. InputError for a missing device,
        a foreign or broken file, or too little memory.
        """
        target = pick_device(device)
        dtype = pick_dtype(precision, target)
        with report_memory_shortage():
            network = load_network(path, dtype).to(target)
        return cls(network, "bf16" if dtype == torch.bfloat16 else "fp32")

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels at its working size, on the surfaces that MoGe sees.

        The user's or the file's focal length is kept. Without one, MoGe's focal length is used if
        it is plausible, else the assumed one. The sky lies behind all surfaces. InputError if the
        network finds no surface, or memory is short.
        """
        photo = resize_photo(photo)
        tokens = min(max(USUAL_TOKENS, self.network.least_tokens), self.network.most_tokens)
        rows, columns = token_grid(photo.height, photo.width, tokens)
        # The maps need not be finer than the network's finest level: lifting enlarges them. Both
        # sizes have the photo's aspect ratio, so that the smaller height is the smaller size.
        finest_size = (PIXELS_PER_TOKEN * rows, PIXELS_PER_TOKEN * columns)
        size = min(finest_size, (photo.height, photo.width))
        with report_memory_shortage():
            output = self.run_network(photo.rgb, tokens, size)

        view, camera, lens_source = self._choose_focal(output, photo)
        prediction = lift_predicted_depth(photo, view.depth_map(photo.path), camera)
        notes = {
            **prediction.notes,
            "precision": self.precision,
            "depth_scale": "metric, by the model",
        }
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)

    @staticmethod
    def _choose_focal(output: MogeOutput, photo: Photo) -> tuple[MogeView, Camera, str]:
        """The view and the camera with the best known focal length, and its source for the report.

        The source is "MoGe", or "" if the photo's focal length is taken.
        """
        # An assumed focal length is worth less than the network's.
        if photo.focal_source.is_assumed:
            view = to_view(output, photo.width, photo.height)
            if is_plausible_focal(view.focal_px, photo.width, photo.height):
                camera = Camera.from_focal(view.focal_px, photo.width, photo.height)
                return view, camera, "MoGe"
        return to_view(output, photo.width, photo.height, photo.focal_px), photo.camera, ""

    @torch.no_grad()
    def run_network(self, rgb: Tensor, tokens: int, size: tuple[int, int]) -> MogeOutput:
        """The network's output, on the CPU, for a photo [H, W, 3], sRGB in 0..1.

        The photo is encoded as about `tokens` tokens; the output has maps of `size` (h, w).
        """
        device = next(self.network.parameters()).device
        image = rgb.float().permute(2, 0, 1)[None].to(device)  # [1, 3, H, W]
        with without_autocast_or_tf32(device):
            output = self.network(image, tokens, size)
        return MogeOutput(output.points.cpu(), output.mask_logits.cpu(), output.metric_scale.cpu())


def to_view(output: MogeOutput, width: int, height: int, focal_px: float | None = None) -> MogeView:
    """Convert the network's output for a width×height photo to metres.

    The depth is (z + shift) · metric scale, with the shift and the focal length that project the
    points to their pixels best. A given `focal_px`, in pixels of the photo, is kept.
    """
    rows, columns = output.mask_logits.shape
    # Two unknowns need few points: 64 × 64 of them, evenly spread.
    sampled_rows = (torch.arange(SAMPLES_PER_SIDE) * rows // SAMPLES_PER_SIDE)[:, None]
    sampled_columns = torch.arange(SAMPLES_PER_SIDE) * columns // SAMPLES_PER_SIDE
    points = output.points[sampled_rows, sampled_columns].double()  # [64, 64, 3]
    plane = view_plane(rows, columns, width / height)[0].permute(1, 2, 0)  # [h, w, 2]
    places = plane[sampled_rows, sampled_columns].double()  # [64, 64, 2]
    # The sky's points are far away and arbitrary.
    is_surface = output.mask_logits[sampled_rows, sampled_columns] > 0
    usable = is_surface & points.isfinite().all(-1)

    half_diagonal = math.hypot(width, height) / 2  # the unit of places and of the focal length
    known_focal = None if focal_px is None else focal_px / half_diagonal
    focal, shift = focal_and_shift(points[usable].numpy(), places[usable].numpy(), known_focal)
    # The shift is in the network's units, hence before the metric scale.
    depth = (output.points[..., 2] + shift) * output.metric_scale
    return MogeView(depth, output.mask_logits > 0, focal * half_diagonal, shift)


@dataclasses.dataclass(frozen=True)
class _Fit:
    """How points, shifted along z, project to their places."""

    focal: float
    projected: Floats  # [N, 2] (x, y) / (z + shift)
    residual: Floats  # [N, 2] focal · projected - places

    @property
    def error(self) -> float:
        """The sum of squared residuals; NaN if a shift puts a point into the camera."""
        return float((self.residual**2).sum())


def _fit_at(shift: float, points: Floats, places: Floats, known_focal: float | None) -> _Fit:
    """Project points [N, 3], shifted along z, by the best focal length or a known one.

    The best one for a shift has a closed form, because the residual is linear in it.
    """
    with np.errstate(all="ignore"):  # a shift may put a point into the camera
        projected = points[:, :2] / (points[:, 2:] + shift)
        focal = known_focal
        if focal is None:
            focal = float((projected * places).sum() / (projected * projected).sum())
        return _Fit(focal, projected, focal * projected - places)


def focal_and_shift(
    points: Floats, places: Floats, known_focal: float | None = None
) -> tuple[float, float]:
    """The focal length f and the shift s along z with which points project to their places.

    Gauss-Newton steps from s = 0 minimise the sum of |f (x, y) / (z + s) - place|²; a step is
    halved until the error falls.

    Args:
        points: [N, 3]; fewer than two points give f = 1 and s = 0.
        places: [N, 2] on the photo, from its centre.
        known_focal: a focal length that is kept; None: it is found. Its unit, and that of `places`
            and of the result, is half the photo's diagonal.
    """
    if len(points) < 2:
        return known_focal or 1.0, 0.0

    # The iteration needs a start; most photos need but a small shift.
    shift = 0.0
    fit = _fit_at(shift, points, places, known_focal)
    for _ in range(MAX_SHIFT_STEPS):
        step = _gauss_newton_step(fit, shift, points, places, known_focal)
        shortest = SHIFT_TOLERANCE * (1 + abs(shift))
        # An error that is not a number does not fall.
        while abs(step) > shortest:
            if _fit_at(shift + step, points, places, known_focal).error < fit.error:
                break
            step /= 2
        shift += step
        fit = _fit_at(shift, points, places, known_focal)
        if not abs(step) > SHIFT_TOLERANCE * (1 + abs(shift)):
            break
    return fit.focal, shift


def _gauss_newton_step(
    fit: _Fit, shift: float, points: Floats, places: Floats, known_focal: float | None
) -> float:
    """The change of the shift that would make the residuals smallest if they were linear in it.

    points [N, 3] are shifted by `shift` so far; places [N, 2] are where they should project to.
    """
    projected_slope = -fit.projected / (points[:, 2:] + shift)  # d projected / d shift
    residual_slope = fit.focal * projected_slope  # d residual / d shift, at this focal length
    if known_focal is None:
        # The best focal length changes with the shift, too.
        focal_slope = float(
            (projected_slope * (places - 2 * fit.focal * fit.projected)).sum()
            / (fit.projected * fit.projected).sum()
        )
        residual_slope += focal_slope * fit.projected
    # All points on one line through the camera have slope 0: then the step is 0.
    squared_slope = (residual_slope * residual_slope).sum()
    return -float((residual_slope * fit.residual).sum() / (squared_slope or 1.0))
