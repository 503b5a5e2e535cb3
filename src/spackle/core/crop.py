"""Rectangles of a grid: `crops_around_mask` covers all masked cells with a few small rectangles.

A network that looks at a limited neighbourhood then runs on these rectangles only. The grid is that
of the network's input, and a cell is one element of it.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.filters import maximum_filter

Mask = NDArray[np.bool_]

# Cells around a masked cell that the network gets to see. Farther cells change an output of the
# shipped weights by less than bfloat16's rounding does.
DEFAULT_MARGIN_CELLS = 32
MAX_CROPPED_RATIO = 0.8  # crops that cover more of the grid save too little: it is used whole
GOOD_ENOUGH_RATIO = 1.1  # a rectangle is not cut if its area is below 1.1 times the lower bound
CALL_COST_BLOCKS = 8  # a call of the network costs as much as this many blocks of cells


@dataclasses.dataclass(frozen=True)
class Crop:
    """A rectangle of cells; `bottom` and `right` are exclusive."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def area(self) -> int:
        """The number of cells."""
        return (self.bottom - self.top) * (self.right - self.left)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices of rows and columns, which cut the rectangle out of an array [h, w, ...]."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def moved(self, down: int, right: int) -> Crop:
        """The rectangle, translated by this number of rows and columns."""
        return Crop(self.top + down, self.left + right, self.bottom + down, self.right + right)

    def grown(self, margin: int, step: int, height: int, width: int) -> Crop:
        """The rectangle with a margin, rounded outwards to multiples of `step`.

        It is cut off at the border of the grid, which has `height` rows and `width` columns.
        """
        return Crop(
            top=_round_down(max(self.top - margin, 0), step),
            left=_round_down(max(self.left - margin, 0), step),
            bottom=min(_round_up(self.bottom + margin, step), height),
            right=min(_round_up(self.right + margin, step), width),
        )

    def touches(self, other: Crop) -> bool:
        """Whether the two rectangles overlap or adjoin."""
        rows_meet = self.top <= other.bottom and other.top <= self.bottom
        columns_meet = self.left <= other.right and other.left <= self.right
        return rows_meet and columns_meet

    def union(self, other: Crop) -> Crop:
        """The smallest rectangle that contains both."""
        return Crop(
            top=min(self.top, other.top),
            left=min(self.left, other.left),
            bottom=max(self.bottom, other.bottom),
            right=max(self.right, other.right),
        )


def _round_down(value: int, step: int) -> int:
    """The largest multiple of `step` that is at most `value`."""
    return value // step * step


def _round_up(value: int, step: int) -> int:
    """The smallest multiple of `step` that is at least `value`."""
    return math.ceil(value / step) * step


def crops_around_mask(
    mask: Tensor, step: int, margin: int = DEFAULT_MARGIN_CELLS
) -> list[tuple[Crop, Crop]]:
    """Cover all masked cells of a grid with a few small rectangles, on which a network then runs.

    Args:
        mask: [h, w] bool, the cells for which the network's output is needed.
        step: the network's stride; outer rectangles begin at multiples of the stride.
        margin: number of cells that the network needs around each masked cell.

    Returns:
        Pairs (inner, outer) of rectangles; outer includes the margin. The inner rectangles contain
        each masked cell exactly once. If cropping saves little, there is one pair, and both its
        rectangles are the whole grid. Without a masked cell, there is no pair.
    """
    cells: Mask = mask.cpu().numpy()
    height, width = cells.shape
    if not cells.any():
        return []

    # The search works with blocks of step×step cells, because outer rectangles begin at multiples
    # of the stride in any case, and blocks are fewer than cells.
    blocks = _any_in_blocks(cells, step)  # [h/step, w/step] whether any cell is masked
    bounds = _shrink_to_mask(blocks, Crop(0, 0, *blocks.shape))
    margin_blocks = math.ceil(margin / step)
    crops = []
    for part in _cut_in_parts(blocks, bounds, margin_blocks):
        # From blocks back to cells. The outermost blocks may have rows or columns of cells without
        # any masked one, which are cut off.
        part_cells = Crop(part.top * step, part.left * step, part.bottom * step, part.right * step)
        inner = _shrink_to_mask(cells, part_cells)
        outer = inner.grown(margin, step, height, width)
        crops.append((inner, outer))

    # One call for the whole grid is faster than many that overlap.
    whole = Crop(0, 0, height, width)
    cropped_area = sum(outer.area for _, outer in crops)
    if cropped_area > MAX_CROPPED_RATIO * whole.area:
        return [(whole, whole)]
    return crops


def _any_in_blocks(cells: Mask, step: int) -> Mask:
    """Whether any cell is masked in each block of step×step cells, [h/step, w/step] rounded up."""
    height, width = cells.shape
    # −n % step is what n lacks to the next multiple of `step`; the cells added are not masked.
    padded = np.pad(cells, [(0, -height % step), (0, -width % step)])
    rows = padded.shape[0] // step
    columns = padded.shape[1] // step
    # Axes 1 and 3 run over the rows and columns inside of a block.
    blocks: Mask = np.any(padded.reshape(rows, step, columns, step), axis=(1, 3))
    return blocks


def _shrink_to_mask(cells: Mask, crop: Crop) -> Crop:
    """Shrink a rectangle to its masked cells; at least one cell of it must be masked."""
    inside = cells[crop.slices]
    rows = np.flatnonzero(inside.any(axis=1))
    columns = np.flatnonzero(inside.any(axis=0))
    tight = Crop(
        top=int(rows[0]),
        left=int(columns[0]),
        bottom=int(rows[-1]) + 1,
        right=int(columns[-1]) + 1,
    )
    return tight.moved(crop.top, crop.left)


def _cut_in_parts(blocks: Mask, crop: Crop, margin: int) -> list[Crop]:
    """Cut a rectangle in two, and its halves again, as long as that saves work of the network.

    Args:
        blocks: [h, w] mask; the network must run on each masked block.
        crop: a rectangle of blocks that has masked blocks at its four sides.
        margin: number of blocks that the network needs around each masked block.

    Returns:
        Rectangles, each shrunk to its masked blocks, which contain each masked block exactly once.
    """
    height, width = blocks.shape
    uncut_area = crop.grown(margin, step=1, height=height, width=width).area
    if uncut_area <= GOOD_ENOUGH_RATIO * _min_area(blocks, crop, margin):
        return [crop]

    # Try all cuts between two rows and between two columns. A cut makes two halves, each a
    # rectangle (top, left, bottom, right) around its masked blocks.
    inside = blocks[crop.slices]
    row_cuts = _halves_of_row_cuts(inside)  # [cuts, 2 halves, 4]
    # A column of the mask is a row of the transposed mask, whose bounds are in another order: left,
    # top, right, bottom.
    transposed_cuts = _halves_of_row_cuts(inside.T)
    column_cuts = transposed_cuts[..., [1, 0, 3, 2]]
    halves = np.concatenate([row_cuts, column_cuts])
    # So far, positions count from the rectangle's corner. With the corner added, they are positions
    # in the grid.
    halves += (crop.top, crop.left, crop.top, crop.left)

    # Take the cut whose halves, with their margins, have the least area.
    grown_starts = np.maximum(halves[..., :2] - margin, 0)  # [cuts, 2 halves, 2]
    grown_ends = np.minimum(halves[..., 2:] + margin, (height, width))
    areas = (grown_ends - grown_starts).prod(-1).sum(1)  # [cuts]
    best_halves = halves[areas.argmin()]  # [2, 4]

    # Cut the halves again, and compare the cost of all parts with that of the uncut rectangle. Each
    # call of the network has a price of its own, so many small parts can cost more.
    parts = []
    for top, left, bottom, right in best_halves.tolist():
        parts += _cut_in_parts(blocks, Crop(top, left, bottom, right), margin)
    part_areas = [part.grown(margin, step=1, height=height, width=width).area for part in parts]
    cut_cost = sum(part_areas) + len(parts) * CALL_COST_BLOCKS
    uncut_cost = uncut_area + CALL_COST_BLOCKS
    return parts if cut_cost < uncut_cost else [crop]


def _min_area(blocks: Mask, crop: Crop, margin: int) -> int:
    """Least number of blocks that the network must process, however the rectangle is cut.

    The network needs all blocks within `margin` blocks of a masked block of the rectangle; `blocks`
    [h, w] is the mask.
    """
    inside_crop = np.zeros_like(blocks)
    inside_crop[crop.slices] = blocks[crop.slices]
    return int(maximum_filter(torch.from_numpy(inside_crop), margin).sum())


def _halves_of_row_cuts(blocks: Mask) -> NDArray[np.int64]:
    """Bounds of the masked blocks above and below each possible cut between two rows.

    Args:
        blocks: [h, w] mask; the first and the last row must have masked blocks.

    Returns:
        [h − 1 cuts, 2 halves, 4]: for the upper and the lower half of each cut, the top, left,
        bottom (exclusive) and right (exclusive) of the rectangle around its masked blocks.
    """
    height, width = blocks.shape
    row_numbers = np.arange(height)
    has_mask = blocks.any(axis=1)  # [h]

    # First and last masked column of each row. A row without masked blocks gets values that never
    # become the minimum or maximum of several rows.
    first_column = np.where(has_mask, blocks.argmax(axis=1), width)
    last_column_end = np.where(has_mask, width - blocks[:, ::-1].argmax(axis=1), 0)

    # For each row, the bounds of that row and all rows above it, and of it and all rows below it.
    # Below, the rows are reversed, because numpy accumulates from the first element on.
    left_above = np.minimum.accumulate(first_column)
    left_below = np.minimum.accumulate(first_column[::-1])[::-1]
    right_above = np.maximum.accumulate(last_column_end)
    right_below = np.maximum.accumulate(last_column_end[::-1])[::-1]
    last_row_above = np.maximum.accumulate(np.where(has_mask, row_numbers, 0))
    first_row_below = np.minimum.accumulate(np.where(has_mask, row_numbers, height)[::-1])[::-1]

    # The cut number k lies between the rows k and k + 1.
    top_of_upper = np.zeros(height - 1, np.int64)
    upper = [top_of_upper, left_above[:-1], last_row_above[:-1] + 1, right_above[:-1]]
    bottom_of_lower = np.full(height - 1, height)
    lower = [first_row_below[1:], left_below[1:], bottom_of_lower, right_below[1:]]
    return np.stack([np.stack(upper, axis=1), np.stack(lower, axis=1)], axis=1)
