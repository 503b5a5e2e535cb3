"""Lists of the Gaussians that touch each tile, front to back."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import kernel
from spackle.device import run_chunks, thread_count
from spackle.render.sort import even_spans, starts_of

Array = npt.NDArray[Any]


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
