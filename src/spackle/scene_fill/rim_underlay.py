"""Gaussians beneath the rim of a hole: hidden from the view that they are made for, seen by its neighbours.

The paper completes one view at a time and has none of these; they are for one scene along a path.
"""

from __future__ import annotations

import dataclasses

from torch import Tensor

from spackle.camera import Camera
from spackle.fill import far_fill
from spackle.filters import greatest_around
from spackle.gaussians import Gaussians
from spackle.residual.base_values import BLOB_CELLS, Seeds, placed_behind
from spackle.residual.compose import compose
from spackle.residual.view_features import CELL
from spackle.surface import surface_slope

REACH_CELLS = 6  # how far beneath the rim
COARSE = 3  # one Gaussian for COARSE × COARSE cells, as much larger: what lies there is smooth
EVERY = (slice(None, None, COARSE),) * 2  # the cells that have one


def rim_underlay(mask: Tensor, seeds: Seeds, camera: Camera) -> Gaussians:
    """Gaussians that extend the holes' seeds beneath the surfaces around the holes, behind all that is seen.

    From another view the rim of a hole moves, and a slit opens between what was seen and what filled the hole. This
    closes most such slits before they open: fewer views of a path are left to complete, and they show the same.

    Args:
        mask: [h, w] bool: the cells of the view's holes.
        seeds: of all cells.
        camera: the view.
    """
    rim = (greatest_around(mask, REACH_CELLS) & ~mask)[EVERY]
    known, rgb = ~rim, seeds.rgb[EVERY].permute(2, 0, 1)
    if not bool(rim.any()) or not bool(known.any()):
        return Gaussians.empty()
    coarse, rgb = far_fill(seeds.inverse_depth[EVERY], rgb, known)
    # At the rim, behind all that is seen or filled as far around as a blob reaches.
    depth, chosen = seeds.inverse_depth.clone(), mask.new_zeros(mask.shape)
    depth[EVERY], chosen[EVERY] = coarse, rim
    placed = placed_behind(depth, chosen, seeds.inverse_depth, COARSE * BLOB_CELLS)[EVERY]
    slope = surface_slope(placed) / (COARSE * CELL)
    beneath = Seeds(seeds.uv[EVERY], placed, slope, rgb.permute(1, 2, 0), seeds.unit).select(rim)
    fine = compose(beneath, None, camera)
    return dataclasses.replace(fine, scales=COARSE * fine.scales)
