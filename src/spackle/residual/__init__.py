"""The paper's method (section 3) and nothing else: a network adds Gaussians in the holes of a view.

Read `completion` first: it goes through eqs. 2 to 7 and calls all other files.
"""

from spackle.residual.completion import MIN_AUX_GAUSSIANS, ViewCompletion, complete_view
from spackle.residual.features import CELL, MASK_THRESHOLD, ViewFeatures, hole_area_ratio, hole_mask
from spackle.residual.initializer import InitialGaussians, initialize
from spackle.residual.network import ResidualNet

__all__ = [
    "CELL",
    "MASK_THRESHOLD",
    "MIN_AUX_GAUSSIANS",
    "InitialGaussians",
    "ResidualNet",
    "ViewCompletion",
    "ViewFeatures",
    "complete_view",
    "hole_area_ratio",
    "hole_mask",
    "initialize",
]
