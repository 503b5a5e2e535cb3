"""Stretch Gaussians along the world's axes, which converts SHARP's Gaussians to metres."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from spackle.core.gaussians import Gaussians
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

SWEEPS = 4  # the cosine between two columns is at worst 3e-3 after three sweeps, 1e-15 after four
UPRIGHT = 0.5  # if the squared sine of the angle between two columns is smaller, the shorter column is noise
BLOCK = 64  # number of Gaussians that the first-level cache holds
LEAST = 1e-300  # avoids 0/0, and is smaller than the square of any positive float32
GRAIN = 256 * BLOCK  # number of Gaussians that a thread takes at a time


def stretch_gaussians(gaussians: Gaussians, stretch: tuple[float, float, float]) -> Gaussians:
    """Map N Gaussians on the CPU by D = diag(stretch), which rotates and reshapes each Gaussian.

    A covariance R S² Rᵀ becomes M Mᵀ with M = D R S. Rotations from the right leave M Mᵀ unchanged and make M's columns
    orthogonal (one-sided Jacobi); then the columns' lengths are the new scales, and their directions are the new axes.
    The covariance itself is never formed, because squared scales would lose the small scales.

    The result has descending scales and unit quats with w ≥ 0; a zero quat counts as no rotation. Opacities and colors
    are the same tensors; means, quats and scales are detached from autograd.
    """
    means, quats, scales = (t.detach() for t in gaussians.tensors[:3])
    source = quats.contiguous().numpy(), scales.contiguous().numpy()
    result = np.empty((len(quats), 4), np.float32), np.empty((len(quats), 3), np.float32)
    factors = float(stretch[0]), float(stretch[1]), float(stretch[2])
    parallel_for_chunks(
        lambda start, stop: stretch_chunk(start, stop, *source, factors, *result), len(quats), GRAIN
    )
    turned, scaled = torch.from_numpy(result[0]), torch.from_numpy(result[1])
    return Gaussians(
        means * means.new_tensor(stretch), turned, scaled, gaussians.opacities, gaussians.colors
    )


@kernel
def stretch_chunk(
    start: int, stop: int, quats: Any, scales: Any, stretch: Any, new_quats: Any, new_scales: Any
) -> None:
    """Stretch Gaussians start..stop (quats [N, 4], scales [N, 3]) block by block in float64; fills the new arrays."""
    columns = np.zeros((9, BLOCK))
    for first in range(start, stop, BLOCK):
        count = min(BLOCK, stop - first)
        _load_block(first, count, quats, scales, stretch, columns)
        for _ in range(SWEEPS):
            _sweep_block(columns)
        _store_block(first, count, columns, new_quats, new_scales)


@kernel
def _load_block(
    first: int, count: int, quats: Any, scales: Any, stretch: Any, columns: Any
) -> None:
    """Write D R S to [9, BLOCK]: three rows for each column of the matrix."""
    sx, sy, sz = stretch
    for i in range(count):
        n = first + i
        w, x, y, z = (
            np.float64(quats[n, 0]),
            np.float64(quats[n, 1]),
            np.float64(quats[n, 2]),
            np.float64(quats[n, 3]),
        )
        two = 2.0 / max(
            w * w + x * x + y * y + z * z, 1e-24
        )  # 2/‖q‖² makes the rotation a unit one
        a, b, c = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
        columns[0, i] = sx * a * (1.0 - two * (y * y + z * z))
        columns[1, i] = sy * a * two * (x * y + w * z)
        columns[2, i] = sz * a * two * (x * z - w * y)
        columns[3, i] = sx * b * two * (x * y - w * z)
        columns[4, i] = sy * b * (1.0 - two * (x * x + z * z))
        columns[5, i] = sz * b * two * (y * z + w * x)
        columns[6, i] = sx * c * two * (x * z + w * y)
        columns[7, i] = sy * c * two * (y * z - w * x)
        columns[8, i] = sz * c * (1.0 - two * (x * x + y * y))


@kernel
def _sweep_block(columns: Any) -> None:
    """Rotate each pair of columns once for the whole block, without branches, so that the loop is vectorised."""
    for i in range(BLOCK):
        a, b, c = _column(columns, 0, i), _column(columns, 1, i), _column(columns, 2, i)
        a, b = _turn(a, b)
        a, c = _turn(a, c)
        b, c = _turn(b, c)
        columns[0, i], columns[1, i], columns[2, i] = a
        columns[3, i], columns[4, i], columns[5, i] = b
        columns[6, i], columns[7, i], columns[8, i] = c


@kernel
def _column(columns: Any, k: int, i: int) -> Any:
    return columns[3 * k, i], columns[3 * k + 1, i], columns[3 * k + 2, i]


@kernel
def _turn(p: Any, q: Any) -> Any:
    skew, lead = 2.0 * _dot(p, q), _dot(q, q) - _dot(p, p)
    tangent = skew / (abs(lead) + math.sqrt(lead * lead + skew * skew) + LEAST)
    tangent = -tangent if lead < 0.0 else tangent
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    turned = cosine * p[0] - sine * q[0], cosine * p[1] - sine * q[1], cosine * p[2] - sine * q[2]
    return turned, (
        sine * p[0] + cosine * q[0],
        sine * p[1] + cosine * q[1],
        sine * p[2] + cosine * q[2],
    )


@kernel
def _store_block(first: int, count: int, columns: Any, new_quats: Any, new_scales: Any) -> None:
    """Compute scales and rotations from orthogonal columns, longest first."""
    for i in range(count):
        n = first + i
        a, b, c = _column(columns, 0, i), _column(columns, 1, i), _column(columns, 2, i)
        la, lb, lc = math.sqrt(_dot(a, a)), math.sqrt(_dot(b, b)), math.sqrt(_dot(c, c))
        if la < lb:
            la, a, lb, b = lb, b, la, a
        if lb < lc:
            lb, b, lc, c = lc, c, lb, b
        if la < lb:
            la, a, lb, b = lb, b, la, a
        new_scales[n, 0], new_scales[n, 1], new_scales[n, 2] = la, lb, lc
        a = _scaled(a, 1.0 / la) if la > 0.0 else (1.0, 0.0, 0.0)
        b, c = _other_axes(a, _scaled(b, 1.0 / max(lb, LEAST)))
        new_quats[n, 0], new_quats[n, 1], new_quats[n, 2], new_quats[n, 3] = _quat_of_axes(a, b, c)


@kernel
def _other_axes(a: Any, b: Any) -> Any:
    """The second and third axis of a right-handed frame: b made orthogonal to a, or any axis if b is parallel to a."""
    c = _cross(a, b)
    if not _dot(c, c) > UPRIGHT:
        x, y, z = abs(a[0]), abs(a[1]), abs(a[2])
        if x <= y and x <= z:
            c = _cross(a, (1.0, 0.0, 0.0))
        else:
            c = _cross(a, (0.0, 1.0, 0.0) if y <= z else (0.0, 0.0, 1.0))
    c = _scaled(c, 1.0 / math.sqrt(_dot(c, c)))
    return _cross(c, a), c


@kernel
def _quat_of_axes(a: Any, b: Any, c: Any) -> Any:
    """`spackle.core.gaussians.quat_from_matrix` of a rotation's columns."""
    ww, xx = 1.0 + a[0] + b[1] + c[2], 1.0 + a[0] - b[1] - c[2]
    yy, zz = 1.0 - a[0] + b[1] - c[2], 1.0 - a[0] - b[1] + c[2]
    wx, wy, wz = b[2] - c[1], c[0] - a[2], a[1] - b[0]
    xy, xz, yz = b[0] + a[1], c[0] + a[2], c[1] + b[2]
    if ww >= max(xx, yy, zz):
        w, x, y, z = ww, wx, wy, wz
    elif xx >= max(yy, zz):
        w, x, y, z = wx, xx, xy, xz
    elif yy >= zz:
        w, x, y, z = wy, xy, yy, yz
    else:
        w, x, y, z = wz, xz, yz, zz
    unit = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    unit = -unit if w < 0.0 else unit
    return w * unit, x * unit, y * unit, z * unit


@kernel
def _dot(p: Any, q: Any) -> Any:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@kernel
def _cross(p: Any, q: Any) -> Any:
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@kernel
def _scaled(p: Any, factor: float) -> Any:
    return factor * p[0], factor * p[1], factor * p[2]
