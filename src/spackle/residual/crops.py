"""Where the network has to look: rectangles around the masked cells, so that a small hole costs little."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from torch import Tensor

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

    def within(self, other: Crop) -> Crop:
        """The same rectangle, counted from another one's corner."""
        return Crop(self.top - other.top, self.left - other.left, self.bottom - other.top, self.right - other.left)

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
    height, width = mask.shape
    whole = Crop(0, 0, height, width)
    found = [(inner, inner.grown(margin, step, height, width)) for inner in _cut(mask.cpu(), whole, step, margin)]
    if sum(outer.area for _, outer in found) > WHOLE * whole.area:
        return [(whole, whole)]
    return found


def _cut(mask: Tensor, crop: Crop, step: int, margin: int) -> list[Crop]:
    """The masked cells' rectangle within a crop, cut in two as long as that saves something."""
    tight = _tight(mask, crop)
    if tight is None:
        return []

    def cost(*parts: Crop) -> int:
        held = (_tight(mask, part) for part in parts)
        return sum(part.grown(margin, step, *mask.shape).area for part in held if part is not None)

    best = min(_halves(tight, step), key=lambda pair: cost(*pair), default=None)
    if best is None or cost(*best) >= cost(tight):
        return [tight]
    return [piece for half in best for piece in _cut(mask, half, step, margin)]


def _tight(mask: Tensor, crop: Crop) -> Crop | None:
    """The smallest rectangle of a crop's masked cells; None where there are none."""
    inside = mask[crop.slices]
    rows, columns = (inside.any(axis).nonzero().flatten() for axis in (1, 0))
    if not len(rows):
        return None
    top, bottom, left, right = (int(v) for v in (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1))
    return Crop(crop.top + top, crop.left + left, crop.top + bottom, crop.left + right)


def _halves(crop: Crop, step: int) -> Iterator[tuple[Crop, Crop]]:
    """All ways to cut a crop in two at multiples of `step`."""
    for row in range(crop.top // step * step + step, crop.bottom, step):
        yield dataclasses.replace(crop, bottom=row), dataclasses.replace(crop, top=row)
    for column in range(crop.left // step * step + step, crop.right, step):
        yield dataclasses.replace(crop, right=column), dataclasses.replace(crop, left=column)
