"""Project Gaussians to the image: each visible one gets a record for blending and a box of tiles.

The arithmetic runs on a block of Gaussians in vector registers; records are then written one by
one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from spackle.core.camera import Camera
from spackle.render.covariance import CX, CY, FX, FY, Numbers, projected_covariance
from spackle.render.fast_math import natural_log
from spackle.render.protocol import ALPHA_MIN, TILE_PX, tile_grid
from spackle.runtime.kernels import HALF, ZERO, Array, inlined_kernel, kernel

Arrays = tuple[Array, ...]

# A record has the numbers for blending a Gaussian. In the row of pixels at the distance dy from the
# centre (X, Y), its alpha is 2^(PEAK - FALL·dy² - ACROSS·(x - X - SLOPE·dy)²). Rounding cannot make
# this quadratic form negative.
X, Y, SLOPE, ACROSS, FALL, PEAK, HALF_WIDTH, HALF_HEIGHT, DEPTH, RED, GREEN, BLUE = range(12)
RECORD_FLOATS = 12

# Results for a block of Gaussians are planes of one flat float32 buffer: the fields of the record
# up to DEPTH, then the box of tiles. In one buffer, the compiler knows that planes do not overlap.
LEFT, RIGHT, TOP, BOTTOM = range(DEPTH + 1, DEPTH + 5)
BLOCK_GAUSSIANS = 256  # the buffer of a block fits into the first-level cache
BLOCK_BUFFER_FLOATS = (BOTTOM + 1) * BLOCK_GAUSSIANS

LOG2_E = math.log2(math.e)
LOG_ALPHA_MIN = math.log(ALPHA_MIN)
MAX_FINITE = 1e30  # larger values would later overflow float32
# As in gsplat: a centre farther outside, in half image sizes, is linearised at this distance.
BORDER_SLACK = 0.3
# Relative, for rounding: no pixel that blending would draw may be left out of the box.
EXTENT_SLACK = 1e-5
PIXEL_SLACK = 0.501  # half a pixel, and room for rounding in blending


class KernelCamera(NamedTuple):
    """A camera as plain numbers, for kernels."""

    lens: Array  # [8] float64: fx, fy, cx, cy and the bounds (left, right, top, bottom) of x/z, y/z
    pose: Array  # [3, 4] float64, world to camera
    width: int  # pixels
    height: int
    eps2d: float  # added to the diagonal of each projected covariance, in pixels²
    near: float  # Gaussians of smaller depth z are not drawn

    @staticmethod
    def of(camera: Camera, eps2d: float, near: float) -> KernelCamera:
        """Read a camera's matrices, and compute the bounds of x/z and y/z for the Jacobian.

        `near` is the depth of the near plane.
        """
        K = camera.K.detach().double().cpu().numpy()
        pose = np.ascontiguousarray(camera.world_to_camera.detach().double().cpu().numpy()[:3])
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]

        # The bounds are those of gsplat: of a frame of 1.3 times the image's size.
        slack_x = BORDER_SLACK * 0.5 * camera.width / fx
        slack_y = BORDER_SLACK * 0.5 * camera.height / fy
        left = -cx / fx - slack_x
        right = (camera.width - cx) / fx + slack_x
        top = -cy / fy - slack_y
        bottom = (camera.height - cy) / fy + slack_y
        lens = np.array([fx, fy, cx, cy, left, right, top, bottom])
        return KernelCamera(lens, pose, camera.width, camera.height, float(eps2d), near)

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles that cover the image."""
        return tile_grid(self.height, self.width)


class Splats(NamedTuple):
    """Projected Gaussians, in the order of the sets."""

    records: Array  # [N, 12] float32, see X, Y, …; not written for a Gaussian that is not drawn
    boxes: Array  # [N, 4] uint16, touched tiles: first column, last, first row, last (exclusive)


@inlined_kernel
def in_tile(record: Array, left: int, top: int) -> Numbers:
    """The 12 numbers of a Gaussian's record, with its centre relative to a tile.

    They are the centre (x, y), the shape of the ellipse (slope, across, fall), log2 of the opacity
    (peak), half sizes in pixels, depth and colour. At the offset (dx, dy) from the centre, log2 of
    alpha is peak - fall·dy² - across·(dx - slope·dy)². The centre is measured from the centre of
    the tile's first pixel, which is the image's pixel (left, top).
    """
    x = record[X] - np.float32(left) - HALF
    y = record[Y] - np.float32(top) - HALF
    return (
        x,
        y,
        record[SLOPE],
        record[ACROSS],
        record[FALL],
        record[PEAK],
        record[HALF_WIDTH],
        record[HALF_HEIGHT],
        record[DEPTH],
        record[RED],
        record[GREEN],
        record[BLUE],
    )


def count_drawn_tiles(drawn_tiles: Array) -> Array:
    """[rows + 1, columns + 1] int32: the summed-area table of `drawn_tiles` [rows, columns] bool.

    An element belongs to a corner between tiles: it is the number of drawn tiles that lie above and
    to the left of it. From the four corners of a box follows how many of its tiles are drawn.
    """
    # Nothing lies above the first row of corners, or to the left of the first column: zeros.
    sums = drawn_tiles.astype(np.int32).cumsum(axis=0).cumsum(axis=1)
    return np.pad(sums, ((1, 0), (1, 0))).astype(np.int32)


@kernel
def project_gaussians(
    start: int,
    stop: int,
    first_index: int,
    scene: Arrays,
    camera: KernelCamera,
    drawn_before: Array,
    splats: Splats,
) -> None:
    """Project the Gaussians start..stop of a set, and write their boxes and records.

    Args:
        start, stop: indices in the set.
        first_index: the index of the set's first Gaussian among those of all sets.
        scene: the set's arrays, float32: means [n, 3], quats [n, 4], scales [n, 3],
            opacities [n], colors [n, 3].
        camera: the view.
        drawn_before: [rows + 1, columns + 1] int32 counts of drawn tiles above and to the left.
            A Gaussian that touches no drawn tile gets no record.
        splats: of all sets; the rows first_index + start to first_index + stop are written.
    """
    means, quats, scales, opacities, colors = scene
    block = np.empty(BLOCK_BUFFER_FLOATS, np.float32)
    for begin in range(start, stop, BLOCK_GAUSSIANS):
        end = min(begin + BLOCK_GAUSSIANS, stop)
        # In flat arrays, a Gaussian's numbers have fixed distances that the compiler knows, which
        # makes the loop over the block faster.
        flat_means = means[begin:end].reshape(-1)
        flat_quats = quats[begin:end].reshape(-1)
        flat_scales = scales[begin:end].reshape(-1)
        flat_colors = colors[begin:end].reshape(-1)
        project_block(block, flat_means, flat_quats, flat_scales, opacities[begin:end], camera)
        write_records(block, flat_colors, first_index + begin, drawn_before, splats)


@kernel
def project_block(
    block: Array, means: Array, quats: Array, scales: Array, opacities: Array, camera: KernelCamera
) -> None:
    """Project n ≤ 256 Gaussians in float64, which keeps thin Gaussians exact.

    Args:
        block: [13·256] float32: 13 planes of 256 numbers, which are written here: the fields X to
            DEPTH of a record, and LEFT, RIGHT, TOP, BOTTOM of the box of tiles. RIGHT is 0 for an
            invisible Gaussian.
        means, quats, scales: flat [3·n], [4·n] (wxyz) and [3·n].
        opacities: [n].
        camera: the view.
    """
    lens = camera.lens
    pose = camera.pose
    for k in range(len(opacities)):
        # Unsigned indices, so that no check for negative ones is compiled.
        i = np.uint64(k)
        i3 = np.uint64(3 * k)
        i4 = np.uint64(4 * k)

        # The centre in the camera's frame, then divided by its depth.
        world_x = np.float64(means[i3])
        world_y = np.float64(means[i3 + np.uint64(1)])
        world_z = np.float64(means[i3 + np.uint64(2)])
        x = pose[0, 0] * world_x + pose[0, 1] * world_y + pose[0, 2] * world_z + pose[0, 3]
        y = pose[1, 0] * world_x + pose[1, 1] * world_y + pose[1, 2] * world_z + pose[1, 3]
        z = pose[2, 0] * world_x + pose[2, 1] * world_y + pose[2, 2] * world_z + pose[2, 3]
        inverse_z = 1.0 / z
        x_slope = x * inverse_z
        y_slope = y * inverse_z
        u = lens[FX] * x_slope + lens[CX]
        v = lens[FY] * y_slope + lens[CY]

        # The ellipse. At the offset (dx, dy) from the centre, log2 of alpha is
        # peak - fall·dy² - across·(dx - slope·dy)², with slope = cxy / cyy.
        quat = (
            quats[i4],
            quats[i4 + np.uint64(1)],
            quats[i4 + np.uint64(2)],
            quats[i4 + np.uint64(3)],
        )
        scale = (scales[i3], scales[i3 + np.uint64(1)], scales[i3 + np.uint64(2)])
        cxx, cxy, cyy, det = projected_covariance(
            x_slope, y_slope, inverse_z, quat, scale, lens, pose, camera.eps2d
        )
        inverse_cyy = 1.0 / cyy
        fall = 0.5 * LOG2_E * inverse_cyy
        across = 0.5 * LOG2_E * cyy / det

        # Alpha falls to ALPHA_MIN at this squared Mahalanobis distance from the centre.
        opacity = opacities[i]
        log_opacity = natural_log(opacity)
        squared_reach = 2.0 * max(log_opacity - LOG_ALPHA_MIN, 0.0) * (1.0 + EXTENT_SLACK)
        half_width = math.sqrt(squared_reach * cxx)
        half_height = math.sqrt(squared_reach * cyy)
        left, right = pixel_range(u, half_width, camera.width)
        top, bottom = pixel_range(v, half_height, camera.height)

        # An ellipse without area is invisible. All comparisons are false for NaN.
        drawable = (z >= camera.near) & (z < MAX_FINITE)
        drawable &= (opacity >= ALPHA_MIN) & (opacity < MAX_FINITE)
        drawable &= (det > 0.0) & (det < MAX_FINITE) & (cxx < MAX_FINITE) & (cyy < MAX_FINITE)
        drawable &= (across < MAX_FINITE) & (fall < MAX_FINITE)
        visible = drawable & (left < right) & (top < bottom)

        block[i + np.uint64(X * BLOCK_GAUSSIANS)] = u
        block[i + np.uint64(Y * BLOCK_GAUSSIANS)] = v
        block[i + np.uint64(SLOPE * BLOCK_GAUSSIANS)] = cxy * inverse_cyy
        block[i + np.uint64(ACROSS * BLOCK_GAUSSIANS)] = across
        block[i + np.uint64(FALL * BLOCK_GAUSSIANS)] = fall
        block[i + np.uint64(PEAK * BLOCK_GAUSSIANS)] = log_opacity * LOG2_E
        block[i + np.uint64(HALF_WIDTH * BLOCK_GAUSSIANS)] = half_width
        block[i + np.uint64(HALF_HEIGHT * BLOCK_GAUSSIANS)] = half_height
        block[i + np.uint64(DEPTH * BLOCK_GAUSSIANS)] = z
        block[i + np.uint64(LEFT * BLOCK_GAUSSIANS)] = left // TILE_PX
        block[i + np.uint64(RIGHT * BLOCK_GAUSSIANS)] = (
            np.float32((right + TILE_PX - 1) // TILE_PX) if visible else ZERO
        )
        block[i + np.uint64(TOP * BLOCK_GAUSSIANS)] = top // TILE_PX
        block[i + np.uint64(BOTTOM * BLOCK_GAUSSIANS)] = (bottom + TILE_PX - 1) // TILE_PX


@inlined_kernel
def pixel_range(center: float, extent: float, size: int) -> tuple[np.int32, np.int32]:
    """The pixels first..last (exclusive) along one axis whose centres may lie near `center`.

    "Near" means within `extent`; all three are in pixels, and `size` is the image's width or
    height. The range is empty if the position is NaN.
    """
    # The slack is half a pixel, from a pixel's border to its centre, and room for rounding. In this
    # order of min and max, NaN becomes 0, and all results fit into integers.
    low = min(np.float64(size), max(0.0, center - extent - PIXEL_SLACK))
    high = min(np.float64(size), max(0.0, center + extent + PIXEL_SLACK))

    # Round `low` up without a call of ceil, which would keep the loop out of vector registers.
    truncated = np.int32(low)
    first = np.int32(truncated + np.int32(truncated < low))
    return first, np.int32(high)


@kernel
def write_records(
    block: Array, colors: Array, first_index: int, drawn_before: Array, splats: Splats
) -> None:
    """Write the boxes of a block of n projected Gaussians, and records of those that are drawn.

    Args:
        block: [13·256] float32: 13 planes of 256 numbers, as `project_block` has filled them. The
            first nine are fields of a record, the last four a box: left, right, top and bottom.
        colors: flat [3·n] linear RGB. A Gaussian whose colour is not finite becomes invisible.
        first_index: the index of the block's first Gaussian in `splats`.
        drawn_before: [rows + 1, columns + 1] int32 counts of drawn tiles above and to the left.
        splats: the rows first_index to first_index + n are written. A box of zeros stands for an
            invisible Gaussian; a Gaussian whose box has no drawn tile gets no record.
    """
    records, boxes = splats
    for k in range(len(colors) // 3):
        # An empty box means that the Gaussian is invisible. This holds until a box is written
        # below. Indices are unsigned, so that no check for negative ones is compiled.
        i = np.uint64(k)
        i3 = np.uint64(3 * k)
        out = np.uint64(first_index + k)
        boxes[out, 0] = 0
        boxes[out, 1] = 0
        boxes[out, 2] = 0
        boxes[out, 3] = 0

        # A plane's numbers follow one another, so that plane p starts at p·256.
        right = np.uint32(block[i + np.uint64(RIGHT * BLOCK_GAUSSIANS)])
        red = colors[i3]
        green = colors[i3 + np.uint64(1)]
        blue = colors[i3 + np.uint64(2)]
        # The comparison is false for NaN.
        if right == 0 or not abs(red) + abs(green) + abs(blue) < MAX_FINITE:
            continue
        left = np.uint32(block[i + np.uint64(LEFT * BLOCK_GAUSSIANS)])
        top = np.uint32(block[i + np.uint64(TOP * BLOCK_GAUSSIANS)])
        bottom = np.uint32(block[i + np.uint64(BOTTOM * BLOCK_GAUSSIANS)])
        boxes[out, 0] = left
        boxes[out, 1] = right
        boxes[out, 2] = top
        boxes[out, 3] = bottom
        if not has_drawn_tile(left, right, top, bottom, drawn_before):
            continue

        record = records[out]
        for plane in range(DEPTH + 1):
            record[plane] = block[i + np.uint64(plane * BLOCK_GAUSSIANS)]
        record[RED] = red
        record[GREEN] = green
        record[BLUE] = blue


@inlined_kernel
def has_drawn_tile(
    left: np.uint32, right: np.uint32, top: np.uint32, bottom: np.uint32, drawn_before: Array
) -> bool:
    """Whether any tile of a box (columns left..right, rows top..bottom, exclusive) is drawn.

    `drawn_before`[r, c], of the shape [rows + 1, columns + 1], is the number of drawn tiles above
    row r and to the left of column c.
    """
    # The drawn tiles in the box's columns, counted from the image's top to the box's bottom, and to
    # the box's top. These numbers differ if a tile in between, which is one of the box, is drawn.
    above_bottom = drawn_before[bottom, right] - drawn_before[bottom, left]
    above_top = drawn_before[top, right] - drawn_before[top, left]
    return bool(above_bottom != above_top)
