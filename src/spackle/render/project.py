"""Project Gaussians to the image: each visible Gaussian gets a record and a box of tiles.

The arithmetic runs on a block of Gaussians in vector registers; records are then written one by one.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from spackle.core.camera import Camera
from spackle.render.protocol import ALPHA_MIN, NEAR_PLANE, TILE, tile_grid
from spackle.runtime.kernels import HALF, MANTISSA_BITS, ZERO, Array, inlined_kernel, kernel

Numbers = Array | tuple[Any, ...]
Arrays = tuple[Array, ...]

# A record has the numbers for blending. In a row of pixels at distance dy from the centre, alpha is
# 2^(PEAK - FALL·dy² - ACROSS·(x - X - SLOPE·dy)²). Rounding cannot make this quadratic form negative.
X, Y, SLOPE, ACROSS, FALL, PEAK, HALF_WIDTH, HALF_HEIGHT, DEPTH, RED, GREEN, BLUE = range(12)
RECORD = 12  # floats in a record

BLUR_CLAMP = 0.3  # a centre farther outside, in half image sizes, is linearised at this distance from the border

# Results for a block of Gaussians are planes of one flat float32 buffer: fields of the record, then the box of tiles.
# In one buffer, the compiler knows that planes do not overlap.
LEFT, RIGHT, TOP, BOTTOM = range(DEPTH + 1, DEPTH + 5)
BLOCK = 256  # Gaussians; the buffer of a block fits into the first-level cache
BUFFER = (BOTTOM + 1) * BLOCK

ROOT_HALF_BITS = np.int32(0x3F3504F3)  # of the square root of a half
LN_2 = math.log(2.0)
# ln((1 + t) / (1 - t)) = 2t + 2t³/3 + 2t⁵/5 + …; for t² < 0.0295, omitted terms are below float64's last digit.
L3, L5, L7, L9, L11, L13, L15, L17, L19 = (2.0 / k for k in range(3, 20, 2))

ONCE, TWICE, THRICE = np.uint64(1), np.uint64(2), np.uint64(3)
LOG2_E = math.log2(math.e)
LOG_FAINT = math.log(ALPHA_MIN)
FINITE = 1e30  # larger values would later overflow float32


class KernelCamera(NamedTuple):
    """A camera as plain numbers."""

    lens: Array  # [8] float64: fx, fy, cx, cy and the bounds (left, right, top, bottom) of x/z and y/z
    pose: Array  # [3, 4] float64, world to camera
    width: int
    height: int
    eps2d: float

    @staticmethod
    def of(camera: Camera, eps2d: float) -> KernelCamera:
        """Read a camera's matrices; the bounds for the Jacobian are those of gsplat."""
        K = camera.K.detach().double().cpu().numpy()
        pose = np.ascontiguousarray(camera.world_to_camera.detach().double().cpu().numpy()[:3])
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        slack_x, slack_y = (
            BLUR_CLAMP * 0.5 * camera.width / fx,
            BLUR_CLAMP * 0.5 * camera.height / fy,
        )
        left, right = -cx / fx - slack_x, (camera.width - cx) / fx + slack_x
        top, bottom = -cy / fy - slack_y, (camera.height - cy) / fy + slack_y
        lens = np.array([fx, fy, cx, cy, left, right, top, bottom])
        return KernelCamera(lens, pose, camera.width, camera.height, float(eps2d))

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return tile_grid(self.height, self.width)


class Splats(NamedTuple):
    """Projected Gaussians, in the order of the sets."""

    records: Array  # [N, RECORD] float32
    boxes: Array  # [N, 4] uint16, touched tiles: first column, last, first row, last (exclusive)


@inlined_kernel
def in_tile(record: Array, left: int, top: int) -> Numbers:
    """A record's numbers, with (X, Y) relative to the centre of the tile's first pixel (left, top)."""
    x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
    shape = (
        x,
        y,
        record[SLOPE],
        record[ACROSS],
        record[FALL],
        record[PEAK],
        record[HALF_WIDTH],
        record[HALF_HEIGHT],
    )
    return *shape, record[DEPTH], record[RED], record[GREEN], record[BLUE]


def count_before(wanted: Array) -> Array:
    """[rows + 1, columns + 1] int32: the number of wanted tiles above and to the left of each corner."""
    return np.pad(wanted.astype(np.int32).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))).astype(
        np.int32
    )


@kernel
def project_chunk(
    start: int,
    stop: int,
    first: int,
    scene: Arrays,
    camera: KernelCamera,
    wanted_before: Array,
    splats: Splats,
) -> None:
    """Project the Gaussians start..stop of a set, whose first Gaussian has the index `first` among all sets.

    A Gaussian that touches no wanted tile gets no record.
    """
    means, quats, scales, opacities, colors = scene
    block = np.empty(BUFFER, np.float32)
    for begin in range(start, stop, BLOCK):
        end = min(begin + BLOCK, stop)
        # For flat arrays, the compiler knows the stride between a Gaussian's numbers.
        shapes = (
            means[begin:end].reshape(-1),
            quats[begin:end].reshape(-1),
            scales[begin:end].reshape(-1),
        )
        measure_block(block, *shapes, opacities[begin:end], camera)
        pack_block(block, colors[begin:end].reshape(-1), first + begin, wanted_before, splats)


@kernel
def measure_block(
    block: Array, means: Array, quats: Array, scales: Array, opacities: Array, camera: KernelCamera
) -> None:
    """Project up to BLOCK Gaussians, given as flat arrays, into `block` [BUFFER]; RIGHT is 0 for an invisible Gaussian.

    Float64 keeps thin Gaussians exact.
    """
    lens, pose = camera.lens, camera.pose
    for k in range(len(opacities)):
        i, i3, i4 = np.uint64(k), np.uint64(3 * k), np.uint64(4 * k)
        px, py, pz = (
            np.float64(means[i3]),
            np.float64(means[i3 + ONCE]),
            np.float64(means[i3 + TWICE]),
        )
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        nearness = 1.0 / z
        x, y = x * nearness, y * nearness
        quat = (quats[i4], quats[i4 + ONCE], quats[i4 + TWICE], quats[i4 + THRICE])
        scale = (scales[i3], scales[i3 + ONCE], scales[i3 + TWICE])
        cxx, cxy, cyy, det = covariance(x, y, nearness, quat, scale, camera)
        u, v = lens[0] * x + lens[2], lens[1] * y + lens[3]
        opacity = opacities[i]
        log_opacity = natural_log(opacity)
        reach = 2.0 * max(log_opacity - LOG_FAINT, 0.0) * (1.0 + 1e-5)
        half_width, half_height = math.sqrt(reach * cxx), math.sqrt(reach * cyy)
        narrow = 1.0 / cyy
        fall, across = 0.5 * LOG2_E * narrow, 0.5 * LOG2_E * cyy / det
        left, right = cover(u, half_width, camera.width)
        top, bottom = cover(v, half_height, camera.height)
        # All comparisons are false for NaN.
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
        block[i + np.uint64(RIGHT * BLOCK)] = (
            np.float32((right + TILE - 1) // TILE) if visible else ZERO
        )
        block[i + np.uint64(TOP * BLOCK)] = top // TILE
        block[i + np.uint64(BOTTOM * BLOCK)] = (bottom + TILE - 1) // TILE


@inlined_kernel
def covariance(
    x: float, y: float, nearness: float, quat: Numbers, scale: Numbers, camera: KernelCamera
) -> Numbers:
    """The projected covariance (xx, xy, yy) and its determinant, for a Gaussian at (x, y, 1) / nearness."""
    return spread(
        factor(jacobian(x, y, nearness, camera.lens), camera.pose, rotation(quat), scale),
        camera.eps2d,
    )


@inlined_kernel
def jacobian(x: float, y: float, nearness: float, lens: Array) -> Numbers:
    """The projection's Jacobian [[a, 0, b], [0, c, d]] at (x, y, 1) / nearness, as (a, b, c, d)."""
    a, c = lens[0] * nearness, lens[1] * nearness
    return a, -a * min(lens[5], max(lens[4], x)), c, -c * min(lens[7], max(lens[6], y))


@inlined_kernel
def rotation(quat: Numbers) -> Numbers:
    """The rotation matrix R, row by row, of a quaternion (wxyz) of any length."""
    qw, qx, qy, qz = (
        np.float64(quat[0]),
        np.float64(quat[1]),
        np.float64(quat[2]),
        np.float64(quat[3]),
    )
    two = 2.0 / max(
        qw * qw + qx * qx + qy * qy + qz * qz, 1e-24
    )  # 2/‖q‖² normalises the quaternion
    r00, r01, r02 = (
        1 - two * (qy * qy + qz * qz),
        two * (qx * qy - qw * qz),
        two * (qx * qz + qw * qy),
    )
    r10, r11, r12 = (
        two * (qx * qy + qw * qz),
        1 - two * (qx * qx + qz * qz),
        two * (qy * qz - qw * qx),
    )
    r20, r21, r22 = (
        two * (qx * qz - qw * qy),
        two * (qy * qz + qw * qx),
        1 - two * (qx * qx + qy * qy),
    )
    return r00, r01, r02, r10, r11, r12, r20, r21, r22


@inlined_kernel
def factor(j: Numbers, pose: Array, r: Numbers, scale: Numbers) -> Numbers:
    """The two rows of M = J W R S; the projected covariance is M Mᵀ."""
    a, b, c, d = j
    h0, h1, h2 = (
        a * pose[0, 0] + b * pose[2, 0],
        a * pose[0, 1] + b * pose[2, 1],
        a * pose[0, 2] + b * pose[2, 2],
    )
    v0, v1, v2 = (
        c * pose[1, 0] + d * pose[2, 0],
        c * pose[1, 1] + d * pose[2, 1],
        c * pose[1, 2] + d * pose[2, 2],
    )
    s0, s1, s2 = np.float64(scale[0]), np.float64(scale[1]), np.float64(scale[2])
    m0, n0 = s0 * (h0 * r[0] + h1 * r[3] + h2 * r[6]), s0 * (v0 * r[0] + v1 * r[3] + v2 * r[6])
    m1, n1 = s1 * (h0 * r[1] + h1 * r[4] + h2 * r[7]), s1 * (v0 * r[1] + v1 * r[4] + v2 * r[7])
    m2, n2 = s2 * (h0 * r[2] + h1 * r[5] + h2 * r[8]), s2 * (v0 * r[2] + v1 * r[5] + v2 * r[8])
    return m0, m1, m2, n0, n1, n2


@inlined_kernel
def spread(m: Numbers, eps2d: float) -> Numbers:
    """The covariance M Mᵀ + eps2d·I as (xx, xy, yy), and its determinant.

    The determinant of M Mᵀ is the squared cross product of M's rows (Cauchy–Binet), exact also for a Gaussian seen
    edge-on.
    """
    m0, m1, m2, n0, n1, n2 = m
    cxx = m0 * m0 + m1 * m1 + m2 * m2
    cyy = n0 * n0 + n1 * n1 + n2 * n2
    cxy = m0 * n0 + m1 * n1 + m2 * n2
    k0, k1, k2 = m1 * n2 - m2 * n1, m2 * n0 - m0 * n2, m0 * n1 - m1 * n0
    det = k0 * k0 + k1 * k1 + k2 * k2 + eps2d * (cxx + cyy + eps2d)
    return cxx + eps2d, cxy, cyy + eps2d, det


@inlined_kernel
def cover(center: float, extent: float, size: int) -> tuple[np.int32, np.int32]:
    """The pixels first..last (exclusive) along one axis whose centres may lie within `extent` of `center`."""
    slack = 0.501  # half a pixel, and room for rounding in blending
    # In this order of min and max, NaN becomes 0, and all results fit into integers.
    low = min(np.float64(size), max(0.0, center - extent - slack))
    high = min(np.float64(size), max(0.0, center + extent + slack))
    first = np.int32(low)
    return np.int32(first + np.int32(first < low)), np.int32(high)


@kernel
def pack_block(
    block: Array, colors: Array, first: int, wanted_before: Array, splats: Splats
) -> None:
    """Write boxes of the projected Gaussians `first`, `first` + 1, …, and records of those that touch wanted tiles."""
    records, boxes = splats
    for k in range(len(colors) // 3):
        i, i3, out = np.uint64(k), np.uint64(3 * k), np.uint64(first + k)
        right = np.uint32(block[i + np.uint64(RIGHT * BLOCK)])
        boxes[out, 0], boxes[out, 1], boxes[out, 2], boxes[out, 3] = 0, 0, 0, 0
        red, green, blue = colors[i3], colors[i3 + ONCE], colors[i3 + TWICE]
        light = abs(red) + abs(green) + abs(blue)
        if right == 0 or not light < FINITE:
            continue
        left, top = (
            np.uint32(block[i + np.uint64(LEFT * BLOCK)]),
            np.uint32(block[i + np.uint64(TOP * BLOCK)]),
        )
        bottom = np.uint32(block[i + np.uint64(BOTTOM * BLOCK)])
        boxes[out, 0], boxes[out, 1], boxes[out, 2], boxes[out, 3] = left, right, top, bottom
        if not touches(left, right, top, bottom, wanted_before):
            continue
        record = records[out]
        for plane in range(DEPTH + 1):
            record[plane] = block[i + np.uint64(plane * BLOCK)]
        record[RED], record[GREEN], record[BLUE] = red, green, blue


@inlined_kernel
def touches(
    left: np.uint32, right: np.uint32, top: np.uint32, bottom: np.uint32, wanted_before: Array
) -> bool:
    """Whether any tile of a box is wanted."""
    below = wanted_before[bottom, right] - wanted_before[bottom, left]
    return bool(below != wanted_before[top, right] - wanted_before[top, left])


@inlined_kernel
def natural_log(x: np.float32) -> float:
    """The logarithm of a positive number, accurate to the last digits of float64."""
    bits = np.float32(x).view(np.int32)
    exponent = (bits - ROOT_HALF_BITS) >> MANTISSA_BITS
    m = np.float64(
        np.int32(bits - (exponent << MANTISSA_BITS)).view(np.float32)
    )  # from sqrt(1/2) to sqrt(2)
    t = (m - 1.0) / (m + 1.0)
    s = t * t
    series = L3 + s * (
        L5 + s * (L7 + s * (L9 + s * (L11 + s * (L13 + s * (L15 + s * (L17 + s * L19))))))
    )
    return np.float64(exponent) * LN_2 + (2.0 * t + t * s * series)
