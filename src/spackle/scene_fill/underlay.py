"""Underlays: Gaussians beneath the rims of holes, which close the slits that other views would show
there.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.core.hole_filling import fill_from_far_side
from spackle.core.surfels import inverse_depth_slope
from spackle.residual.composer import compose
from spackle.residual.features import CELL
from spackle.residual.initializer import (
    GAUSSIAN_REACH_CELLS,
    InitialGaussians,
    place_behind_surfaces,
)

# An underlay is smooth, so each of its Gaussians is three times as large as usual and covers 3×3
# cells.
UNDERLAY_STRIDE = 3
# An underlay extends this far beneath a rim: the reach of one of its Gaussians.
UNDERLAY_REACH_CELLS = UNDERLAY_STRIDE * GAUSSIAN_REACH_CELLS


def rim_underlay(
    mask: Tensor,
    surfaces: InitialGaussians,
    camera: Camera,
    open_cells: Tensor | None = None,
) -> Gaussians:
    """Gaussians behind the surfaces around a view's holes, which continue what fills the holes.

    From another view, a slit appears between the rim of a hole and the hole's filling. These
    Gaussians (the underlay) close most slits in advance.

    Args:
        mask: [h, w] bool: the cells (2×2 pixels) of the view that touch a hole.
        surfaces: a surface point and its colour for each cell: of the filling in holes, of the
            visible surface elsewhere.
        camera: of the view.
        open_cells: [h, w] bool: cells with holes that stay open, which have no surface; None: none.
    """
    if open_cells is None:
        open_cells = torch.zeros_like(mask)

    # An underlay is smooth: one large Gaussian for every third row and column of cells is enough.
    every_third = slice(None, None, UNDERLAY_STRIDE)
    coarse = (every_third, every_third)
    around_holes = maximum_filter(mask, UNDERLAY_REACH_CELLS) & ~mask & ~open_cells
    rim = around_holes[coarse]
    known = ~rim & ~open_cells[coarse]
    if not bool(rim.any()) or not bool(known.any()):
        return Gaussians.empty(mask.device)  # no rim, or nothing that could be continued beneath it

    # The cells at a rim are filled anew, from all other cells: from the holes' filling on one side,
    # from visible surfaces on the other. Of these two, the farther one counts.
    coarse_inverse_depth, coarse_rgb = fill_from_far_side(
        surfaces.inverse_depth[coarse], surfaces.rgb[coarse].permute(2, 0, 1), known
    )

    # The underlay must lie behind the surfaces of all cells that its Gaussians reach, also of those
    # that the coarse grid leaves out. So it is placed on the fine grid, of which then every third
    # cell is read again.
    inverse_depth = surfaces.inverse_depth.clone()
    inverse_depth[coarse] = coarse_inverse_depth
    is_underlay = mask.new_zeros(mask.shape)
    is_underlay[coarse] = rim
    behind = place_behind_surfaces(
        inverse_depth, is_underlay, surfaces.inverse_depth, UNDERLAY_REACH_CELLS
    )[coarse]

    slope_per_coarse_cell = inverse_depth_slope(behind)
    cells = InitialGaussians(
        uv=surfaces.uv[coarse],
        inverse_depth=behind,
        slope=slope_per_coarse_cell / (UNDERLAY_STRIDE * CELL),  # per pixel
        rgb=coarse_rgb.permute(1, 2, 0),
        unit=surfaces.unit,
    )
    # Without deltas, which a network would predict: the guesses become Gaussians as they are.
    underlay = compose(cells.select(rim), deltas=None, camera=camera)

    # One Gaussian covers 3×3 cells, so it is three times as large as one for a single cell.
    return dataclasses.replace(underlay, scales=UNDERLAY_STRIDE * underlay.scales)
