"""A quadtree that decides which pixels share a Gaussian.

It weighs the detail that is lost when pixels share one against the number of Gaussians. A *block*
is a square of the quadtree, of 2×2, 4×4, … pixels. A *tile* is a rectangle of pixels that share one
Gaussian: a whole block, or one of its halves.
"""

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

TILE_LEVELS = 3  # number of block sizes; the largest tiles have 8×8 pixels
# Largest relative deviation of the inverse depth from a block's plane, in and around the block.
MAX_PLANE_DEVIATION = np.float32(0.003)

# How a block may be divided into tiles: not at all, into two halves above each other, or into two
# halves side by side. Any higher number stands for a division into its four quarters.
WHOLE, FLAT_HALVES, TALL_HALVES = 0, 1, 2
TILES_OF_DIVISION = (1.0, 2.0, 2.0)


@dataclasses.dataclass(frozen=True)
class Tiles:
    """Rectangles of one size, chosen from a regular grid of such rectangles."""

    height: int  # pixels
    width: int
    rows: Tensor  # [N] indices in the grid
    columns: Tensor  # [N] indices in the grid

    def means(self, image: Tensor) -> Tensor:
        """[N, ...]: the mean of an image [H, W, ...] in each rectangle."""
        pixels = image.flatten(0, 1)  # [H·W, ...]
        image_width = image.shape[1]
        first_pixel = self.rows * (self.height * image_width) + self.columns * self.width
        # The pixels at the same place in all rectangles, one place after the other.
        total = sum(
            pixels[first_pixel + (y * image_width + x)]
            for y in range(self.height)
            for x in range(self.width)
        )
        return cast("Tensor", total) / (self.height * self.width)

    def centers(self) -> Tensor:
        """[N, 2]: the centres of the rectangles in pixels, as (x, y)."""
        x = (self.columns + 0.5) * self.width
        y = (self.rows + 0.5) * self.height
        return torch.stack([x, y], dim=-1)


def grid_means(image: Tensor, height: int, width: int) -> Tensor:
    """[H/height, W/width, ...]: the mean of an image [H, W, ...] in each rectangle of a grid.

    Rectangles that the right or lower border would cut are left out.
    """
    rows = image.shape[0] // height * height
    columns = image.shape[1] // width * width
    # Adding strided views is many times faster on a CPU than pooling. First along y, then along x.
    column_sums = cast("Tensor", sum(image[y:rows:height, :columns] for y in range(height)))
    sums = cast("Tensor", sum(column_sums[:, x::width] for x in range(width)))
    return sums / (height * width)


class Quadtree:
    """Blocks of 2×2, 4×4, … pixels, and the detail that each block would lose as one or two tiles.

    A loss is the squared difference between pixels and bilinearly interpolated tile means, summed
    over pixels and averaged over channels. A block made into tiles must not be steep. Its pixels,
    and those within one block side around it, must be free and in the block's plane, because a
    tile's Gaussian reaches that far.
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
        """Measure the losses of all blocks.

        A block is a square of 2×2, 4×4, … pixels. Its losses are the detail that it would lose if
        all its pixels, or those of each half, shared one Gaussian.

        Args:
            picture: [H, W, 3] sRGB.
            inverse_depth: [H, W] 1/z.
            slope: [H, W, 2] derivative of the inverse depth by pixel x and y.
            free: [H, W] bool: pixels that may share a Gaussian.
            levels: number of block sizes.
            steepest: greatest relative change of the inverse depth across a tile.
        """
        self.shape = inverse_depth.shape
        # For each level [H/side, W/side, 3]: the loss for WHOLE, FLAT_HALVES and TALL_HALVES;
        # infinite for a block that must not become tiles.
        self.losses: list[Tensor] = []
        for level in range(1, levels + 1):
            side = 2**level
            rows = self.shape[0] // side
            columns = self.shape[1] // side
            if rows == 0 or columns == 0:
                continue
            whole_blocks = picture[: rows * side, : columns * side]
            tile_means = [grid_means(whole_blocks, h, w) for h, w in _tile_sizes(side)]
            mean_depth = grid_means(inverse_depth, side, side)
            mean_slope = grid_means(slope, side, side)
            # In the order of the last arguments of the kernel `_measure_losses`.
            images = (picture, *tile_means, inverse_depth, mean_depth, mean_slope, free)
            arrays = [image.contiguous().numpy() for image in images]
            losses = np.empty((rows, columns, 3), np.float32)
            _measure_all_losses(side, np.float32(steepest), losses, arrays)
            self.losses.append(torch.from_numpy(losses))

    def detail(self) -> float:
        """The median deviation of pixels from their 2×2 tile, over blocks that may become tiles."""
        if not self.losses:
            return 0.0
        losses = self.losses[0][..., WHOLE]
        finite = losses[torch.isfinite(losses)]
        if finite.numel() == 0:
            return 0.0
        # A loss is a sum of squared deviations over the 4 pixels of a block.
        return math.sqrt(float(finite.median()) / 4)

    def cut(self, gaussian_cost: float) -> tuple[Tensor, list[Tiles]]:
        """The cheapest division of the picture into tiles and single pixels.

        A block, which is a square of 2×2, 4×4, … pixels, may become one tile, two flat halves or
        two tall halves, or it is divided into its four quarters, the next smaller blocks.

        The cost of a division is the sum of all losses, plus `gaussian_cost` for each Gaussian, of
        which each tile and each single pixel has one.

        Returns:
            [H, W] bool, true for single pixels, and the tiles.
        """
        # From small blocks to large ones: the cheapest way to divide each block, and its cost.
        cost = torch.full(self.shape, gaussian_cost)  # of a single pixel, [H, W]
        best_divisions = []
        for losses in self.losses:
            rows, columns, _ = losses.shape
            # The sum over the four quarters is four times their mean.
            quarters_cost = 4 * grid_means(cost[: 2 * rows, : 2 * columns], 2, 2)
            tiles_cost = losses + gaussian_cost * torch.tensor(TILES_OF_DIVISION)
            # Along the last axis: WHOLE, FLAT_HALVES, TALL_HALVES, quarters. The index of the
            # cheapest one is `division`.
            all_costs = torch.cat([tiles_cost, quarters_cost[..., None]], dim=-1)
            cost, division = all_costs.min(dim=-1)  # [rows, columns] each
            best_divisions.append(division)

        # From large blocks to small ones: take the blocks that no larger one covers. At first, all
        # pixels count as single.
        single = torch.ones(self.shape, dtype=torch.bool)
        tiles = []
        for level in range(len(best_divisions), 0, -1):
            side = 2**level
            division = best_divisions[level - 1]
            rows = division.shape[0] * side  # pixels
            columns = division.shape[1] * side
            # A block is covered as a whole or not at all, so that its first pixel tells which.
            uncovered = single[:rows:side, :columns:side]
            for kind, (height, width) in enumerate(_tile_sizes(side)):
                blocks = uncovered & (division == kind)
                # Tiles are numbered in a grid of tiles. For halves it is finer than that of blocks.
                tile_grid = blocks.repeat_interleave(side // height, 0)
                tile_grid = tile_grid.repeat_interleave(side // width, 1)
                tiles.append(Tiles(height, width, *tile_grid.nonzero(as_tuple=True)))
            # Blocks that are divided into quarters are left to the next smaller level.
            still_single = ~uncovered | (division > TALL_HALVES)
            still_single = still_single.repeat_interleave(side, 0).repeat_interleave(side, 1)
            single[:rows, :columns] &= still_single
        return single, [of_one_size for of_one_size in tiles if len(of_one_size.rows) > 0]


def _tile_sizes(side: int) -> tuple[tuple[int, int], ...]:
    """(height, width) of a block's tiles for WHOLE, FLAT_HALVES and TALL_HALVES."""
    return (side, side), (side // 2, side), (side, side // 2)


def _measure_all_losses(
    side: int, steepest: np.float32, losses: NDArray[np.float32], arrays: list[NDArray[Any]]
) -> None:
    """Write the losses [rows, columns, 3] of all blocks with this side, on several threads.

    A block is a square of side × side pixels. Its losses are the detail that it would lose as one
    tile, as two flat halves and as two tall halves, if the pixels of a tile share one Gaussian.

    `arrays` are the inputs, in the order of the kernel's last arguments: the picture; its means in
    whole, flat and tall tiles; the inverse depth; the means of the inverse depth and of its slope
    in blocks; and the pixels that may share a Gaussian.
    """
    parallel_for_chunks(
        lambda start, stop: _measure_losses(start, stop, side, steepest, losses, *arrays),
        len(losses),
    )


@kernel
def _measure_losses(
    start: int, stop: int, side: int, steepest: Any, losses: Any,
    picture: Any, whole_means: Any, flat_means: Any, tall_means: Any,
    inverse_depth: Any, mean_depth: Any, mean_slope: Any, free: Any,
) -> None:  # fmt: skip
    """Measure the detail that blocks would lose as tiles, for the block rows start..stop.

    Args:
        start, stop: rows of blocks.
        side: of a block, in pixels.
        steepest: greatest relative change of the inverse depth across a tile.
        losses: [rows, columns, 3] float32: the losses as one tile, as two flat halves and as two
            tall ones are written here; infinite for a block that must not become tiles.
        picture: [H, W, 3] sRGB.
        whole_means, flat_means, tall_means: means of the picture in all tiles of these kinds.
        inverse_depth: [H, W].
        mean_depth, mean_slope: [rows, columns] and [rows, columns, 2]: means of the inverse depth
            and of its derivative in each block, which together are the block's plane.
        free: [H, W] bool: pixels that may share a Gaussian.
    """
    half = side // 2
    for row in range(start, stop):
        for column in range(losses.shape[1]):
            depth = mean_depth[row, column]
            slope = mean_slope[row, column]
            if not _lies_in_plane(row, column, side, steepest, inverse_depth, depth, slope, free):
                losses[row, column, :] = np.inf
                continue
            losses[row, column, WHOLE] = _tile_loss(row, column, side, side, whole_means, picture)
            losses[row, column, FLAT_HALVES] = 0
            losses[row, column, TALL_HALVES] = 0
            for k in range(2):
                losses[row, column, FLAT_HALVES] += _tile_loss(
                    2 * row + k, column, half, side, flat_means, picture
                )
                losses[row, column, TALL_HALVES] += _tile_loss(
                    row, 2 * column + k, side, half, tall_means, picture
                )


@kernel
def _lies_in_plane(
    row: int,
    column: int,
    side: int,
    steepest: Any,
    inverse_depth: Any,
    depth: Any,
    slope: Any,
    free: Any,
) -> bool:
    """Whether a block and its surroundings, one side wide, are free and lie in the block's plane.

    Args:
        row, column: of the block among blocks of its size.
        side: of the block, in pixels.
        steepest: greatest relative change of the inverse depth across the block.
        inverse_depth: [H, W].
        depth, slope: mean inverse depth of the block, and its mean derivative [2] by x and y.
        free: [H, W] bool: pixels that may share a Gaussian.
    """
    height, width = inverse_depth.shape
    if (abs(slope[0]) + abs(slope[1])) * side > steepest * depth:
        return False
    top = row * side
    left = column * side
    middle = np.float32(0.5) * (side - 1)  # offset of the block's centre from its first pixel's
    for y in range(max(top - side, 0), min(top + 2 * side, height)):
        for x in range(max(left - side, 0), min(left + 2 * side, width)):
            plane = depth + slope[0] * (x - left - middle) + slope[1] * (y - top - middle)
            deviation = abs(inverse_depth[y, x] - plane)
            if not free[y, x] or deviation > MAX_PLANE_DEVIATION * depth:
                return False
    return True


@kernel
def _tile_loss(row: int, column: int, height: int, width: int, means: Any, picture: Any) -> Any:
    """Squared difference between a tile's pixels and the bilinearly interpolated means of tiles.

    It is summed over the tile's pixels and averaged over channels.

    Args:
        row, column: of the tile among tiles of its size.
        height, width: of the tile, in pixels.
        means: [rows, columns, 3] means of all tiles of this size.
        picture: [H, W, 3].
    """
    rows, columns, channels = means.shape
    total = np.float32(0)
    for y in range(height):
        # The pixel's row lies between the centre of this tile and that of the next tile below or
        # above. v is the distance from this tile's centre in tile heights, and so the share of the
        # other tile in the interpolation; u and the columns are the same along x.
        v = (y + np.float32(0.5)) / height - np.float32(0.5)
        other_row = min(max(row + (1 if v > 0 else -1), 0), rows - 1)
        v = abs(v)
        for x in range(width):
            u = (x + np.float32(0.5)) / width - np.float32(0.5)
            other_column = min(max(column + (1 if u > 0 else -1), 0), columns - 1)
            u = abs(u)
            for c in range(channels):
                own = (1 - u) * means[row, column, c] + u * means[row, other_column, c]
                other = (1 - u) * means[other_row, column, c] + u * means[
                    other_row, other_column, c
                ]
                smooth = (1 - v) * own + v * other
                difference = picture[row * height + y, column * width + x, c] - smooth
                total += difference * difference
    return total / channels
