"""Binning: one stable radix sort of all visible Gaussians by depth, and lists of those that touch each tile."""

from __future__ import annotations

import dataclasses

import numpy as np

from spackle._numba import Array, kernel
from spackle.device import run_chunks, thread_count

DIGIT_BITS = 11  # three digits hold the 31 bits of a positive float; a table of 2048 counts stays in cache
BUCKETS = 1 << DIGIT_BITS
MASK = BUCKETS - 1


def sort_by_depth(keys: Array, ids: Array, spans: Array) -> Array:
    """Order Gaussians front to back; those of equal depth stay in the order in which they came.

    Args:
        keys: [N] uint32, the bits of positive floats; overwritten.
        ids: [N] int32; overwritten.
        spans: [C, 2] int64, the pieces (start, count) of keys and ids that are in use.

    Returns:
        [M] int32, the ids in order of their keys, M being the sum of the counts.
    """
    total = int(spans[:, 1].sum())
    other_keys, other_ids = np.empty(total, np.uint32), np.empty(total, np.int32)
    for shift in range(0, 32, DIGIT_BITS):
        _sort_digit(keys, ids, spans, shift, other_keys, other_ids)
        keys, ids, other_keys, other_ids = other_keys, other_ids, keys, ids
        spans = even_spans(total, len(spans))
    return ids[:total]


def _sort_digit(keys: Array, ids: Array, spans: Array, shift: int, sorted_keys: Array, sorted_ids: Array) -> None:
    """Sort by the digit at bit `shift` alone, keeping the order of equal ones."""
    counts = np.zeros((len(spans), BUCKETS), np.int64)
    run_chunks(lambda a, b: count_digits(a, b, spans, keys, shift, counts), len(spans), 1)
    positions = starts_of(counts)
    run_chunks(lambda a, b: scatter(a, b, spans, keys, ids, shift, positions, sorted_keys, sorted_ids), len(spans), 1)


def even_spans(total: int, parts: int) -> Array:
    """Cut 0..total into equal pieces (start, count), [parts, 2] int64."""
    edges = np.linspace(0, total, parts + 1).astype(np.int64)
    return np.stack([edges[:-1], np.diff(edges)], axis=1)


def starts_of(counts: Array) -> Array:
    """Where each piece's items of each bucket begin: buckets in order, and pieces in order within one.

    Args:
        counts: [C, B] items of bucket b in piece c.
    """
    flat = counts.T.reshape(-1)
    return np.ascontiguousarray((np.cumsum(flat) - flat).reshape(counts.shape[::-1]).T)


@kernel
def count_digits(first: int, last: int, spans: Array, keys: Array, shift: int, counts: Array) -> None:
    """Count the digits of the keys of pieces first..last."""
    for piece in range(first, last):
        row = counts[piece]
        for i in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            row[(keys[i] >> np.uint32(shift)) & np.uint32(MASK)] += 1


@kernel
def scatter(
    first: int,
    last: int,
    spans: Array,
    keys: Array,
    ids: Array,
    shift: int,
    positions: Array,
    sorted_keys: Array,
    sorted_ids: Array,
) -> None:
    """Move the items of pieces first..last to their places."""
    for piece in range(first, last):
        row = positions[piece]
        for i in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            digit = (keys[i] >> np.uint32(shift)) & np.uint32(MASK)
            place = row[digit]
            row[digit] = place + 1
            sorted_keys[place] = keys[i]
            sorted_ids[place] = ids[i]


@dataclasses.dataclass(frozen=True)
class TileLists:
    """Which Gaussians each tile draws."""

    ids: Array  # [E] int32, the lists one after the other
    starts: Array  # [T + 1] int64, where each tile's list begins


def list_tiles(order: Array, boxes: Array, wanted: Array) -> TileLists:
    """Deal the sorted Gaussians out to the tiles.

    Args:
        order: [M] int32, visible Gaussians front to back.
        boxes: [N, 4] uint16, the tiles each one touches.
        wanted: [rows, columns] bool, the tiles to make lists for; the others' lists stay empty.
    """
    parts = thread_count()
    spans = even_spans(len(order), parts)
    counts = np.zeros((parts, wanted.size), np.int64)
    sorted_boxes = np.empty((len(order), 4), np.uint16)
    run_chunks(lambda a, b: count_entries(a, b, spans, order, boxes, wanted, sorted_boxes, counts), parts, 1)
    starts = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    positions = starts_of(counts)
    ids = np.empty(starts[-1], np.int32)
    run_chunks(lambda a, b: write_entries(a, b, spans, order, sorted_boxes, wanted, positions, ids), parts, 1)
    return TileLists(ids, starts)


@kernel
def count_entries(
    first: int, last: int, spans: Array, order: Array, boxes: Array, wanted: Array, sorted_boxes: Array, counts: Array
) -> None:
    """Count the entries that pieces first..last of the order bring to each tile, and sort the boxes on the way."""
    columns, flat = wanted.shape[1], wanted.reshape(-1)
    for piece in range(first, last):
        row_counts = counts[piece]
        for place in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            k = np.uint64(place)  # unsigned numbers need no look at whether they count from an array's end
            i = np.uint64(order[k])
            left, right, top, bottom = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
            sorted_boxes[k, 0], sorted_boxes[k, 1], sorted_boxes[k, 2], sorted_boxes[k, 3] = left, right, top, bottom
            # Read back on purpose: of bounds that it cannot keep in registers the compiler makes plain loops, and
            # vectors for two tiles cost more.
            for row in range(sorted_boxes[k, 2], sorted_boxes[k, 3]):
                for column in range(sorted_boxes[k, 0], sorted_boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if flat[tile]:
                        row_counts[tile] += 1


@kernel
def write_entries(
    first: int, last: int, spans: Array, order: Array, sorted_boxes: Array, wanted: Array, positions: Array, ids: Array
) -> None:
    """Write the entries that pieces first..last of the order, whose boxes are sorted, bring to each tile."""
    columns, flat = wanted.shape[1], wanted.reshape(-1)
    for piece in range(first, last):
        places = positions[piece]
        for place in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            k = np.uint64(place)
            for row in range(sorted_boxes[k, 2], sorted_boxes[k, 3]):
                for column in range(sorted_boxes[k, 0], sorted_boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if flat[tile]:
                        ids[np.uint64(places[tile])] = order[k]
                        places[tile] += 1
