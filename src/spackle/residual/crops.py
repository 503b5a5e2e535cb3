"""Where the network has to look: rectangles around the masked cells, so that a small hole costs little."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Cells = NDArray[np.bool_]
Edges = tuple[int, int, int, int]

# What a cell's delta depends on reaches 205 cells far, but fades: from 64 cells on it is some thousandths with the
# shipped weights, a tenth of what bfloat16 rounds away. See tests/test_residual.py.
MARGIN = 64
WHOLE = 0.8  # crops that cover more than this share are not worth the trouble


@dataclasses.dataclass(frozen=True)
class Crop:
    """A rectangle of cells; the last row and column are exclusive."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def area(self) -> int:
        """In cells."""
        return (self.bottom - self.top) * (self.right - self.left)

    @property
    def slices(self) -> tuple[slice, slice]:
        """To index [h, w, ...] with."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def moved(self, down: int, right: int) -> Crop:
        """The same rectangle elsewhere."""
        return Crop(self.top + down, self.left + right, self.bottom + down, self.right + right)

    def within(self, other: Crop) -> Crop:
        """The same rectangle, counted from another one's corner."""
        return self.moved(-other.top, -other.left)

    def grown(self, margin: int, step: int, height: int, width: int) -> Crop:
        """With a margin, outwards to multiples of `step`, as far as the grid goes."""

        def down(place: int) -> int:
            return max(place - margin, 0) // step * step

        def up(place: int, end: int) -> int:
            return min(-(-(place + margin) // step) * step, end)

        return Crop(down(self.top), down(self.left), up(self.bottom, height), up(self.right, width))


def crops_around(mask: Tensor, step: int, margin: int = MARGIN) -> list[tuple[Crop, Crop]]:
    """Rectangles that hold all masked cells, and what has to be looked at for each; few and small.

    Args:
        mask: [h, w] bool.
        step: the network's stride: what it looks at begins at multiples of it, so that its grids stay where they are.
        margin: how far around the masked cells it looks.

    Returns:
        Pairs (inner, outer): the inner ones cover each masked cell exactly once, or are the whole grid.
    """
    cells = mask.cpu().numpy()
    whole = Crop(0, 0, *cells.shape)
    rows, columns = (np.flatnonzero(cells.any(axis)) for axis in (1, 0))
    if not len(rows):
        return []
    tight = Crop(*(int(edge) for edge in (rows[0], columns[0], rows[-1] + 1, columns[-1] + 1)))
    found = [(inner, inner.grown(margin, step, *cells.shape)) for inner in _cut(cells, tight, step, margin)]
    if sum(outer.area for _, outer in found) > WHOLE * whole.area:
        return [(whole, whole)]
    return found


def _cut(cells: Cells, crop: Crop, step: int, margin: int) -> list[Crop]:
    """A rectangle that its masked cells fill to all four sides, cut in two as long as that saves something."""

    def cost(*parts: Crop) -> int:
        return sum(part.grown(margin, step, *cells.shape).area for part in parts)

    best = min(_halves(cells, crop, step), key=lambda pair: cost(*pair), default=None)
    if best is None or cost(*best) >= cost(crop):
        return [crop]
    return [piece for half in best for piece in _cut(cells, half, step, margin)]


def _halves(cells: Cells, crop: Crop, step: int) -> Iterator[tuple[Crop, Crop]]:
    """All ways to cut such a rectangle in two at multiples of `step`; each half shrunk to its masked cells."""
    inside = cells[crop.slices]
    for above, below in _row_halves(inside, range(step - crop.top % step, len(inside), step)):
        yield Crop(*above).moved(crop.top, crop.left), Crop(*below).moved(crop.top, crop.left)
    for (top, left, bottom, right), other in _row_halves(
        inside.T, range(step - crop.left % step, inside.shape[1], step)
    ):
        first, second = Crop(left, top, right, bottom), Crop(other[1], other[0], other[3], other[2])
        yield first.moved(crop.top, crop.left), second.moved(crop.top, crop.left)


def _row_halves(inside: Cells, cuts: range) -> Iterator[tuple[Edges, Edges]]:
    """Top, left, bottom and right of the masked cells above and below each cut; the outermost rows have some.

    Every cut's edges come from one pass over the cells: this runs for each view that is completed.
    """
    height, width = inside.shape
    row, filled = np.arange(height), inside.any(1)
    left = np.where(filled, inside.argmax(1), width)
    right = np.where(filled, width - inside[:, ::-1].argmax(1), 0)
    upper, lower = (slice(None), slice(None, None, -1))
    lefts = [np.minimum.accumulate(left[way])[way] for way in (upper, lower)]
    rights = [np.maximum.accumulate(right[way])[way] for way in (upper, lower)]
    last = np.maximum.accumulate(np.where(filled, row, 0))
    first = np.minimum.accumulate(np.where(filled, row, height)[::-1])[::-1]
    for cut in cuts:
        above = (0, int(lefts[0][cut - 1]), int(last[cut - 1]) + 1, int(rights[0][cut - 1]))
        yield above, (int(first[cut]), int(lefts[1][cut]), height, int(rights[1][cut]))
