"""The blender's gradient: each tile is drawn again, then walked back to front."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import kernel
from spackle.render.approx import ONE, ZERO, srgb_slope
from spackle.render.patch import PLANE
from spackle.render.protocol import TILE
from spackle.render.walk import BEHIND, CHUNK, GRADIENTS, NOTES, SUMS, WORKSPACE, replay, walk_back

Array = npt.NDArray[Any]


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
    left: int,
    top: int,
    ranges: Array,
    sums: Array,
) -> None:
    """The gradients of one tile.

    Args:
        work: [WORKSPACE], its gradients loaded.
        notes: [NOTES], room for notes, and `first_notes` [CHUNK], where each Gaussian's begin.
        ids: [n], the tile's list.
        sums: [m, SUMS], one row for each entry of the list that wants gradients, in the list's order.
    """
    chunks = (len(ids) + CHUNK - 1) // CHUNK
    before = np.empty((chunks, PLANE), np.float32)  # the light that reaches each chunk
    fill(work, 0, ONE)
    fill(work, BEHIND, ZERO)
    for chunk in range(chunks):
        copy_plane(work, before[chunk])
        if chunk < chunks - 1:
            replay(work, notes, records, ids[chunk * CHUNK : (chunk + 1) * CHUNK], left, top, first_notes)
    slot = len(sums)
    for chunk in range(chunks - 1, -1, -1):
        copy_plane(before[chunk], work)
        part = ids[chunk * CHUNK : (chunk + 1) * CHUNK]
        drawn = replay(work, notes, records, part, left, top, first_notes)
        for k in range(len(part) - 1, -1, -1):
            if slot == 0:
                return
            wanted = wanted_row(part[k], ranges) >= 0
            slot -= wanted
            if k < drawn:
                own = sums[slot if wanted else 0]
                walk_back(work, notes, first_notes[k], records[part[k]], left, top, wanted, own)


@kernel
def fill(work: Array, plane: int, value: np.float32) -> None:
    """Set a plane of the workspace."""
    for i in range(PLANE):
        work[plane + i] = value


@kernel
def copy_plane(source: Array, target: Array) -> None:
    """Copy the first plane of a buffer to the first of another."""
    for i in range(PLANE):
        target[i] = source[i]


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
    work, notes = np.empty(WORKSPACE, np.float32), np.empty(NOTES, np.float32)
    first_notes = np.empty(CHUNK, np.uint64)
    for k in range(first, last):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        load_gradients(work, left, top, outputs, gradients, linear)
        part, rows = ids[starts[tile] : starts[tile + 1]], sums[slots[tile] : slots[tile + 1]]
        backward_tile(work, notes, first_notes, records, part, left, top, ranges, rows)


@kernel
def collect_sums(
    first: int, last: int, rows: int, tiles: Array, ids: Array, starts: Array, ranges: Array, sums: Array, table: Array
) -> None:
    """Add each entry's sums to its Gaussian's, for rows first..last of the table; tiles in order.

    Args:
        rows: the size of a share: shares first..last own the rows from first·rows to last·rows.
        table: [G, SUMS] float32, zeros.
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
