"""The paper's method (section 3): a network adds Gaussians in the holes of a view; read `complete` first."""

from spackle.residual.completion import complete_view
from spackle.residual.features import CELL, MASK_THRESHOLD, ViewFeatures, hole_area_ratio, hole_mask
from spackle.residual.initializer import InitialGaussians, initialize
from spackle.residual.network import ResidualNet

__all__ = [
    "CELL",
    "MASK_THRESHOLD",
    "InitialGaussians",
    "ResidualNet",
    "ViewFeatures",
    "complete_view",
    "hole_area_ratio",
    "hole_mask",
    "initialize",
]
