"""The blender's gradient: each tile is drawn again in chunks of Gaussians, then walked back to front."""

from __future__ import annotations

import math

import numpy as np

from spackle._numba import HALF, ONE, ZERO, Array, kernel, reordering_kernel
from spackle.render.blend import CHECK_EVERY, LIMIT, PLANE, STOP, alpha_of, is_full, span_of, srgb_slope
from spackle.render.project import ACROSS, BLUE, DEPTH, FALL, GREEN, HALF_HEIGHT, PEAK, RED, SLOPE, X, Y
from spackle.render.protocol import ALPHA_MIN, TILE

# What the pixels of a tile give to one Gaussian. With u = x - centre and v = ∂L/∂ln(alpha), sums of v,
# v·u, v·u², v·dy, v·dy², v·u·dy, then the gradients of red, green, blue and depth.
SUMS = 10

# The workspace is one flat buffer of planes, as in `blend`, but with the pixels row by row: the light that is
# left, what lies behind the Gaussian in hand, the gradients of red, green, blue, depth and alpha.
BEHIND = 1 * PLANE
GRADIENTS = 2 * PLANE
WORKSPACE = 7 * PLANE

# The alphas and light of a chunk of Gaussians are noted down on the way forth, for the way back; small
# enough for the second-level cache.
CHUNK = 128  # Gaussians
NOTE = 2 * TILE  # floats for one row of one Gaussian
NOTES = CHUNK * TILE * NOTE
INVISIBLE = np.float32(math.log2(ALPHA_MIN) - 1e-3)  # a row that peaks below this shows nothing


@kernel
def replay_row(
    work: Array,
    offset: np.uint64,
    notes: Array,
    note: np.uint64,
    peak: np.float32,
    across: np.float32,
    center: np.float32,
) -> None:
    """Draw one row as `blend_patch` does; note alpha (0 where nothing is drawn) and the light before it."""
    for x in range(TILE):
        i, n = offset + np.uint64(x), note + np.uint64(x)
        u = np.float32(x) - center
        alpha = alpha_of(peak - across * u * u)
        light = work[i]
        after = light * (ONE - alpha)
        full = after <= STOP
        work[i] = ZERO if full else after
        notes[n] = ZERO if full else alpha
        notes[n + np.uint64(TILE)] = light


@kernel
def replay(work: Array, notes: Array, records: Array, ids: Array, left: int, top: int, first_notes: Array) -> int:
    """Draw a chunk of Gaussians again; `first_notes` [CHUNK] gets where the notes of each begin.

    Returns:
        How many were drawn before the tile was full.
    """
    note = np.uint64(0)
    for k in range(len(ids)):
        first_notes[k] = note
        record = records[ids[k]]
        x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
        first, last = span_of(y, record[HALF_HEIGHT])
        for row in range(first, last):
            dy = np.float32(row) - y
            peak = record[PEAK] - record[FALL] * dy * dy
            if peak < INVISIBLE:
                continue
            replay_row(work, np.uint64(row * TILE), notes, note, peak, record[ACROSS], x + record[SLOPE] * dy)
            note += np.uint64(NOTE)
        if k % CHECK_EVERY == CHECK_EVERY - 1 and is_full(work):
            return k + 1
    return len(ids)


@kernel
def pass_row(
    work: Array,
    offset: np.uint64,
    notes: Array,
    note: np.uint64,
    red: np.float32,
    green: np.float32,
    blue: np.float32,
    depth: np.float32,
) -> None:
    """Walk back past a row of a Gaussian that wants no gradient."""
    for x in range(TILE):
        i, n = offset + np.uint64(x), note + np.uint64(x)
        g = i + np.uint64(GRADIENTS)
        value = red * work[g] + green * work[g + np.uint64(PLANE)] + blue * work[g + np.uint64(2 * PLANE)]
        value += depth * work[g + np.uint64(3 * PLANE)] + work[g + np.uint64(4 * PLANE)]
        work[i + np.uint64(BEHIND)] += notes[n] * notes[n + np.uint64(TILE)] * value


@reordering_kernel
def gather_row(
    work: Array,
    offset: np.uint64,
    notes: Array,
    note: np.uint64,
    center: np.float32,
    red: np.float32,
    green: np.float32,
    blue: np.float32,
    depth: np.float32,
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]:
    """Walk back past a row of a Gaussian, and add up what its pixels give to it: see SUMS, without dy."""
    sum_v, sum_vu, sum_vuu = ZERO, ZERO, ZERO
    sum_red, sum_green, sum_blue, sum_depth = ZERO, ZERO, ZERO, ZERO
    for x in range(TILE):
        i, n = offset + np.uint64(x), note + np.uint64(x)
        g = i + np.uint64(GRADIENTS)
        by_red, by_green, by_blue = work[g], work[g + np.uint64(PLANE)], work[g + np.uint64(2 * PLANE)]
        by_depth, by_alpha = work[g + np.uint64(3 * PLANE)], work[g + np.uint64(4 * PLANE)]
        value = red * by_red + green * by_green + blue * by_blue + depth * by_depth + by_alpha
        alpha, light, behind = notes[n], notes[n + np.uint64(TILE)], work[i + np.uint64(BEHIND)]
        weight = alpha * light
        work[i + np.uint64(BEHIND)] = behind + weight * value
        # More alpha shows more of this one and less of what lies behind; at the clamp nothing moves.
        slope = alpha * (light * value - behind / (ONE - alpha))
        v = slope if alpha < LIMIT else ZERO
        u = np.float32(x) - center
        sum_v += v
        sum_vu += v * u
        sum_vuu += v * u * u
        sum_red += weight * by_red
        sum_green += weight * by_green
        sum_blue += weight * by_blue
        sum_depth += weight * by_depth
    return sum_v, sum_vu, sum_vuu, sum_red, sum_green, sum_blue, sum_depth


@kernel
def walk_back(
    work: Array, notes: Array, note: np.uint64, record: Array, left: int, top: int, wanted: bool, sums: Array
) -> None:
    """Walk back past one Gaussian, whose notes begin at `note`; if it wants gradients, `sums` [SUMS] gets them."""
    x, y = record[X] - np.float32(left) - HALF, record[Y] - np.float32(top) - HALF
    red, green, blue, depth = record[RED], record[GREEN], record[BLUE], record[DEPTH]
    first, last = span_of(y, record[HALF_HEIGHT])
    for row in range(first, last):
        dy = np.float32(row) - y
        if record[PEAK] - record[FALL] * dy * dy < INVISIBLE:
            continue
        offset = np.uint64(row * TILE)
        if wanted:
            gifts = gather_row(work, offset, notes, note, x + record[SLOPE] * dy, red, green, blue, depth)
            v, vu, vuu, by_red, by_green, by_blue, by_depth = gifts
            sums[0] += v
            sums[1] += vu
            sums[2] += vuu
            sums[3] += v * dy
            sums[4] += v * dy * dy
            sums[5] += vu * dy
            sums[6] += by_red
            sums[7] += by_green
            sums[8] += by_blue
            sums[9] += by_depth
        else:
            pass_row(work, offset, notes, note, red, green, blue, depth)
        note += np.uint64(NOTE)


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
    for i in range(GRADIENTS, GRADIENTS + 5 * PLANE):
        work[i] = ZERO
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
def backward_tile(
    work: Array,
    notes: Array,
    first_notes: Array,
    records: Array,
    ids: Array,
    rows: Array,
    left: int,
    top: int,
    sums: Array,
) -> None:
    """The gradients of one tile.

    Args:
        work: [WORKSPACE], its gradients loaded.
        notes: [NOTES], room for notes, and `first_notes` [CHUNK], where each Gaussian's begin.
        ids: [n], the tile's list.
        rows: [n], 0 or more for an entry whose Gaussian wants gradients.
        sums: [m, SUMS], one row for each such entry, in the list's order.
    """
    chunks = (len(ids) + CHUNK - 1) // CHUNK
    before = np.empty((chunks, PLANE), np.float32)  # the light that reaches each chunk
    work[:PLANE] = ONE
    work[BEHIND : BEHIND + PLANE] = ZERO
    for chunk in range(chunks):
        before[chunk] = work[:PLANE]
        if chunk < chunks - 1:
            replay(work, notes, records, ids[chunk * CHUNK : (chunk + 1) * CHUNK], left, top, first_notes)
    slot = len(sums)
    for chunk in range(chunks - 1, -1, -1):
        work[:PLANE] = before[chunk]
        part = ids[chunk * CHUNK : (chunk + 1) * CHUNK]
        drawn = replay(work, notes, records, part, left, top, first_notes)
        for k in range(len(part) - 1, -1, -1):
            if slot == 0:
                return
            wanted = rows[chunk * CHUNK + k] >= 0
            slot -= wanted
            if k < drawn:
                own = sums[slot if wanted else 0]
                walk_back(work, notes, first_notes[k], records[part[k]], left, top, wanted, own)


@kernel
def backward_tiles(
    first: int,
    last: int,
    tiles: Array,
    columns: int,
    ids: Array,
    rows: Array,
    starts: Array,
    records: Array,
    outputs: tuple[Array, ...],
    gradients: tuple[Array, ...],
    linear: Array,
    slots: Array,
    sums: Array,
) -> None:
    """The gradients of tiles first..last of the list `tiles` [K].

    Args:
        rows: [E] int32, the row of the gradient table that belongs to each entry's Gaussian; -1 for none.
        slots: [T + 1] int64, where each tile's rows in `sums` begin.
        sums: [M, SUMS] float32, zeros.
    """
    work, notes = np.empty(WORKSPACE, np.float32), np.empty(NOTES, np.float32)
    first_notes = np.empty(CHUNK, np.uint64)
    for k in range(first, last):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        load_gradients(work, left, top, outputs, gradients, linear)
        part, own = slice(starts[tile], starts[tile + 1]), sums[slots[tile] : slots[tile + 1]]
        backward_tile(work, notes, first_notes, records, ids[part], rows[part], left, top, own)


@kernel
def collect_sums(first: int, last: int, share: int, rows: Array, sums: Array, table: Array) -> None:
    """Add sums [M, SUMS] to their rows [M] of the table [G, SUMS], for rows first·share to last·share, in order."""
    for slot in range(len(rows)):
        row = rows[slot]
        if first * share <= row < last * share:
            for s in range(SUMS):
                table[row, s] += sums[slot, s]
