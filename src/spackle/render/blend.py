"""Blend the Gaussians of a tile front to back in linear light.

A tile's pixels are stored in patches of sixteen, the size of a vector register. Functions for
pixels have neither branches nor calls that stay calls: only then do loops over pixels run in vector
registers.
"""

from __future__ import annotations

import numpy as np

from spackle.render.covariance import Numbers
from spackle.render.fast_math import MIN_EXPONENT, encode_srgb, exp2
from spackle.render.project import RECORD_FLOATS, Arrays, in_tile
from spackle.render.protocol import ALPHA_MAX, ALPHA_MIN, TILE_PX, TRANSMITTANCE_STOP
from spackle.render.tile_lists import TileLists
from spackle.runtime.kernels import ONE, ZERO, Array, inlined_kernel, kernel

# The renderer's rules in float32: a Python float would widen a whole expression to float64.
ALPHA_MAX_F32 = np.float32(ALPHA_MAX)
ALPHA_MIN_F32 = np.float32(ALPHA_MIN)
TRANSMITTANCE_STOP_F32 = np.float32(TRANSMITTANCE_STOP)

# A tile's state is a flat buffer of six planes: the transmittance (0 once a pixel is full), red,
# green, blue, depth, alpha. In one buffer, the compiler knows that planes do not overlap. Alpha is
# summed separately, because 1 - transmittance would lose digits of a small alpha.
PLANE_FLOATS = TILE_PX * TILE_PX
RED_PLANE, GREEN_PLANE, BLUE_PLANE, DEPTH_PLANE, ALPHA_PLANE = (
    np.uint64(k * PLANE_FLOATS) for k in range(1, 6)
)
TILE_STATE_FLOATS = 6 * PLANE_FLOATS

# A plane stores its patches of 4×4 pixels one after the other. A typical Gaussian touches fewer
# patches than rows of the tile.
PATCH_PX = 4  # a patch's side
PATCHES_PER_SIDE = TILE_PX // PATCH_PX
PATCH_PIXELS = PATCH_PX * PATCH_PX

ROUNDING_SLACK_PX = np.float32(1e-3)
TILE_PX_F32 = np.float32(TILE_PX)
GAUSSIANS_PER_CHECK = 16  # after so many, blending ends if the whole tile is full


@kernel
def alpha_from_log2(log2_alpha: np.float32) -> np.float32:
    """Alpha = 2^log2_alpha, at most 0.999; 0 if it is below 1/255, too faint to be drawn."""
    alpha = min(exp2(max(log2_alpha, MIN_EXPONENT)), ALPHA_MAX_F32)
    return alpha if alpha >= ALPHA_MIN_F32 else ZERO


@inlined_kernel
def weight_and_transmittance(
    alpha: np.float32, transmittance: np.float32
) -> tuple[np.float32, np.float32]:
    """The weight of a Gaussian's colour in a pixel, and the transmittance that is left behind it.

    Both are 0 if the pixel would be full (transmittance 1e-4 or less): the Gaussian is skipped, and
    so are all that follow.
    """
    after = transmittance * (ONE - alpha)
    full = after <= TRANSMITTANCE_STOP_F32
    weight = ZERO if full else alpha * transmittance
    return weight, ZERO if full else after


@kernel
def blend_tiles(
    first: int, last: int, tiles: Array, lists: TileLists, records: Array, images: Arrays
) -> None:
    """Draw some tiles of an image.

    Args:
        first, last: the tiles `tiles[first]` to `tiles[last - 1]` are drawn.
        tiles: [K] numbers of tiles, row by row.
        lists: the Gaussians of each tile, sorted front to back.
        records: [N, 12] float32: centre, ellipse, opacity, depth and colour of each Gaussian.
        images: rgb [H, W, 3] sRGB, depth [H, W], alpha [H, W] and linear colour [H, W, 3], whose
            pixels in these tiles are written. An empty linear colour is not written.
    """
    ids, starts = lists
    _, depth, _, _ = images
    columns = (depth.shape[1] + TILE_PX - 1) // TILE_PX  # of tiles
    state = np.empty(TILE_STATE_FLOATS, np.float32)
    next_records = np.empty((GAUSSIANS_PER_CHECK, RECORD_FLOATS), np.float32)
    for k in range(first, last):
        tile = tiles[k]
        left = (tile % columns) * TILE_PX
        top = (tile // columns) * TILE_PX

        # The first plane is the transmittance, which starts at 1; sums start at 0.
        for i in range(TILE_STATE_FLOATS):
            state[i] = ONE if i < PLANE_FLOATS else ZERO

        end = starts[tile + 1]
        for begin in range(starts[tile], end, GAUSSIANS_PER_CHECK):
            count = min(GAUSSIANS_PER_CHECK, end - begin)
            fetch_records(records, ids, begin, count, next_records)
            blend_splats(state, next_records, count, left, top)
            if count == GAUSSIANS_PER_CHECK and is_full(state):
                break
        store_tile(state, left, top, images)


@kernel
def fetch_records(records: Array, ids: Array, begin: int, count: int, next_records: Array) -> None:
    """Copy the records of the Gaussians ids[begin], …, ids[begin + count - 1] to `next_records`.

    `records` is [N, 12], `next_records` [16, 12]. Records are scattered in memory; in this loop,
    their cache misses overlap.
    """
    for n in range(count):
        record = records[ids[begin + n]]
        for field in range(RECORD_FLOATS):
            next_records[n, field] = record[field]


@kernel
def blend_splats(state: Array, records: Array, count: int, left: int, top: int) -> None:
    """Draw the Gaussians with the first `count` of `records` [16, 12] into a tile.

    `state` is the tile's buffer of colours and transmittances, changed in place, and (left, top) is
    the tile's first pixel in the image. This is a function of its own so that constants stay in
    registers.
    """
    for index in range(count):
        blend_splat(state, records[index], left, top)


@inlined_kernel
def blend_splat(state: Array, record: Array, left: int, top: int) -> None:
    """Draw a Gaussian into the patches of a tile that it may touch.

    A patch has 4×4 pixels; a tile has 4×4 patches.

    Args:
        state: the tile's flat buffer, six planes of 256 floats: transmittance, red, green, blue,
            depth, alpha. It is changed in place.
        record: [12] the Gaussian's centre (x, y), the shape of its ellipse (slope, across, fall),
            log2 of its opacity (peak), half sizes in pixels, depth and colour. At the offset
            (dx, dy) from the centre, log2 of alpha is peak - fall·dy² - across·(dx - slope·dy)².
        left, top: the tile's first pixel in the image.
    """
    x, y, slope, across, fall, peak, half_width, half_height, depth, red, green, blue = in_tile(
        record, left, top
    )
    splat = x, y, slope, across, fall, peak, depth, red, green, blue
    first_row, last_row = touched_patches(y, half_height)
    first_column, last_column = touched_patches(x, half_width)
    for row in range(first_row, last_row):
        for column in range(first_column, last_column):
            # A plane of the buffer holds the patches one after the other, row by row. The offset
            # is unsigned, so that no check for negative indices is compiled.
            offset = np.uint64((row * PATCHES_PER_SIDE + column) * PATCH_PIXELS)
            patch_left = np.float32(column * PATCH_PX)
            patch_top = np.float32(row * PATCH_PX)
            blend_patch(state, offset, patch_left, patch_top, splat)


@kernel
def blend_patch(
    state: Array, offset: np.uint64, left: np.float32, top: np.float32, splat: Numbers
) -> None:
    """Draw a Gaussian into a patch of 4×4 pixels.

    Args:
        state: the tile's flat buffer, changed in place: planes of transmittance, red, green, blue,
            depth and alpha, 256 floats each.
        offset: where the patch begins in each plane.
        left, top: the patch's first pixel, relative to the tile's.
        splat: the Gaussian's record, with the centre relative to the tile and without half sizes.
            At the offset (dx, dy) from the centre, log2 of alpha is peak - fall·dy² - across·u²
            with u = dx - slope·dy.
    """
    x, y, slope, across, fall, peak, depth, red, green, blue = splat
    for lane in range(PATCH_PIXELS):  # pixels row by row
        i = offset + np.uint64(lane)
        dy = np.float32(lane // PATCH_PX) + top - y
        u = np.float32(lane % PATCH_PX) + left - (x + slope * dy)
        alpha = alpha_from_log2(peak - fall * dy * dy - across * u * u)
        weight, after = weight_and_transmittance(alpha, state[i])
        state[i] = after
        state[i + RED_PLANE] += weight * red
        state[i + GREEN_PLANE] += weight * green
        state[i + BLUE_PLANE] += weight * blue
        state[i + DEPTH_PLANE] += weight * depth
        state[i + ALPHA_PLANE] += weight


@kernel
def touched_pixels(center: np.float32, half_size: np.float32) -> tuple[int, int]:
    """The range first..last (exclusive) of a tile's rows or columns that a Gaussian may touch.

    `center` and `half_size` are in pixels along this axis; 0 is the centre of the tile's first
    pixel.
    """
    # `int` cuts off the fraction. With one added, `first` is the next pixel after the lower bound,
    # and `last` (exclusive) is one more than the last pixel before the upper bound. Calls of ceil
    # and floor would cost more than drawing a patch.
    first = int(max(center - half_size - ROUNDING_SLACK_PX, -ONE) + ONE)
    last = min(int(min(center + half_size + ROUNDING_SLACK_PX, TILE_PX_F32)) + 1, TILE_PX)
    return first, last


@kernel
def touched_patches(center: np.float32, half_size: np.float32) -> tuple[int, int]:
    """The range first..last (exclusive) of a tile's patches that a Gaussian may touch on one axis.

    A patch has 4×4 pixels. `center` and `half_size` are in pixels along this axis; 0 is the centre
    of the tile's first pixel.
    """
    first, last = touched_pixels(center, half_size)
    last_rounded_up = (last + PATCH_PX - 1) // PATCH_PX
    return first // PATCH_PX, last_rounded_up


@kernel
def is_full(state: Array) -> bool:
    """Whether no pixel of the tile takes more light: the first plane, transmittance, is all 0."""
    for i in range(PLANE_FLOATS):  # noqa: SIM110 (numba has no generators)
        if state[i] > ZERO:
            return False
    return True


@kernel
def store_tile(state: Array, left: int, top: int, images: Arrays) -> None:
    """Write a tile's colours, depth and alpha to its pixels inside the image.

    Args:
        state: the tile's flat buffer, six planes of 256 floats: transmittance, red, green, blue,
            depth, alpha. Its colours are converted from linear light to sRGB in place.
        left, top: the tile's first pixel in the image.
        images: rgb [H, W, 3], depth [H, W], alpha [H, W] and linear colour [H, W, 3], which are
            written. An empty linear colour is not written.
    """
    rgb, depth, alpha, linear = images
    rows = min(TILE_PX, depth.shape[0] - top)
    columns = min(TILE_PX, depth.shape[1] - left)

    if len(linear) > 0:
        store_color(state, left, top, rows, columns, linear)
    for i in range(PLANE_FLOATS, 4 * PLANE_FLOATS):  # the planes of red, green and blue
        state[i] = encode_srgb(state[i])
    store_color(state, left, top, rows, columns, rgb)

    for row in range(rows):
        for column in range(columns):
            i = pixel_index(row, column)
            # Depths were summed with their weights, whose sum is alpha. The mean is stored.
            opacity = state[i + 5 * PLANE_FLOATS]
            depth_sum = state[i + 4 * PLANE_FLOATS]
            alpha[top + row, left + column] = opacity
            depth[top + row, left + column] = depth_sum / opacity if opacity > ZERO else ZERO


@kernel
def store_color(state: Array, left: int, top: int, rows: int, columns: int, image: Array) -> None:
    """Write a tile's colours to its pixels in an image [H, W, 3].

    Args:
        state: the tile's flat buffer, six planes of 256 floats: transmittance, red, green, blue,
            depth, alpha.
        left, top: the tile's first pixel in the image.
        rows, columns: of the tile, as far as they lie in the image.
        image: [H, W, 3], written here.
    """
    for row in range(rows):
        for column in range(columns):
            i = pixel_index(row, column)
            for channel in range(3):  # the planes of colours follow that of transmittances
                image[top + row, left + column, channel] = state[i + (1 + channel) * PLANE_FLOATS]


@inlined_kernel
def pixel_index(row: int, column: int) -> int:
    """The index of a tile's pixel in a plane, which stores patches of 4×4 pixels one by one."""
    patch = row // PATCH_PX * PATCHES_PER_SIDE + column // PATCH_PX
    return patch * PATCH_PIXELS + row % PATCH_PX * PATCH_PX + column % PATCH_PX
