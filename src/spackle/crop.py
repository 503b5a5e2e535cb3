"""A rectangle of a grid of pixels or cells."""

from __future__ import annotations

import dataclasses


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

    def grown(self, margin: int, step: int, height: int, width: int) -> Crop:
        """With a margin, outwards to multiples of `step`, as far as the grid goes."""
        top, left = (max(place - margin, 0) // step * step for place in (self.top, self.left))
        far = ((self.bottom, height), (self.right, width))
        return Crop(top, left, *(min(-(-(place + margin) // step) * step, end) for place, end in far))

    def touches(self, other: Crop) -> bool:
        """Whether they overlap, or there is no cell between them."""
        rows = self.top <= other.bottom and other.top <= self.bottom
        return rows and self.left <= other.right and other.left <= self.right

    def union(self, other: Crop) -> Crop:
        """The smallest that holds both."""
        top, left = min(self.top, other.top), min(self.left, other.left)
        return Crop(top, left, max(self.bottom, other.bottom), max(self.right, other.right))
