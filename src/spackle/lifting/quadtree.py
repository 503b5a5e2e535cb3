"""A quadtree that decides which pixels share a Gaussian: it weighs lost detail against the number of Gaussians."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

LEVELS = 3  # the largest tiles have 8×8 pixels
BEND = np.float32(
    0.003
)  # largest relative deviation of the inverse depth from a tile's plane, in and around the tile
SQUARE, FLAT, TALL = (
    0,
    1,
    2,
)  # a block becomes one tile, two halves above each other, or two halves side by side


@dataclasses.dataclass(frozen=True)
class Tiles:
    """Rectangles of one size on a grid."""

    height: int  # pixels
    width: int
    rows: Tensor  # [N] indices in the grid
    columns: Tensor  # [N] indices in the grid

    def means(self, image: Tensor) -> Tensor:
        """[N, ...]: the mean of an image [H, W, ...] in each rectangle."""
        flat, width = image.flatten(0, 1), image.shape[1]
        first = self.rows * (self.height * width) + self.columns * self.width
        total = sum(
            flat[first + (y * width + x)] for y in range(self.height) for x in range(self.width)
        )
        return cast("Tensor", total) / (self.height * self.width)

    def centers(self) -> Tensor:
        """[N, 2]: the centres of the rectangles in pixels, as (x, y)."""
        return torch.stack(
            [(self.columns + 0.5) * self.width, (self.rows + 0.5) * self.height], dim=-1
        )


def grid_means(image: Tensor, height: int, width: int) -> Tensor:
    """[H/height, W/width, ...]: the mean of an image [H, W, ...] in each whole rectangle of a grid."""
    rows, columns = image.shape[0] // height * height, image.shape[1] // width * width
    tall = sum(image[y:rows:height, :columns] for y in range(height))
    return cast("Tensor", sum(cast("Tensor", tall)[:, x::width] for x in range(width))) / (
        height * width
    )


class Quadtree:
    """Blocks of 2×2, 4×4, … pixels, and the detail that each block would lose as one tile or as two halves.

    A loss is the squared difference between pixels and bilinearly interpolated tile means, summed over pixels and
    averaged over channels. A block made into a tile must not be steep. Its pixels, and those within one block side
    around it, must be free and in the block's plane, because a tile's Gaussian reaches that far.
    """

    def __init__(
        self,
        picture: Tensor,
        inverse_depth: Tensor,
        slope: Tensor,
        free: Tensor,
        levels: int,
        steepest: float,
    ) -> None:
        """Measure the losses of all blocks in `picture` [H, W, 3] sRGB.

        `slope` [H, W, 2] is the derivative of `inverse_depth` [H, W] by pixel x and y, `free` [H, W] bool marks the
        pixels that may share a Gaussian, `levels` is the number of block sizes, and `steepest` the greatest relative
        change of inverse depth across a tile.
        """
        self.shape = inverse_depth.shape
        self.lost: list[
            Tensor
        ] = []  # [H/side, W/side, 3] for each level: as one tile, as flat and as tall halves
        for level in range(1, levels + 1):
            side = 2**level
            rows, columns = (n // side for n in self.shape)
            if rows and columns:
                inside = picture[: rows * side, : columns * side]
                means = [grid_means(inside, h, w) for h, w in _sizes(side)]
                planes = (grid_means(inverse_depth, side, side), grid_means(slope, side, side))
                arrays = [
                    image.contiguous().numpy()
                    for image in (picture, *means, inverse_depth, *planes, free)
                ]
                lost = np.empty((rows, columns, 3), np.float32)
                _measure_all(side, np.float32(steepest), lost, arrays)
                self.lost.append(torch.from_numpy(lost))

    def detail(self) -> float:
        """The median deviation of pixels from their 2×2 tile, over blocks that may become tiles."""
        lost = self.lost[0][..., SQUARE] if self.lost else torch.empty(0)
        finite = lost[torch.isfinite(lost)]
        return math.sqrt(float(finite.median()) / 4) if finite.numel() else 0.0

    def cut(self, worth: float) -> tuple[Tensor, list[Tiles]]:
        """The cheapest division into tiles and single pixels; the cost is all losses plus `worth` for each Gaussian.

        Returns [H, W] bool (true for single pixels), and the tiles.
        """
        single = torch.ones(self.shape, dtype=torch.bool)
        cost = torch.full(self.shape, worth)
        choices = []
        for lost in self.lost:
            parts = 4 * grid_means(cost[: 2 * lost.shape[0], : 2 * lost.shape[1]], 2, 2)
            options = lost + worth * torch.tensor([1.0, 2.0, 2.0])
            cost, choice = torch.cat([options, parts[..., None]], dim=-1).min(dim=-1)
            choices.append(choice)
        tiles = []
        for level in range(len(choices), 0, -1):
            side, choice = 2**level, choices[level - 1]
            rows, columns = (n * side for n in choice.shape)
            open_ = single[:rows:side, :columns:side]
            for shape, (height, width) in enumerate(_sizes(side)):
                chosen = open_ & (choice == shape)
                chosen = chosen.repeat_interleave(side // height, 0).repeat_interleave(
                    side // width, 1
                )
                tiles.append(Tiles(height, width, *chosen.nonzero(as_tuple=True)))
            left = ~open_ | (choice > TALL)
            single[:rows, :columns] &= left.repeat_interleave(side, 0).repeat_interleave(side, 1)
        return single, [part for part in tiles if len(part.rows)]


def _sizes(side: int) -> tuple[tuple[int, int], ...]:
    """(height, width) of a block's tiles for SQUARE, FLAT and TALL."""
    return (side, side), (side // 2, side), (side, side // 2)


def _measure_all(
    side: int, steepest: np.float32, lost: NDArray[np.float32], arrays: list[NDArray[Any]]
) -> None:
    parallel_for_chunks(
        lambda start, stop: _measure(start, stop, side, steepest, lost, *arrays), len(lost)
    )


@kernel
def _measure(
    start: int, stop: int, side: int, steepest: Any, lost: Any,
    picture: Any, square: Any, flat: Any, tall: Any, inverse_depth: Any, depths: Any, slopes: Any, free: Any,
) -> None:  # fmt: skip
    """Measure the losses of the block rows start..stop."""
    for row in range(start, stop):
        for column in range(lost.shape[1]):
            if not _fits(
                row,
                column,
                side,
                steepest,
                inverse_depth,
                depths[row, column],
                slopes[row, column],
                free,
            ):
                lost[row, column, :] = np.inf
                continue
            lost[row, column, SQUARE] = _lost(row, column, side, side, square, picture)
            lost[row, column, FLAT] = lost[row, column, TALL] = 0
            for half in range(2):
                lost[row, column, FLAT] += _lost(
                    2 * row + half, column, side // 2, side, flat, picture
                )
                lost[row, column, TALL] += _lost(
                    row, 2 * column + half, side, side // 2, tall, picture
                )


@kernel
def _fits(
    row: int,
    column: int,
    side: int,
    steepest: Any,
    inverse_depth: Any,
    depth: Any,
    slope: Any,
    free: Any,
) -> bool:
    """Whether a block and its surroundings, one side wide, are free and lie in the block's plane."""
    height, width = inverse_depth.shape
    if (abs(slope[0]) + abs(slope[1])) * side > steepest * depth:
        return False
    top, left, middle = row * side, column * side, np.float32(0.5) * (side - 1)
    for y in range(max(top - side, 0), min(top + 2 * side, height)):
        for x in range(max(left - side, 0), min(left + 2 * side, width)):
            plane = depth + slope[0] * (x - left - middle) + slope[1] * (y - top - middle)
            if not free[y, x] or abs(inverse_depth[y, x] - plane) > BEND * depth:
                return False
    return True


@kernel
def _lost(row: int, column: int, height: int, width: int, means: Any, picture: Any) -> Any:
    """Squared difference between a tile's pixels and the bilinearly interpolated means of tiles."""
    rows, columns, channels = means.shape
    total = np.float32(0)
    for y in range(height):
        v = (y + np.float32(0.5)) / height - np.float32(0.5)
        row2, v = min(max(row + (1 if v > 0 else -1), 0), rows - 1), abs(v)
        for x in range(width):
            u = (x + np.float32(0.5)) / width - np.float32(0.5)
            column2, u = min(max(column + (1 if u > 0 else -1), 0), columns - 1), abs(u)
            for c in range(channels):
                here = (1 - u) * means[row, column, c] + u * means[row, column2, c]
                there = (1 - u) * means[row2, column, c] + u * means[row2, column2, c]
                off = picture[row * height + y, column * width + x, c] - (
                    (1 - v) * here + v * there
                )
                total += off * off
    return total / channels
