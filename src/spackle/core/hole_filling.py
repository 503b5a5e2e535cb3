"""Fill holes of an inverse depth image from their rims, mostly from the far side.

`fill_from_far_side` works from coarse to fine: `_fill_level` reduces the image, fills the reduced
one by calling itself, interpolates its values into the holes, and smooths them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.runtime.kernels import kernel
from spackle.runtime.parallel_kernels import kernel_for_items, kernel_for_pixels

# Preference for the far side of a rim: a sample 5 % nearer than the fill has the weight 1/50.
FAR_SIDE_BIAS = 80.0
RELAXATION_SWEEPS = 12  # at each resolution; the coarser ones have settled the large distances

MIN_RIM_WEIGHT = 1e-6  # above 0, so that a hole with only a near rim is filled from it
MAX_EXPONENT = 30.0  # keeps weights within single precision
SMALLEST_WEIGHT = np.float32(np.exp(-MAX_EXPONENT))
LARGEST_WEIGHT = np.float32(np.exp(MAX_EXPONENT))
NEIGHBOR_COUNT = 4  # above, below, left and right of a pixel


def fill_from_far_side(
    inverse_depth: Tensor,
    values: Tensor,
    known: Tensor,
    *,
    far_bias: Tensor | float = FAR_SIDE_BIAS,
) -> tuple[Tensor, Tensor]:
    """Fill the unknown part of an inverse depth image and of further values, such as colours.

    A moving camera uncovers the surface behind, so a hole between a near and a far surface belongs
    to the far surface. The work goes from coarse to fine. At each resolution, the hole begins with
    a guess, which the next coarser resolution gives; then each of its pixels is replaced, several
    times, by the weighted mean of its four neighbours. So the hole becomes a smooth membrane that
    hangs on its rim, the known pixels around it. A rim pixel of inverse depth r beside a hole pixel
    of inverse depth h has the weight min(1, h / r)^far_bias, so a nearer rim hardly counts.

    Args:
        inverse_depth: [H, W], positive at known pixels.
        values: [C, H, W] further values, such as colours.
        known: [H, W] bool. Values at unknown pixels are ignored.
        far_bias: one number, or one for each pixel [H, W]; 0 treats both sides of the rim alike.

    Returns:
        Inverse depth [H, W] and values [C, H, W], float32, on the input's device; known pixels are
        unchanged.

    Raises:
        ValueError: nothing is known.
    """
    if not bool(known.any()):
        raise ValueError("no pixel is known")
    # The work is done in place, so these must be copies. Channels come last, so that the values of
    # one pixel are together in memory: a hole's pixels are scattered.
    filled_depth = _contiguous_copy(inverse_depth.detach().float())  # [H, W]
    filled_values = _contiguous_copy(values.detach().float().permute(1, 2, 0))  # [H, W, C]
    bias = torch.as_tensor(far_bias, dtype=torch.float32, device=inverse_depth.device)
    bias = bias.expand(inverse_depth.shape).contiguous()
    _fill_level(filled_depth, filled_values, known.contiguous(), bias)
    return filled_depth, filled_values.permute(2, 0, 1)


def _contiguous_copy(tensor: Tensor) -> Tensor:
    """A copy whose elements lie in memory in the order of the axes."""
    return tensor.clone(memory_format=torch.contiguous_format)


def _fill_level(depths: Tensor, values: Tensor, known: Tensor, bias: Tensor) -> None:
    """Fill the unknown pixels of an image in place, by first filling an image of half the size.

    Args:
        depths: [H, W] inverse depths, filled in place.
        values: [H, W, C] further values, filled in place.
        known: [H, W]; at least one pixel must be known.
        bias: [H, W] preference for the far side.
    """
    hole_pixels = _positions(~known)
    hole_count = len(hole_pixels)
    if hole_count == 0:
        return
    width = known.shape[1]
    channels = values.shape[-1]

    # Fill an image of half the size.
    coarse_shape = ((known.shape[0] + 1) // 2, (width + 1) // 2)
    coarse_depths = depths.new_empty(coarse_shape)
    coarse_values = depths.new_empty(*coarse_shape, channels)
    coarse_known = known.new_empty(coarse_shape)
    coarse_bias = depths.new_empty(coarse_shape)
    weights = torch.empty_like(depths)
    reference = _reference_depth(depths, known, bias)
    _write_far_weight(known.shape, depths, known, bias, reference, weights)
    _reduce_block(
        coarse_shape, depths, values, weights, bias,
        coarse_depths, coarse_values, coarse_known, coarse_bias,
    )  # fmt: skip
    _fill_level(coarse_depths, coarse_values, coarse_known, coarse_bias)

    # Collect the samples of the holes and then of their rims: column 0 is the inverse depth, the
    # others are the values. The holes begin with a guess from the coarser level.
    rim_pixels = _positions(known & _is_beside(~known))
    numbers = _number_pixels(known.shape, torch.cat([hole_pixels, rim_pixels]))
    flat_depths = depths.view(-1)
    flat_values = values.view(known.numel(), channels)
    samples = depths.new_empty(hole_count + len(rim_pixels), 1 + channels)
    _interpolate_guess(hole_count, width, coarse_depths, coarse_values, hole_pixels, samples)
    samples[hole_count:, 0] = flat_depths[rim_pixels]
    samples[hole_count:, 1:] = flat_values[rim_pixels]

    # The coarser image has settled the large distances; a few sweeps settle the small ones. Each
    # sweep reads the samples of the last one, and writes others (Jacobi).
    hole_bias = bias.view(-1)[hole_pixels]
    neighbors = hole_pixels.new_empty(hole_count, NEIGHBOR_COUNT)
    _find_neighbors(hole_count, hole_pixels, numbers, neighbors)
    old, new = samples, samples.clone()
    for _ in range(RELAXATION_SWEEPS):
        _relax_pixel(hole_count, old, neighbors, hole_bias, new)
        old, new = new, old
    flat_depths[hole_pixels] = old[:hole_count, 0]
    flat_values[hole_pixels] = old[:hole_count, 1:]


def _reference_depth(depths: Tensor, known: Tensor, bias: Tensor) -> np.float32:
    """The median inverse depth of the known pixels, by which inverse depths are divided.

    The weights are high powers of these ratios, which would leave the range of float32 without the
    division. Without any preference for the far side, all weights are 1, so the result is 1, too.

    Args:
        depths: [H, W] inverse depths.
        known: [H, W].
        bias: [H, W] preference for the far side; 0 for none.
    """
    if not bool(bias.any()):
        return np.float32(1)
    # For an even number of pixels, torch's median is the lower one of the two in the middle.
    return np.float32(float(torch.where(known, depths, torch.nan).nanmedian()))


def _positions(mask: Tensor) -> Tensor:
    """[n] int32: positions y·W + x of the true pixels of a mask [H, W], row by row."""
    return mask.view(-1).nonzero()[:, 0].int()


def _number_pixels(shape: Sequence[int], pixels: Tensor) -> Tensor:
    """[H, W] int32: the number k of the k-th of n pixels; −1 at all others.

    `pixels` [n] are positions y·W + x in an image of the given shape.
    """
    numbers = pixels.new_full(shape, -1)
    numbers.view(-1)[pixels] = torch.arange(len(pixels), dtype=pixels.dtype, device=pixels.device)
    return numbers


def _is_beside(mask: Tensor) -> Tensor:
    """[H, W] bool: pixels whose neighbour above, below, left or right is true in a mask."""
    is_beside = torch.zeros_like(mask)
    is_beside[1:] |= mask[:-1]
    is_beside[:-1] |= mask[1:]
    is_beside[:, 1:] |= mask[:, :-1]
    is_beside[:, :-1] |= mask[:, 1:]
    return is_beside


@kernel_for_pixels
def _write_far_weight(
    y: int, x: int, depths: Any, known: Any, bias: Any, reference: Any, weights: Any
) -> None:
    """Write the weight (depth / reference)^−bias, float32, of a pixel for the mean of its block.

    Farther pixels have a smaller inverse depth, so they weigh more. The weight stays between two
    bounds, so that neither it nor a sum of weights leaves the range of float32. An unknown pixel
    has the weight 0.

    Args:
        y, x: the pixel.
        depths: [H, W] inverse depths.
        known: [H, W].
        bias: [H, W] preference for far pixels; 0 makes plain means.
        reference: the inverse depth of a pixel whose weight is 1, such as the median.
        weights: output [H, W].
    """
    weight = np.float32(1)
    if not known[y, x]:
        weight = np.float32(0)
    elif bias[y, x] != 0:
        # The logarithm of the weight shows whether the weight would be too large or too small.
        # 1e-6, because the logarithm of 0 is infinite.
        exponent = -bias[y, x] * math.log(max(depths[y, x] / reference, np.float32(1e-6)))
        if abs(exponent) < MAX_EXPONENT:
            weight = np.float32(math.exp(np.float64(exponent)))
        else:
            weight = LARGEST_WEIGHT if exponent > 0 else SMALLEST_WEIGHT
    weights[y, x] = weight


@kernel_for_pixels
def _reduce_block(
    row: int, column: int, depths: Any, values: Any, weights: Any, bias: Any,
    coarse_depths: Any, coarse_values: Any, coarse_known: Any, coarse_bias: Any,
) -> None:  # fmt: skip
    """Reduce a block of 2×2 pixels to the weighted means of its known pixels.

    Args:
        row, column: of the block.
        depths: [H, W] inverse depths.
        values: [H, W, C] further values.
        weights: [H, W] of the pixels; unknown ones have the weight 0.
        bias: [H, W] preference for far pixels.
        coarse_depths: [⌈H/2⌉, ⌈W/2⌉] written; unset where no pixel of the block is known.
        coarse_values: [⌈H/2⌉, ⌈W/2⌉, C] written; unset where no pixel of the block is known.
        coarse_known: [⌈H/2⌉, ⌈W/2⌉] written: whether any pixel of the block is known.
        coarse_bias: [⌈H/2⌉, ⌈W/2⌉] written: plain means of `bias`.
    """
    height, width = depths.shape
    top, left = 2 * row, 2 * column
    # An odd last row or column counts twice in the mean of the bias.
    bottom, right = min(top + 1, height - 1), min(left + 1, width - 1)
    coarse_bias[row, column] = (
        bias[top, left] / 4
        + bias[top, right] / 4
        + bias[bottom, left] / 4
        + bias[bottom, right] / 4
    )

    # Unknown pixels must not enter the sums, because they may be NaN.
    weight_sum, depth_sum = np.float32(0), np.float32(0)
    for y in range(top, min(top + 2, height)):
        for x in range(left, min(left + 2, width)):
            if weights[y, x] > 0:
                weight_sum += weights[y, x]
                depth_sum += weights[y, x] * depths[y, x]
    coarse_known[row, column] = weight_sum > 0
    if not weight_sum > 0:  # no pixel of the block is known
        return

    coarse_depths[row, column] = depth_sum / weight_sum
    for channel in range(values.shape[2]):
        value_sum = np.float32(0)
        for y in range(top, min(top + 2, height)):
            for x in range(left, min(left + 2, width)):
                if weights[y, x] > 0:
                    value_sum += weights[y, x] * values[y, x, channel]
        coarse_values[row, column, channel] = value_sum / weight_sum


@kernel_for_items
def _interpolate_guess(
    n: int, width: int, coarse_depths: Any, coarse_values: Any, hole_pixels: Any, samples: Any
) -> None:
    """Interpolate the values of a hole pixel bilinearly from the image of half the size.

    Args:
        n: number of the hole pixel.
        width: W of the finer image.
        coarse_depths: [⌈H/2⌉, ⌈W/2⌉] inverse depths.
        coarse_values: [⌈H/2⌉, ⌈W/2⌉, C] further values.
        hole_pixels: [n] positions y·W + x.
        samples: the row n is written: inverse depth, then C values.
    """
    rows, columns, channels = coarse_values.shape
    y, x = hole_pixels[n] // width, hole_pixels[n] % width
    # A fine pixel lies between two coarse rows and two coarse columns. The coarse pixel that covers
    # it is a quarter of a coarse pixel away from it, the other one three quarters, so that the
    # weights are 0.75 and 0.25. The covering pixel is in the lower row if y is even, and in the
    # right column if x is even.
    upper_row, left_column = (y - 1) // 2, (x - 1) // 2
    lower_weight = np.float32(0.75) if y % 2 == 0 else np.float32(0.25)
    right_weight = np.float32(0.75) if x % 2 == 0 else np.float32(0.25)
    top, bottom = max(upper_row, 0), min(upper_row + 1, rows - 1)
    left, right = max(left_column, 0), min(left_column + 1, columns - 1)

    upper = coarse_depths[top, left] * (1 - right_weight) + coarse_depths[top, right] * right_weight
    lower = (
        coarse_depths[bottom, left] * (1 - right_weight)
        + coarse_depths[bottom, right] * right_weight
    )
    samples[n, 0] = upper * (1 - lower_weight) + lower * lower_weight
    for channel in range(channels):
        upper = (
            coarse_values[top, left, channel] * (1 - right_weight)
            + coarse_values[top, right, channel] * right_weight
        )
        lower = (
            coarse_values[bottom, left, channel] * (1 - right_weight)
            + coarse_values[bottom, right, channel] * right_weight
        )
        samples[n, 1 + channel] = upper * (1 - lower_weight) + lower * lower_weight


@kernel_for_items
def _find_neighbors(n: int, hole_pixels: Any, numbers: Any, neighbors: Any) -> None:
    """Write the numbers of the pixels above, below, left and right of a hole pixel.

    At the image's border, a pixel is its own neighbour.

    Args:
        n: number of the hole pixel.
        hole_pixels: [n] positions y·W + x.
        numbers: [H, W] the number of each hole pixel and rim pixel.
        neighbors: [n, 4] the row n is written.
    """
    height, width = numbers.shape
    y, x = hole_pixels[n] // width, hole_pixels[n] % width
    neighbors[n, 0] = numbers[max(y - 1, 0), x]
    neighbors[n, 1] = numbers[min(y + 1, height - 1), x]
    neighbors[n, 2] = numbers[y, max(x - 1, 0)]
    neighbors[n, 3] = numbers[y, min(x + 1, width - 1)]


@kernel_for_items
def _relax_pixel(n: int, old: Any, neighbors: Any, bias: Any, new: Any) -> None:
    """Replace a hole pixel by the weighted mean of its four neighbours.

    Args:
        n: number of the hole pixel.
        old: [holes + rims, 1 + C] one row for each pixel, with its inverse depth and then C values:
            first the hole pixels, then the rim pixels (known pixels beside a hole).
        neighbors: [holes, 4] the rows of each hole pixel's neighbours.
        bias: [holes] preference for the far side of the rim; 0 makes a plain mean.
        new: the row n is written.
    """
    hole_count, channels = len(neighbors), old.shape[1]
    up, down = neighbors[n, 0], neighbors[n, 1]
    left, right = neighbors[n, 2], neighbors[n, 3]

    # Inside of a hole, all neighbours are hole pixels, and have the same weight.
    if bias[n] == 0 or max(up, down, left, right) < hole_count:
        for channel in range(channels):
            neighbor_sum = (
                old[up, channel] + old[down, channel] + old[left, channel] + old[right, channel]
            )
            new[n, channel] = neighbor_sum / NEIGHBOR_COUNT
        return

    # Beside the rim, known pixels that are nearer than the hole pixel weigh less.
    weight_sum = np.float32(0)
    for channel in range(channels):
        new[n, channel] = 0
    for k in range(NEIGHBOR_COUNT):
        neighbor = neighbors[n, k]
        weight = np.float32(1)
        if neighbor >= hole_count:  # a rim pixel
            weight = _rim_weight(old[n, 0], old[neighbor, 0], bias[n])
        weight_sum += weight
        for channel in range(channels):
            new[n, channel] += weight * old[neighbor, channel]
    for channel in range(channels):
        new[n, channel] /= weight_sum


@kernel
def _rim_weight(fill_depth: Any, rim_depth: Any, bias: Any) -> Any:
    """The weight min(1, fill_depth / rim_depth)^bias, float32, of a rim sample for a hole's fill.

    Both are inverse depths, so a rim that is nearer than the fill weighs less than 1. It still
    weighs a little, so that a hole which has only a near rim is filled from it.
    """
    if rim_depth <= fill_depth:
        return np.float32(1)
    # The small numbers keep the division and the logarithm finite.
    ratio = max(fill_depth / max(rim_depth, np.float32(1e-12)), np.float32(1e-6))
    return np.float32(max(math.exp(bias * math.log(np.float64(ratio))), MIN_RIM_WEIGHT))
