"""Blending of a tile: front to back, in linear light, a row of sixteen pixels at a time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import kernel
from spackle.render.approx import HALF, ONE, ZERO, alpha_of, encode_srgb
from spackle.render.project import ACROSS, BLUE, DEPTH, FALL, GREEN, HALF_HEIGHT, PEAK, RECORD, RED, SLOPE, X, Y
from spackle.render.protocol import ALPHA_MIN, TILE, TRANSMITTANCE_STOP

Array = npt.NDArray[Any]

# A tile's state is one flat buffer of six planes: light (the transmittance, 0 once a pixel is full), red,
# green, blue, depth, alpha. One buffer, because the compiler then knows that the planes do not overlap.
# Alpha has a sum of its own: as 1 - light a faint one would lose digits, and depth, its quotient, too.
PLANE = TILE * TILE
STATE = 6 * PLANE
CHECK_EVERY = 16  # Gaussians that are fetched at once, and between two looks at whether the whole tile is full

STOP = np.float32(TRANSMITTANCE_STOP)
INVISIBLE = np.float32(math.log2(ALPHA_MIN) - 1e-3)  # a row that peaks below this shows nothing
SLACK = np.float32(1e-3)  # pixels; room for rounding
SIDE = np.float32(TILE)


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
        i = offset + np.uint64(x)
        u = np.float32(x) - center
        alpha = alpha_of(peak - across * u * u)
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
def rows_of(y: np.float32, half_height: np.float32) -> tuple[int, int]:
    """The tile's rows first..last (exclusive) that a Gaussian may reach, its centre `y` counted in the tile."""
    # Truncation rounds up where one is added; a call to ceil or floor would cost more than a row.
    first = int(max(y - half_height - SLACK, -ONE) + ONE)
    last = min(int(min(y + half_height + SLACK, SIDE)) + 1, TILE)
    return first, last


@kernel
def blend_splat(state: Array, records: Array, index: int, left: int, top: int) -> None:
    """Draw one Gaussian into the tile whose first pixel is (left, top)."""
    record = records[index]
    x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
    first, last = rows_of(y, record[HALF_HEIGHT])
    for row in range(first, last):
        dy = np.float32(row) - y
        peak = record[PEAK] - record[FALL] * dy * dy
        if peak < INVISIBLE:
            continue
        center = x + record[SLOPE] * dy
        offset = np.uint64(row * TILE)
        blend_row(state, offset, peak, record[ACROSS], center, record[RED], record[GREEN], record[BLUE], record[DEPTH])


@kernel
def is_full(state: Array) -> bool:
    """Whether no pixel of the tile takes more light."""
    for i in range(PLANE):  # noqa: SIM110 (numba has no generators)
        if state[i] > ZERO:
            return False
    return True


@kernel
def store_tile(state: Array, left: int, top: int, rgb: Array, depth: Array, alpha: Array, linear: Array) -> None:
    """Finish a tile's pixels and write those inside the image; `linear` may be empty."""
    rows, columns = min(TILE, depth.shape[0] - top), min(TILE, depth.shape[1] - left)
    if len(linear) > 0:
        store_color(state, left, top, rows, columns, linear)
    for i in range(PLANE, 4 * PLANE):
        state[i] = encode_srgb(state[i])
    store_color(state, left, top, rows, columns, rgb)
    for row in range(rows):
        for column in range(columns):
            i = row * TILE + column
            opacity = state[i + 5 * PLANE]
            alpha[top + row, left + column] = opacity
            depth[top + row, left + column] = state[i + 4 * PLANE] / opacity if opacity > ZERO else ZERO


@kernel
def store_color(state: Array, left: int, top: int, rows: int, columns: int, image: Array) -> None:
    """Write the three planes of colour to an image [H, W, 3]."""
    for row in range(rows):
        for column in range(columns):
            for channel in range(3):
                image[top + row, left + column, channel] = state[row * TILE + column + (1 + channel) * PLANE]


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
    linear: Array,
) -> None:
    """Draw tiles first..last of the list `tiles` [K] into rgb [H, W, 3], depth and alpha [H, W].

    The colour before sRGB goes to `linear` [H, W, 3], unless that is empty.
    """
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
            for n in range(count):
                blend_splat(state, near, n, left, top)
            if count == CHECK_EVERY and is_full(state):
                break
        store_tile(state, left, top, rgb, depth, alpha, linear)


@kernel
def fetch(records: Array, ids: Array, begin: int, count: int, near: Array) -> None:
    """Bring records close: they lie anywhere, and waiting for all of them at once is shorter than for each in turn."""
    for n in range(count):
        record = records[ids[begin + n]]
        for field in range(RECORD):
            near[n, field] = record[field]
