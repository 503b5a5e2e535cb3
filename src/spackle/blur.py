"""Gaussian blur of pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor


def blurred(image: Tensor, sigma: float) -> Tensor:
    """A picture [..., H, W, C] under a Gaussian of `sigma` pixels; what lies beyond the border has no weight."""
    weights = [math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(math.ceil(3 * sigma) + 1)]
    for dim in (-2, -3):
        mass = _weighted_sum(image.new_ones(image.shape[dim]), weights, 0)
        image = _weighted_sum(image, weights, dim) / mass.view(-1, *[1] * (-1 - dim))
    return image


def _weighted_sum(values: Tensor, weights: Sequence[float], dim: int) -> Tensor:
    """Of neighbours along a dimension, to both sides: many times faster on a processor than a thin convolution."""
    size = values.shape[dim]
    total = weights[0] * values
    for offset, weight in enumerate(weights[1:size], start=1):
        total.narrow(dim, 0, size - offset).add_(values.narrow(dim, offset, size - offset), alpha=weight)
        total.narrow(dim, offset, size - offset).add_(values.narrow(dim, 0, size - offset), alpha=weight)
    return total
