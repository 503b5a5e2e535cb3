"""One stable sort of all visible Gaussians by depth: a radix sort, shared between threads."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import kernel
from spackle.device import run_chunks

Array = npt.NDArray[Any]

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
