"""The paper's contribution (section 3): a few more Gaussians where the base shows holes, hiding none of what it shows.

- `hole_features`: the mask M_v of a view (eq. 4) and what its cells show.
- `seeds`: base values of the aux Gaussians, carried into the holes from their far rims.
- `network`: f_res (eq. 5), which predicts deltas over the seeds; `sparse` runs it around the holes alone.
- `compose`: seeds and deltas to Gaussians; of the masked cells they are 𝒢̃_aug (eq. 7).
- `complete`: one view as the paper has it, or one set for a path; the union with the base is eq. 8.
- For one scene along a path, beyond the paper: `view_order`, `occlusion_guard`, `rim_underlay`.
"""

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
