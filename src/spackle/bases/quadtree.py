"""Which pixels share a Gaussian: a quadtree over the picture, cut where the lost detail is worth less than is saved."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle._numba import kernel
from spackle.device import run_chunks

LEVELS = 3  # the largest tiles have 8×8 pixels
BEND = np.float32(0.003)  # most that the inverse depth in and around a tile leaves its plane, relative


@dataclasses.dataclass(frozen=True)
class Tiles:
    """Squares of one size that lie on a grid of such squares."""

    side: int  # pixels
    rows: Tensor  # [N] of the grid
    columns: Tensor  # [N]

    def means(self, image: Tensor) -> Tensor:
        """[N, ...]: an image's [H, W, ...] mean in each."""
        return block_means(image, self.side)[self.rows, self.columns]

    def centers(self) -> Tensor:
        """[N, 2] in pixels, as (x, y)."""
        return (torch.stack([self.columns, self.rows], dim=-1) + 0.5) * self.side


def block_means(image: Tensor, side: int) -> Tensor:
    """[H/side, W/side, ...]: an image's mean in each whole block of a grid."""
    rows, columns = (n // side * side for n in image.shape[:2])
    tall = sum(image[y:rows:side, :columns] for y in range(side))
    return cast("Tensor", sum(cast("Tensor", tall)[:, x::side] for x in range(side))) / side**2


class Quadtree:
    """Blocks of 2×2, 4×4, … pixels, and what each would lose as one tile.

    Lost is the squared difference from tiles' means with smooth transitions, summed over pixels, mean of channels. A
    block with a pixel that is not free, or a depth that leaves its plane, in it or within a block's side around it is
    no tile: its Gaussian reaches as far. Nor is a steep one.
    """

    def __init__(
        self, picture: Tensor, inverse_depth: Tensor, slope: Tensor, free: Tensor, levels: int, steepest: float
    ) -> None:
        """Measure all blocks.

        Args:
            picture: [H, W, 3], as it is compared: sRGB.
            inverse_depth: [H, W].
            slope: [H, W, 2] of it by pixel x and y.
            free: [H, W] bool.
            levels: how many sizes of blocks there are; 0 leaves every pixel for itself.
            steepest: most that the inverse depth changes across a block, relative.
        """
        self.shape = inverse_depth.shape
        self.lost: list[Tensor] = []  # [H/side, W/side] for each level
        for side in (2**level for level in range(1, levels + 1)):
            means = [block_means(image, side) for image in (picture, inverse_depth, slope)]
            arrays = [image.contiguous().numpy() for image in (picture, inverse_depth, free, *means)]
            lost = np.empty(means[1].shape, np.float32)
            _measure_all(side, np.float32(steepest), lost, arrays)
            self.lost.append(torch.from_numpy(lost))

    def detail(self) -> float:
        """The median deviation of pixels from what a tile of 2×2 would show, where there may be one."""
        finite = self.lost[0][torch.isfinite(self.lost[0])] if self.lost else torch.empty(0)
        return math.sqrt(float(finite.median()) / 4) if finite.numel() else 0.0

    def cut(self, worth: float) -> tuple[Tensor, list[Tiles]]:
        """Tiles that together lose least, a tile or pixel itself counting as a loss of `worth`.

        Returns [H, W] bool, which pixels stay for themselves, and the tiles.
        """
        cost, whole = torch.full(self.shape, worth), []
        for lost in self.lost:
            parts = 4 * block_means(cost[: 2 * lost.shape[0], : 2 * lost.shape[1]], 2)
            whole.append(lost + worth < parts)
            cost = torch.minimum(lost + worth, parts)
        single, tiles = torch.ones(self.shape, dtype=torch.bool), []
        for level in range(len(whole), 0, -1):
            side, (rows, columns) = 2**level, whole[level - 1].shape
            chosen = whole[level - 1] & single[: rows * side : side, : columns * side : side]
            tiles.append(Tiles(side, *chosen.nonzero(as_tuple=True)))
            covered = chosen.repeat_interleave(side, 0).repeat_interleave(side, 1)
            single[: rows * side, : columns * side] &= ~covered
        return single, [part for part in tiles if len(part.rows)]


def _measure_all(side: int, steepest: np.float32, lost: NDArray[np.float32], arrays: list[NDArray[Any]]) -> None:
    run_chunks(lambda start, stop: _measure(start, stop, side, steepest, lost, *arrays), len(lost), grain=16)


@kernel
def _measure(
    start: int, stop: int, side: int, steepest: Any, lost: Any,
    picture: Any, inverse_depth: Any, free: Any, colors: Any, depths: Any, slopes: Any,
) -> None:  # fmt: skip
    """Rows start..stop of the blocks."""
    for row in range(start, stop):
        for column in range(lost.shape[1]):
            lost[row, column] = np.inf
            if _fits(row, column, side, steepest, inverse_depth, depths[row, column], slopes[row, column], free):
                lost[row, column] = _lost(row, column, side, colors, picture)


@kernel
def _fits(
    row: int, column: int, side: int, steepest: Any, inverse_depth: Any, depth: Any, slope: Any, free: Any
) -> bool:
    """Whether a block and what lies within a side of it is free, and in the block's plane."""
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
def _lost(row: int, column: int, side: int, means: Any, picture: Any) -> Any:
    """Squared difference of a block's pixels from its grid's means, interpolated bilinearly."""
    rows, columns, channels = means.shape
    total = np.float32(0)
    for y in range(side):
        v = (y + np.float32(0.5)) / side - np.float32(0.5)
        row2, v = min(max(row + (1 if v > 0 else -1), 0), rows - 1), abs(v)
        for x in range(side):
            u = (x + np.float32(0.5)) / side - np.float32(0.5)
            column2, u = min(max(column + (1 if u > 0 else -1), 0), columns - 1), abs(u)
            for c in range(channels):
                here = (1 - u) * means[row, column, c] + u * means[row, column2, c]
                there = (1 - u) * means[row2, column, c] + u * means[row2, column2, c]
                off = picture[row * side + y, column * side + x, c] - ((1 - v) * here + v * there)
                total += off * off
    return total / channels
