"""Blend the Gaussians of a tile front to back in linear light.

A tile's pixels are stored in patches of sixteen, the size of a vector register. Functions for pixels have neither
branches nor calls: only then do loops over pixels run in vector registers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from spackle.render.project import RECORD, Arrays, Numbers, in_tile
from spackle.render.protocol import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_STOP
from spackle.runtime.kernels import MANTISSA_BITS, ONE, ZERO, Array, inlined_kernel, kernel

LIMIT = np.float32(ALPHA_MAX)
FAINT = np.float32(ALPHA_MIN)
LOWEST = np.float32(-60.0)
ROUND = np.float32(
    1.5 * 2.0**23
)  # this plus a small float has the rounded float as integer in its low bits
ROUND_BITS = np.int32(0x4B400000)
KNEE = np.float32(0.0031308)  # linear value at which sRGB changes from a line to a power
LINE = np.float32(12.92)


def _power_series(function: Any, low: float, high: float, degree: int) -> list[np.float32]:
    """Coefficients, lowest power first, of a near-minimax polynomial on low..high."""
    fit = Chebyshev.interpolate(function, degree, [low, high])
    return [np.float32(c) for c in fit.convert(kind=Polynomial).coef]


# 2^x on -½..½; error 1e-7.
E0, E1, E2, E3, E4, E5 = _power_series(np.exp2, -0.5, 0.5, 5)
# sRGB's power as a polynomial in t, with the fourth root of the linear value = MIDDLE + SPREAD·t; error 2e-7.
_root = float(KNEE) ** 0.25
MIDDLE, SPREAD = np.float32((1 + _root) / 2), np.float32((1 - _root) / 2)
S0, S1, S2, S3, S4, S5, S6, S7, S8 = _power_series(
    lambda t: 1.055 * ((1 + _root) / 2 + (1 - _root) / 2 * t) ** (5 / 3) - 0.055, -1.0, 1.0, 8
)
# The inverse power is y²·q^1.6, with q the fourth root of y; relative error of a few 1e-8.
ENCODED_KNEE = np.float32(0.04045)
_low_root = ((float(ENCODED_KNEE) + 0.055) / 1.055) ** 0.25
D0, D1, D2, D3, D4, D5 = _power_series(lambda q: q**1.6, _low_root, 1.0, 5)


@kernel
def exp2(x: np.float32) -> np.float32:
    """2^x for x in -60..60."""
    shifted = x + ROUND
    f = x - (shifted - ROUND)
    series = E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * E5))))
    exponent = (np.float32(shifted).view(np.int32) - ROUND_BITS) << MANTISSA_BITS
    return np.int32(np.float32(series).view(np.int32) + exponent).view(np.float32)


@kernel
def alpha_of(power: np.float32) -> np.float32:
    """Alpha = 2^power, clamped from above; 0 below the threshold."""
    alpha = min(exp2(max(power, LOWEST)), LIMIT)
    return alpha if alpha >= FAINT else ZERO


@kernel
def encode_srgb(linear: np.float32) -> np.float32:
    """Convert linear light to sRGB, both clamped to 0..1."""
    value = min(max(linear, ZERO), ONE)
    t = (np.sqrt(np.sqrt(value)) - MIDDLE) / SPREAD
    curve = S0 + t * (S1 + t * (S2 + t * (S3 + t * (S4 + t * (S5 + t * (S6 + t * (S7 + t * S8)))))))
    return LINE * value if value <= KNEE else min(curve, ONE)


@kernel
def decode_srgb(encoded: np.float32) -> np.float32:
    """Convert sRGB to linear light, both clamped to 0..1."""
    value = min(max(encoded, ZERO), ONE)
    y = (value + np.float32(0.055)) / np.float32(1.055)
    q = np.sqrt(np.sqrt(y))
    curve = y * y * (D0 + q * (D1 + q * (D2 + q * (D3 + q * (D4 + q * D5)))))
    return value / LINE if value <= ENCODED_KNEE else min(curve, ONE)


@kernel
def srgb_slope(linear: np.float32, encoded: np.float32) -> np.float32:
    """The derivative of `encode_srgb` at `linear`, given `encoded = encode_srgb(linear)`."""
    slope = LINE if linear <= KNEE else (encoded + np.float32(0.055)) / (np.float32(2.4) * linear)
    return slope if ZERO <= linear <= ONE else ZERO


# A tile's state is a flat buffer of six planes: light (the transmittance, 0 once a pixel is full), red, green, blue,
# depth, alpha. In one buffer, the compiler knows that planes do not overlap. Alpha is summed separately, because
# 1 - light would lose digits of a small alpha.
PLANE = TILE * TILE
STATE = 6 * PLANE

# A plane stores its patches of PATCH × PATCH pixels one after the other. A typical Gaussian touches fewer patches than
# rows of the tile.
PATCH = 4
PATCHES = TILE // PATCH  # number of patches along a tile's side
LANES = PATCH * PATCH

STOP = np.float32(TRANSMITTANCE_STOP)
SLACK = np.float32(1e-3)  # pixels, for rounding
SIDE = np.float32(TILE)
CHECK_EVERY = 16  # Gaussians per batch; after each batch, blending ends if the whole tile is full


class TileLists(NamedTuple):
    """The Gaussians of each tile, front to back once the tile has been drawn."""

    ids: Array  # [E] int32, all lists one after the other
    starts: Array  # [T + 1] int64, the start of each tile's list


@kernel
def blend_patch(
    state: Array, offset: np.uint64, left: np.float32, top: np.float32, splat: Numbers
) -> None:
    """Draw a Gaussian into the patch with the first pixel (left, top), relative to the tile."""
    x, y, slope, across, fall, peak, depth, red, green, blue = splat
    for lane in range(LANES):
        i = offset + np.uint64(lane)
        dy = np.float32(lane // PATCH) + top - y
        u = np.float32(lane % PATCH) + left - (x + slope * dy)
        alpha = alpha_of(peak - fall * dy * dy - across * u * u)
        light = state[i]
        after = light * (ONE - alpha)
        full = after <= STOP
        weight = ZERO if full else alpha * light
        state[i] = ZERO if full else after
        state[i + np.uint64(1 * PLANE)] += weight * red
        state[i + np.uint64(2 * PLANE)] += weight * green
        state[i + np.uint64(3 * PLANE)] += weight * blue
        state[i + np.uint64(4 * PLANE)] += weight * depth
        state[i + np.uint64(5 * PLANE)] += weight


@kernel
def span_of(center: np.float32, reach: np.float32) -> tuple[int, int]:
    """The range first..last (exclusive) of a tile's rows or columns that a Gaussian may touch."""
    # One is added before or after truncation to round up: ceil or floor would cost more than drawing a patch.
    first = int(max(center - reach - SLACK, -ONE) + ONE)
    last = min(int(min(center + reach + SLACK, SIDE)) + 1, TILE)
    return first, last


@kernel
def patches_of(center: np.float32, reach: np.float32) -> tuple[int, int]:
    """The range first..last (exclusive) of patches along one axis of a tile that a Gaussian may touch."""
    first, last = span_of(center, reach)
    return first // PATCH, (last + PATCH - 1) // PATCH


@inlined_kernel
def blend_splat(state: Array, record: Array, left: int, top: int) -> None:
    """Draw a Gaussian into the tile with the first pixel (left, top)."""
    x, y, slope, across, fall, peak, half_width, half_height, depth, red, green, blue = in_tile(
        record, left, top
    )
    splat = x, y, slope, across, fall, peak, depth, red, green, blue
    first_row, last_row = patches_of(y, half_height)
    first_column, last_column = patches_of(x, half_width)
    for row in range(first_row, last_row):
        for column in range(first_column, last_column):
            offset = np.uint64((row * PATCHES + column) * LANES)
            blend_patch(state, offset, np.float32(column * PATCH), np.float32(row * PATCH), splat)


@inlined_kernel
def pixel_index(row: int, column: int) -> int:
    """The index of a tile's pixel in a plane."""
    patch = row // PATCH * PATCHES + column // PATCH
    return patch * LANES + row % PATCH * PATCH + column % PATCH


@kernel
def blend_splats(state: Array, records: Array, count: int, left: int, top: int) -> None:
    """Draw the first `count` records into a tile; a separate function, so that constants stay in registers."""
    for index in range(count):
        blend_splat(state, records[index], left, top)


@kernel
def is_full(state: Array) -> bool:
    """Whether every pixel of the tile has reached the transmittance limit."""
    for i in range(PLANE):  # noqa: SIM110 (numba has no generators)
        if state[i] > ZERO:
            return False
    return True


@kernel
def store_tile(state: Array, left: int, top: int, images: Arrays) -> None:
    """Write a tile's colours, depth and alpha to the pixels inside the image."""
    rgb, depth, alpha, linear = images
    rows, columns = min(TILE, depth.shape[0] - top), min(TILE, depth.shape[1] - left)
    if len(linear) > 0:
        store_color(state, left, top, rows, columns, linear)
    for i in range(PLANE, 4 * PLANE):
        state[i] = encode_srgb(state[i])
    store_color(state, left, top, rows, columns, rgb)
    for row in range(rows):
        for column in range(columns):
            i = pixel_index(row, column)
            opacity = state[i + 5 * PLANE]
            alpha[top + row, left + column] = opacity
            depth[top + row, left + column] = (
                state[i + 4 * PLANE] / opacity if opacity > ZERO else ZERO
            )


@kernel
def store_color(state: Array, left: int, top: int, rows: int, columns: int, image: Array) -> None:
    """Write the three colour planes to an image [H, W, 3]."""
    for row in range(rows):
        for column in range(columns):
            for channel in range(3):
                image[top + row, left + column, channel] = state[
                    pixel_index(row, column) + (1 + channel) * PLANE
                ]


@kernel
def blend_tiles(
    first: int, last: int, tiles: Array, lists: TileLists, records: Array, images: Arrays
) -> None:
    """Draw the tiles first..last of `tiles` [K] into the images rgb, depth, alpha and (unless empty) linear colour."""
    ids, starts = lists
    columns = (images[1].shape[1] + TILE - 1) // TILE
    state, near = np.empty(STATE, np.float32), np.empty((CHECK_EVERY, RECORD), np.float32)
    for k in range(first, last):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        for i in range(STATE):
            state[i] = ONE if i < PLANE else ZERO
        end = starts[tile + 1]
        for begin in range(starts[tile], end, CHECK_EVERY):
            count = min(CHECK_EVERY, end - begin)
            fetch(records, ids, begin, count, near)
            blend_splats(state, near, count, left, top)
            if count == CHECK_EVERY and is_full(state):
                break
        store_tile(state, left, top, images)


@kernel
def fetch(records: Array, ids: Array, begin: int, count: int, near: Array) -> None:
    """Copy records, which are scattered in memory, to `near`; in this loop their cache misses overlap."""
    for n in range(count):
        record = records[ids[begin + n]]
        for field in range(RECORD):
            near[n, field] = record[field]
