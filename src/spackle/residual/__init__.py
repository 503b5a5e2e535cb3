"""The paper's method (section 3): a few more Gaussians where the base shows holes, hiding none of what it shows.

- `complete`: one view, eq. 2 to 9.
- `mask`: M_v (eq. 4) and HAR (eqs. 10 and 11).
- `view_features`: what the rendered view shows, in cells of 2×2 pixels.
- `base_values`: colour and depth of the aux Gaussians before the network; `beyond_border` extends the photo's frame.
- `rim`: what stands at a hole's far rim, by `epipolar_walk`, and patches that match; the network sees both.
- `network`: f_res (eq. 5); `crops` are the rectangles around the holes that it looks at.
- `compose`: base values and deltas to Gaussians; those of the masked cells are 𝒢̃_aug (eq. 7).
"""

from spackle.residual.base_values import Seeds, make_seeds
from spackle.residual.complete import complete_view
from spackle.residual.mask import MASK_THRESHOLD, hole_area_ratio, hole_mask
from spackle.residual.network import ResidualNet
from spackle.residual.view_features import CELL, ViewFeatures

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
