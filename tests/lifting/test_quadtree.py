"""Tiles: the detail that they lose, the places that they may cover, and that no grid is visible."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from helpers.scenes import psnr
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.surfels import DEPTH_EDGE_RATIO
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost
from spackle.lifting.quadtree import MAX_PLANE_DEVIATION, TILE_LEVELS, Quadtree
from spackle.lifting.splats import layered_gaussians
from spackle.render import CpuRenderer

CPU = CpuRenderer()


def ground(height: int = 27, width: int = 38) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A partly detailed picture, a plane with a bump, its slope, and a mask of free pixels."""
    torch.manual_seed(1)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    picture = (0.3 + 0.01 * x)[..., None] + 0.2 * torch.rand(height, width, 3) * (x + y > 36)[
        ..., None
    ]
    inverse = 0.4 + 0.0004 * x + 0.0008 * y
    inverse[20, 6] *= 1 + 2 * float(MAX_PLANE_DEVIATION)
    free = torch.ones(height, width, dtype=torch.bool)
    free[3, 30] = free[26] = False
    return picture, inverse, torch.tensor([0.0004, 0.0008]).expand(height, width, 2), free


def losses(picture: Tensor, height: int, width: int) -> Tensor:
    """[H/height, W/width] losses of tiles, by PyTorch's bilinear interpolation of their means."""
    rows, columns = picture.shape[0] // height * height, picture.shape[1] // width * width
    inside = picture[:rows, :columns].permute(2, 0, 1)[None].double()
    smooth = interpolate(avg_pool2d(inside, (height, width)), size=(rows, columns), mode="bilinear")
    return avg_pool2d((inside - smooth).square().mean(1), (height, width))[0] * height * width


@pytest.mark.parametrize("level", [1, 2, 3])
def test_a_blocks_loss_is_its_difference_from_interpolated_means(level: int) -> None:
    picture, inverse, slope, free = ground()
    lost = Quadtree(picture, inverse, slope, free, TILE_LEVELS, DEPTH_EDGE_RATIO).losses[level - 1]
    side, (rows, columns) = 2**level, lost.shape[:2]
    assert (rows, columns) == (27 // side, 38 // side)
    whole = picture[: rows * side, : columns * side]
    flat, tall = losses(whole, side // 2, side), losses(whole, side, side // 2)
    expected = torch.stack(
        [losses(whole, side, side), flat[::2] + flat[1::2], tall[:, ::2] + tall[:, 1::2]], dim=-1
    )
    depth, blocked = inverse.double().numpy(), torch.zeros(rows, columns, dtype=torch.bool)
    for row, column in itertools.product(range(rows), range(columns)):
        top, left, half = row * side, column * side, side // 2
        around = np.s_[max(top - side, 0) : top + 2 * side, max(left - side, 0) : left + 2 * side]
        center = depth[top : top + side, left : left + side].mean()
        y, x = np.indices(depth.shape)[(slice(None), *around)]
        plane = center + 0.0004 * (x - left - half + 0.5) + 0.0008 * (y - top - half + 0.5)
        off = (abs(depth[around] - plane) > float(MAX_PLANE_DEVIATION) * center).any()
        blocked[row, column] = bool(off) or not bool(free[around].all())
    assert bool(blocked.any())
    assert not bool(blocked.all())
    assert torch.equal(torch.isinf(lost), blocked[..., None].expand(-1, -1, 3))
    torch.testing.assert_close(lost[~blocked].double(), expected[~blocked], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("worth", [1e-6, 1e-3, 0.02, 10.0])
def test_a_cut_covers_every_pixel_once_and_no_other_costs_less(worth: float) -> None:
    picture, inverse, slope, free = ground()
    tree = Quadtree(picture, inverse, slope, free, TILE_LEVELS, DEPTH_EDGE_RATIO)
    single, tiles = tree.cut(worth)
    covered = single.long()
    for part in tiles:
        for row, column in zip(part.rows.tolist(), part.columns.tolist(), strict=True):
            inside = np.s_[
                row * part.height : (row + 1) * part.height,
                column * part.width : (column + 1) * part.width,
            ]
            covered[inside] += 1
            assert free[inside].all()
    assert (covered == 1).all()

    def best(level: int, row: int, column: int) -> float:
        if level == 0:
            return worth
        below = itertools.product((2 * row, 2 * row + 1), (2 * column, 2 * column + 1))
        whole, flat, tall = tree.losses[level - 1][row, column].tolist()
        return min(
            sum(best(level - 1, *at) for at in below), whole + worth, min(flat, tall) + 2 * worth
        )

    for row, column in itertools.product(range(27 // 8), range(38 // 8)):
        inside = np.s_[row * 8 : row * 8 + 8, column * 8 : column * 8 + 8]
        count = int(single[inside].sum())
        cost = 0.0
        for part in tiles:
            mine = (part.rows * part.height // 8 == row) & (
                part.columns * part.width // 8 == column
            )
            count += int(mine.sum())
            side = max(part.height, part.width)
            shape = 0 if part.height == part.width else 1 if part.height < part.width else 2
            lost = tree.losses[side.bit_length() - 2][..., shape]
            shares = 1 if shape == 0 else 2  # the stored loss belongs to both halves together
            at = part.rows[mine] * part.height // side, part.columns[mine] * part.width // side
            cost += float(lost[at].sum()) / shares
        assert cost + worth * count == pytest.approx(best(3, row, column), rel=1e-3)


@pytest.mark.parametrize("slant", [0.0, 0.3])
@pytest.mark.parametrize("rise", [0.0, 0.4])
def test_no_grid_is_visible_between_tiles_of_several_sizes(slant: float, rise: float) -> None:
    height, width = 120, 160
    y, x = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
    smooth = (0.3 + rise * x)[..., None].expand(height, width, 3)
    speck = torch.zeros(height, width, dtype=torch.bool)
    torch.manual_seed(0)
    for top, left in torch.randint(8, 110, (12, 2)).tolist():
        speck[top : top + 2, left : left + 3] = True
    photo = torch.where(speck[..., None], 0.2 + 0.6 * torch.rand(height, width, 3), smooth)
    camera = Camera.from_focal(140, width, height)
    base = layered_gaussians(0.3 + slant * y, srgb_to_linear(photo), camera)
    assert len(base) < (0.5 if slant else 0.35) * height * width
    own = CPU.render(base, camera)
    assert psnr(own.rgb, photo) > 42
    away = max_pool2d(speck[None, None].float(), 7, 1, 3)[0, 0] == 0
    assert float((own.rgb - photo).abs().amax(-1)[away].max()) < (1.0 if rise == 0 else 1.5) / 255
    if rise == 0:
        for view in leftmost_and_rightmost(camera, 0.3, DepthRange.of(base, is_metric=True)):
            seen = CPU.render(base, view)
            inner = max_pool2d((seen.alpha < 0.9)[None, None].float(), 9, 1, 4)[0, 0] == 0
            off = (seen.rgb - 0.3).abs().amax(-1)[inner]
            assert float(off.quantile(0.9)) < 0.5 / 255
