"""Projection of Gaussians to the image: the arithmetic of a block of them in vector registers, then one by one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import inlined_kernel, kernel
from spackle.render.approx import ZERO, natural_log
from spackle.render.project import ACROSS, BLUE, DEPTH, FALL, GREEN, HALF_HEIGHT, HALF_WIDTH, PEAK, RED, SLOPE, X, Y
from spackle.render.protocol import ALPHA_MIN, NEAR_PLANE, TILE

Array = npt.NDArray[Any]
Numbers = Array | tuple[Any, ...]

# What is measured of a block of Gaussians is one flat buffer of planes, because the compiler then knows that they do
# not overlap: first the record's, then the box of tiles touched. All are float32, which holds a box exactly.
LEFT, RIGHT, TOP, BOTTOM = range(DEPTH + 1, DEPTH + 5)
BLOCK = 256  # Gaussians: the buffer stays in the first-level cache
BUFFER = (BOTTOM + 1) * BLOCK

ONCE, TWICE, THRICE = np.uint64(1), np.uint64(2), np.uint64(3)
LOG2_E = math.log2(math.e)
LOG_FAINT = math.log(ALPHA_MIN)
FINITE = 1e30  # larger values would overflow float32 further on


@kernel
def project_chunk(
    start: int,
    stop: int,
    first: int,
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    colors: Array,
    lens: Array,
    pose: Array,
    width: int,
    height: int,
    eps2d: float,
    wanted_before: Array,
    records: Array,
    boxes: Array,
    keys: Array,
    ids: Array,
) -> int:
    """Project Gaussians start..stop of one set, whose first one is number `first` of all.

    A Gaussian that touches no wanted tile counts as invisible; see `count_before`.

    Returns:
        How many are visible; their keys and ids lie from first + start on.
    """
    found = first + start
    block = np.empty(BUFFER, np.float32)
    for begin in range(start, stop, BLOCK):
        end = min(begin + BLOCK, stop)
        # Only of flat arrays does the compiler know how far apart a Gaussian's numbers lie.
        measure_block(
            block, means[begin:end].reshape(-1), quats[begin:end].reshape(-1), scales[begin:end].reshape(-1),
            opacities[begin:end], lens, pose, width, height, eps2d,
        )  # fmt: skip
        found = pack_block(
            block, colors[begin:end].reshape(-1), first + begin, found, wanted_before, records, boxes, keys, ids
        )
    return found - first - start


@kernel
def measure_block(
    block: Array,
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    lens: Array,
    pose: Array,
    width: int,
    height: int,
    eps2d: float,
) -> None:
    """Do the arithmetic of up to BLOCK Gaussians, whether or not they are visible, which their boxes tell.

    It is float64, which costs little here and keeps thin Gaussians exact; without a branch or a call, so that
    all of it runs in vector registers.

    Args:
        block: [BUFFER], the result; an invisible Gaussian's RIGHT is 0.
        means, quats, scales, opacities: flat arrays.
    """
    for k in range(len(opacities)):
        i, i3, i4 = np.uint64(k), np.uint64(3 * k), np.uint64(4 * k)
        px, py, pz = np.float64(means[i3]), np.float64(means[i3 + ONCE]), np.float64(means[i3 + TWICE])
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        nearness = 1.0 / z
        x, y = x * nearness, y * nearness
        quat = (quats[i4], quats[i4 + ONCE], quats[i4 + TWICE], quats[i4 + THRICE])
        scale = (scales[i3], scales[i3 + ONCE], scales[i3 + TWICE])
        cxx, cxy, cyy, det = covariance(x, y, nearness, quat, scale, lens, pose, eps2d)
        u, v = lens[0] * x + lens[2], lens[1] * y + lens[3]
        opacity = opacities[i]
        log_opacity = natural_log(opacity)
        reach = 2.0 * max(log_opacity - LOG_FAINT, 0.0) * (1.0 + 1e-5)
        half_width, half_height = math.sqrt(reach * cxx), math.sqrt(reach * cyy)
        narrow = 1.0 / cyy
        fall, across = 0.5 * LOG2_E * narrow, 0.5 * LOG2_E * cyy / det
        left, right = cover(u, half_width, width)
        top, bottom = cover(v, half_height, height)
        # Written so that NaN fails each test.
        sound = (z >= NEAR_PLANE) & (z < FINITE) & (opacity >= ALPHA_MIN) & (opacity < FINITE)
        sound &= (det > 0.0) & (det < FINITE) & (cxx < FINITE) & (cyy < FINITE)
        sound &= (across < FINITE) & (fall < FINITE)
        visible = sound & (left < right) & (top < bottom)
        block[i + np.uint64(X * BLOCK)] = u
        block[i + np.uint64(Y * BLOCK)] = v
        block[i + np.uint64(SLOPE * BLOCK)] = cxy * narrow
        block[i + np.uint64(ACROSS * BLOCK)] = across
        block[i + np.uint64(FALL * BLOCK)] = fall
        block[i + np.uint64(PEAK * BLOCK)] = log_opacity * LOG2_E
        block[i + np.uint64(HALF_WIDTH * BLOCK)] = half_width
        block[i + np.uint64(HALF_HEIGHT * BLOCK)] = half_height
        block[i + np.uint64(DEPTH * BLOCK)] = z
        block[i + np.uint64(LEFT * BLOCK)] = left // TILE
        block[i + np.uint64(RIGHT * BLOCK)] = np.float32((right + TILE - 1) // TILE) if visible else ZERO
        block[i + np.uint64(TOP * BLOCK)] = top // TILE
        block[i + np.uint64(BOTTOM * BLOCK)] = (bottom + TILE - 1) // TILE


@inlined_kernel
def covariance(
    x: float, y: float, nearness: float, quat: Numbers, scale: Numbers, lens: Array, pose: Array, eps2d: float
) -> tuple[float, float, float, float]:
    """The projected covariance (xx, xy, yy) and its determinant, of a Gaussian at (x, y, 1) / nearness.

    With M = J W R S, the covariance is M Mᵀ, and its determinant the squared cross product of M's rows
    (Cauchy–Binet), which does not cancel where a Gaussian is seen edge-on.
    """
    qw, qx, qy, qz = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    two = 2.0 / max(qw * qw + qx * qx + qy * qy + qz * qz, 1e-24)  # 2/‖q‖² makes the rotation a unit one
    # The Jacobian's two rows are (a, 0, b) and (0, c, d).
    a, c = lens[0] * nearness, lens[1] * nearness
    b, d = -a * min(lens[5], max(lens[4], x)), -c * min(lens[7], max(lens[6], y))
    h0, h1, h2 = a * pose[0, 0] + b * pose[2, 0], a * pose[0, 1] + b * pose[2, 1], a * pose[0, 2] + b * pose[2, 2]
    v0, v1, v2 = c * pose[1, 0] + d * pose[2, 0], c * pose[1, 1] + d * pose[2, 1], c * pose[1, 2] + d * pose[2, 2]
    r00, r01, r02 = 1 - two * (qy * qy + qz * qz), two * (qx * qy - qw * qz), two * (qx * qz + qw * qy)
    r10, r11, r12 = two * (qx * qy + qw * qz), 1 - two * (qx * qx + qz * qz), two * (qy * qz - qw * qx)
    r20, r21, r22 = two * (qx * qz - qw * qy), two * (qy * qz + qw * qx), 1 - two * (qx * qx + qy * qy)
    s0, s1, s2 = np.float64(scale[0]), np.float64(scale[1]), np.float64(scale[2])
    m0, n0 = s0 * (h0 * r00 + h1 * r10 + h2 * r20), s0 * (v0 * r00 + v1 * r10 + v2 * r20)
    m1, n1 = s1 * (h0 * r01 + h1 * r11 + h2 * r21), s1 * (v0 * r01 + v1 * r11 + v2 * r21)
    m2, n2 = s2 * (h0 * r02 + h1 * r12 + h2 * r22), s2 * (v0 * r02 + v1 * r12 + v2 * r22)
    cxx = m0 * m0 + m1 * m1 + m2 * m2
    cyy = n0 * n0 + n1 * n1 + n2 * n2
    cxy = m0 * n0 + m1 * n1 + m2 * n2
    k0, k1, k2 = m1 * n2 - m2 * n1, m2 * n0 - m0 * n2, m0 * n1 - m1 * n0
    det = k0 * k0 + k1 * k1 + k2 * k2 + eps2d * (cxx + cyy + eps2d)
    return cxx + eps2d, cxy, cyy + eps2d, det


@inlined_kernel
def cover(center: float, extent: float, size: int) -> tuple[np.int32, np.int32]:
    """The pixels first..last (exclusive) along one side of the image whose centres an extent may hold."""
    slack = 0.501  # half a pixel to its centre, and room for the blender's rounding
    # In this order NaN becomes 0, and every number one that an integer can hold.
    low = min(np.float64(size), max(0.0, center - extent - slack))
    high = min(np.float64(size), max(0.0, center + extent + slack))
    first = np.int32(low)
    return np.int32(first + np.int32(first < low)), np.int32(high)


@kernel
def pack_block(
    block: Array,
    colors: Array,
    first: int,
    found: int,
    wanted_before: Array,
    records: Array,
    boxes: Array,
    keys: Array,
    ids: Array,
) -> int:
    """Write the boxes of measured Gaussians first, first + 1, …, and what else there is of the visible ones.

    Returns:
        Where the next key belongs, `found` being where the first one does.
    """
    depth_bits = keys.view(np.float32)
    for k in range(len(colors) // 3):
        # Unsigned numbers need no look at whether they count from an array's end.
        i, i3, out, place = np.uint64(k), np.uint64(3 * k), np.uint64(first + k), np.uint64(found)
        right = np.uint32(block[i + np.uint64(RIGHT * BLOCK)])
        boxes[out, 0], boxes[out, 1] = 0, 0
        red, green, blue = colors[i3], colors[i3 + ONCE], colors[i3 + TWICE]
        light = abs(red) + abs(green) + abs(blue)
        if right == 0 or not light < FINITE:
            continue
        left, top = np.uint32(block[i + np.uint64(LEFT * BLOCK)]), np.uint32(block[i + np.uint64(TOP * BLOCK)])
        bottom = np.uint32(block[i + np.uint64(BOTTOM * BLOCK)])
        boxes[out, 0], boxes[out, 1], boxes[out, 2], boxes[out, 3] = left, right, top, bottom
        if not touches(left, right, top, bottom, wanted_before):
            continue
        record = records[out]
        for plane in range(DEPTH + 1):
            record[plane] = block[i + np.uint64(plane * BLOCK)]
        record[RED], record[GREEN], record[BLUE] = red, green, blue
        depth_bits[place] = record[DEPTH]
        ids[place] = out
        found += 1
    return found


@inlined_kernel
def touches(left: np.uint32, right: np.uint32, top: np.uint32, bottom: np.uint32, wanted_before: Array) -> bool:
    """Whether any tile of a box is wanted."""
    below = wanted_before[bottom, right] - wanted_before[bottom, left]
    return bool(below != wanted_before[top, right] - wanted_before[top, left])
