"""Filters of pictures: Gaussian blur, the greatest value in a window, and a distance transform."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from spackle._numba import kernel

FAR = 1 << 14  # cells to a place that is not there


def blurred(image: Tensor, sigma: float) -> Tensor:
    """A picture [..., H, W, C] under a Gaussian of `sigma` pixels; what lies beyond the border has no weight."""
    weights = [math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(math.ceil(3 * sigma) + 1)]
    for dim in (-2, -3):
        mass = _weighted_sum(image.new_ones(image.shape[dim]), weights, 0)
        image = _weighted_sum(image, weights, dim) / mass.view(-1, *[1] * (-1 - dim))
    return image


def broadly_blurred(image: Tensor, sigma: float) -> Tensor:
    """About `blurred` for a picture [H, W, C] and many pixels: means of squares are blurred, and magnified again."""
    step = max(int(sigma / 2), 1)
    means = avg_pool2d(image.movedim(-1, 0)[None], step, ceil_mode=True, count_include_pad=False)[0]
    coarse = blurred(means.movedim(0, -1), sigma / step).movedim(-1, 0)
    height, width, _ = image.shape
    return interpolate(coarse[None], scale_factor=step, mode="bilinear")[0, :, :height, :width].movedim(0, -1)


def _weighted_sum(values: Tensor, weights: Sequence[float], dim: int) -> Tensor:
    """Of neighbours along a dimension, to both sides: many times faster on a processor than a thin convolution."""
    size = values.shape[dim]
    total = weights[0] * values
    for offset, weight in enumerate(weights[1:size], start=1):
        total.narrow(dim, 0, size - offset).add_(values.narrow(dim, offset, size - offset), alpha=weight)
        total.narrow(dim, offset, size - offset).add_(values.narrow(dim, 0, size - offset), alpha=weight)
    return total


def greatest_around(image: Tensor, reach: int) -> Tensor:
    """Of an image or mask [..., H, W] the greatest value up to `reach` rows and columns away from each pixel."""
    least = 0 if image.dtype == torch.bool else -math.inf
    return greatest_in_windows(pad(image, (reach,) * 4, value=least), 2 * reach + 1)


def greatest_in_windows(image: Tensor, size: int) -> Tensor:
    """The greatest value in each window of size × size pixels: [..., H, W] to [..., H - size + 1, W - size + 1].

    Of two windows one of up to twice their width is made: a processor's pooling looks at all pixels of each instead.
    """
    for dim in (-1, -2):
        width = 1
        while width < size:
            step = min(width, size - width)
            count = image.shape[dim] - step
            image = torch.maximum(image.narrow(dim, 0, count), image.narrow(dim, step, count))
            width += step
    return image


def nearest_known(hole: NDArray[np.bool_]) -> NDArray[np.int32]:
    """[2, H, W] row and column of the nearest pixel outside of a hole [H, W], nearly always; far away without any."""
    near = np.where(hole, -FAR, np.indices(hole.shape)).astype(np.int32)
    _propagate_nearest(hole, near)
    return near


def distance_to(near: NDArray[np.int32]) -> Tensor:
    """[H, W] pixels from each pixel to the one that `nearest_known` gives, [2, H, W]."""
    row, column = torch.from_numpy(near - np.indices(near.shape[1:], np.int32)).float()
    return torch.hypot(row, column)


@kernel
def _propagate_nearest(hole: Any, near: Any) -> None:
    """Each cell takes its neighbours' nearest cell if that is nearer: four sweeps, each the other way around."""
    height, width = hole.shape
    for turn in range(4):
        for i in range(height):
            y = i if turn % 2 == 0 else height - 1 - i
            for j in range(width):
                x = j if turn % 2 == 0 else width - 1 - j
                if not hole[y, x]:
                    continue
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        row, column = near[0, v, u], near[1, v, u]
                        apart = (near[0, y, x] - y) ** 2 + (near[1, y, x] - x) ** 2
                        if (row - y) ** 2 + (column - x) ** 2 < apart:
                            near[0, y, x], near[1, y, x] = row, column
