"""The paper's method (section 3): a few more Gaussians in the base's holes, which hide nothing that the base shows.

- `complete`: completes one view (eqs. 2 to 9): base values and deltas give the Gaussians of the masked cells,
  𝒢̃_aug (eq. 7).
- `view_features`: M_v (eq. 4), HAR (eqs. 10 and 11), and what the rendered view shows, in cells of 2×2 pixels.
- `base_values`: the aux Gaussians' colours and depths before the network; `epipolar_walk` finds the surface that
  continues into a hole.
- `network`: f_res (eq. 5) and its input; `architectures`: its two architectures, and their weight files.
"""

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
