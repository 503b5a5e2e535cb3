"""The blender's gradient: each tile is drawn again, then walked back to front."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from spackle.render._numba import kernel, reordering_kernel
from spackle.render.approx import HALF, LIMIT, ONE, ZERO, alpha_of, srgb_slope
from spackle.render.blend import CHECK_EVERY, INVISIBLE, PLANE, STOP, is_full, rows_of
from spackle.render.project import ACROSS, BLUE, DEPTH, FALL, GREEN, HALF_HEIGHT, PEAK, RED, SLOPE, X, Y
from spackle.render.protocol import TILE

Array = npt.NDArray[Any]

# What the pixels of a tile give to one Gaussian. With u = x - centre and v = ∂L/∂ln(alpha), sums of v,
# v·u, v·u², v·dy, v·dy², v·u·dy, then the gradients of red, green, blue and depth.
SUMS = 10

# The workspace is one flat buffer, see `blend`: light, the light from behind a Gaussian, the gradients
# of red, green, blue, depth and alpha, SUMS rows of lanes, and the alphas and light of one chunk of
# Gaussians. A chunk's share fits the second-level cache.
BEHIND = 1 * PLANE
GRADIENTS = 2 * PLANE
LANES = 7 * PLANE
HISTORY = 8 * PLANE
CHUNK = 128  # Gaussians
STEP = 2 * TILE  # floats that one row of one Gaussian leaves in the history
WORKSPACE = HISTORY + CHUNK * TILE * STEP


@kernel
def wanted_row(gaussian: int, ranges: Array) -> int:
    """The row of the gradient table that belongs to a Gaussian, or -1.

    Args:
        ranges: [S, 3] int64; Gaussians from ranges[s, 0] to ranges[s, 1] own the rows from ranges[s, 2] on.
    """
    for s in range(len(ranges)):
        if ranges[s, 0] <= gaussian < ranges[s, 1]:
            return int(gaussian - ranges[s, 0] + ranges[s, 2])
    return -1


@kernel
def count_wanted(first: int, last: int, ids: Array, starts: Array, ranges: Array, counts: Array) -> None:
    """Count, in tiles first..last, the entries that want gradients."""
    for tile in range(first, last):
        for entry in range(starts[tile], starts[tile + 1]):
            if wanted_row(ids[entry], ranges) >= 0:
                counts[tile] += 1


@kernel
def load_gradients(
    work: Array, left: int, top: int, outputs: tuple[Array, ...], gradients: tuple[Array, ...], linear: Array
) -> None:
    """Turn the gradients of the finished pixels into those of the blended sums; 0 outside the image.

    Args:
        outputs: rgb [H, W, 3], depth and alpha [H, W], as drawn.
        gradients: those of the loss by each of the three.
        linear: [H, W, 3], the blended colour.
    """
    rgb, depth, alpha = outputs
    rgb_grad, depth_grad, alpha_grad = gradients
    work[GRADIENTS : GRADIENTS + 5 * PLANE] = ZERO
    for row in range(min(TILE, depth.shape[0] - top)):
        for column in range(min(TILE, depth.shape[1] - left)):
            i, y, x = GRADIENTS + row * TILE + column, top + row, left + column
            for channel in range(3):
                slope = srgb_slope(linear[y, x, channel], rgb[y, x, channel])
                work[i + channel * PLANE] = rgb_grad[y, x, channel] * slope
            work[i + 4 * PLANE] = alpha_grad[y, x]
            if alpha[y, x] > ZERO:
                by_sum = depth_grad[y, x] / alpha[y, x]
                work[i + 3 * PLANE] = by_sum
                work[i + 4 * PLANE] -= by_sum * depth[y, x]


@kernel
def replay_row(
    work: Array, offset: np.uint64, history: np.uint64, peak: np.float32, across: np.float32, center: np.float32
) -> None:
    """Draw one row as `blend_row` does, and note alpha (0 where nothing is drawn) and the light before it."""
    for x in range(TILE):
        i, h = offset + np.uint64(x), history + np.uint64(x)
        u = np.float32(x) - center
        alpha = alpha_of(peak - across * u * u)
        light = work[i]
        after = light * (ONE - alpha)
        full = after <= STOP
        work[i] = -abs(light) if full else after
        work[h] = ZERO if full else alpha
        work[h + np.uint64(TILE)] = light


@kernel
def replay(work: Array, records: Array, ids: Array, left: int, top: int, noted: Array) -> int:
    """Draw a chunk of Gaussians again; `noted` [CHUNK] gets where the history of each begins.

    Returns:
        How many were drawn before the tile was full.
    """
    history = np.uint64(HISTORY)
    for k in range(len(ids)):
        noted[k] = history
        record = records[ids[k]]
        x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
        first, last = rows_of(y, record[HALF_HEIGHT])
        for row in range(first, last):
            dy = np.float32(row) - y
            peak = record[PEAK] - record[FALL] * dy * dy
            if peak < INVISIBLE:
                continue
            replay_row(work, np.uint64(row * TILE), history, peak, record[ACROSS], x + record[SLOPE] * dy)
            history += np.uint64(STEP)
        if k % CHECK_EVERY == CHECK_EVERY - 1 and is_full(work):
            return k + 1
    return len(ids)


@kernel
def pass_row(
    work: Array,
    offset: np.uint64,
    history: np.uint64,
    red: np.float32,
    green: np.float32,
    blue: np.float32,
    depth: np.float32,
) -> None:
    """Walk back past a row of a Gaussian that wants no gradient."""
    for x in range(TILE):
        i, h = offset + np.uint64(x), history + np.uint64(x)
        g = i + np.uint64(GRADIENTS)
        value = red * work[g] + green * work[g + np.uint64(PLANE)] + blue * work[g + np.uint64(2 * PLANE)]
        value += depth * work[g + np.uint64(3 * PLANE)] + work[g + np.uint64(4 * PLANE)]
        work[i + np.uint64(BEHIND)] += work[h] * work[h + np.uint64(TILE)] * value


@kernel
def gather_row(
    work: Array,
    offset: np.uint64,
    history: np.uint64,
    center: np.float32,
    dy: np.float32,
    red: np.float32,
    green: np.float32,
    blue: np.float32,
    depth: np.float32,
) -> None:
    """Walk back past a row of a Gaussian, and add up in each lane what the pixel gives to it."""
    for x in range(TILE):
        i, h = offset + np.uint64(x), history + np.uint64(x)
        g, s = i + np.uint64(GRADIENTS), np.uint64(LANES) + np.uint64(x)
        by_red, by_green, by_blue = work[g], work[g + np.uint64(PLANE)], work[g + np.uint64(2 * PLANE)]
        by_depth, by_alpha = work[g + np.uint64(3 * PLANE)], work[g + np.uint64(4 * PLANE)]
        value = red * by_red + green * by_green + blue * by_blue + depth * by_depth + by_alpha
        alpha, light, behind = work[h], work[h + np.uint64(TILE)], work[i + np.uint64(BEHIND)]
        weight = alpha * light
        # More alpha shows more of this one and less of what lies behind; at the clamp nothing moves.
        slope = alpha * (light * value - behind / (ONE - alpha))
        v = slope if alpha < LIMIT else ZERO
        work[i + np.uint64(BEHIND)] = behind + weight * value
        u = np.float32(x) - center
        work[s] += v
        work[s + np.uint64(1 * TILE)] += v * u
        work[s + np.uint64(2 * TILE)] += v * u * u
        work[s + np.uint64(3 * TILE)] += v * dy
        work[s + np.uint64(4 * TILE)] += v * dy * dy
        work[s + np.uint64(5 * TILE)] += v * u * dy
        work[s + np.uint64(6 * TILE)] += weight * by_red
        work[s + np.uint64(7 * TILE)] += weight * by_green
        work[s + np.uint64(8 * TILE)] += weight * by_blue
        work[s + np.uint64(9 * TILE)] += weight * by_depth


@reordering_kernel
def sum_lanes(work: Array, sums: Array) -> None:
    """Add up the lanes."""
    for k in range(SUMS):
        total = ZERO
        for x in range(TILE):
            total += work[LANES + k * TILE + x]
        sums[k] = total


@kernel
def walk_back(work: Array, record: Array, left: int, top: int, history: np.uint64, wanted: bool) -> None:
    """Walk back past one Gaussian, whose notes begin at `history`."""
    x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
    red, green, blue, depth = record[RED], record[GREEN], record[BLUE], record[DEPTH]
    first, last = rows_of(y, record[HALF_HEIGHT])
    for row in range(first, last):
        dy = np.float32(row) - y
        if record[PEAK] - record[FALL] * dy * dy < INVISIBLE:
            continue
        offset = np.uint64(row * TILE)
        if wanted:
            gather_row(work, offset, history, x + record[SLOPE] * dy, dy, red, green, blue, depth)
        else:
            pass_row(work, offset, history, red, green, blue, depth)
        history += np.uint64(STEP)


@kernel
def backward_tile(
    work: Array, noted: Array, records: Array, ids: Array, left: int, top: int, ranges: Array, sums: Array
) -> None:
    """The gradients of one tile.

    Args:
        ids: [n], the tile's list.
        sums: [m, SUMS], one row for each entry of the list that wants gradients, in the list's order.
    """
    chunks = (len(ids) + CHUNK - 1) // CHUNK
    before = np.empty((chunks, PLANE), np.float32)  # the light that reaches each chunk
    work[:PLANE] = ONE
    work[BEHIND : BEHIND + PLANE] = ZERO
    for chunk in range(chunks - 1):
        before[chunk] = work[:PLANE]
        replay(work, records, ids[chunk * CHUNK : (chunk + 1) * CHUNK], left, top, noted)
    if chunks > 0:
        before[chunks - 1] = work[:PLANE]
    slot = len(sums)
    for chunk in range(chunks - 1, -1, -1):
        work[:PLANE] = before[chunk]
        part = ids[chunk * CHUNK : (chunk + 1) * CHUNK]
        drawn = replay(work, records, part, left, top, noted)
        for k in range(len(part) - 1, -1, -1):
            if slot == 0:
                return
            wanted = wanted_row(part[k], ranges) >= 0
            if k < drawn:
                work[LANES : LANES + SUMS * TILE] = ZERO
                walk_back(work, records[part[k]], left, top, noted[k], wanted)
            if wanted:
                slot -= 1
                if k < drawn:
                    sum_lanes(work, sums[slot])


@kernel
def backward_tiles(
    first: int,
    last: int,
    tiles: Array,
    columns: int,
    ids: Array,
    starts: Array,
    records: Array,
    outputs: tuple[Array, ...],
    gradients: tuple[Array, ...],
    linear: Array,
    ranges: Array,
    slots: Array,
    sums: Array,
) -> None:
    """The gradients of tiles first..last of the list `tiles` [K].

    Args:
        slots: [T + 1] int64, where each tile's rows in `sums` begin.
        sums: [E, SUMS] float32, zeros.
    """
    work, noted = np.empty(WORKSPACE, np.float32), np.empty(CHUNK, np.uint64)
    for k in range(first, last):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        load_gradients(work, left, top, outputs, gradients, linear)
        part, rows = ids[starts[tile] : starts[tile + 1]], sums[slots[tile] : slots[tile + 1]]
        backward_tile(work, noted, records, part, left, top, ranges, rows)


@kernel
def collect_sums(
    first: int, last: int, rows: int, tiles: Array, ids: Array, starts: Array, ranges: Array, sums: Array, table: Array
) -> None:
    """Add each entry's sums to its Gaussian's, for rows first..last of the table; tiles in order.

    Args:
        rows: the size of a share: shares first..last own the rows from first·rows to last·rows.
        table: [G, SUMS] float64, zeros.
    """
    slot = 0
    for k in range(len(tiles)):
        for entry in range(starts[tiles[k]], starts[tiles[k] + 1]):
            row = wanted_row(ids[entry], ranges)
            if row < 0:
                continue
            if first * rows <= row < last * rows:
                for s in range(SUMS):
                    table[row, s] += sums[slot, s]
            slot += 1
