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

UNREACHABLE_PX = 1 << 14  # distance of a pixel that does not exist; larger than every image


def gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Blur a picture [..., H, W, C] with a Gaussian of `sigma` pixels.

    The weights are normalised by their sum inside the picture, so its border does not darken.
    """
    radius = math.ceil(3 * sigma)  # farther pixels have less than 1 % of the weight
    weights = [math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(radius + 1)]
    # A Gaussian is separable: blur along the rows, then along the columns.
    for dim in (-2, -3):
        side = image.shape[dim]
        ones = image.new_ones(side)
        weight_sums = _weighted_sum_of_neighbors(ones, weights, dim=0)  # [side]
        axes_after = -1 - dim  # number of axes behind the axis `dim`
        weight_sums = weight_sums.view(-1, *[1] * axes_after)  # aligned with the axis `dim`
        image = _weighted_sum_of_neighbors(image, weights, dim) / weight_sums
    return image


def approximate_gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Blur a picture [H, W, C] with a Gaussian of a large `sigma` in pixels, fast but not exactly.

    The picture is reduced, blurred, and enlarged again: a wide blur leaves no details that a
    reduced picture could not show.
    """
    height, width, _ = image.shape
    factor = max(int(sigma / 2), 1)  # two reduced pixels for each `sigma` suffice
    planes = image.movedim(-1, 0)[None]  # [1, C, H, W], as torch's functions want it
    reduced = avg_pool2d(planes, factor, ceil_mode=True, count_include_pad=False)[0]
    blurred = gaussian_blur(reduced.movedim(0, -1), sigma / factor).movedim(-1, 0)
    enlarged = interpolate(blurred[None], scale_factor=factor, mode="bilinear")
    # The last reduced row and column may stand for less than `factor` pixels, so the enlarged
    # picture may be too large.
    return enlarged[0, :, :height, :width].movedim(0, -1)


def _weighted_sum_of_neighbors(values: Tensor, weights: Sequence[float], dim: int) -> Tensor:
    """Weighted sum of each element and its neighbours along a dimension of a tensor.

    Neighbours beyond the ends count as 0. On a CPU, this is many times faster than a convolution.

    Args:
        values: any shape.
        weights: the weight at the distance 0 (the element itself), 1 (both its neighbours), 2, …
        dim: the dimension.
    """
    size = values.shape[dim]
    total = weights[0] * values
    # In a dimension of `size` elements, no two are `size` or more apart.
    for offset, weight in enumerate(weights[1:size], start=1):
        count = size - offset  # elements that have a neighbour at this offset
        without_end = total.narrow(dim, 0, count)
        without_start = total.narrow(dim, offset, count)
        # Each element gets the neighbour behind it, then the one before it.
        without_end.add_(values.narrow(dim, offset, count), alpha=weight)
        without_start.add_(values.narrow(dim, 0, count), alpha=weight)
    return total


def maximum_filter(image: Tensor, radius: int) -> Tensor:
    """For each pixel the maximum of an image or mask [..., H, W] within `radius` rows and columns.

    For a mask, this is a dilation by a square of 2·radius + 1 pixels.
    """
    # Padding with the smallest value never changes a maximum.
    smallest = 0 if image.dtype == torch.bool else -math.inf
    image = pad(image, (radius, radius, radius, radius), value=smallest)
    full_width = 2 * radius + 1
    for dim in (-1, -2):
        # Start with windows of one pixel, and join two windows to a wider one, whose maximum is the
        # larger of theirs. Each round doubles the width, so few suffice; on a CPU this is faster
        # than pooling.
        width = 1
        while width < full_width:
            step = min(width, full_width - width)
            count = image.shape[dim] - step
            image = torch.maximum(image.narrow(dim, 0, count), image.narrow(dim, step, count))
            width += step
    return image


def nearest_known_pixels(hole: NDArray[np.bool_]) -> NDArray[np.int32]:
    """For each pixel the row and column [2, H, W] of the nearest pixel outside of a hole [H, W].

    In rare cases the second nearest pixel is returned: only a few sweeps spread the nearest pixels
    from neighbour to neighbour, which is much faster than an exact search. If the whole image is a
    hole, all rows and columns are `-UNREACHABLE_PX`.
    """
    own_positions = np.indices(hole.shape)  # [2, H, W]
    # A known pixel is its own nearest one; a hole pixel begins with one that is too far away.
    nearest = np.where(hole, -UNREACHABLE_PX, own_positions).astype(np.int32)
    _spread_nearest(hole, nearest)
    return nearest


def distance_to_nearest(nearest: NDArray[np.int32]) -> Tensor:
    """The distance [H, W] in pixels from each pixel to its nearest known pixel.

    `nearest` [2, H, W] holds the row and column of the nearest known pixel of each pixel.
    """
    own_positions = np.indices(nearest.shape[1:], np.int32)
    rows_apart, columns_apart = torch.from_numpy(nearest - own_positions).float()
    return torch.hypot(rows_apart, columns_apart)


@kernel
def _spread_nearest(hole: Any, nearest: Any) -> None:
    """Give each pixel of a hole a neighbour's nearest known pixel if that is nearer than its own.

    Each sweep visits all pixels. Two sweeps from the first pixel to the last, and two from the last
    to the first, spread the positions of known pixels in all directions.

    Args:
        hole: [H, W] bool.
        nearest: [2, H, W] int32 row and column of the nearest known pixel; improved in place.
    """
    height, width = hole.shape
    for sweep in range(4):
        for i in range(height):
            # Every other sweep runs backwards.
            y = i if sweep % 2 == 0 else height - 1 - i
            for j in range(width):
                x = j if sweep % 2 == 0 else width - 1 - j
                if not hole[y, x]:
                    continue
                # Look at the 3×3 pixels around (y, x).
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        row, column = nearest[0, v, u], nearest[1, v, u]
                        own_distance2 = (nearest[0, y, x] - y) ** 2 + (nearest[1, y, x] - x) ** 2
                        if (row - y) ** 2 + (column - x) ** 2 < own_distance2:
                            nearest[0, y, x] = row
                            nearest[1, y, x] = column
