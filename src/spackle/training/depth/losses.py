"""What a predicted inverse depth is held to: the true one, up to a factor, up to a line, and in its steps."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

FARTHEST = 0.02  # of the median inverse depth: what is farther, sky above all, counts as this far
NEAREST = 20.0
AT_MOST = 2.0  # an error in log inverse depth beyond this counts as this: such truth is more often wrong than hard
STEEPEST = 1.0  # likewise of a step between neighbours
SCALES = (1, 2, 4, 8)  # strides at which steps are compared


@dataclasses.dataclass(frozen=True)
class DepthLossWeights:
    """How much each term counts."""

    factor: float = 1.0
    line: float = 1.0
    steps: float = 0.5
    offset: float = 0.1  # of no use to anyone, but without it features grow until half precision cannot hold them


def depth_loss(
    predicted: Tensor, truth: Tensor, valid: Tensor, weights: DepthLossWeights
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss [], and its terms [] unweighted, as means over the pictures.

    With t the true inverse depth over its median, and e = predicted − log t minus its own median:
    factor is mean |e|; line is mean |a·exp(predicted) + b − t| / (t + 0.2) after the least-squares a ≥ 0 and b,
    in the spirit of MiDaS (Ranftl et al. 2020); steps is the sum over `SCALES` of mean |∂e/∂x| + |∂e/∂y|;
    offset is the size of the median that e was freed from, which the other terms do not know.

    Args:
        predicted: [B, H, W] log inverse depth.
        truth: [B, H, W] inverse depth in any unit, 0 for infinitely far.
        valid: [B, H, W] bool, where the truth is known.
        weights: of the terms.
    """
    mask = valid.to(predicted.dtype)
    truth = (truth / _median(truth, valid & (truth > 0)).clamp_min(1e-6)).clamp(FARTHEST, NEAREST)
    error = predicted - truth.log()
    offset = _median(error, valid)
    middle = offset.detach()
    error = error - middle
    terms = {
        "factor": _mean(error.abs().clamp_max(AT_MOST), mask).mean(),
        "line": _line(predicted - middle, truth, mask).mean(),
        "steps": _steps(error, mask).mean(),
        "offset": offset.where(valid.any(2).any(1)[:, None, None], 0.0).abs().mean(),
    }
    total = weights.factor * terms["factor"] + weights.line * terms["line"] + weights.steps * terms["steps"]
    total = total + weights.offset * terms["offset"]
    return total, {name: term.detach() for name, term in terms.items()}


def _line(predicted: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    """[B] error of the inverse depth after its best scale and shift."""
    inverse = predicted.clamp(-8, 4).exp()
    count = mask.sum((1, 2)).clamp_min(1)

    def mean(x: Tensor) -> Tensor:
        return ((mask * x).sum((1, 2)) / count)[:, None, None]

    p, t = inverse - mean(inverse), truth - mean(truth)
    scale = (mean(p * t) / (mean(p * p) + 1e-3)).clamp_min(0)
    return _mean((scale * p - t).abs() / (truth + 0.2), mask)


def _steps(error: Tensor, mask: Tensor) -> Tensor:
    """[B] how differently neighbours differ, at several strides."""
    total = error.new_zeros(len(error))
    for stride in SCALES:
        e, m = error[:, ::stride, ::stride], mask[:, ::stride, ::stride]
        for axis in (1, 2):
            n = e.shape[axis] - 1
            both = m.narrow(axis, 1, n) * m.narrow(axis, 0, n)
            step = (e.narrow(axis, 1, n) - e.narrow(axis, 0, n)).abs().clamp_max(STEEPEST)
            total = total + (step * both).sum((1, 2)) / m.sum((1, 2)).clamp_min(1)
    return total


def _mean(x: Tensor, mask: Tensor) -> Tensor:
    return (x * mask).sum((1, 2)) / mask.sum((1, 2)).clamp_min(1)


def _median(x: Tensor, valid: Tensor) -> Tensor:
    """[B, 1, 1] of the valid values; 1 where there are none."""
    values = [
        one[known].median() if bool(known.any()) else one.new_ones(()) for one, known in zip(x, valid, strict=True)
    ]
    return torch.stack(values)[:, None, None]
