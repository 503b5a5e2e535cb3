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
        """Make a depth map of the view, in which the sky lies behind all surfaces.

        `path` is the photo's, for messages. InputError if there is no surface with a depth.
        """
        known = self.surface & (self.depth > 0) & self.depth.isfinite()
        if not known.any():
            raise InputError(f"{path}: MoGe finds no surface: give another photo, or `base` lite")
        # The sky has no depth of its own: without one, the scene would have a hole there.
        sky_depth = SKY_DISTANCE_FACTOR * self.depth[known].max()
        depth = torch.where(self.surface, self.depth.where(known, 0.0), sky_depth)
        is_sky = ~self.surface
        # The map needs no intrinsics (K), because the camera is passed separately, and has no
        # quantisation step (quantum), because nothing was rounded.
        return DepthMap(depth, known | is_sky, K=None, quantum=None, quantity="depth", path=path)


class MogeBase:
    """MoGe-2 (Wang et al. 2025), frozen."""

    name = "moge"

    def __init__(self, network: MogeNetwork, precision: str) -> None:
        """Use a loaded network on its device; `precision`, fp32 or bf16, is for the report."""
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

        `precision` is the number type of most of the arithmetic; auto is bf16 if the hardware
        multiplies it natively. `device` is cpu or a CUDA device; None: CUDA if available.
        InputError for a missing device, a foreign or broken file, or too little memory.
        """
        target = pick_device(device)
        dtype = pick_dtype(precision, target)
        with report_memory_shortage():
            network = load_network(path, dtype).to(target)
        return cls(network, "bf16" if dtype == torch.bfloat16 else "fp32")

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels, on the surfaces that MoGe sees.

        The photo is first resized to its working size (the long side is at most 1536 pixels). The
        user's or the file's focal length is kept. Without one, MoGe's focal length is used if it is
        plausible, else the assumed one. The sky lies behind all surfaces. InputError if the network
        finds no surface, or memory is short.
        """
        photo = resize_photo(photo)
        # The checkpoint says with which numbers of tokens it was trained.
        tokens = min(max(USUAL_TOKENS, self.network.least_tokens), self.network.most_tokens)
        rows, columns = token_grid(photo.height, photo.width, tokens)

        # The network's finest level, or the photo's size if that is smaller: lifting resizes the
        # maps to the photo's pixels. Both sizes, (height, width), have the photo's aspect ratio, so
        # that `min`, which compares the heights first, gives the smaller size.
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
        """Take the photo's focal length, or else the network's.

        Returns:
            The network's depth of the photo and the photo's camera, both with this focal length,
            and the source of the focal length for the report: "MoGe", or "" if it is the photo's.
        """
        # The network's focal length is used only if the photo's is a mere assumption.
        if photo.focal_source.is_assumed:
            view = to_view(output, photo.width, photo.height)
            if is_plausible_focal(view.focal_px, photo.width, photo.height):
                camera = Camera.from_focal(view.focal_px, photo.width, photo.height)
                return view, camera, "MoGe"
        view = to_view(output, photo.width, photo.height, photo.focal_px)
        return view, photo.camera, ""

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
    """Convert the network's output for a photo of width × height pixels to metres.

    The network predicts points (x, y, z) up to a shift along z and a scale. The depth is
    (z + shift) · metric scale, with the shift and the focal length with which the points project to
    their pixels best. If `focal_px`, in pixels of the photo, is not None, it is the focal length.
    """
    rows, columns = output.mask_logits.shape
    # Two unknowns need few points: a grid of 64 × 64 (SAMPLES_PER_SIDE), evenly spread.
    sampled_rows = (torch.arange(SAMPLES_PER_SIDE) * rows // SAMPLES_PER_SIDE)[:, None]
    sampled_columns = torch.arange(SAMPLES_PER_SIDE) * columns // SAMPLES_PER_SIDE
    points = output.points[sampled_rows, sampled_columns].double()  # [64, 64, 3]
    # Where the points must project to: the places of their pixels on the photo.
    plane = view_plane(rows, columns, width / height)[0].permute(1, 2, 0)  # [h, w, 2]
    places = plane[sampled_rows, sampled_columns].double()  # [64, 64, 2]
    # The sky's points are left out: they are far away and arbitrary.
    is_surface = output.mask_logits[sampled_rows, sampled_columns] > 0
    usable = is_surface & points.isfinite().all(-1)

    half_diagonal = math.hypot(width, height) / 2  # the unit of places and of the focal length
    known_focal = None if focal_px is None else focal_px / half_diagonal
    focal, shift = focal_and_shift(points[usable].numpy(), places[usable].numpy(), known_focal)
    # The shift is in the network's units, hence it is added before the scale is applied.
    depth = (output.points[..., 2] + shift) * output.metric_scale
    return MogeView(
        depth=depth,
        surface=output.mask_logits > 0,
        focal_px=focal * half_diagonal,
        shift=shift,
    )


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
    """Project points [N, 3] that are shifted by `shift` along z, and compare with their places.

    The places [N, 2] are where the points should project to. The focal length is the known one, or
    else that with the least squared residuals, focal · projected - places. It has a closed form,
    because the residuals are linear in the focal length.
    """
    # A shift may put a point into the camera, where z + shift is zero.
    with np.errstate(all="ignore"):
        projected = points[:, :2] / (points[:, 2:] + shift)
        focal = known_focal
        if focal is None:
            focal = float((projected * places).sum() / (projected * projected).sum())
        residual = focal * projected - places
    return _Fit(focal, projected, residual)


def focal_and_shift(
    points: Floats, places: Floats, known_focal: float | None = None
) -> tuple[float, float]:
    """The focal length f and the shift s along z with which points project to their places.

    Gauss-Newton steps from s = 0 minimise the error, the sum of |f (x, y) / (z + s) - place|². A
    step that would not reduce the error is halved until it does.

    Args:
        points: [N, 3], x, y and z; fewer than two points give s = 0 and, unless it is known, f = 1.
        places: [N, 2] on the photo, from its centre.
        known_focal: the focal length; None: it is searched for, too. Its unit, and that of `places`
            and of the result, is half the photo's diagonal.
    """
    if len(points) < 2:
        return known_focal or 1.0, 0.0

    # The search begins without a shift, because most photos need only a small one.
    shift = 0.0
    fit = _fit_at(shift, points, places, known_focal)
    for _ in range(MAX_SHIFT_STEPS):
        step = _gauss_newton_step(fit, shift, points, places, known_focal)
        shortest_step = SHIFT_TOLERANCE * (1 + abs(shift))
        # The error is NaN if the step puts a point into the camera. NaN is not less than the
        # present error, so that such a step is halved, too.
        while abs(step) > shortest_step:
            if _fit_at(shift + step, points, places, known_focal).error < fit.error:
                break
            step /= 2
        shift += step
        fit = _fit_at(shift, points, places, known_focal)
        # `not … >` also ends the search if the step is NaN.
        if not abs(step) > SHIFT_TOLERANCE * (1 + abs(shift)):
            break
    return fit.focal, shift


def _gauss_newton_step(
    fit: _Fit, shift: float, points: Floats, places: Floats, known_focal: float | None
) -> float:
    """The change of the shift that would make the residuals smallest if they were linear in it.

    The residuals, fit.focal · fit.projected - places, say how far the points [N, 3], which are
    shifted by `shift` so far, miss their places [N, 2]. Without a known focal length, each shift
    comes with the focal length that makes its residuals smallest.
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
    # All points on one line through the camera project to the same place whatever the shift: the
    # slope is 0, and so is the step.
    squared_slope = (residual_slope * residual_slope).sum()
    divisor = squared_slope or 1.0
    return -float((residual_slope * fit.residual).sum() / divisor)
