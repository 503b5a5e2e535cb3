"""The projection's twin: one Gaussian after the other, by matrices, in plain float64."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spackle.gaussians import Gaussians
from spackle.render.project import KernelCamera
from spackle.render.protocol import ALPHA_MIN, NEAR_PLANE, TILE

HUGE = 1e30
SLACK = 0.501  # pixels


@dataclass(frozen=True)
class Plain:
    """One visible Gaussian: its record without the unused last number, and the tiles that it touches."""

    record: list[float]
    box: tuple[int, int, int, int]


def project_plainly(gaussians: Gaussians, view: KernelCamera, wanted: np.ndarray) -> dict[int, Plain]:
    """The visible ones by their numbers."""
    found = {}
    with np.errstate(all="ignore"):
        for i in range(len(gaussians)):
            mean, quat, scale, opacity, color = (t[i].double().numpy() for t in gaussians.tensors)
            plain = _project(mean, quat, scale, float(opacity), color, view)
            if plain is not None:
                left, right, top, bottom = plain.box
                if wanted[top:bottom, left:right].any():
                    found[i] = plain
    return found


def _project(
    mean: np.ndarray, quat: np.ndarray, scale: np.ndarray, opacity: float, color: np.ndarray, view: KernelCamera
) -> Plain | None:
    fx, fy, cx, cy, left, right, top, bottom = view.lens
    x, y, z = view.pose[:, :3] @ mean + view.pose[:, 3]
    if not (NEAR_PLANE <= z < HUGE and ALPHA_MIN <= opacity < HUGE and np.abs(color).sum() < HUGE):
        return None
    tx, ty = np.clip(x / z, left, right), np.clip(y / z, top, bottom)
    jacobian = np.array([[fx, 0, -fx * tx], [0, fy, -fy * ty]]) / z
    factor = jacobian @ view.pose[:, :3] @ _rotation(quat) @ np.diag(scale)
    (cxx, cxy), (_, cyy) = factor @ factor.T + view.eps2d * np.eye(2)
    # As xx·yy - xy² the determinant of what is seen edge-on would lose all its digits.
    det = (np.cross(*factor) ** 2).sum() + view.eps2d * (cxx + cyy - view.eps2d)
    if not (0 < det < HUGE and cxx < HUGE and cyy < HUGE):
        return None
    across, fall = 0.5 * math.log2(math.e) * cyy / det, 0.5 * math.log2(math.e) / cyy
    if not (across < HUGE and fall < HUGE):
        return None
    u, v = fx * x / z + cx, fy * y / z + cy
    reach = 2 * max(math.log(opacity / ALPHA_MIN), 0) * (1 + 1e-5)
    half_width, half_height = math.sqrt(reach * cxx), math.sqrt(reach * cyy)
    columns, rows = _tiles(u, half_width, view.width), _tiles(v, half_height, view.height)
    if columns is None or rows is None:
        return None
    record = [u, v, cxy / cyy, across, fall, math.log2(opacity), half_width, half_height, z, *color]
    return Plain(record, (*columns, *rows))


def _rotation(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat / max(np.linalg.norm(quat), 1e-12)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _tiles(center: float, extent: float, size: int) -> tuple[int, int] | None:
    """The tiles along one side, from and to; None where there are none."""
    low, high = max(center - extent - SLACK, 0), min(center + extent + SLACK, size)
    if not low < size or not high > 0 or not math.ceil(low) < math.floor(high):
        return None
    return math.ceil(low) // TILE, -(-math.floor(high) // TILE)
