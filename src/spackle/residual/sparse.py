"""f_res where it is needed: rectangles around the masked cells, and its fine layers at those cells alone.

Holes are thin, and the network's last, finest convolutions are half of its cost. Its encoder has to see everything in
a rectangle, but its decoder and heads need to be right only around the masked cells: gathered rows and matrix products
take the place of convolutions there, see `ResidualNet.deltas_at`.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import linear, pad

from spackle.crop import Crop
from spackle.filters import greatest_around

Mask = NDArray[np.bool_]

CHUNK = 8192  # cells whose surroundings are gathered at once: they should stay in the cache
# What a cell's delta depends on reaches 205 cells far, but fades. With the shipped weights, what lies beyond 64 cells
# changes it by less than a hundredth of what bfloat16 rounds away; beyond 48, by a tenth; beyond 32, by as much.
# See tests/residual/test_sparse.py.
MARGIN = 48
WHOLE = 0.8  # crops that cover more than this share are not worth the trouble
NEARLY = 1.1  # of what has to be looked at in any case: no cut saves much
CALL_BLOCKS = 8  # what a crop costs by itself, in blocks of 16×16 cells


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
        return Cells(greatest_around(self.grid, radius))

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
    """A 3×3 convolution with zeros around the grid, at some cells: [m, D].

    Its input is a table [n + 1, C], whose last row is zero for what lies outside; `around` is [m, 9], see `Cells`.
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


def crops_around(mask: Tensor, step: int, margin: int = MARGIN) -> list[tuple[Crop, Crop]]:
    """Rectangles that hold all masked cells, and what has to be looked at for each; few and small.

    Args:
        mask: [h, w] bool.
        step: the network's stride: what it looks at begins at multiples of it, so that its grids stay where they are.
        margin: how far around the masked cells it looks.

    Returns:
        Pairs (inner, outer): the inner ones cover each masked cell exactly once, or are the whole grid.
    """
    cells: Mask = mask.cpu().numpy()
    whole = Crop(0, 0, *cells.shape)
    if not cells.any():
        return []
    rest = [(0, -size % step) for size in cells.shape]
    tall, wide = (-(-size // step) for size in cells.shape)
    blocks: Mask = np.logical_or.reduce(np.pad(cells, rest).reshape(tall, step, wide, step), axis=(1, 3))
    found = []
    for part in _cut(blocks, _tight(blocks, Crop(0, 0, tall, wide)), -(-margin // step)):
        inner = _tight(cells, Crop(*(step * edge for edge in dataclasses.astuple(part))))
        found.append((inner, inner.grown(margin, step, *cells.shape)))
    if sum(outer.area for _, outer in found) > WHOLE * whole.area:
        return [(whole, whole)]
    return found


def _tight(cells: Mask, crop: Crop) -> Crop:
    """Shrunk to its masked cells; there are some."""
    rows, columns = (np.flatnonzero(cells[crop.slices].any(axis)) for axis in (1, 0))
    edges = (int(edge) for edge in (rows[0], columns[0], rows[-1] + 1, columns[-1] + 1))
    return Crop(*edges).moved(crop.top, crop.left)


def _cut(blocks: Mask, crop: Crop, reach: int) -> list[Crop]:
    """A rectangle that its masked blocks fill to all four sides, cut in two where later cuts save something."""
    own = crop.grown(reach, 1, *blocks.shape).area
    if own <= NEARLY * _least(blocks, crop, reach):
        return [crop]
    inside = blocks[crop.slices]
    halves = np.concatenate([_row_halves(inside), _row_halves(inside.T)[..., [1, 0, 3, 2]]])
    halves += (crop.top, crop.left) * 2
    if not len(halves):
        return [crop]
    low, high = np.maximum(halves[..., :2] - reach, 0), np.minimum(halves[..., 2:] + reach, blocks.shape)
    best = halves[(high - low).prod(-1).sum(1).argmin()]
    parts = [part for half in best for part in _cut(blocks, Crop(*map(int, half)), reach)]
    cost = sum(part.grown(reach, 1, *blocks.shape).area + CALL_BLOCKS for part in parts)
    return parts if cost < own + CALL_BLOCKS else [crop]


def _least(blocks: Mask, crop: Crop, reach: int) -> int:
    """Blocks that are looked at however a rectangle is cut."""
    near = np.zeros_like(blocks)
    near[crop.slices] = blocks[crop.slices]
    return int(Cells(torch.from_numpy(near)).grown(reach).grid.sum())


def _row_halves(inside: Mask) -> NDArray[np.int64]:
    """Top, left, bottom and right of the masked blocks above and below each cut between rows, [cuts, 2, 4]."""
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
