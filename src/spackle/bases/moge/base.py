"""The moge base: lift the depth of MoGe-2, and take MoGe-2's focal length if the photo's is unknown."""

from __future__ import annotations

import dataclasses
import math
import os

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
SAMPLES = 64  # points along each side of the map that determine focal length and shift
MAX_STEPS, MIN_STEP = (
    200,
    1e-9,
)  # the search for the shift: most steps, and the smallest step relative to 1 + shift
SKY_DISTANCE_FACTOR = 10.0  # distance of the sky, as a multiple of the farthest surface's distance

Floats = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class MogeView:
    """MoGe's depth of a photo, on a grid [h, w] over the photo."""

    depth: Tensor  # [h, w] float32 z in metres, also where `surface` is false
    surface: Tensor  # [h, w] bool: the network's mask, false in the sky
    focal_px: float  # in pixels of the photo
    shift: float  # of the network's points along z


class MogeBase:
    """MoGe-2 (Wang et al. 2025), frozen."""

    name = "moge"

    def __init__(self, network: MogeNetwork, precision: str) -> None:
        """Use a loaded network on its device; `precision` is its name in the report."""
        self.network, self.precision = network, precision

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        precision: Precision = "auto",
        device: torch.device | str | None = None,
    ) -> MogeBase:
        """Read MoGe-2's model.pt; InputError for a missing device, a foreign or broken file, or too little memory."""
        target = pick_device(device)
        dtype = pick_dtype(precision, target)
        with report_memory_shortage():
            return cls(
                load_network(path, dtype).to(target), "bf16" if dtype == torch.bfloat16 else "fp32"
            )

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the pixels of the photo at its working size, as `lift_rgbd` makes them.

        The user's or the file's focal length is kept. Without one, MoGe's focal length is used if it is plausible, else
        the default. The sky lies behind all surfaces. InputError if the network finds no surface, or memory is short.
        """
        photo = resize_photo(photo)
        tokens = min(max(USUAL_TOKENS, self.network.least_tokens), self.network.most_tokens)
        rows, columns = token_grid(photo.height, photo.width, tokens)
        size = min(
            (PIXELS_PER_TOKEN * rows, PIXELS_PER_TOKEN * columns), (photo.height, photo.width)
        )  # `lift_rgbd` enlarges
        known = not photo.focal_source.is_assumed
        with report_memory_shortage():
            output = self.ask(photo.rgb, tokens, size)
        view = to_view(output, photo.width, photo.height, photo.focal_px if known else None)
        camera, lens_source = photo.camera, ""
        if not known and is_plausible_focal(view.focal_px, photo.width, photo.height):
            camera, lens_source = (
                Camera.from_focal(view.focal_px, photo.width, photo.height),
                "MoGe",
            )
        elif not known:
            view = to_view(output, photo.width, photo.height, photo.focal_px)
        valid = view.surface & (view.depth > 0) & view.depth.isfinite()
        if not valid.any():
            raise InputError(
                f"{photo.path}: MoGe finds no surface: give another photo, or --base lite"
            )
        depth = torch.where(
            view.surface,
            view.depth.where(valid, 0.0),
            SKY_DISTANCE_FACTOR * view.depth[valid].max(),
        )
        depth_map = DepthMap(depth, valid | ~view.surface, None, None, "depth", photo.path)
        prediction = lift_predicted_depth(photo, depth_map, camera)
        notes = {
            **prediction.notes,
            "precision": self.precision,
            "depth_scale": "metric, by the model",
        }
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)

    @torch.no_grad()
    def ask(self, rgb: Tensor, tokens: int, size: tuple[int, int]) -> MogeOutput:
        """The network's output, on the CPU, for a photo [H, W, 3], sRGB in 0..1, with maps of `size` (h, w)."""
        device = next(self.network.parameters()).device
        with without_autocast_or_tf32(device):
            output = self.network(rgb.float().permute(2, 0, 1)[None].to(device), tokens, size)
        return MogeOutput(output.points.cpu(), output.mask_logits.cpu(), output.metric_scale.cpu())


def to_view(output: MogeOutput, width: int, height: int, focal_px: float | None = None) -> MogeView:
    """Convert the output for a width×height photo to metres, by the shift and focal length of `focal_and_shift`."""
    rows, columns = output.mask_logits.shape
    half_diagonal = math.hypot(width, height) / 2
    down, right = (torch.arange(SAMPLES) * n // SAMPLES for n in (rows, columns))
    points = output.points[down][:, right].double()
    plane = view_plane(rows, columns, width / height)[0].permute(1, 2, 0)[down][:, right].double()
    chosen = (output.mask_logits[down][:, right] > 0) & points.isfinite().all(-1)
    known = focal_px and focal_px / half_diagonal
    focal, shift = focal_and_shift(points[chosen].numpy(), plane[chosen].numpy(), known)
    depth = (output.points[..., 2] + shift) * output.metric_scale
    return MogeView(depth, output.mask_logits > 0, focal * half_diagonal, shift)


def focal_and_shift(
    points: Floats, places: Floats, focal: float | None = None
) -> tuple[float, float]:
    """The focal length f and the shift s along z with which points [N, 3] project to `places` [N, 2].

    Gauss-Newton steps from s = 0 minimise |f (x, y) / (z + s) - place|²; a step is halved until the error falls. The
    best f for a shift has a closed form. The unit of f and of `places` is half the diagonal; a given f is kept. Fewer
    than two points give f = 1 and s = 0.
    """
    if len(points) < 2:
        return focal or 1.0, 0.0

    def at(shift: float) -> tuple[float, Floats, Floats]:
        with np.errstate(all="ignore"):  # a shift may put a point into the camera
            seen = points[:, :2] / (points[:, 2:] + shift)
            best = focal or float((seen * places).sum() / (seen * seen).sum())
            return best, seen, best * seen - places

    shift = 0.0
    for _ in range(MAX_STEPS):
        best, seen, off = at(shift)
        moved = -seen / (points[:, 2:] + shift)  # the derivative of `seen` by the shift
        change = best * moved  # the derivative of `off` by the shift
        if focal is None:
            change += float((moved * (places - 2 * best * seen)).sum() / (seen * seen).sum()) * seen
        step = -float((change * off).sum() / ((change * change).sum() or 1.0))
        while (
            abs(step) > MIN_STEP * (1 + abs(shift))
            and not (at(shift + step)[2] ** 2).sum() < (off**2).sum()
        ):
            step /= 2
        shift += step
        if not abs(step) > MIN_STEP * (1 + abs(shift)):
            break
    return at(shift)[0], shift
