"""Blending of tiles: front to back, in linear light."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import kernel
from spackle.render.approx import ONE, ZERO, encode_srgb
from spackle.render.patch import PLANE, STATE, blend_splat, place_of
from spackle.render.project import RECORD
from spackle.render.protocol import TILE

Array = npt.NDArray[Any]

CHECK_EVERY = 16  # Gaussians that are fetched at once, and between two looks at whether the whole tile is full


@kernel
def blend_splats(state: Array, records: Array, count: int, left: int, top: int) -> None:
    """Draw the first Gaussians; a function of its own, because only so the constants stay in registers."""
    for index in range(count):
        blend_splat(state, records, index, left, top)


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
            i = place_of(row, column)
            opacity = state[i + 5 * PLANE]
            alpha[top + row, left + column] = opacity
            depth[top + row, left + column] = state[i + 4 * PLANE] / opacity if opacity > ZERO else ZERO


@kernel
def store_color(state: Array, left: int, top: int, rows: int, columns: int, image: Array) -> None:
    """Write the three planes of colour to an image [H, W, 3]."""
    for row in range(rows):
        for column in range(columns):
            for channel in range(3):
                image[top + row, left + column, channel] = state[place_of(row, column) + (1 + channel) * PLANE]


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
            blend_splats(state, near, count, left, top)
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
