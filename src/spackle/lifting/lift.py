"""Lift a photo and its depth map to surface-aligned Gaussians: smooth the map, sharpen its edges, fill its gaps."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import DEPTH_EDGE_RATIO
from spackle.depth.depth_map import DepthMap
from spackle.lifting.edges import (
    HOLE,
    SETTLED,
    Bools,
    Floats,
    assign_open_pixels,
    find_edges,
    sample,
)
from spackle.lifting.quadtree import LEVELS
from spackle.lifting.splats import layered_gaussians
from spackle.runtime.errors import InputError
from spackle.runtime.kernels import kernel


@dataclasses.dataclass(frozen=True)
class LiftedPhoto:
    """The Gaussians of a photo and its depth map, in the frame of the photo's camera."""

    gaussians: Gaussians
    camera: Camera  # the photo's camera
    notes: dict[str, float | int | str]  # for the report: measured, filled or assumed values


def lift_depth_map(
    rgb: Tensor, depth: DepthMap, camera: Camera, levels: int = LEVELS
) -> LiftedPhoto:
    """Lift a photo and its depth map to Gaussians, see `layered_gaussians`.

    Args:
        rgb: [H, W, 3] sRGB in 0..1.
        depth: of any size with the photo's aspect ratio; InputError if no pixel has a depth.
        camera: the photo's camera, at the world's origin.
        levels: number of tile sizes. All pixels of a tile share one Gaussian; with 0, every pixel has its own.
    """
    rgb = rgb.detach().float().contiguous()
    values = depth.depth.detach().float()
    known = (depth.valid & torch.isfinite(values) & (values > 0)).contiguous().numpy()
    inverse = np.divide(1, values.numpy(), out=np.zeros(known.shape, np.float32), where=known)
    step = np.float32(depth.quantum or 0) * (
        inverse**2 if depth.quantity == "depth" else np.ones_like(inverse)
    )
    inverse = smoothed(inverse, known, step)
    rows, columns = known.shape
    fx, fy = camera.focal
    edges = find_edges(inverse, known, (fx * columns / camera.width, fy * rows / camera.height))
    sampled = sample(inverse, known, edges, camera.height, camera.width)
    if not (sampled.state == SETTLED).any():
        raise InputError(
            f"{depth.path}: no depth is left at {camera.width}×{camera.height}: give a denser map"
        )
    inverse_depth = torch.from_numpy(assign_open_pixels(sampled, rgb.numpy()))
    gaussians = layered_gaussians(inverse_depth, srgb_to_linear(rgb), camera, levels)
    notes: dict[str, float | int | str] = {
        "depth_filled": round(float((sampled.state == HOLE).mean()), 4)
    }
    if depth.depth.shape != inverse_depth.shape:
        notes["depth_resampled_from"] = f"{columns}×{rows}"
    return LiftedPhoto(gaussians, camera, notes)


SWEEPS = 100  # smoothing iterations; enough for quantisation steps about 30 pixels apart
LEAST_NOISE = 5e-4  # relative to the inverse depth; less noise causes no gaps between the Gaussians
DEVIATIONS = 2.0  # a value may change by this number of the noise's standard deviations


def noise_level(inverse_depth: Floats, known: Bools) -> float:
    """The noise of most pixels, from second differences: its standard deviation relative to the inverse depth."""
    if min(inverse_depth.shape) < 3:
        return 0.0
    bend, seen = inverse_depth, known
    for _ in range(2):  # by y, then by x
        bend = (bend[:-2] - 2 * bend[1:-1] + bend[2:]).T
        seen = (seen[:-2] & seen[1:-1] & seen[2:]).T
    if not seen.any():
        return 0.0
    return float(np.median(np.abs(bend[seen]) / inverse_depth[1:-1, 1:-1][seen])) / (0.6745 * 6)


def smoothed(inverse_depth: Floats, known: Bools, step: Floats | np.float32) -> Floats:
    """The smoothest inverse depth [h, w] that its noise and its quantisation step (a number, or [h, w]) allow.

    Each known value is replaced by the mean of its neighbours on both sides. The change is limited to half a
    quantisation step, or to `DEVIATIONS` of the noise if this is more. A neighbour that differs by over three times the
    limit belongs to another surface. Noise as large as depth edges is kept as content, such as leaves or meshes.
    """
    noise = noise_level(inverse_depth, known)
    reach = np.maximum(step / 2, DEVIATIONS * noise * (noise <= DEPTH_EDGE_RATIO) * inverse_depth)
    reach = np.where(reach >= LEAST_NOISE * inverse_depth, reach, 0).astype(np.float32)
    if not reach.any():
        return inverse_depth
    result = np.where(known, inverse_depth, np.float32(np.nan))
    _relax(result, inverse_depth - reach, inverse_depth + reach, 3 * reach)
    return np.where(known, result, inverse_depth)


@kernel
def _relax(depths: Any, low: Any, high: Any, apart: Any) -> None:
    height, width = depths.shape
    for _ in range(SWEEPS):
        for y in range(height):
            for x in range(width):
                here, total, count = depths[y, x], np.float32(0), 0
                if not low[y, x] < high[y, x]:
                    continue
                for dy, dx in ((0, 1), (1, 0)):
                    if y - dy < 0 or x - dx < 0 or y + dy >= height or x + dx >= width:
                        continue
                    before, after = depths[y - dy, x - dx], depths[y + dy, x + dx]
                    if abs(before - here) <= apart[y, x] and abs(after - here) <= apart[y, x]:
                        total += before + after
                        count += 2
                if count:
                    depths[y, x] = min(max(total / count, low[y, x]), high[y, x])
