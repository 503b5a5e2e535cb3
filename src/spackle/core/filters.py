"""Image filters: Gaussian blurs, the maximum in a window, and the nearest known pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from spackle.runtime.kernels import kernel

UNREACHABLE_PX = 1 << 14  # distance, in pixels, of a pixel that does not exist


def gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Blur a picture [..., H, W, C] with a Gaussian of `sigma` pixels, normalised by the weights inside the picture."""
    weights = [math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(math.ceil(3 * sigma) + 1)]
    for dim in (-2, -3):
        mass = _weighted_sum(image.new_ones(image.shape[dim]), weights, 0)
        image = _weighted_sum(image, weights, dim) / mass.view(-1, *[1] * (-1 - dim))
    return image


def approximate_gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Approximate `gaussian_blur` of a picture [H, W, C] for a large `sigma`: reduce the picture, blur it, and enlarge it."""
    step = max(int(sigma / 2), 1)
    means = avg_pool2d(image.movedim(-1, 0)[None], step, ceil_mode=True, count_include_pad=False)[0]
    coarse = gaussian_blur(means.movedim(0, -1), sigma / step).movedim(-1, 0)
    height, width, _ = image.shape
    return interpolate(coarse[None], scale_factor=step, mode="bilinear")[
        0, :, :height, :width
    ].movedim(0, -1)


def _weighted_sum(values: Tensor, weights: Sequence[float], dim: int) -> Tensor:
    """Weighted sum of neighbours along a dimension, many times faster on a CPU than a convolution."""
    size = values.shape[dim]
    total = weights[0] * values
    for offset, weight in enumerate(weights[1:size], start=1):
        total.narrow(dim, 0, size - offset).add_(
            values.narrow(dim, offset, size - offset), alpha=weight
        )
        total.narrow(dim, offset, size - offset).add_(
            values.narrow(dim, 0, size - offset), alpha=weight
        )
    return total


def maximum_filter(image: Tensor, reach: int) -> Tensor:
    """For each pixel the maximum of an image or mask [..., H, W] within `reach` rows and columns."""
    size = 2 * reach + 1
    image = pad(image, (reach,) * 4, value=0 if image.dtype == torch.bool else -math.inf)
    for dim in (-1, -2):
        width = 1  # window size so far; doubling is faster on a CPU than pooling
        while width < size:
            step = min(width, size - width)
            count = image.shape[dim] - step
            image = torch.maximum(image.narrow(dim, 0, count), image.narrow(dim, step, count))
            width += step
    return image


def nearest_known_pixels(hole: NDArray[np.bool_]) -> NDArray[np.int32]:
    """For each pixel the row and column [2, H, W] of the nearest pixel outside of a hole [H, W].

    In rare cases the second nearest pixel is found. If the whole image is a hole, rows and columns are `-FAR`.
    """
    near = np.where(hole, -UNREACHABLE_PX, np.indices(hole.shape)).astype(np.int32)
    _propagate_nearest(hole, near)
    return near


def distance_to_nearest(near: NDArray[np.int32]) -> Tensor:
    """The distance [H, W] in pixels from each pixel to its nearest known pixel, given by `nearest_known_pixels`."""
    row, column = torch.from_numpy(near - np.indices(near.shape[1:], np.int32)).float()
    return torch.hypot(row, column)


@kernel
def _propagate_nearest(hole: Any, near: Any) -> None:
    """In four sweeps, give each pixel of a hole a neighbour's known pixel if that is nearer than its own."""
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
