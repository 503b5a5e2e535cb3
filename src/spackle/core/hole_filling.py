"""Fill holes of an inverse depth image from their rims, mostly from the far side.

`fill_from_far_side` works from coarse to fine: `_fill_level` reduces the image, fills the reduced
one by calling itself, interpolates its values into the holes, and smooths them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

# Preference for the far side of a rim: a sample 5 % nearer than the fill has the weight 1/50.
FAR_SIDE_BIAS = 80.0
RELAXATION_SWEEPS = 12  # at each resolution; the coarser ones have settled the large distances

MIN_RIM_WEIGHT = 1e-6  # above 0, so that a hole with only a near rim is filled from it
MAX_EXPONENT = 30.0  # keeps weights within single precision
SMALLEST_WEIGHT = np.float32(np.exp(-MAX_EXPONENT))
LARGEST_WEIGHT = np.float32(np.exp(MAX_EXPONENT))
NEIGHBOR_COUNT = 4  # above, below, left and right of a pixel

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


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
    filled_depth = _contiguous_copy(inverse_depth.detach().cpu().float())  # [H, W]
    filled_values = _contiguous_copy(values.detach().cpu().float().permute(1, 2, 0))  # [H, W, C]
    bias = torch.as_tensor(far_bias, dtype=torch.float32).cpu().expand(inverse_depth.shape)
    _fill_level(
        filled_depth.numpy(),
        filled_values.numpy(),
        known.cpu().contiguous().numpy(),
        bias.contiguous().numpy(),
    )
    device = inverse_depth.device
    return filled_depth.to(device), filled_values.permute(2, 0, 1).to(device)


def _contiguous_copy(tensor: Tensor) -> Tensor:
    """A copy whose elements lie in memory in the order of the axes."""
    return tensor.clone(memory_format=torch.contiguous_format)


def _fill_level(depths: Floats, values: Floats, known: Bools, bias: Floats) -> None:
    """Fill the unknown pixels of an image in place, by first filling an image of half the size.

    Args:
        depths: [H, W] inverse depths, filled in place.
        values: [H, W, C] further values, filled in place.
        known: [H, W]; at least one pixel must be known.
        bias: [H, W] preference for the far side.
    """
    hole_count = known.size - np.count_nonzero(known)
    if hole_count == 0:
        return
    channels = values.shape[-1]

    # Fill an image of half the size.
    coarse_shape = ((known.shape[0] + 1) // 2, (known.shape[1] + 1) // 2)
    coarse_depths = np.empty(coarse_shape, np.float32)
    coarse_values = np.empty((*coarse_shape, channels), np.float32)
    coarse_known = np.empty(coarse_shape, np.bool_)
    coarse_bias = np.empty(coarse_shape, np.float32)
    reference = _reference_depth(depths, known, bias)

    def reduce_rows(start: int, stop: int) -> None:
        """Compute the rows start..stop of the coarser images."""
        _reduce_by_half(
            start, stop, depths, values, known, bias, reference,
            coarse_depths, coarse_values, coarse_known, coarse_bias,
        )  # fmt: skip

    parallel_for_chunks(reduce_rows, coarse_shape[0])
    _fill_level(coarse_depths, coarse_values, coarse_known, coarse_bias)

    # Collect the samples of the holes and then of their rims: column 0 is the inverse depth, the
    # others are the values. The holes begin with a guess from the coarser level.
    hole_pixels, neighbors, rim_pixels = _find_holes(known, hole_count)
    flat_depths = depths.reshape(-1)
    flat_values = values.reshape(known.size, channels)
    samples = np.empty((hole_count + len(rim_pixels), 1 + channels), np.float32)
    _interpolate_guess(known.shape[1], coarse_depths, coarse_values, hole_pixels, samples)
    samples[hole_count:, 0] = flat_depths[rim_pixels]
    samples[hole_count:, 1:] = flat_values[rim_pixels]

    # The coarser image has settled the large distances; a few sweeps settle the small ones.
    hole_bias = bias.ravel()[hole_pixels]
    samples = _relax(samples, samples.copy(), neighbors, hole_bias, RELAXATION_SWEEPS)
    flat_depths[hole_pixels] = samples[:hole_count, 0]
    flat_values[hole_pixels] = samples[:hole_count, 1:]


def _reference_depth(depths: Floats, known: Bools, bias: Floats) -> np.float32:
    """The median inverse depth of the known pixels, by which inverse depths are divided.

    The weights are high powers of these ratios, which would leave the range of float32 without the
    division. Without any preference for the far side, all weights are 1, so the result is 1, too.

    Args:
        depths: [H, W] inverse depths.
        known: [H, W].
        bias: [H, W] preference for the far side; 0 for none.
    """
    if not bias.any():
        return np.float32(1)
    # For an even number of pixels, torch's median is the lower one of the two in the middle.
    return np.float32(torch.from_numpy(depths[known]).median())


@kernel
def _reduce_by_half(
    start: int, stop: int, depths: Any, values: Any, known: Any, bias: Any, reference: Any,
    coarse_depths: Any, coarse_values: Any, coarse_known: Any, coarse_bias: Any,
) -> None:  # fmt: skip
    """Reduce blocks of 2×2 pixels to weighted means of their known pixels; far ones weigh most.

    Args:
        start: first row of the coarser images that is written.
        stop: the row after the last one that is written.
        depths: [H, W] inverse depths.
        values: [H, W, C] further values.
        known: [H, W]; only known pixels count.
        bias: [H, W] preference for far pixels; 0 makes plain means.
        reference: the inverse depth of a pixel whose weight is 1, such as the median.
        coarse_depths: [⌈H/2⌉, ⌈W/2⌉] written; unset where no pixel of the block is known.
        coarse_values: [⌈H/2⌉, ⌈W/2⌉, C] written; unset where no pixel of the block is known.
        coarse_known: [⌈H/2⌉, ⌈W/2⌉] written: whether any pixel of the block is known.
        coarse_bias: [⌈H/2⌉, ⌈W/2⌉] written: plain means of `bias`.
    """
    height, width = depths.shape
    channels = values.shape[2]
    weights = np.empty(4, np.float32)
    for row in range(start, stop):
        for column in range(coarse_depths.shape[1]):
            top, left = 2 * row, 2 * column
            # An odd last row or column counts twice in the mean of the bias.
            bottom, right = min(top + 1, height - 1), min(left + 1, width - 1)
            coarse_bias[row, column] = (
                bias[top, left] / 4
                + bias[top, right] / 4
                + bias[bottom, left] / 4
                + bias[bottom, right] / 4
            )

            # The weights depend on the depth, so the mean depth is computed first; the further
            # values then have the same weights.
            weight_sum, depth_sum = np.float32(0), np.float32(0)
            for k in range(4):  # the four pixels of the block, row by row
                y, x = top + k // 2, left + k % 2
                weights[k] = 0
                if y < height and x < width and known[y, x]:
                    weights[k] = _far_weight(depths[y, x] / reference, bias[y, x])
                    weight_sum += weights[k]
                    depth_sum += weights[k] * depths[y, x]
            coarse_known[row, column] = weight_sum > 0
            if not weight_sum > 0:  # no pixel of the block is known
                continue

            coarse_depths[row, column] = depth_sum / weight_sum
            for channel in range(channels):
                value_sum = np.float32(0)
                for k in range(4):
                    if weights[k] > 0:
                        value_sum += weights[k] * values[top + k // 2, left + k % 2, channel]
                coarse_values[row, column, channel] = value_sum / weight_sum


@kernel
def _far_weight(relative_depth: Any, bias: Any) -> Any:
    """The weight relative_depth^−bias, float32, of a pixel for the mean of its block.

    `relative_depth` is the pixel's inverse depth divided by the median one. Farther pixels have a
    smaller inverse depth, so they weigh more. The weight stays between two bounds, so that neither
    it nor a sum of weights leaves the range of float32.
    """
    if bias == 0:
        return np.float32(1)
    # The logarithm of the weight shows whether the weight would be too large or too small. 1e-6,
    # because the logarithm of 0 is infinite.
    exponent = -bias * np.log(max(relative_depth, np.float32(1e-6)))
    if abs(exponent) < MAX_EXPONENT:
        return np.float32(np.exp(np.float64(exponent)))
    return LARGEST_WEIGHT if exponent > 0 else SMALLEST_WEIGHT


@kernel
def _find_holes(known: Any, hole_count: int) -> Any:
    """Number the unknown pixels and the known ones beside them; list an unknown one's neighbours.

    Args:
        known: [H, W].
        hole_count: number n of unknown pixels.

    Returns:
        hole_pixels [n]: positions y·W + x of the unknown pixels; the k-th pixel has the number k.
        neighbors [n, 4]: numbers of the pixels above, below, left and right of each hole pixel; at
            the image's border, a pixel is its own neighbour.
        rim_pixels [m]: positions of the known pixels around the holes; the k-th of them has the
            number n + k.
    """
    height, width = known.shape
    hole_pixels = np.empty(hole_count, np.int32)
    neighbors = np.empty((hole_count, NEIGHBOR_COUNT), np.int32)
    max_rim_count = min(NEIGHBOR_COUNT * hole_count, height * width - hole_count)
    rim_pixels = np.empty(max_rim_count, np.int32)
    numbers = np.empty((height, width), np.int32)  # of all pixels; -1 as long as there is none

    # First all hole pixels get their numbers, because a pixel's neighbours may come after it.
    n = 0
    for y in range(height):
        for x in range(width):
            if known[y, x]:
                numbers[y, x] = -1
            else:
                numbers[y, x] = n
                hole_pixels[n] = y * width + x
                n += 1

    # Then each hole pixel learns the numbers of its neighbours; a known neighbour gets one now.
    rim_count = 0
    for n in range(hole_count):
        y, x = hole_pixels[n] // width, hole_pixels[n] % width
        for k in range(NEIGHBOR_COUNT):
            neighbor_y, neighbor_x = y, x
            if k == 0:
                neighbor_y = max(y - 1, 0)
            elif k == 1:
                neighbor_y = min(y + 1, height - 1)
            elif k == 2:
                neighbor_x = max(x - 1, 0)
            else:
                neighbor_x = min(x + 1, width - 1)
            if numbers[neighbor_y, neighbor_x] < 0:  # a known pixel without a number
                numbers[neighbor_y, neighbor_x] = hole_count + rim_count
                rim_pixels[rim_count] = neighbor_y * width + neighbor_x
                rim_count += 1
            neighbors[n, k] = numbers[neighbor_y, neighbor_x]
    return hole_pixels, neighbors, rim_pixels[:rim_count]


@kernel
def _interpolate_guess(
    width: int, coarse_depths: Any, coarse_values: Any, hole_pixels: Any, samples: Any
) -> None:
    """Interpolate the values of hole pixels bilinearly from the image of half the size.

    Args:
        width: W of the finer image.
        coarse_depths: [⌈H/2⌉, ⌈W/2⌉] inverse depths.
        coarse_values: [⌈H/2⌉, ⌈W/2⌉, C] further values.
        hole_pixels: [n] positions y·W + x.
        samples: the first n rows are written: inverse depth, then C values.
    """
    rows, columns, channels = coarse_values.shape
    for n in range(len(hole_pixels)):
        y, x = hole_pixels[n] // width, hole_pixels[n] % width
        # A fine pixel lies between two coarse rows and two coarse columns. The coarse pixel that
        # covers it is a quarter of a coarse pixel away from it, the other one three quarters, so
        # that the weights are 0.75 and 0.25. The covering pixel is in the lower row if y is even,
        # and in the right column if x is even.
        upper_row, left_column = (y - 1) // 2, (x - 1) // 2
        lower_weight = np.float32(0.75) if y % 2 == 0 else np.float32(0.25)
        right_weight = np.float32(0.75) if x % 2 == 0 else np.float32(0.25)
        top, bottom = max(upper_row, 0), min(upper_row + 1, rows - 1)
        left, right = max(left_column, 0), min(left_column + 1, columns - 1)

        upper = (
            coarse_depths[top, left] * (1 - right_weight) + coarse_depths[top, right] * right_weight
        )
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


@kernel
def _relax(samples: Any, buffer: Any, neighbors: Any, bias: Any, sweeps: int) -> Any:
    """Replace each hole pixel by the weighted mean of its four neighbours, several times (Jacobi).

    Args:
        samples: [n + m, 1 + C] one row for each pixel, with its inverse depth and then C values:
            first n hole pixels, then m rim pixels (known pixels beside a hole), which stay as they
            are. Overwritten.
        buffer: a copy of `samples`, for every other repetition. Overwritten.
        neighbors: [n, 4] the rows in `samples` of each hole pixel's neighbours.
        bias: [n] preference for the far side of the rim; 0 makes a plain mean.
        sweeps: number of repetitions.

    Returns:
        `samples` or `buffer`, whichever was written last.
    """
    hole_count, channels = len(neighbors), samples.shape[1]
    old, new = samples, buffer
    for _ in range(sweeps):
        for n in range(hole_count):
            up, down, left, right = neighbors[n]
            # Inside of a hole, all neighbours are hole pixels, and have the same weight.
            if bias[n] == 0 or max(up, down, left, right) < hole_count:
                for channel in range(channels):
                    neighbor_sum = (
                        old[up, channel]
                        + old[down, channel]
                        + old[left, channel]
                        + old[right, channel]
                    )
                    new[n, channel] = neighbor_sum / NEIGHBOR_COUNT
                continue

            # Beside the rim, known pixels that are nearer than the hole pixel weigh less.
            weight_sum = np.float32(0)
            new[n] = 0
            for k in range(NEIGHBOR_COUNT):
                neighbor = neighbors[n, k]
                is_rim = neighbor >= hole_count
                weight = (
                    _rim_weight(old[n, 0], old[neighbor, 0], bias[n]) if is_rim else np.float32(1)
                )
                weight_sum += weight
                for channel in range(channels):
                    new[n, channel] += weight * old[neighbor, channel]
            for channel in range(channels):
                new[n, channel] /= weight_sum
        old, new = new, old
    return old


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
    return np.float32(max(np.exp(bias * np.log(np.float64(ratio))), MIN_RIM_WEIGHT))
