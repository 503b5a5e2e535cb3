"""Blending of one tile: front to back, in linear light, a row of sixteen pixels at a time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Chebyshev, Polynomial

from spackle.render._numba import kernel
from spackle.render.project import (
    ACROSS,
    BLUE,
    DEPTH,
    FALL,
    GREEN,
    HALF_HEIGHT,
    PEAK,
    RED,
    SLOPE,
    X,
    Y,
)
from spackle.render.protocol import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_STOP

Array = npt.NDArray[Any]

# A tile's state is one flat buffer of five planes: transmittance, red, green, blue, depth. One buffer,
# because the compiler then knows that the planes do not overlap. Transmittance is negative once a pixel
# is full: its size stays, and every product with it stays below the stop.
PLANE = TILE * TILE
PLANES = 5
CHECK_EVERY = 16  # Gaussians between two looks at whether the whole tile is full

LIMIT = np.float32(ALPHA_MAX)
FAINT = np.float32(ALPHA_MIN)
FAINT_LOG2 = np.float32(math.log2(ALPHA_MIN) - 1e-3)  # a row that peaks below this cannot show
STOP = np.float32(TRANSMITTANCE_STOP)
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
SLACK = np.float32(1e-3)  # pixels; room for rounding
LOWEST = np.float32(-60.0)
ROUND = np.float32(1.5 * 2.0**23)  # adding this rounds a small float to an integer in its low bits
ROUND_BITS = np.int32(0x4B400000)
MANTISSA = np.int32(23)


def _power_series(function: Any, low: float, high: float, degree: int) -> list[np.float32]:
    """Coefficients of a near-minimax polynomial, lowest power first."""
    fit = Chebyshev.interpolate(function, degree, [low, high])
    return [np.float32(c) for c in fit.convert(kind=Polynomial).coef]


# 2^x on -½..½, to 1e-7.
E0, E1, E2, E3, E4, E5 = _power_series(np.exp2, -0.5, 0.5, 5)
# sRGB's power branch in t, where the fourth root of the linear value is MIDDLE + SPREAD·t, to 2e-7.
KNEE = np.float32(0.0031308)
LINEAR = np.float32(12.92)
_low = 0.0031308**0.25
MIDDLE, SPREAD = np.float32((1 + _low) / 2), np.float32((1 - _low) / 2)
S0, S1, S2, S3, S4, S5, S6, S7, S8 = _power_series(
    lambda t: 1.055 * ((1 + _low) / 2 + (1 - _low) / 2 * t) ** (5 / 3) - 0.055, -1.0, 1.0, 8
)


@kernel
def exp2(x: np.float32) -> np.float32:
    """2^x for x in -60..60, without a branch."""
    shifted = x + ROUND
    f = x - (shifted - ROUND)
    series = E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * E5))))
    exponent = (np.float32(shifted).view(np.int32) - ROUND_BITS) << MANTISSA
    return np.int32(np.float32(series).view(np.int32) + exponent).view(np.float32)


@kernel
def encode_srgb(linear: np.float32) -> np.float32:
    """Linear light to sRGB, both clamped to 0..1, without a branch."""
    value = min(max(linear, ZERO), ONE)
    t = (np.sqrt(np.sqrt(value)) - MIDDLE) / SPREAD
    curve = S0 + t * (S1 + t * (S2 + t * (S3 + t * (S4 + t * (S5 + t * (S6 + t * (S7 + t * S8)))))))
    return LINEAR * value if value <= KNEE else min(curve, ONE)


@kernel
def blend_row(
    state: Array,
    offset: np.uint64,
    peak: np.float32,
    across: np.float32,
    center: np.float32,
    red: np.float32,
    green: np.float32,
    blue: np.float32,
    depth: np.float32,
) -> None:
    """Draw one Gaussian into one row: alpha is 2^(peak - across·(x - center)²), x counted in the tile."""
    for x in range(TILE):
        t = offset + np.uint64(x)
        u = np.float32(x) - center
        alpha = min(exp2(max(peak - across * u * u, LOWEST)), LIMIT)
        alpha = alpha if alpha >= FAINT else ZERO
        light = state[t]
        after = light * (ONE - alpha)
        full = after <= STOP
        weight = ZERO if full else alpha * light
        state[t] = -abs(light) if full else after
        state[t + np.uint64(1 * PLANE)] += weight * red
        state[t + np.uint64(2 * PLANE)] += weight * green
        state[t + np.uint64(3 * PLANE)] += weight * blue
        state[t + np.uint64(4 * PLANE)] += weight * depth


@kernel
def blend_splat(state: Array, record: Array, left: int, top: int) -> None:
    """Draw one Gaussian into the tile whose first pixel is (left, top)."""
    x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
    first = max(math.ceil(max(y - record[HALF_HEIGHT], -ONE) - SLACK), 0)
    last = min(math.floor(min(y + record[HALF_HEIGHT], np.float32(TILE)) + SLACK), TILE - 1)
    for row in range(first, last + 1):
        dy = np.float32(row) - y
        peak = record[PEAK] - record[FALL] * dy * dy
        if peak < FAINT_LOG2:
            continue
        center = x + record[SLOPE] * dy
        offset = np.uint64(row * TILE)
        blend_row(state, offset, peak, record[ACROSS], center, record[RED], record[GREEN], record[BLUE], record[DEPTH])


@kernel
def is_full(state: Array) -> bool:
    """Whether no pixel of the tile takes more light."""
    most = state[0]
    for i in range(1, PLANE):
        most = max(most, state[i])
    return bool(most <= ZERO)


@kernel
def store_tile(state: Array, left: int, top: int, rgb: Array, depth: Array, alpha: Array) -> None:
    """Finish a tile's pixels and write those inside the image."""
    for i in range(PLANE, 4 * PLANE):
        state[i] = encode_srgb(state[i])
    for row in range(min(TILE, depth.shape[0] - top)):
        for column in range(min(TILE, depth.shape[1] - left)):
            i, y, x = row * TILE + column, top + row, left + column
            opacity = ONE - abs(state[i])
            alpha[y, x] = opacity
            depth[y, x] = state[i + 4 * PLANE] / opacity if opacity > ZERO else ZERO
            for channel in range(3):
                rgb[y, x, channel] = state[i + (1 + channel) * PLANE]


@kernel
def blend_tiles(
    first: int,
    last: int,
    tiles: Array,
    columns: int,
    ids: Array,
    starts: Array,
    records: Array,
    rgb: Array,
    depth: Array,
    alpha: Array,
) -> None:
    """Draw tiles first..last of the list `tiles` [K] into rgb [H, W, 3], depth and alpha [H, W]."""
    state = np.empty(PLANES * PLANE, np.float32)
    for k in range(first, last):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        state[:PLANE] = ONE
        state[PLANE:] = ZERO
        for entry in range(starts[tile], starts[tile + 1]):
            blend_splat(state, records[ids[entry]], left, top)
            if (entry - starts[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and is_full(state):
                break
        store_tile(state, left, top, rgb, depth, alpha)
