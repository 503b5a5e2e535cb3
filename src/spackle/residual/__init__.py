"""The paper's method (section 3): a network adds Gaussians in the holes of a view; read `complete` first."""

from spackle.residual.base_values import Seeds, make_seeds
from spackle.residual.complete import complete_view
from spackle.residual.network import ResidualNet
from spackle.residual.view_features import CELL, MASK_THRESHOLD, ViewFeatures, hole_area_ratio, hole_mask

__all__ = [
    "CELL",
    "MASK_THRESHOLD",
    "ResidualNet",
    "Seeds",
    "ViewFeatures",
    "complete_view",
    "hole_area_ratio",
    "hole_mask",
    "make_seeds",
]
