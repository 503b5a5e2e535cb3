"""The backing: wide Gaussians behind those of the pixels, which close the surface from behind.

The unit is a *cell* of 2×2 pixels. In flat areas, several cells share a Gaussian.
"""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.core.color import linear_to_srgb
from spackle.core.surfels import BEHIND_SURFACE_RATIO, CREASE_RATIO, SURFEL_OPACITY
from spackle.lifting.quadtree import Quadtree, Tiles
from spackle.lifting.surfaces import (
    TILE_SIGMA_SIDES,
    PixelSurfaces,
    Surface,
    SurfelSamples,
    without_border,
)

CELL_PX = 2
# Standard deviations of backing Gaussians, in units of their sides: of those for several cells,
# which lie away from depth steps, and of those at a near surface's rim, past which a wider one
# would show.
LARGE_SIGMA_SIDES = 0.65
RIM_SIGMA_SIDES = 0.42
# The backing recedes by the depth change over this number of its sides, to stay hidden.
RECEDING_SIDES = 2
VISIBLE_BACKING_SHARE = 0.02  # share of the backing's colour that is visible through the front
SAME_SURFACE_RATIO = 0.02  # pixels that differ by less than this share are on one surface
# A cell's centre has at least this share of the photo's smallest inverse depth.
MIN_CENTER_RATIO = 0.5


def backing_surfels(
    pixels: PixelSurfaces, gaussian_cost: float, levels: int
) -> list[SurfelSamples]:
    """A wide Gaussian behind each cell of 2×2 pixels, on the surface of its farthest pixel.

    Two kinds of cells beside a depth step have no backing: those with pixels of both sides, and
    those in which pixels show a little of the far surface, but none shows it mainly.

    Args:
        pixels: the surfaces that each pixel of the photo shows.
        gaussian_cost: squared sRGB difference that justifies one more Gaussian in the front.
        levels: number of sizes of larger backing Gaussians; 0: every cell has its own.

    Returns:
        One part for each size and place, none if the photo is one pixel high or wide.
    """
    # The farthest surface that a pixel shows, also where that is the lesser of two.
    hidden_far = pixels.mixed & pixels.near_is_main
    deepest = pixels.main.replaced(hidden_far, pixels.other)
    cell_depths = _cells(deepest.inverse_depth)  # [h, w, 4]
    if cell_depths.numel() == 0:
        return []
    surface = _cell_surface(deepest, cell_depths)

    # Which cells have a backing: of the cells with pixels of the far side, those without pixels of
    # the near side; of all other cells, those in which no pixel shows a little of the far surface.
    has_near = _cells(pixels.beside_step & pixels.near_is_main).any(-1)  # [h, w]
    has_far = _cells(pixels.beside_step & ~pixels.near_is_main).any(-1)
    has_hidden_far = _cells(hidden_far).any(-1)
    backed = torch.where(has_far, ~has_near, ~has_hidden_far)

    # Away from steps, cells may share a Gaussian. Only 2 % of its light passes the front, so that
    # lost detail is less visible. So one more Gaussian must save 50 times as much of it.
    may_share = without_border(backed & ~_cells(pixels.beside_step).any(-1))
    picture = linear_to_srgb(surface.color)
    slope_by_cell = CELL_PX * surface.slope
    tree = Quadtree(picture, surface.inverse_depth, slope_by_cell, may_share, levels, CREASE_RATIO)
    single, tiles = tree.cut(gaussian_cost / VISIBLE_BACKING_SHARE)

    # The larger a backing Gaussian and the farther from a near surface's rim, the wider it may be.
    # Single cells are tiles of 1×1 cells.
    inner_cells = Tiles(1, 1, *(single & backed & ~has_near).nonzero(as_tuple=True))
    rim_cells = Tiles(1, 1, *(single & backed & has_near).nonzero(as_tuple=True))
    parts = [(of_one_size, LARGE_SIGMA_SIDES) for of_one_size in tiles]
    parts += [(inner_cells, TILE_SIGMA_SIDES), (rim_cells, RIM_SIGMA_SIDES)]
    return [
        _receded(surface.tile_samples(part, sigma_sides, cell_px=CELL_PX), part)
        for part, sigma_sides in parts
    ]


def _cell_surface(deepest: Surface, cell_depths: Tensor) -> Surface:
    """The surface of each cell's farthest pixel, at the cell's centre: a surface of [h, w] cells.

    A cell has 2×2 pixels, numbered 0 to 3 row by row.

    Args:
        deepest: the farthest surface of each pixel, [H, W].
        cell_depths: [h, w, 4] inverse depths of each cell's pixels on this surface.
    """
    # The farthest pixel has the smallest inverse depth.
    far, number = cell_depths.min(dim=-1)  # [h, w] each
    slope_index = number[..., None, None].expand(*number.shape, 1, 2)
    slope = _cells(deepest.slope).gather(2, slope_index).squeeze(2)  # [h, w, 2]

    # The cell's centre lies half a pixel from that pixel's centre, along x and along y. Extended to
    # there, the inverse depth of a steep surface could become 0 or negative. So it is limited to
    # half of the smallest one.
    x_in_cell = number % 2
    y_in_cell = number // 2
    offset = torch.stack([0.5 - x_in_cell, 0.5 - y_in_cell], dim=-1)  # [h, w, 2]
    at_center = (far + (slope * offset).sum(-1)).clamp_min(MIN_CENTER_RATIO * far.min())

    # The colour is the mean of the cell's pixels on the same surface.
    difference = cell_depths - far[..., None]
    same_surface = (difference < SAME_SURFACE_RATIO * far[..., None]).to(far)  # [h, w, 4]
    color_sum = (_cells(deepest.color) * same_surface[..., None]).sum(2)
    color = color_sum / same_surface.sum(2)[..., None]
    return Surface(
        inverse_depth=at_center,
        slope=slope,
        color=color,
        opacity=torch.full_like(far, float(SURFEL_OPACITY)),
    )


def _receded(samples: SurfelSamples, tiles: Tiles) -> SurfelSamples:
    """The backing moved behind the front Gaussians, further where the surface is steep.

    The backing are wide Gaussians that close the gaps between those of the pixels from behind.
    `samples` has one Gaussian for each of `tiles`, which are rectangles of cells.
    """
    # On a steep surface, the parts of a wide Gaussian that are nearer than its centre must not lie
    # in front, either. So it moves back by as much as the surface changes over two of its sides.
    reach_px = CELL_PX * RECEDING_SIDES * torch.tensor([tiles.width, tiles.height])
    relative_change = (reach_px * samples.slope.abs()).sum(-1) / samples.inverse_depth
    factor = 1 - BEHIND_SURFACE_RATIO - relative_change
    return samples._replace(
        inverse_depth=samples.inverse_depth * factor, slope=samples.slope * factor[:, None]
    )


def _cells(image: Tensor) -> Tensor:
    """[H, W, ...] to [H/2, W/2, 4, ...]: the pixels of each 2×2 cell in row-major order.

    An odd last row or column is left out.
    """
    rows = image.shape[0] // CELL_PX
    columns = image.shape[1] // CELL_PX
    whole_cells = image[: CELL_PX * rows, : CELL_PX * columns]
    grid = whole_cells.reshape(rows, CELL_PX, columns, CELL_PX, *image.shape[2:])
    return grid.transpose(1, 2).flatten(2, 3)
