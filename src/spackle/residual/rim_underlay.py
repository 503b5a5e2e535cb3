"""Gaussians beneath the rim of a hole: hidden from the view that they are made for, seen by its neighbours.

The paper completes one view at a time and has none of these; they are for one scene along a path.
"""

from __future__ import annotations

import dataclasses

from spackle.camera import Camera
from spackle.fill import far_fill
from spackle.gaussians import Gaussians
from spackle.residual.compose import compose
from spackle.residual.hole_features import CELL, Cues
from spackle.residual.seeds import BLOB_CELLS, Seeds, placed_behind
from spackle.residual.sparse import Cells
from spackle.surface import surface_slope

REACH_CELLS = 6  # how far beneath the rim
COARSE = 3  # one Gaussian for COARSE × COARSE cells, as much larger: what lies there is smooth
EVERY = (slice(None, None, COARSE),) * 2  # the cells that have one


def rim_underlay(cues: Cues, seeds: Seeds, camera: Camera) -> Gaussians:
    """What goes on beneath the surfaces around the holes of a view, as the holes' seeds do, behind all that is seen.

    From beside, the rim of a hole moves, and a slit opens between what was seen and what filled the hole. This closes
    most such slits before they open: on a path fewer views are left to complete, and they show the same.
    """
    rim = (Cells(cues.mask).grown(REACH_CELLS).grid & ~cues.mask)[EVERY]
    known, rgb = ~rim, seeds.rgb[EVERY].permute(2, 0, 1)
    if not bool(rim.any()) or not bool(known.any()):
        return Gaussians.empty()
    coarse, rgb = far_fill(seeds.inverse_depth[EVERY], rgb, known)
    # At the rim, behind all that is seen or filled as far around as a blob reaches.
    shown = dataclasses.replace(cues, inverse_depth=seeds.inverse_depth)
    depth, chosen = seeds.inverse_depth.clone(), cues.mask.new_zeros(cues.mask.shape)
    depth[EVERY], chosen[EVERY] = coarse, rim
    placed = placed_behind(depth, chosen, shown, COARSE * BLOB_CELLS)[EVERY]
    slope = surface_slope(placed) / (COARSE * CELL)
    there = Seeds(seeds.uv[EVERY], placed, slope, rgb.permute(1, 2, 0), seeds.unit).select(rim)
    fine = compose(there, None, camera)
    return dataclasses.replace(fine, scales=COARSE * fine.scales)
