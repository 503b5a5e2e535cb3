"""Projection of Gaussians to the image: one packed record, one tile box and one sort key each."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import kernel
from spackle.camera import Camera
from spackle.render.protocol import ALPHA_MIN, NEAR_PLANE, TILE

Array = npt.NDArray[Any]

# A record is what the blender needs, in two thirds of a cache line. Along a row of pixels at distance
# dy from the centre, a Gaussian's alpha is 2^(PEAK - FALL·dy² - ACROSS·(x - X - SLOPE·dy)²): no square
# of this form is ever negative, and each row's span can be read off it.
X, Y, SLOPE, ACROSS, FALL, PEAK, HALF_HEIGHT, DEPTH, RED, GREEN, BLUE = range(11)
RECORD = 12  # floats in a record, the last one unused

SPARE = 1 << 16  # Gaussians
LOG2_E = math.log2(math.e)
LOG_FAINT = math.log(ALPHA_MIN)
BLUR_CLAMP = 0.3  # how far beyond the border, in half-images, the projection is still linearised in place
FINITE = 1e30  # larger values would overflow float32 further on


@dataclasses.dataclass(frozen=True)
class View:
    """A camera as plain numbers."""

    lens: Array  # [8] float64: fx, fy, cx, cy and the bounds (left, right, top, bottom) of x/z and y/z
    pose: Array  # [3, 4] float64, world to camera
    width: int
    height: int
    eps2d: float

    @staticmethod
    def of(camera: Camera, eps2d: float) -> View:
        """Read a camera's matrices; the bounds are gsplat's."""
        K = camera.K.detach().double().cpu().numpy()
        pose = np.ascontiguousarray(camera.world_to_camera.detach().double().cpu().numpy()[:3])
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        slack_x, slack_y = BLUR_CLAMP * 0.5 * camera.width / fx, BLUR_CLAMP * 0.5 * camera.height / fy
        left, right = -cx / fx - slack_x, (camera.width - cx) / fx + slack_x
        top, bottom = -cy / fy - slack_y, (camera.height - cy) / fy + slack_y
        lens = np.array([fx, fy, cx, cy, left, right, top, bottom])
        return View(lens, pose, camera.width, camera.height, eps2d)

    def same_as(self, other: View) -> bool:
        """Whether both show the same."""
        return (
            (self.width, self.height, self.eps2d) == (other.width, other.height, other.eps2d)
            and np.array_equal(self.lens, other.lens)
            and np.array_equal(self.pose, other.pose)
        )

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-self.height // TILE), -(-self.width // TILE)


@dataclasses.dataclass(frozen=True)
class Splats:
    """Gaussians on the image plane, in the order in which they came."""

    records: Array  # [N, RECORD] float32
    boxes: Array  # [N, 4] uint16, the tiles touched: columns from, to, rows from, to (exclusive)
    keys: Array  # [N] uint32, the bits of the depth of visible Gaussians, packed to the front of each chunk
    ids: Array  # [N] int32, the Gaussians that the keys belong to

    @staticmethod
    def allocate(n: int) -> Splats:
        """Room for n Gaussians, and for some more that may come later; what is not written to takes no memory."""
        n += n // 4 + SPARE
        return Splats(
            np.empty((n, RECORD), np.float32),
            np.empty((n, 4), np.uint16),
            np.empty(n, np.uint32),
            np.empty(n, np.int32),
        )


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

    Arithmetic is float64, which costs nothing here and keeps thin Gaussians exact. A Gaussian that
    touches no wanted tile counts as invisible; see `count_before`.

    Returns:
        How many are visible; their keys and ids lie from first + start on.
    """
    found = first + start
    depth_bits = keys.view(np.float32)
    for i in range(start, stop):
        out = first + i
        boxes[out, 0] = 0
        boxes[out, 1] = 0
        px, py, pz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        opacity = np.float64(opacities[i])
        # Written so that NaN fails each test.
        if not (z >= NEAR_PLANE and z < FINITE and opacity >= ALPHA_MIN and opacity < FINITE):
            continue
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        nearness = 1.0 / z
        x, y = x * nearness, y * nearness
        cxx, cxy, cyy, det = covariance(x, y, nearness, quats[i], scales[i], lens, pose, eps2d)
        if not (det > 0.0 and det < FINITE and cxx < FINITE and cyy < FINITE):
            continue
        u, v = lens[0] * x + lens[2], lens[1] * y + lens[3]
        log_opacity = math.log(opacity)
        reach = 2.0 * max(log_opacity - LOG_FAINT, 0.0) * (1.0 + 1e-5)
        half_height = math.sqrt(reach * cyy)
        if not cover(u, v, math.sqrt(reach * cxx), half_height, width, height, boxes[out]):
            continue
        if not touches(boxes[out], wanted_before):
            continue
        narrow = 1.0 / cyy
        fall, across = 0.5 * LOG2_E * narrow, 0.5 * LOG2_E * cyy / det
        red, green, blue = colors[i, 0], colors[i, 1], colors[i, 2]
        light = abs(red) + abs(green) + abs(blue)
        if not (across < FINITE and fall < FINITE and light < FINITE):
            boxes[out, 1] = 0
            continue
        record = records[out]
        record[X], record[Y], record[DEPTH] = u, v, z
        record[SLOPE], record[ACROSS], record[FALL] = cxy * narrow, across, fall
        record[PEAK], record[HALF_HEIGHT] = log_opacity * LOG2_E, half_height
        record[RED], record[GREEN], record[BLUE] = red, green, blue
        depth_bits[found] = z
        ids[found] = out
        found += 1
    return found - first - start


@kernel
def covariance(
    x: float, y: float, nearness: float, quat: Array, scale: Array, lens: Array, pose: Array, eps2d: float
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


@kernel
def cover(u: float, v: float, half_width: float, half_height: float, width: int, height: int, box: Array) -> bool:
    """Write the tiles whose pixel centres an extent around (u, v) may hold; False where there are none."""
    slack = 0.501  # half a pixel to its centre, and room for the blender's rounding
    left, right = math.ceil(max(u - half_width - slack, 0.0)), math.floor(min(u + half_width + slack, width))
    top, bottom = math.ceil(max(v - half_height - slack, 0.0)), math.floor(min(v + half_height + slack, height))
    if not (left < right and top < bottom):
        return False
    box[0], box[1] = left // TILE, (right + TILE - 1) // TILE
    box[2], box[3] = top // TILE, (bottom + TILE - 1) // TILE
    return True


def count_before(wanted: Array) -> Array:
    """How many tiles are wanted above and to the left of each corner, [rows + 1, columns + 1] int32."""
    return np.pad(wanted.astype(np.int32).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))).astype(np.int32)


@kernel
def touches(box: Array, wanted_before: Array) -> bool:
    """Whether any tile of a box is wanted."""
    left, right, top, bottom = box[0], box[1], box[2], box[3]
    below = wanted_before[bottom, right] - wanted_before[bottom, left]
    return bool(below != wanted_before[top, right] - wanted_before[top, left])
