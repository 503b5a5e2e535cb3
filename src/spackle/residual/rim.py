"""What stands at a hole's far rim, along the line on which the hole opened."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle._numba import kernel
from spackle.camera import Camera
from spackle.residual.cues import CELL, Cues
from spackle.residual.seeds import Seeds

SAME_DEPTH = 1.1  # what is mirrored at the rim may differ from the rim in inverse depth by this factor


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
        direction = _epipolar(seeds.uv, camera, photo_camera).cpu().numpy()
        fields = (seeds.rgb, seeds.inverse_depth, cues.mask)
        arrays = (np.ascontiguousarray(t.detach().cpu().numpy()) for t in fields)
        return Rim(*(torch.from_numpy(a).to(seeds.rgb) for a in _walk(*arrays, direction, SAME_DEPTH)))


def _epipolar(uv: Tensor, camera: Camera, photo_camera: Camera) -> Tensor:
    """[h, w, 2] unit vectors along the epipolar lines; along the rows where both eyes are one."""
    eye = photo_camera.position.double()
    epipole = camera.K.double() @ camera.to_camera(eye)  # homogeneous: it may lie at infinity
    direction = epipole[:2] - epipole[2] * uv.double()
    length = direction.norm(dim=-1, keepdim=True)
    rows = torch.tensor([1.0, 0.0], dtype=torch.float64)
    return torch.where(length > 1e-9 * CELL, direction / length.clamp_min(1e-30), rows)


@kernel
def _walk(rgb: Any, depths: Any, mask: Any, direction: Any, same: float) -> Any:
    height, width = depths.shape
    found, mirrored = rgb.copy(), rgb.copy()
    distance = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if not mask[y, x]:
                continue
            best, steps, side = np.float32(np.inf), 0, 0.0
            for turn in (1.0, -1.0):
                k = _steps_to_rim(mask, y, x, turn * direction[y, x, 1], turn * direction[y, x, 0])
                if k == 0:
                    continue
                v, u = _cell(y, x, k * turn * direction[y, x, 1], k * turn * direction[y, x, 0])
                if depths[v, u] < best:
                    best, steps, side = depths[v, u], k, turn
            if steps == 0:
                continue
            dy, dx = side * direction[y, x, 1], side * direction[y, x, 0]
            v, u = _cell(y, x, steps * dy, steps * dx)
            found[y, x], mirrored[y, x], distance[y, x] = rgb[v, u], rgb[v, u], steps
            q, p = _cell(y, x, 2 * steps * dy, 2 * steps * dx)
            if 0 <= q < height and 0 <= p < width and not mask[q, p]:
                ratio = depths[q, p] / best
                if ratio < same and ratio > 1.0 / same:
                    mirrored[y, x] = rgb[q, p]
    return found, mirrored, distance


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
