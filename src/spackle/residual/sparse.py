"""The fine end of the network at chosen cells alone: gathered rows and matrix products in place of convolutions.

Holes are thin, and the network's last, finest convolutions are half of its cost. Its encoder has to see everything,
but its decoder and heads need to be right only around the masked cells: see `ResidualNet.deltas_at`.
"""

from __future__ import annotations

import dataclasses
import functools

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, pad

CHUNK = 8192  # cells whose surroundings are gathered at once: they should stay in the cache


@dataclasses.dataclass(frozen=True)
class Cells:
    """Some cells of a grid, in the order in which their features lie in a table [n, C]."""

    grid: Tensor  # [h, w] bool

    @property
    def share(self) -> float:
        """Of the grid's cells."""
        return float(self.grid.float().mean())

    @functools.cached_property
    def flat(self) -> Tensor:
        """Where each is in the grid's rows laid end to end, [n] int64."""
        return self.grid.reshape(-1).nonzero()[:, 0]

    @property
    def places(self) -> tuple[Tensor, Tensor]:
        """Row and column of each, [n] int64."""
        width = self.grid.shape[1]
        return self.flat.div(width, rounding_mode="floor"), self.flat % width

    def grown(self, radius: int) -> Cells:
        """With all that are up to `radius` rows and columns away."""
        grid = self.grid
        for _ in range(radius):
            tall = grid.clone()
            tall[1:] |= grid[:-1]
            tall[:-1] |= grid[1:]
            grid = tall.clone()
            grid[:, 1:] |= tall[:, :-1]
            grid[:, :-1] |= tall[:, 1:]
        return Cells(grid)

    def halved(self) -> Cells:
        """Those of a grid of half the size that bilinear interpolation to these reads."""
        found = torch.zeros_like(self.grid[::2, ::2])
        for rows, columns, _ in _corners(self):
            found[rows, columns] = True
        return Cells(found)

    def rows_at(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Where in the table the cells at these places of the grid lie, [...] int64; n for those that are not there."""
        return self._numbers.view(-1).index_select(0, (rows + 1) * self._numbers.shape[1] + columns + 1)

    def around(self, centres: Cells) -> Tensor:
        """Where in the table the 3×3 cells around each centre lie, [m, 9] int64; n for those that are not there."""
        rows, columns = centres.places
        width = self._numbers.shape[1]
        steps = torch.tensor([down * width + right for down in range(3) for right in range(3)], device=rows.device)
        near = (rows * width + columns)[:, None] + steps
        return self._numbers.view(-1).index_select(0, near.view(-1)).view(-1, 9)

    @functools.cached_property
    def _numbers(self) -> Tensor:
        """Of each cell in the table, [h + 2, w + 2] with a border."""
        grid = pad(self.grid, (1, 1, 1, 1))
        numbers = grid.view(-1).cumsum(0).view_as(grid) - 1
        return torch.where(grid, numbers, int(self.grid.sum()))


def conv_rows(conv: nn.Conv2d, table: Tensor, around: Tensor) -> Tensor:
    """A 3×3 convolution with zeros around the grid, at some cells.

    Args:
        conv: its weights.
        table: [n + 1, C]; the last row is zero, for what lies outside.
        around: [m, 9] rows of the table, see `Cells.around`.

    Returns:
        [m, D].
    """
    weight = conv.weight.permute(0, 2, 3, 1).flatten(1).to(table.dtype)  # once, not for each chunk
    out = []
    for part in torch.split(around, CHUNK):
        patches = table.index_select(0, part.reshape(-1)).view(len(part), -1)
        out.append(linear(patches, weight, conv.bias))
    return torch.cat(out)


def relu_rows(table: Tensor) -> Tensor:
    """[n, C] to [n + 1, C]: rectified, a row of zeros at the end."""
    return pad(table, (0, 0, 0, 1)).relu_()


def point_rows(conv: nn.Conv2d, table: Tensor) -> Tensor:
    """A 1×1 convolution of a table [n, C]."""
    return linear(table, conv.weight.flatten(1), conv.bias)


def upsampled(table: Tensor, coarse: Cells, fine: Cells) -> Tensor:
    """Twice as fine by bilinear interpolation, as `interpolate` has it: a table of `coarse` to one of `fine`."""
    out = torch.zeros(len(fine.places[0]), table.shape[1], device=table.device)
    for rows, columns, weight in _corners(fine):
        out.addcmul_(table.index_select(0, coarse.rows_at(rows, columns)).float(), weight[:, None])
    return out.to(table.dtype)


def _corners(cells: Cells) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Rows and columns of the four coarse cells between which each cell lies, and the weight of each."""
    sides = []
    for places, size in zip(cells.places, cells.grid.shape, strict=True):
        low = (places - 1).div(2, rounding_mode="floor")
        far = 0.25 + 0.5 * (places % 2 == 0).float()  # of the higher one: three quarters where the cell is even
        sides.append(((low.clamp_min(0), 1 - far), ((low + 1).clamp_max(size // 2 - 1), far)))
    return [(row, column, wr * wc) for row, wr in sides[0] for column, wc in sides[1]]
