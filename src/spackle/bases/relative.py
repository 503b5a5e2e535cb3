"""Inverse depth of unknown scale: where it is put in the world."""

from __future__ import annotations

from torch import Tensor

NEAREST_M = 1.5  # an arm's length and a half
NEAREST_QUANTILE = 0.999  # trajectories take the 0.1 % nearest for the nearest depth; beyond are specks


def nearest(values: Tensor) -> Tensor:
    """[] what counts as the greatest of inverse depths [N], and belongs at `NEAREST_M`."""
    return values.kthvalue(1 + round(NEAREST_QUANTILE * (len(values) - 1))).values
