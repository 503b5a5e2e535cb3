"""Find the sharp and the smeared depth edges of a depth map.

A depth edge is where a near surface ends in front of a far one. A network or a filter may smear it
over several pixels, whose depths then lie between both surfaces and belong to neither.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.core.surfels import DEPTH_EDGE_RATIO
from spackle.runtime.kernels import kernel

# Tangent of 79°: only surfaces at a larger angle to the image plane may be smeared edges.
MIN_EDGE_TANGENT = 5.0
MAX_SMEAR_PX = 16  # most pixels of the map from a smeared edge's steepest pixel to its end
# A smeared edge ends where its slope has fallen to about this share of the way from its steepest
# value down to the slope beside it.
FOOT_SLOPE_RATIO = 0.1
# If the slope rises again by this share of the steepest one, the rise belongs to another edge.
NEXT_EDGE_RISE_RATIO = 0.25

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Edges:
    """The depth edges of a map [h, w]."""

    # [h, w]: height, in inverse depth, of the smeared edge to which a pixel belongs; 0 for pixels
    # outside of smeared edges, whose depth can be trusted.
    smear_height: Floats
    right: Bools  # [h, w]: an edge runs between a pixel and its right neighbour
    below: Bools  # [h, w]: an edge runs between a pixel and its lower neighbour


def find_edges(inverse_depth: Floats, known: Bools, focal: tuple[float, float]) -> Edges:
    """Find sharp and smeared depth edges along the rows and the columns of a map.

    The slope of the inverse depth rises to a peak and falls again only at an edge. A peak is an
    edge if it is steeper than a surface seen at an angle of 79°, and if the inverse depth changes
    there by more than 3 %, in addition to the change that the slopes on both sides explain. The
    pixels between the two feet of the peak belong to the smeared edge. No edge is found beside
    unknown pixels.

    Args:
        inverse_depth: [h, w] 1/z.
        known: [h, w] bool: pixels with a depth.
        focal: horizontal and vertical focal length in pixels of the map.
    """
    # On a surface that is inclined by an angle to the image plane, the inverse depth changes by
    # tan(angle) / focal length from pixel to pixel, relative to itself.
    height_in_rows, right = _find_edges_in_rows(inverse_depth, known, MIN_EDGE_TANGENT / focal[0])
    # The columns are the rows of the transposed map.
    height_in_columns, below = _find_edges_in_rows(
        np.ascontiguousarray(inverse_depth.T),
        np.ascontiguousarray(known.T),
        MIN_EDGE_TANGENT / focal[1],
    )
    smear_height = np.maximum(height_in_rows, height_in_columns.T)
    return Edges(smear_height, right, np.ascontiguousarray(below.T))


@kernel
def _find_edges_in_rows(inverse_depth: Any, known: Any, min_slope: float) -> Any:
    """Find the depth edges along each row of a map.

    Args:
        inverse_depth: [h, w] float32.
        known: [h, w] bool: pixels with a depth.
        min_slope: an edge is steeper than this change of inverse depth a pixel, relative to the
            inverse depth.

    Returns:
        [h, w] float32: the height of the smeared edge to which a pixel belongs, or 0; and
        [h, w] bool: whether an edge runs between a pixel and its right neighbour.
    """
    height, width = inverse_depth.shape
    smear_height = np.zeros((height, width), np.float32)
    right_edge = np.zeros((height, width), np.bool_)
    # gaps[x] is the change from pixel x - 1 to pixel x; NaN beside unknown pixels.
    gaps = np.empty(width + 1, np.float32)
    for y in range(height):
        row = inverse_depth[y]
        gaps[0] = np.nan
        gaps[width] = np.nan
        for x in range(1, width):
            both_known = known[y, x] and known[y, x - 1]
            gaps[x] = row[x] - row[x - 1] if both_known else np.nan

        for x in range(1, width):
            # Only a peak of the slope that is steep enough is an edge. Comparisons with NaN are
            # false.
            peak = abs(gaps[x])
            if not peak > min_slope * max(row[x], row[x - 1]):
                continue
            if abs(gaps[x - 1]) > peak or abs(gaps[x + 1]) >= peak:
                continue

            # The edge lies between the pixels first - 1 and last. The surfaces on both sides have
            # slopes, too. What they would change over the edge's width is no part of its height.
            left_slope, first = _find_foot(gaps, x, -1)
            right_slope, last = _find_foot(gaps, x, 1)
            flattest = max(left_slope, right_slope, np.float32(0))
            both_slopes_known = min(left_slope, right_slope) >= 0
            outer_slope = 0.5 * (left_slope + right_slope) if both_slopes_known else flattest
            start = row[first - 1]
            end = row[last]
            rise = abs(end - start) - outer_slope * (last - first + 1)
            if rise <= DEPTH_EDGE_RATIO * max(start, end):
                continue

            for k in range(first, last + 1):
                right_edge[y, k - 1] = True
            # A pixel between two gaps of the edge is a mixture of both surfaces.
            for k in range(first, last):
                smear_height[y, k] = max(smear_height[y, k], rise)
    return smear_height, right_edge


@kernel
def _find_foot(gaps: Any, peak: int, direction: int) -> Any:
    """Where an edge ends on one side of its steepest gap, and how steep the surface is beyond.

    Args:
        gaps: [w + 1] changes of inverse depth between neighbouring pixels; NaN if unknown.
        peak: index of the edge's steepest gap.
        direction: -1 towards the left, 1 towards the right.

    Returns:
        The slope next to the edge (≥ 0 along the edge's own direction; -1 if unknown), and the
        index of the edge's last gap on this side.
    """
    if np.isnan(gaps[peak + direction]):
        return np.float32(-1), peak
    sign = np.float32(1 if gaps[peak] > 0 else -1)
    steepest = sign * gaps[peak]

    # Walk down from the peak to the flattest gap. The walk ends where the slope rises again, which
    # is where another edge begins, or after the number of steps that a smeared edge can have.
    flattest = steepest
    flattest_at = peak
    max_steps = MAX_SMEAR_PX
    for n in range(1, MAX_SMEAR_PX + 1):
        k = peak + direction * n
        if n > max_steps or not sign * gaps[k] <= flattest + NEXT_EDGE_RISE_RATIO * steepest:
            break
        if sign * gaps[k] < flattest:
            flattest = max(sign * gaps[k], np.float32(0))
            flattest_at = k
        if flattest == 0:
            break
        # A smeared edge is about twice as wide as its part that is steeper than half the peak. So
        # once the slope is below that, the end of the walk is known.
        if 2 * sign * gaps[k] < steepest:
            max_steps = min(max_steps, 2 * n + 1)

    # If another edge is close, this edge ends early and does not cut into a thin object between
    # both edges. A peak without steep gaps beside it is a sharp edge, even if the rim of a round
    # object curves towards it.
    other_edge_is_close = abs(gaps[flattest_at + direction]) > FOOT_SLOPE_RATIO * steepest
    # From the peak on, the edge takes in each gap that is still clearly steeper than the surface.
    foot = peak
    while (flattest_at - foot) * direction > 1:
        ends_early = other_edge_is_close or foot == peak
        foot_ratio = FOOT_SLOPE_RATIO if ends_early else FOOT_SLOPE_RATIO / 2
        if sign * gaps[foot + direction] - flattest <= foot_ratio * (steepest - flattest):
            break
        foot += direction
    return flattest, foot
