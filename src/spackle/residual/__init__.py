"""The paper's method (section 3): a few more Gaussians where the base shows holes, hiding none of what it shows.

- `complete`: one view, eqs. 2 to 9: base values and deltas to Gaussians; those of the masked cells are 𝒢̃_aug (eq. 7).
- `view_features`: M_v (eq. 4), HAR (eqs. 10 and 11), and what the rendered view shows, in cells of 2×2 pixels.
- `base_values`: colour and depth of the aux Gaussians before the network; `epipolar_walk` finds what is extended.
- `network`: f_res (eq. 5) and what it sees; `architectures`: the two that it may have, and their weight files.
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
