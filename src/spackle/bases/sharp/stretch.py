"""Stretch Gaussians along the world's axes, which converts SHARP's Gaussians to metres.

`stretch_gaussians` is the entry and states the method. The kernels below it process blocks of 64
Gaussians; a block is an array [9, 64], whose rows 0 to 2, 3 to 5 and 6 to 8 hold the columns of
64 matrices of 3 × 3.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from spackle.core.gaussians import Gaussians
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

# The cosine between two columns is at worst 3e-3 after three sweeps, 1e-15 after four.
JACOBI_SWEEPS = 4
# If the squared sine of the angle between two columns is smaller, the shorter column is noise.
MIN_SQUARED_SINE = 0.5
BLOCK_SIZE = 64  # number of Gaussians that the first-level cache holds
CHUNK_SIZE = 256 * BLOCK_SIZE  # number of Gaussians that a thread takes at a time
TINY = 1e-300  # avoids 0/0, and is smaller than the square of any positive float32
MIN_SQUARED_QUAT = 1e-24  # a shorter quaternion counts as no rotation


def stretch_gaussians(gaussians: Gaussians, stretch: tuple[float, float, float]) -> Gaussians:
    """Map N Gaussians on the CPU by D = diag(stretch), which rotates and reshapes each Gaussian.

    A covariance R S² Rᵀ becomes M Mᵀ with M = D R S. Rotations from the right leave M Mᵀ unchanged
    and make M's columns orthogonal (one-sided Jacobi); then the columns' lengths are the new
    scales, and their directions are the new axes. The covariance itself is never formed, because
    squared scales would lose the small scales.

    The result has descending scales and unit quaternions with w ≥ 0; a zero quaternion counts as no
    rotation. Opacities and colours are the same tensors; means, quaternions and scales are detached
    from autograd.
    """
    means = gaussians.means.detach()
    quats = gaussians.quats.detach().contiguous().numpy()
    scales = gaussians.scales.detach().contiguous().numpy()
    factors = (float(stretch[0]), float(stretch[1]), float(stretch[2]))
    new_quats = np.empty((len(quats), 4), np.float32)
    new_scales = np.empty((len(quats), 3), np.float32)

    # The kernel frees the GIL, so that threads compute at the same time.
    def stretch_range(start: int, stop: int) -> None:
        stretch_chunk(start, stop, quats, scales, factors, new_quats, new_scales)

    parallel_for_chunks(stretch_range, len(quats), CHUNK_SIZE)
    return Gaussians(
        means * means.new_tensor(stretch),
        torch.from_numpy(new_quats),
        torch.from_numpy(new_scales),
        gaussians.opacities,
        gaussians.colors,
    )


@kernel
def stretch_chunk(
    start: int, stop: int, quats: Any, scales: Any, stretch: Any, new_quats: Any, new_scales: Any
) -> None:
    """Stretch Gaussians start..stop by the factors `stretch` (x, y, z), block by block in float64.

    A stretched Gaussian has the covariance M Mᵀ, where M = stretch · rotation · scales (3 × 3). Its
    new rotation and scales come from the singular values of M, by the one-sided Jacobi method:
    rotations from the right make the columns of M orthogonal. Their directions are then the new
    axes, and their lengths the new scales.

    quats [N, 4] (w, x, y, z) and scales [N, 3] are read; rows start..stop of new_quats [N, 4] and
    new_scales [N, 3] are written.
    """
    block = np.zeros((9, BLOCK_SIZE))  # a matrix of 3 × 3 numbers for each Gaussian
    for first in range(start, stop, BLOCK_SIZE):
        count = min(BLOCK_SIZE, stop - first)
        _load_block(first, count, quats, scales, stretch, block)
        # Each sweep makes the columns of the matrices more orthogonal.
        for _ in range(JACOBI_SWEEPS):
            _orthogonalise_block(block)
        _store_block(first, count, block, new_quats, new_scales)


@kernel
def _load_block(first: int, count: int, quats: Any, scales: Any, stretch: Any, block: Any) -> None:
    """Write a matrix M = D R S for each of `count` Gaussians, from number `first` on, to `block`.

    D is the diagonal matrix of `stretch` (x, y, z), R the rotation of a quaternion (w, x, y, z) in
    quats [N, 4], of any length, and S the diagonal matrix of the scales [N, 3]. Gaussian i of the
    block gets column i of `block` [9, BLOCK_SIZE]: the three columns of M, one below the other.
    """
    stretch_x, stretch_y, stretch_z = stretch
    for i in range(count):
        n = first + i
        w = np.float64(quats[n, 0])
        x = np.float64(quats[n, 1])
        y = np.float64(quats[n, 2])
        z = np.float64(quats[n, 3])
        # 2/‖q‖² instead of 2 makes R the rotation of the unit quaternion.
        two = 2.0 / max(w * w + x * x + y * y + z * z, MIN_SQUARED_QUAT)
        # The scales along the Gaussian's three axes.
        a = np.float64(scales[n, 0])
        b = np.float64(scales[n, 1])
        c = np.float64(scales[n, 2])
        block[0, i] = stretch_x * a * (1.0 - two * (y * y + z * z))
        block[1, i] = stretch_y * a * two * (x * y + w * z)
        block[2, i] = stretch_z * a * two * (x * z - w * y)
        block[3, i] = stretch_x * b * two * (x * y - w * z)
        block[4, i] = stretch_y * b * (1.0 - two * (x * x + z * z))
        block[5, i] = stretch_z * b * two * (y * z + w * x)
        block[6, i] = stretch_x * c * two * (x * z + w * y)
        block[7, i] = stretch_y * c * two * (y * z - w * x)
        block[8, i] = stretch_z * c * (1.0 - two * (x * x + y * y))


@kernel
def _orthogonalise_block(block: Any) -> None:
    """Rotate each pair of columns of all matrices in `block` once, in place (a sweep).

    `block` [9, BLOCK_SIZE] holds matrix i in its column i: the three columns of the matrix, one
    below the other. After a rotation the two columns are orthogonal; the next rotation disturbs
    this a little. There are no branches, so that the compiler vectorises the loop.
    """
    for i in range(BLOCK_SIZE):
        a = _column(block, 0, i)
        b = _column(block, 1, i)
        c = _column(block, 2, i)
        a, b = _rotate_to_orthogonal(a, b)
        a, c = _rotate_to_orthogonal(a, c)
        b, c = _rotate_to_orthogonal(b, c)
        block[0, i], block[1, i], block[2, i] = a
        block[3, i], block[4, i], block[5, i] = b
        block[6, i], block[7, i], block[8, i] = c


@kernel
def _column(block: Any, k: int, i: int) -> Any:
    """Column k (0 to 2) of matrix i in `block` [9, BLOCK_SIZE], as three numbers."""
    return block[3 * k, i], block[3 * k + 1, i], block[3 * k + 2, i]


@kernel
def _rotate_to_orthogonal(p: Any, q: Any) -> Any:
    """Rotate the pair of vectors (p, q) into each other until they are orthogonal (Jacobi).

    The result is (cos·p - sin·q, sin·p + cos·q), with the angle of at most 45° for which
    tan(2·angle) = 2 p·q / (q·q - p·p).
    """
    twice_dot = 2.0 * _dot(p, q)
    difference = _dot(q, q) - _dot(p, p)
    hypotenuse = math.sqrt(difference * difference + twice_dot * twice_dot)
    # This form of the tangent loses no digits if the angle is small.
    tangent = twice_dot / (abs(difference) + hypotenuse + TINY)
    tangent = -tangent if difference < 0.0 else tangent
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    rotated_p = (
        cosine * p[0] - sine * q[0],
        cosine * p[1] - sine * q[1],
        cosine * p[2] - sine * q[2],
    )
    rotated_q = (
        sine * p[0] + cosine * q[0],
        sine * p[1] + cosine * q[1],
        sine * p[2] + cosine * q[2],
    )
    return rotated_p, rotated_q


@kernel
def _store_block(first: int, count: int, block: Any, new_quats: Any, new_scales: Any) -> None:
    """Write scales and rotations of matrices with orthogonal columns, the longest axis first.

    `block` [9, BLOCK_SIZE] holds the matrices of `count` Gaussians, matrix i in column i: the three
    columns of the matrix, one below the other. Rows first to first + count of new_quats [N, 4] and
    new_scales [N, 3] are written.
    """
    for i in range(count):
        a = _column(block, 0, i)
        b = _column(block, 1, i)
        c = _column(block, 2, i)
        length_a = math.sqrt(_dot(a, a))
        length_b = math.sqrt(_dot(b, b))
        length_c = math.sqrt(_dot(c, c))
        # Three exchanges sort the columns by length.
        if length_a < length_b:
            length_a, length_b = length_b, length_a
            a, b = b, a
        if length_b < length_c:
            length_b, length_c = length_c, length_b
            b, c = c, b
        if length_a < length_b:
            length_a, length_b = length_b, length_a
            a, b = b, a

        n = first + i
        new_scales[n, 0] = length_a
        new_scales[n, 1] = length_b
        new_scales[n, 2] = length_c
        # Scales are the columns' lengths, axes their directions. A Gaussian without any extent has
        # no directions, and gets the axes of the world.
        a = _scaled(a, 1.0 / length_a) if length_a > 0.0 else (1.0, 0.0, 0.0)
        b, c = _other_axes(a, _scaled(b, 1.0 / max(length_b, TINY)))
        w, x, y, z = _quat_of_axes(a, b, c)
        new_quats[n, 0] = w
        new_quats[n, 1] = x
        new_quats[n, 2] = y
        new_quats[n, 3] = z


@kernel
def _other_axes(a: Any, b: Any) -> Any:
    """The second and third axis of a right-handed frame whose first axis is the unit vector `a`.

    The second axis is the unit vector `b`, made orthogonal to `a`. The caller's axes are orthogonal
    but for rounding. So if b is zero, or far from orthogonal to `a`, its Gaussian is flat in this
    direction and rounding has decided where b points: then any orthogonal axis is as good.
    """
    # The squared length of the vector product of two unit vectors is the squared sine of their
    # angle: 1 if they are orthogonal. `not … >` is also true for NaN.
    c = _cross(a, b)
    if not _dot(c, c) > MIN_SQUARED_SINE:
        # The axis of the world that is most nearly at a right angle to a.
        x = abs(a[0])
        y = abs(a[1])
        z = abs(a[2])
        if x <= y and x <= z:
            c = _cross(a, (1.0, 0.0, 0.0))
        elif y <= z:
            c = _cross(a, (0.0, 1.0, 0.0))
        else:
            c = _cross(a, (0.0, 0.0, 1.0))
    c = _scaled(c, 1.0 / math.sqrt(_dot(c, c)))
    return _cross(c, a), c


@kernel
def _quat_of_axes(a: Any, b: Any, c: Any) -> Any:
    """The unit quaternion (w ≥ 0, x, y, z) of the rotation matrix with the columns a, b, c.

    With ww = 4 w², wx = 4 w x and so on, each row of (4 q qᵀ) is a multiple of q; the row with the
    largest diagonal entry is the most exact.
    """
    ww = 1.0 + a[0] + b[1] + c[2]
    xx = 1.0 + a[0] - b[1] - c[2]
    yy = 1.0 - a[0] + b[1] - c[2]
    zz = 1.0 - a[0] - b[1] + c[2]
    wx = b[2] - c[1]
    wy = c[0] - a[2]
    wz = a[1] - b[0]
    xy = b[0] + a[1]
    xz = c[0] + a[2]
    yz = c[1] + b[2]
    if ww >= max(xx, yy, zz):
        w, x, y, z = ww, wx, wy, wz
    elif xx >= max(yy, zz):
        w, x, y, z = wx, xx, xy, xz
    elif yy >= zz:
        w, x, y, z = wy, xy, yy, yz
    else:
        w, x, y, z = wz, xz, yz, zz

    # q and -q are the same rotation: w ≥ 0 makes it unique.
    factor = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    factor = -factor if w < 0.0 else factor
    return w * factor, x * factor, y * factor, z * factor


@kernel
def _dot(p: Any, q: Any) -> Any:
    """The scalar product of two vectors of three numbers."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@kernel
def _cross(p: Any, q: Any) -> Any:
    """The vector product of two vectors of three numbers."""
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@kernel
def _scaled(p: Any, factor: float) -> Any:
    """A vector of three numbers times a factor."""
    return factor * p[0], factor * p[1], factor * p[2]
