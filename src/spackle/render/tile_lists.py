"""Which tile shows which Gaussians: a list of indices for each tile, and its sorting by depth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from spackle.render.project import DEPTH
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import Array, inlined_kernel, kernel

# A sort key is the 32 bits of a depth, as four digits of 8 bits.
DIGITS_PER_KEY = 4
BITS_PER_DIGIT = 8
DIGIT_VALUES = 1 << BITS_PER_DIGIT


class TileLists(NamedTuple):
    """The Gaussians that may touch each of T tiles; front to back once `sort_tiles` has run."""

    ids: Array  # [E] int32: indices of Gaussians, the lists of all tiles one after the other
    starts: Array  # [T + 1] int64: where each tile's list starts in `ids`, and the end of the last


class TileBlock(NamedTuple):
    """A rectangle of tiles whose lists are made at one time; ends are exclusive."""

    first_column: int
    last_column: int
    first_row: int
    last_row: int

    def clip(self, boxes: Array) -> Array:
        """The boxes [N, 4] of Gaussians as far as they lie in the block; others become empty."""
        clipped = np.empty_like(boxes)
        np.maximum(boxes[:, 0], self.first_column, out=clipped[:, 0])
        np.minimum(boxes[:, 1], self.last_column, out=clipped[:, 1])
        np.maximum(boxes[:, 2], self.first_row, out=clipped[:, 2])
        np.minimum(boxes[:, 3], self.last_row, out=clipped[:, 3])
        return clipped

    def drawn(self, drawn_tiles: Array) -> Array:
        """`drawn_tiles` [rows, columns] bool, in which all tiles outside of the block are False."""
        mask = np.zeros_like(drawn_tiles)
        rows = slice(self.first_row, self.last_row)
        columns = slice(self.first_column, self.last_column)
        mask[rows, columns] = drawn_tiles[rows, columns]
        return mask


def count_by_part(boxes: Array, drawn_tiles: Array, part_size: int) -> Array:
    """How many Gaussians of each part touch each tile, [parts, tiles] int64.

    Args:
        boxes: [N, 4] uint16: the tiles that each Gaussian may touch, as first column, last column,
            first row, last row (last exclusive).
        drawn_tiles: [rows, columns] bool; other tiles are not counted.
        part_size: the Gaussians are divided into parts of this size, one for a thread at a time.
    """
    parts = math.ceil(len(boxes) / part_size)
    counts = np.zeros((parts, drawn_tiles.size), np.int64)
    parallel_for_chunks(
        lambda start, stop: count_entries(start, stop, part_size, boxes, drawn_tiles, counts),
        parts,
        chunk_length=1,
    )
    return counts


def list_tiles(
    boxes: Array, drawn_tiles: Array, part_size: int, counts: Array | None = None
) -> TileLists:
    """List the Gaussians of each tile, in their own order.

    An *entry* is a Gaussian in the list of a tile. A Gaussian that touches three tiles has three.

    Args:
        boxes: [N, 4] uint16: the tiles that each Gaussian may touch, as first column, last column,
            first row, last row (last exclusive).
        drawn_tiles: [rows, columns] bool; lists of other tiles are empty.
        part_size: the Gaussians are divided into parts of this size, one for a thread at a time.
        counts: what `count_by_part` gives for these arguments; None: it is called.
    """
    # Every part counts its entries of each tile. Then it is known where each part may write, and
    # the parts are independent.
    if counts is None:
        counts = count_by_part(boxes, drawn_tiles, part_size)
    starts = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    counts_of_earlier_parts = np.cumsum(counts, axis=0) - counts
    positions = starts[:-1] + counts_of_earlier_parts  # [parts, T]: of each part's first entry

    ids = np.empty(starts[-1], np.int32)
    parallel_for_chunks(
        lambda start, stop: write_entries(
            start, stop, part_size, boxes, drawn_tiles, positions, ids
        ),
        len(counts),
        chunk_length=1,
    )
    return TileLists(ids, starts)


def tile_blocks(list_lengths: Array, max_entries: int) -> Iterator[TileBlock]:
    """Yield rectangles that cover all tiles, each with lists of at most `max_entries` entries.

    A block has whole rows of tiles, or, where the lists of one row are too long, a part of a row.
    A single tile may have a longer list.

    Args:
        list_lengths: [rows, columns] entries of each tile's list.
        max_entries: bounds the memory that the lists of a block take.
    """
    row_count, column_count = list_lengths.shape
    row_lengths = list_lengths.sum(axis=1)
    first_row = 0
    while first_row < row_count:
        last_row = first_row + _leading_count(row_lengths[first_row:], max_entries)
        if row_lengths[first_row] <= max_entries:
            yield TileBlock(0, column_count, first_row, last_row)
        else:
            first_column = 0
            while first_column < column_count:
                rest = list_lengths[first_row, first_column:]
                last_column = first_column + _leading_count(rest, max_entries)
                yield TileBlock(first_column, last_column, first_row, last_row)
                first_column = last_column
        first_row = last_row


def _leading_count(lengths: Array, max_entries: int) -> int:
    """How many of the first `lengths` [n] have a sum of at most `max_entries`; at least 1."""
    sums = np.cumsum(lengths)
    return max(1, int(np.searchsorted(sums, max_entries, side="right")))


@kernel
def count_entries(
    first: int, last: int, part_size: int, boxes: Array, drawn_tiles: Array, counts: Array
) -> None:
    """Count how many Gaussians of each part are in each tile's list.

    Args:
        first, last: the parts first..last (exclusive) are counted; part k has `part_size` Gaussians
            from the index k·part_size on.
        part_size: Gaussians in a part.
        boxes: [N, 4] uint16: the tiles that each Gaussian may touch, as first column, last column,
            first row, last row (last exclusive).
        drawn_tiles: [rows, columns] bool; other tiles are not counted.
        counts: [parts, rows·columns] int64, zero at first: the counts are added here.
    """
    columns = drawn_tiles.shape[1]
    is_drawn = drawn_tiles.reshape(-1)
    for part in range(first, last):
        part_counts = counts[part]
        for i in range(part * part_size, min((part + 1) * part_size, len(boxes))):
            k = np.uint64(i)  # unsigned, so that no check for negative indices is compiled
            for row in range(boxes[k, 2], boxes[k, 3]):
                for column in range(boxes[k, 0], boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if is_drawn[tile]:
                        part_counts[tile] += 1


@kernel
def write_entries(
    first: int,
    last: int,
    part_size: int,
    boxes: Array,
    drawn_tiles: Array,
    positions: Array,
    ids: Array,
) -> None:
    """Write the index of each Gaussian into the list of each tile that it may touch.

    Args:
        first, last: the parts of the Gaussians to write; part k has those from k·part_size on.
        part_size: Gaussians in a part.
        boxes: [N, 4] uint16: the tiles that each Gaussian may touch, as first column, last column,
            first row, last row (last exclusive).
        drawn_tiles: [rows, columns] bool; other tiles have no list.
        positions: [parts, rows·columns] int64: where a part's next entry for a tile goes. Each
            entry moves its position on.
        ids: [E] int32: the lists, which are written here.
    """
    columns = drawn_tiles.shape[1]
    is_drawn = drawn_tiles.reshape(-1)
    for part in range(first, last):
        next_position = positions[part]
        for i in range(part * part_size, min((part + 1) * part_size, len(boxes))):
            k = np.uint64(i)  # unsigned, so that no check for negative indices is compiled
            for row in range(boxes[k, 2], boxes[k, 3]):
                for column in range(boxes[k, 0], boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if is_drawn[tile]:
                        ids[np.uint64(next_position[tile])] = i
                        next_position[tile] += 1


@kernel
def sort_tiles(first: int, last: int, tiles: Array, lists: TileLists, records: Array) -> None:
    """Sort the lists of some tiles front to back; Gaussians of equal depth keep their order.

    This is a radix sort: the list is sorted by the lowest digit of the key, then by the next one,
    and so on. Depths are positive, so their float32 bits, read as an integer, have the same order.

    Args:
        first, last: the tiles `tiles[first]` to `tiles[last - 1]` are sorted.
        tiles: [K] numbers of tiles, row by row.
        lists: the lists, sorted in place.
        records: [N, 12] float32 numbers of each Gaussian, one of which is the depth.
    """
    ids, starts = lists
    depth_bits = records.view(np.uint32)
    longest = 0
    for k in range(first, last):
        longest = max(longest, starts[tiles[k] + 1] - starts[tiles[k]])
    keys = np.empty(longest, np.uint32)
    sorted_keys = np.empty(longest, np.uint32)
    items = np.empty(longest, np.int32)
    sorted_items = np.empty(longest, np.int32)
    # For each digit and each of its values: first the number of keys, later the place of the next
    # key. Unsigned, so that no check for negative indices is compiled.
    places = np.empty((DIGITS_PER_KEY, DIGIT_VALUES), np.uint32)

    for k in range(first, last):
        tile_list = ids[starts[tiles[k]] : starts[tiles[k] + 1]]
        count = len(tile_list)

        # Read the keys once, and count the values of all digits.
        places[:] = 0
        for n in range(count):
            items[n] = tile_list[n]
            keys[n] = depth_bits[np.uint64(tile_list[n]), DEPTH]
            for digit in range(DIGITS_PER_KEY):
                places[digit, digit_of(keys[n], digit)] += np.uint32(1)

        for digit in range(DIGITS_PER_KEY):
            digit_places = places[digit]
            # Most tiles show a small range of depths, whose highest digit is the same.
            if count == 0 or digit_places[digit_of(keys[0], digit)] == count:
                continue
            # Keys with a lower value of this digit come first: counts become places.
            next_place = np.uint32(0)
            for digit_value in range(DIGIT_VALUES):
                keys_with_value = digit_places[digit_value]
                digit_places[digit_value] = next_place
                next_place += keys_with_value
            for n in range(count):
                value = digit_of(keys[n], digit)
                place = digit_places[value]
                sorted_keys[place] = keys[n]
                sorted_items[place] = items[n]
                digit_places[value] = place + np.uint32(1)
            # The result is the input for the next digit.
            keys, sorted_keys = sorted_keys, keys
            items, sorted_items = sorted_items, items
        tile_list[:] = items[:count]


@inlined_kernel
def digit_of(key: np.uint32, digit: int) -> np.uint32:
    """The 8 bits of a 32-bit sort key that are its digit number `digit`, from the lowest on."""
    shifted = key >> np.uint32(BITS_PER_DIGIT * digit)
    return np.uint32(shifted & np.uint32(DIGIT_VALUES - 1))
