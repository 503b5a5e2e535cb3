"""One Gaussian and one tile: its pixels lie in patches of sixteen, each of which fills a vector register."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import inlined_kernel, kernel
from spackle.render.approx import HALF, ONE, ZERO, alpha_of
from spackle.render.project import ACROSS, BLUE, DEPTH, FALL, GREEN, HALF_HEIGHT, HALF_WIDTH, PEAK, RED, SLOPE, X, Y
from spackle.render.protocol import TILE, TRANSMITTANCE_STOP

Array = npt.NDArray[Any]

# A tile's state is one flat buffer of six planes: light (the transmittance, 0 once a pixel is full), red,
# green, blue, depth, alpha. One buffer, because the compiler then knows that the planes do not overlap.
# Alpha has a sum of its own: as 1 - light a faint one would lose digits, and depth, its quotient, too.
PLANE = TILE * TILE
STATE = 6 * PLANE

# A plane is its patches one after the other, of PATCH × PATCH pixels each: most Gaussians are small, and touch
# about two thirds as many of these as rows of the tile.
PATCH = 4
PATCHES = TILE // PATCH  # along a tile's side
LANES = PATCH * PATCH

STOP = np.float32(TRANSMITTANCE_STOP)
SLACK = np.float32(1e-3)  # pixels; room for rounding
SIDE = np.float32(TILE)


@kernel
def blend_patch(
    state: Array,
    offset: np.uint64,
    left: np.float32,
    top: np.float32,
    x: np.float32,
    y: np.float32,
    slope: np.float32,
    across: np.float32,
    fall: np.float32,
    peak: np.float32,
    red: np.float32,
    green: np.float32,
    blue: np.float32,
    depth: np.float32,
) -> None:
    """Draw one Gaussian into the patch whose first pixel is (left, top): this, and its centre, counted in the tile."""
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
    """Which of the tile's rows, or columns, first..last (exclusive), a Gaussian may reach from a centre in the tile."""
    # Truncation rounds up where one is added; a call to ceil or floor would cost more than a patch.
    first = int(max(center - reach - SLACK, -ONE) + ONE)
    last = min(int(min(center + reach + SLACK, SIDE)) + 1, TILE)
    return first, last


@kernel
def patches_of(center: np.float32, reach: np.float32) -> tuple[int, int]:
    """The same in patches."""
    first, last = span_of(center, reach)
    return first // PATCH, (last + PATCH - 1) // PATCH


@inlined_kernel
def blend_splat(state: Array, records: Array, index: int, left: int, top: int) -> None:
    """Draw one Gaussian into the tile whose first pixel is (left, top)."""
    record = records[index]
    x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
    first_row, last_row = patches_of(y, record[HALF_HEIGHT])
    first_column, last_column = patches_of(x, record[HALF_WIDTH])
    for row in range(first_row, last_row):
        for column in range(first_column, last_column):
            blend_patch(
                state, np.uint64((row * PATCHES + column) * LANES), np.float32(column * PATCH), np.float32(row * PATCH),
                x, y, record[SLOPE], record[ACROSS], record[FALL], record[PEAK],
                record[RED], record[GREEN], record[BLUE], record[DEPTH],
            )  # fmt: skip


@inlined_kernel
def place_of(row: int, column: int) -> int:
    """Where a plane keeps a pixel of the tile."""
    patch = row // PATCH * PATCHES + column // PATCH
    return patch * LANES + row % PATCH * PATCH + column % PATCH
