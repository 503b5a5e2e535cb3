"""How near a relative inverse depth comes to the true depth, once its scale and shift are given away."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

FARTHEST = 2.0  # an aligned depth is at most this many times the farthest true one


@dataclasses.dataclass(frozen=True)
class DepthScore:
    """Of one picture."""

    abs_rel: float  # mean |z − z*| / z*
    delta: float  # share of pixels with max(z/z*, z*/z) < 1.25


def score_depth(inverse_depth: Tensor, depth: Tensor, valid: Tensor) -> DepthScore:
    """Align an inverse depth to the truth by least squares in inverse depth, then compare depths.

    Args:
        inverse_depth: [H, W] up to scale and shift.
        depth: [H, W] true z in any unit.
        valid: [H, W] bool, where it is known.
    """
    true = 1 / depth[valid].double()
    found = align(inverse_depth[valid].double(), true).clamp_min(true.min() / FARTHEST)
    ratio = true / found  # of depths: found over true
    within = torch.maximum(ratio, 1 / ratio) < 1.25
    return DepthScore(float((ratio - 1).abs().mean()), float(within.double().mean()))


def align(values: Tensor, true: Tensor) -> Tensor:
    """[N] a·values + b nearest to `true` [N] by least squares; its mean where the values are all the same."""
    v, t = values - values.mean(), true - true.mean()
    spread = (v * v).sum()
    scale = (v * t).sum() / spread if spread > 1e-12 * len(v) * values.abs().max() ** 2 else v.new_zeros(())
    return scale * v + true.mean()


def vertical_ramp(height: int, width: int) -> Tensor:
    """[H, W] the guess that needs no photo: what stands lower in the picture is nearer."""
    return (torch.arange(height) + 0.5)[:, None].expand(height, width)
