"""Lift a photo and its depth map to surface-aligned Gaussians."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.depth.depth_map import MIN_DEPTH_M, DepthMap
from spackle.lifting.edges import find_edges
from spackle.lifting.guessed_outlines import grow_near_surfaces
from spackle.lifting.open_pixels import assign_open_pixels
from spackle.lifting.quadtree import TILE_LEVELS
from spackle.lifting.resampling import HOLE, SETTLED, resample_map
from spackle.lifting.smoothing import smooth_inverse_depth
from spackle.lifting.splats import layered_gaussians
from spackle.runtime.errors import InputError


@dataclasses.dataclass(frozen=True)
class LiftedPhoto:
    """The Gaussians of a photo and its depth map, in the frame of the photo's camera."""

    gaussians: Gaussians
    camera: Camera  # the photo's camera
    notes: dict[str, float | int | str]  # for the report: measured, filled or assumed values


def lift_depth_map(
    rgb: Tensor,
    depth: DepthMap,
    camera: Camera,
    levels: int = TILE_LEVELS,
    *,
    outline_growth_px: int = 0,
) -> LiftedPhoto:
    """Lift a photo and its depth map to Gaussians that look like the photo at the photo's camera.

    The map is smoothed within its noise, brought to the photo's size, its edges are moved to the
    photo's outlines and its gaps are filled. About one Gaussian for each pixel, or for each tile of
    similar pixels, then lies in the surface that the map describes.

    Args:
        rgb: [H, W, 3] sRGB in 0..1.
        depth: of any size with the photo's aspect ratio.
        camera: the photo's camera, at the world's origin.
        levels: number of tile sizes, from 2×2 pixels on. All pixels of a tile share one Gaussian;
            with 0, every pixel has its own.
        outline_growth_px: by how many of the photo's pixels near surfaces grow at depth steps, for
            a map whose outlines are guessed.

    Raises:
        InputError: no pixel has a depth.
    """
    rgb = rgb.detach().float().contiguous()
    z = depth.depth.detach().float()
    # The inverse of a smaller depth overflows. A network may put the sky at any distance.
    is_safe = torch.isfinite(z) & (z >= MIN_DEPTH_M)
    known = (depth.valid & is_safe).contiguous().numpy()  # [h, w]
    inverse_depth = np.zeros(known.shape, np.float32)
    np.divide(1, z.numpy(), out=inverse_depth, where=known)

    # The step between two values that the map can store, as a step of the inverse depth: for a map
    # that stores depth, |d(1/z)| = dz/z².
    stored_step = np.float32(depth.quantum or 0)
    step_ratio = np.ones_like(inverse_depth)
    if depth.quantity == "depth":
        step_ratio = inverse_depth**2
    quantization = stored_step * step_ratio
    inverse_depth = smooth_inverse_depth(inverse_depth, known, quantization)

    # Bring the map to the photo's size. There, each pixel is settled (has a depth), open (lies in a
    # depth edge, so that its side must be found), or a hole.
    rows, columns = known.shape
    fx, fy = camera.focal
    map_focal = (fx * columns / camera.width, fy * rows / camera.height)  # pixels of the map
    edges = find_edges(inverse_depth, known, map_focal)
    resampled = resample_map(inverse_depth, known, edges, camera.height, camera.width)
    if not (resampled.state == SETTLED).any():
        raise InputError(
            f"{depth.path}: no depth is left at {camera.width}×{camera.height}: give a denser map"
        )
    assigned = assign_open_pixels(resampled, rgb.numpy())  # [H, W]
    photo_inverse_depth = torch.from_numpy(grow_near_surfaces(assigned, outline_growth_px))
    # Outlines that have grown lie in the background: their pixels are no mixtures.
    gaussians = layered_gaussians(
        photo_inverse_depth, srgb_to_linear(rgb), camera, levels, unmix=outline_growth_px == 0
    )

    hole_share = float((resampled.state == HOLE).mean())
    notes: dict[str, float | int | str] = {"depth_filled": round(hole_share, 4)}
    if depth.depth.shape != photo_inverse_depth.shape:
        notes["depth_resampled_from"] = f"{columns}×{rows}"
    return LiftedPhoto(gaussians, camera, notes)
