"""The paper's contribution: a few more Gaussians where the base shows holes, and none that hides what it shows."""

from spackle.residual.complete import Completer
from spackle.residual.hole_features import CELL, MASK_THRESHOLD, Cues, hole_area_ratio, hole_mask
from spackle.residual.network import ResidualNet
from spackle.residual.seeds import Seeds, make_seeds
from spackle.residual.view_order import farthest_first

__all__ = [
    "CELL",
    "MASK_THRESHOLD",
    "Completer",
    "Cues",
    "ResidualNet",
    "Seeds",
    "farthest_first",
    "hole_area_ratio",
    "hole_mask",
    "make_seeds",
]
