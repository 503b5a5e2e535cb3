"""The mask of a view (paper, section 3.2, eq. 4), and the share of its holes (section 4.2, eqs. 10 and 11)."""

from __future__ import annotations

import numpy as np
from torch import Tensor

MASK_THRESHOLD = 0.95  # τ_α: a pixel with less opacity is a hole (eq. 4)


def hole_mask(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> Tensor:
    """M_v(p) = 1[A_v(p) < τ_α] (eq. 4): [H, W] bool, true where nothing was seen."""
    return alpha < threshold


def hole_area_ratio(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> float:
    """HAR = 1 − coverage (eqs. 10 and 11): the share of hole pixels."""
    hole = hole_mask(alpha, threshold)
    return int(np.count_nonzero(hole.cpu().numpy())) / hole.numel()  # of what counts bits, numpy is the fastest by far
