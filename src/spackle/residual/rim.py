"""What stands at a hole's far rim, along the line on which the hole opened."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle._numba import kernel
from spackle.camera import Camera
from spackle.residual.cues import CELL, GRAIN, Cues
from spackle.residual.seeds import Seeds
from spackle.threads import run_chunks

SAME_DEPTH = 1.1  # what is mirrored at the rim may differ from the rim in inverse depth by this factor
SAME_EYE = 1e-9 * CELL  # the epipole's part of a cell's offset from it, below which there is no line


@dataclasses.dataclass(frozen=True)
class Rim:
    """For each masked cell, what its line meets; elsewhere the cell itself."""

    rgb: Tensor  # [h, w, 3] sRGB at the far rim
    mirrored: Tensor  # [h, w, 3] sRGB as far beyond the rim as the cell is before it, if that is the same surface
    distance: Tensor  # [h, w] cells to the rim; 0 elsewhere

    @staticmethod
    def of(cues: Cues, seeds: Seeds, camera: Camera, photo_camera: Camera) -> Rim:
        """Walk from each masked cell to both sides along its epipolar line, and take the farther surface.

        What moves in front of what, moves along the lines through the epipole, where the view sees the
        photo's eye. So that line leads from a hole to the surface that goes on behind, and structure
        at the rim goes on along it more often than not.

        Args:
            cues: the view's cells.
            seeds: what fills them at first: it stays where no line meets anything.
            camera: the view.
            photo_camera: the camera of the photo.
        """
        fields = (seeds.uv, seeds.rgb, seeds.inverse_depth, cues.mask)
        uv, rgb, depths, mask = (image.detach().cpu().contiguous().numpy() for image in fields)
        epipole = _epipole(camera, photo_camera)
        found, mirrored, distance = rgb.copy(), rgb.copy(), np.zeros(mask.shape, np.float32)
        cells = (found, mirrored, distance)
        run_chunks(
            lambda start, stop: _walk(start, stop, uv, rgb, depths, mask, epipole, SAME_DEPTH, *cells), len(mask), GRAIN
        )
        return Rim(*(torch.from_numpy(image).to(seeds.rgb) for image in cells))


def _epipole(camera: Camera, photo_camera: Camera) -> Any:
    """[3] float64, homogeneous, for it may lie at infinity: where the view sees the photo's eye."""
    eye = photo_camera.position.double()
    return (camera.K.to(eye) @ camera.to_camera(eye)).detach().cpu().numpy()


@kernel
def _walk(
    start: int, stop: int, uv: Any, rgb: Any, depths: Any, mask: Any, epipole: Any, same: float,
    found: Any, mirrored: Any, distance: Any,
) -> None:  # fmt: skip
    """The masked cells of the rows start..stop."""
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
    """The unit vector x, y along a pixel's epipolar line; along the rows where both eyes are one."""
    x, y = epipole[0] - epipole[2] * u, epipole[1] - epipole[2] * v
    length = np.sqrt(x * x + y * y)
    if length > SAME_EYE:
        return x / length, y / length
    return 1.0, 0.0


@kernel
def _steps_to_rim(mask: Any, y: int, x: int, dy: float, dx: float) -> int:
    """Steps of one cell to the first that is not masked; 0 where the picture ends before."""
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
