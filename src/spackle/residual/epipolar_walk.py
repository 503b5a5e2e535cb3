"""Walk along epipolar lines from the cells of a hole to the hole's far rim, and read values at the rim."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle._numba import kernel
from spackle.camera import Camera
from spackle.device import run_chunks
from spackle.residual.view_features import CELL

SAME_DEPTH = 1.1  # a cell mirrored at the rim and the rim belong to one surface if inverse depths differ by less
SAME_EYE = 1e-9 * CELL  # a shorter offset between cell and epipole (homogeneous) has no direction


def walk(
    uv: Tensor, values: Tensor, inverse_depth: Tensor, mask: Tensor, camera: Camera, eye: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Walk from each masked cell in both directions along its epipolar line, and take the farther surface.

    Args:
        uv: [h, w, 2] pixels of the cells.
        values: [h, w, c] to read at the rim.
        inverse_depth: [h, w], positive.
        mask: [h, w] bool.
        camera: of the view.
        eye: [3] position of the other camera; its projection into the view is the epipole.

    Returns:
        Values [h, w, c] at the far rim; values [h, w, c] at the cell's mirror image beyond the rim, or at the rim if
        the mirror image lies on another surface; distance [h, w] to the rim in cells. Unmasked cells, and cells whose
        line meets no surface, have their own values and distance 0.
    """
    eye = eye.double()
    # Homogeneous, because the epipole may lie at infinity.
    epipole = (camera.K.to(eye) @ camera.to_camera(eye)).detach().cpu().numpy()
    view = [image.contiguous().numpy() for image in (uv, values, inverse_depth, mask)]
    grids = (view[1].copy(), view[1].copy(), np.zeros(mask.shape, np.float32))
    run_chunks(lambda start, stop: _walk(start, stop, *view, epipole, SAME_DEPTH, *grids), len(mask))
    far, mirrored, distance = map(torch.from_numpy, grids)
    return far, mirrored, distance


@kernel
def _walk(
    start: int, stop: int, uv: Any, rgb: Any, depths: Any, mask: Any, epipole: Any, same: float,
    found: Any, mirrored: Any, distance: Any,
) -> None:  # fmt: skip
    height, width = depths.shape
    for y in range(start, stop):
        for x in range(width):
            if not mask[y, x]:
                continue
            across, down = _line(epipole, uv[y, x, 0], uv[y, x, 1])
            best, steps, side = np.float32(np.inf), 0, 0.0
            for turn in (1.0, -1.0):
                k = _steps_to_rim(mask, y, x, turn * down, turn * across)
                if k == 0:
                    continue
                v, u = _cell(y, x, k * turn * down, k * turn * across)
                if depths[v, u] < best:
                    best, steps, side = depths[v, u], k, turn
            if steps == 0:
                continue
            dy, dx = side * down, side * across
            v, u = _cell(y, x, steps * dy, steps * dx)
            found[y, x], mirrored[y, x], distance[y, x] = rgb[v, u], rgb[v, u], steps
            q, p = _cell(y, x, 2 * steps * dy, 2 * steps * dx)
            if 0 <= q < height and 0 <= p < width and not mask[q, p]:
                ratio = depths[q, p] / best
                if ratio < same and ratio > 1.0 / same:
                    mirrored[y, x] = rgb[q, p]


@kernel
def _line(epipole: Any, u: float, v: float) -> Any:
    """The unit vector (x, y) along a pixel's epipolar line; (1, 0) if both camera positions coincide."""
    x, y = epipole[0] - epipole[2] * u, epipole[1] - epipole[2] * v
    length = np.sqrt(x * x + y * y)
    if length > SAME_EYE:
        return x / length, y / length
    return 1.0, 0.0


@kernel
def _steps_to_rim(mask: Any, y: int, x: int, dy: float, dx: float) -> int:
    """The number of steps of one cell to the first unmasked cell; 0 if the image ends before."""
    height, width = mask.shape
    k = 1
    while True:
        v, u = _cell(y, x, k * dy, k * dx)
        if v < 0 or u < 0 or v >= height or u >= width:
            return 0
        if not mask[v, u]:
            return k
        k += 1


@kernel
def _cell(y: int, x: int, dy: float, dx: float) -> Any:
    return int(np.floor(y + dy + 0.5)), int(np.floor(x + dx + 0.5))
