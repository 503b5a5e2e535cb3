"""Decide the depth of pixels in depth edges and in holes, along the outlines of the photo."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from spackle.core.hole_filling import fill_from_far_side
from spackle.lifting.edges import Floats
from spackle.lifting.resampling import HOLE, MIN_PLANE_RATIO, OPEN, ResampledMap
from spackle.runtime.kernels import inlined_kernel, kernel

# Costs of a path, in pixels of path length.
COLOR_CHANGE_COST = 35.0  # of a channel's change from 0 to 1, or of crossing a smeared edge
NEAR_START_COST = 300.0  # of filling a hole from a pixel that is much too near

DIAGONAL_STEP = 1.4142135  # length of a step to a diagonal neighbour


def assign_open_pixels(resampled: ResampledMap, rgb: Floats) -> Floats:
    """Give each open pixel, then each hole, the depth of the known pixel to which it belongs.

    An open pixel lies in a depth edge and belongs to one of its two sides. A pixel belongs to the
    known pixel to which its cheapest path leads. A path costs its length plus the change of colour
    along it, so that depth spreads within objects and stops at their outlines. In a smeared edge
    the change of the smeared depth adds to the cost, so that the paths from both sides meet in the
    middle of the edge if the photo shows no outline. The depth of each side is extended along its
    surface. In a hole, a start pixel nearer than the hole's far side costs extra, because most
    holes are background that is hidden from a second camera.

    Args:
        resampled: the depth map on the photo's grid.
        rgb: [H, W, 3] the photo, sRGB in 0..1.

    Returns:
        [H, W] inverse depth; settled pixels are unchanged.
    """
    inverse_depth = resampled.inverse_depth.copy()
    is_hole = resampled.state == HOLE
    width = inverse_depth.shape[1]
    for state in (OPEN, HOLE):
        pixels = np.flatnonzero(resampled.state == state)
        if len(pixels) == 0:
            continue
        # All pixels whose depth is known by now are starts of paths, at no cost. States are numbers
        # with HOLE < OPEN < SETTLED. So these are the settled pixels and, when holes are filled,
        # also the open ones, which were assigned before.
        path_cost = np.where(resampled.state > state, np.float32(0), np.float32(np.inf))
        path_start = np.arange(path_cost.size)
        far_inverse_depth = inverse_depth
        edge_height = resampled.edge_height
        if state == HOLE:
            # A hole has no smeared depths, so that only colours count.
            edge_height = np.full_like(edge_height, np.inf)
            # The inverse depth of a hole's far side. The function also fills other images, its
            # second argument; here there are none, so that it gets the depth again.
            far_side, _ = fill_from_far_side(
                torch.from_numpy(inverse_depth),
                torch.from_numpy(inverse_depth[None]),
                torch.from_numpy(~is_hole),
            )
            far_inverse_depth = far_side.numpy()
        _find_cheapest_paths(
            path_cost, path_start, inverse_depth, edge_height, far_inverse_depth, rgb, pixels
        )

        starts = path_start[pixels]
        assigned = inverse_depth.reshape(-1)[starts]
        if state == OPEN:
            # Extend the surface of the start to the pixel.
            slope_x, slope_y = resampled.slope
            offset_x = pixels % width - starts % width
            offset_y = pixels // width - starts // width
            change = slope_x.reshape(-1)[starts] * offset_x + slope_y.reshape(-1)[starts] * offset_y
            assigned = np.maximum(assigned + change, MIN_PLANE_RATIO * assigned)
        inverse_depth.reshape(-1)[pixels] = assigned
    return inverse_depth


@inlined_kernel
def _color_change(rgb: Any, y: int, x: int, v: int, u: int) -> Any:
    """Sum of the channels' differences between two pixels (y, x), (v, u) of a photo [H, W, 3]."""
    change = abs(rgb[y, x, 0] - rgb[v, u, 0]) + abs(rgb[y, x, 1] - rgb[v, u, 1])
    return change + abs(rgb[y, x, 2] - rgb[v, u, 2])


@kernel
def _find_cheapest_paths(
    cost: Any, start: Any, inverse_depth: Any, edge_height: Any, far: Any, rgb: Any, pixels: Any
) -> None:
    """Find the cheapest path from any start pixel to each of `pixels`.

    Sweeps go through the pixels from the first to the last and back, until nothing changes.

    Args:
        cost: [H, W] float32: the cost of the cheapest path, written here. At first it is 0 at start
            pixels, and infinite at all others.
        start: [H·W] int64: where the path of each pixel starts, as y·W + x, written here. At first
            each pixel is its own start.
        inverse_depth: [H, W] float32.
        edge_height: [H, W]: height, in inverse depth, of the smeared edge around a pixel. Climbing
            the whole edge costs as much as a channel's change from 0 to 1. Infinite in holes, where
            climbing costs nothing and a start that is too near costs extra.
        far: [H, W] inverse depth of a hole's far side.
        rgb: [H, W, 3] float32 sRGB.
        pixels: [n] the pixels to which paths are searched, as y·W + x, increasing.
    """
    height, width = inverse_depth.shape
    # A sweep through the pixels in their order tries the neighbours above and to the left (-1), a
    # sweep backwards those below and to the right (1). The sweep has updated them just before.
    direction = -1
    changed = True
    changed_before = True
    while changed or changed_before:
        changed_before = changed
        changed = False
        for i in range(len(pixels)):
            n = pixels[i if direction < 0 else len(pixels) - 1 - i]
            y = n // width
            x = n % width
            for k in range(4):  # the three pixels of the neighbouring row, and one beside
                v = y + direction if k < 3 else y
                u = x + k - 1 if k < 3 else x + direction
                if v < 0 or u < 0 or v >= height or u >= width or cost[v, u] == np.inf:
                    continue
                length = 1.0 if v == y or u == x else DIAGONAL_STEP
                climb = abs(inverse_depth[y, x] - inverse_depth[v, u]) / max(
                    edge_height[y, x], np.float32(1e-12)
                )
                color = _color_change(rgb, y, x, v, u)
                total = cost[v, u] + length + COLOR_CHANGE_COST * (color + climb)
                # A neighbour without cost is a start, and only in a hole is the edge infinite.
                if cost[v, u] == 0 and edge_height[y, x] == np.inf:
                    total += NEAR_START_COST * max(0.0, 1 - far[y, x] / inverse_depth[v, u])
                if np.float32(total) < cost[y, x]:
                    cost[y, x] = total
                    start[n] = start[v * width + u]
                    changed = True
        direction = -direction
