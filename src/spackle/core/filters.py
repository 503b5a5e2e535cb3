"""Image filters: Gaussian blurs, the maximum in a window, and the nearest known pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from spackle.runtime.parallel_kernels import kernel_for_items, kernel_for_pixels

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


def nearest_known_pixels(hole: Tensor) -> Tensor:
    """For each pixel the row and column [2, H, W] int32 of the nearest pixel outside of a hole.

    If the whole image is a hole, all rows and columns are `-UNREACHABLE_PX`.

    Args:
        hole: [H, W] bool, on any device, as is the result.
    """
    hole = hole.contiguous()
    nearest_in_column = torch.empty(hole.shape, dtype=torch.int32, device=hole.device)
    _find_nearest_in_columns(hole.shape[1], hole, nearest_in_column)
    nearest = torch.empty((2, *hole.shape), dtype=torch.int32, device=hole.device)
    _find_nearest(hole.shape, nearest_in_column, nearest)
    return nearest


def distance_to_nearest(nearest: Tensor) -> Tensor:
    """The distance [H, W] in pixels from each pixel to its nearest known pixel.

    `nearest` [2, H, W] holds the row and column of the nearest known pixel of each pixel.
    """
    height, width = nearest.shape[1:]
    rows_apart = nearest[0] - torch.arange(height, device=nearest.device)[:, None]
    columns_apart = nearest[1] - torch.arange(width, device=nearest.device)
    return torch.hypot(rows_apart.float(), columns_apart.float())


@kernel_for_items
def _find_nearest_in_columns(column: int, hole: Any, nearest_row: Any) -> None:
    """Write, for each pixel of a column, the row of the nearest known pixel in the column.

    Args:
        column: is done.
        hole: [H, W] bool; pixels outside of it are known.
        nearest_row: output [H, W] int32; `-UNREACHABLE_PX` if the column has no known pixel.
    """
    height = hole.shape[0]
    last_known = -UNREACHABLE_PX
    for y in range(height):
        if not hole[y, column]:
            last_known = y
        nearest_row[y, column] = last_known

    # Upwards, the known pixel below may be nearer than the one above.
    next_known = -UNREACHABLE_PX
    for i in range(height):
        y = height - 1 - i
        if not hole[y, column]:
            next_known = y
        is_nearer = next_known - y < y - nearest_row[y, column]
        if next_known >= 0 and is_nearer:
            nearest_row[y, column] = next_known


@kernel_for_pixels
def _find_nearest(y: int, x: int, nearest_row: Any, nearest: Any) -> None:
    """Write the row and column of the known pixel nearest to a pixel.

    Args:
        y, x: the pixel.
        nearest_row: [H, W] the row of the nearest known pixel in each pixel's own column.
        nearest: output [2, H, W] int32; `-UNREACHABLE_PX` if there is no known pixel.
    """
    width = nearest_row.shape[1]
    nearest_y = -UNREACHABLE_PX
    nearest_x = -UNREACHABLE_PX
    least_distance2 = UNREACHABLE_PX * UNREACHABLE_PX

    # Look at columns farther and farther away, until the column alone is as far as what was found.
    for columns_apart in range(width):
        if columns_apart * columns_apart >= least_distance2:
            break
        for column in (x - columns_apart, x + columns_apart):
            if column < 0 or column >= width:
                continue
            row = int(nearest_row[y, column])
            distance2 = (row - y) * (row - y) + columns_apart * columns_apart
            if row >= 0 and distance2 < least_distance2:
                least_distance2 = distance2
                nearest_y = row
                nearest_x = column
    nearest[0, y, x] = nearest_y
    nearest[1, y, x] = nearest_x
