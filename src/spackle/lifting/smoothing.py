"""Smooth a depth map within its noise and its quantisation step."""

from __future__ import annotations

from typing import Any

import numpy as np

from spackle.core.surfels import DEPTH_EDGE_RATIO
from spackle.lifting.edges import Bools, Floats
from spackle.runtime.kernels import kernel

SMOOTHING_SWEEPS = 100  # enough for quantisation steps about 30 pixels apart
# Relative to the inverse depth; smaller changes would cause no gaps between the Gaussians.
MIN_SMOOTHED_CHANGE = 5e-4
NOISE_DEVIATIONS = 2.0  # a value may change by this number of the noise's standard deviations
# The median of |x| is this share of the standard deviation, for normally distributed x.
MEDIAN_TO_DEVIATION = 0.6745
# A second difference has the weights 1, -2, 1; along y and x they multiply independent noise by
# (1 + 4 + 1)^½ each, so by 6 together.
NOISE_GAIN = 6


def smooth_inverse_depth(
    inverse_depth: Floats, known: Bools, quantization: Floats | np.float32
) -> Floats:
    """The smoothest inverse depth [h, w] that its noise and its quantisation allow.

    Each known value is replaced by the mean of its neighbours on both sides. The change is limited
    to half a quantisation step, or to twice the noise's standard deviation if this is more. A
    neighbour that differs by over three times the limit belongs to another surface. If the noise is
    as large as the steps at depth edges, it is no noise: the map shows something fine, such as
    leaves or a mesh, which must stay.

    Args:
        inverse_depth: [h, w] 1/z.
        known: [h, w] bool: pixels with a depth; all others are returned unchanged.
        quantization: step between two values that the map can store, as [h, w] or as one number.
    """
    noise = estimate_noise(inverse_depth, known)
    if noise > DEPTH_EDGE_RATIO:
        noise = 0.0  # what looked like noise is the shape of fine objects
    max_change = np.maximum(quantization / 2, NOISE_DEVIATIONS * noise * inverse_depth)
    large_enough = max_change >= MIN_SMOOTHED_CHANGE * inverse_depth
    max_change = np.where(large_enough, max_change, 0).astype(np.float32)
    if not max_change.any():
        return inverse_depth

    # NaN keeps unknown pixels out of every mean, because all comparisons with it are false.
    smoothed = np.where(known, inverse_depth, np.float32(np.nan))
    _average_neighbors(
        smoothed, inverse_depth - max_change, inverse_depth + max_change, 3 * max_change
    )
    return np.where(known, smoothed, inverse_depth)


def estimate_noise(inverse_depth: Floats, known: Bools) -> float:
    """The standard deviation of most pixels' noise, relative to the inverse depth [h, w].

    It is measured by second differences along y and then along x. These are 0 on every plane, so
    that only noise and edges are left of the map. Edges are few, and hardly change the median. The
    result is 0 if no 3×3 pixels are `known` [h, w].
    """
    if min(inverse_depth.shape) < 3:
        return 0.0
    second_difference = inverse_depth
    all_known = known
    for _ in range(2):  # along y; then, transposed, along x
        second_difference = (
            second_difference[:-2] - 2 * second_difference[1:-1] + second_difference[2:]
        ).T
        all_known = (all_known[:-2] & all_known[1:-1] & all_known[2:]).T
    if not all_known.any():
        return 0.0
    centers = inverse_depth[1:-1, 1:-1]
    relative = np.abs(second_difference[all_known]) / centers[all_known]
    # From the median of absolute values to a standard deviation, and from the second differences,
    # which enlarge the noise, back to the map.
    return float(np.median(relative)) / (MEDIAN_TO_DEVIATION * NOISE_GAIN)


@kernel
def _average_neighbors(inverse_depth: Any, lowest: Any, highest: Any, max_difference: Any) -> None:
    """Replace each pixel by the mean of its neighbours again and again, within limits.

    A pixel's left and right neighbours count if both are on its surface, and so do the upper and
    lower ones.

    Args:
        inverse_depth: [h, w] float32, changed in place; NaN at unknown pixels.
        lowest, highest: [h, w]: the limits of each pixel; where they are equal, nothing changes.
        max_difference: [h, w]: a neighbour that differs by more is on another surface.
    """
    height, width = inverse_depth.shape
    for _ in range(SMOOTHING_SWEEPS):
        for y in range(height):
            for x in range(width):
                if not lowest[y, x] < highest[y, x]:
                    continue
                value = inverse_depth[y, x]
                total = np.float32(0)
                count = 0
                for dy, dx in ((0, 1), (1, 0)):
                    if y - dy < 0 or x - dx < 0 or y + dy >= height or x + dx >= width:
                        continue
                    before = inverse_depth[y - dy, x - dx]
                    after = inverse_depth[y + dy, x + dx]
                    limit = max_difference[y, x]
                    # False for NaN.
                    if abs(before - value) <= limit and abs(after - value) <= limit:
                        total += before + after
                        count += 2
                if count > 0:
                    mean = total / count
                    inverse_depth[y, x] = min(max(mean, lowest[y, x]), highest[y, x])
