"""Gaussians beneath the rim of a hole: hidden from the view that they are made for, seen by its neighbours."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.camera import Camera
from spackle.fill import far_fill
from spackle.gaussians import Gaussians
from spackle.residual.compose import compose
from spackle.residual.cues import CELL, Cues
from spackle.residual.seeds import RIM_CELLS, Seeds, placed_behind
from spackle.surface import surface_slope

REACH_CELLS = 6  # how far beneath the rim
COARSE = 3  # one Gaussian for COARSE × COARSE cells, as much larger: what lies there is smooth


def tucked(cues: Cues, seeds: Seeds, camera: Camera) -> Gaussians:
    """What goes on beneath the surfaces around the holes of a view, as the holes' seeds do, behind all that is seen.

    From beside, the rim of a hole moves, and a slit opens between what was seen and what filled the hole. This closes
    most such slits before they open: on a path fewer views are left to complete, and they show the same.

    Args:
        cues: the view's cells.
        seeds: of all cells; those of the masked ones are what goes on.
        camera: the view.
    """
    rim = _around(cues.mask, REACH_CELLS) & ~cues.mask
    inverse_depth, rgb = far_fill(seeds.inverse_depth, seeds.rgb.permute(2, 0, 1), ~rim)
    field = placed_behind(inverse_depth, rim, cues, COARSE * RIM_CELLS)
    slope = surface_slope(field) / CELL
    chosen = torch.zeros_like(rim)
    chosen[::COARSE, ::COARSE] = rim[::COARSE, ::COARSE]
    fine = compose(Seeds(seeds.uv, field, slope, rgb.permute(1, 2, 0), seeds.unit).select(chosen), None, camera)
    return dataclasses.replace(fine, scales=COARSE * fine.scales)


def _around(mask: Tensor, radius: int) -> Tensor:
    """[h, w] bool: all cells within `radius` of the chosen ones, along rows and columns."""
    return max_pool2d(mask.float()[None, None], 2 * radius + 1, stride=1, padding=radius)[0, 0] > 0
