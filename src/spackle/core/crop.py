"""Rectangles of a grid; `crops_around_mask` covers all masked cells with a few small rectangles."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.filters import maximum_filter

Mask = NDArray[np.bool_]

MARGIN = 32  # cells; farther cells change a delta of the shipped weights by less than bfloat16's rounding does
WHOLE = 0.8  # if crops cover more than this fraction of the grid, the whole grid is used instead
NEARLY = 1.1  # a rectangle is not cut if its area is below this multiple of the least possible area
CALL_BLOCKS = 8  # fixed cost of a crop, in blocks of step×step cells


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
        """Slices for an array [h, w, ...]."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def moved(self, down: int, right: int) -> Crop:
        """The rectangle, translated."""
        return Crop(self.top + down, self.left + right, self.bottom + down, self.right + right)

    def grown(self, margin: int, step: int, height: int, width: int) -> Crop:
        """The rectangle with a margin, rounded outwards to multiples of `step` within the grid."""
        top, left = (max(place - margin, 0) // step * step for place in (self.top, self.left))
        far = ((self.bottom, height), (self.right, width))
        return Crop(
            top, left, *(min(-(-(place + margin) // step) * step, end) for place, end in far)
        )

    def touches(self, other: Crop) -> bool:
        """Whether the two rectangles overlap or adjoin."""
        rows = self.top <= other.bottom and other.top <= self.bottom
        return rows and self.left <= other.right and other.left <= self.right

    def union(self, other: Crop) -> Crop:
        """The smallest rectangle that contains both."""
        top, left = min(self.top, other.top), min(self.left, other.left)
        return Crop(top, left, max(self.bottom, other.bottom), max(self.right, other.right))


def crops_around_mask(mask: Tensor, step: int, margin: int = MARGIN) -> list[tuple[Crop, Crop]]:
    """Cover all masked cells with a few small rectangles.

    Args:
        mask: [h, w] bool.
        step: the network's stride; outer rectangles begin at multiples of the stride.
        margin: number of cells that the network needs around each masked cell.

    Returns:
        Pairs (inner, outer) of rectangles; outer includes the margin. The inner rectangles contain each masked cell
        exactly once. If cropping saves little, there is one pair, and both its rectangles are the whole grid.
    """
    cells: Mask = mask.cpu().numpy()
    whole = Crop(0, 0, *cells.shape)
    if not cells.any():
        return []
    rest = [(0, -size % step) for size in cells.shape]
    tall, wide = (-(-size // step) for size in cells.shape)
    blocks: Mask = np.logical_or.reduce(
        np.pad(cells, rest).reshape(tall, step, wide, step), axis=(1, 3)
    )
    found = []
    for part in _cut(blocks, _tight(blocks, Crop(0, 0, tall, wide)), -(-margin // step)):
        inner = _tight(cells, Crop(*(step * edge for edge in dataclasses.astuple(part))))
        found.append((inner, inner.grown(margin, step, *cells.shape)))
    if sum(outer.area for _, outer in found) > WHOLE * whole.area:
        return [(whole, whole)]
    return found


def _tight(cells: Mask, crop: Crop) -> Crop:
    """Shrink a rectangle to its masked cells; at least one cell must be masked."""
    rows, columns = (np.flatnonzero(cells[crop.slices].any(axis)) for axis in (1, 0))
    edges = (int(edge) for edge in (rows[0], columns[0], rows[-1] + 1, columns[-1] + 1))
    return Crop(*edges).moved(crop.top, crop.left)


def _cut(blocks: Mask, crop: Crop, reach: int) -> list[Crop]:
    """Cut a tight rectangle recursively in two if that saves work."""
    own = crop.grown(reach, 1, *blocks.shape).area
    if own <= NEARLY * _least(blocks, crop, reach):
        return [crop]
    inside = blocks[crop.slices]
    halves = np.concatenate([_row_halves(inside), _row_halves(inside.T)[..., [1, 0, 3, 2]]])
    halves += (crop.top, crop.left) * 2
    low, high = (
        np.maximum(halves[..., :2] - reach, 0),
        np.minimum(halves[..., 2:] + reach, blocks.shape),
    )
    best = halves[(high - low).prod(-1).sum(1).argmin()]
    parts = [part for half in best for part in _cut(blocks, Crop(*map(int, half)), reach)]
    cost = sum(part.grown(reach, 1, *blocks.shape).area + CALL_BLOCKS for part in parts)
    return parts if cost < own + CALL_BLOCKS else [crop]


def _least(blocks: Mask, crop: Crop, reach: int) -> int:
    """Lower bound for the number of blocks that the network must process, however the rectangle is cut."""
    near = np.zeros_like(blocks)
    near[crop.slices] = blocks[crop.slices]
    return int(maximum_filter(torch.from_numpy(near), reach).sum())


def _row_halves(inside: Mask) -> NDArray[np.int64]:
    """Bounds [cuts, 2, 4] of the masked blocks above and below each cut between rows: top, left, bottom, right."""
    height, width = inside.shape
    row, filled = np.arange(height), inside.any(1)
    left = np.where(filled, inside.argmax(1), width)
    right = np.where(filled, width - inside[:, ::-1].argmax(1), 0)
    upper, lower = (slice(None), slice(None, None, -1))
    lefts = [np.minimum.accumulate(left[way])[way] for way in (upper, lower)]
    rights = [np.maximum.accumulate(right[way])[way] for way in (upper, lower)]
    last = np.maximum.accumulate(np.where(filled, row, 0))
    first = np.minimum.accumulate(np.where(filled, row, height)[::-1])[::-1]
    above = [np.zeros(height - 1, np.int64), lefts[0][:-1], last[:-1] + 1, rights[0][:-1]]
    below = [first[1:], lefts[1][1:], np.full(height - 1, height), rights[1][1:]]
    return np.stack([np.stack(above, 1), np.stack(below, 1)], 1)
