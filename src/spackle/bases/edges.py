"""Where a depth map has edges, and where an edge is smeared over several pixels."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle._numba import kernel
from spackle.surface import EDGE

STEEPEST = 5.0  # a surface at 79° to the image plane; only what is steeper may be a smeared edge
REACH = 16  # pixels of the map from the steepest place to the end of what was smeared, at most
FLAT = 0.1  # where the slope has fallen so far, in units of its peak, the surface is all but itself again
SWELL = 0.25  # a rise of the slope by so much of the peak belongs to another edge
STANDS_OUT = 0.7  # the slopes that an edge joins are at most that steep, in units of its peak

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Edges:
    """The depth edges of a map."""

    step: Floats  # [h, w] height in inverse depth of the smeared edge that a pixel hangs in; 0 where it hangs in none
    across: Bools  # [h, w] an edge runs between a pixel and the one to the right
    down: Bools  # [h, w] an edge runs between a pixel and the one below


def find_edges(inverse_depth: Floats, known: Bools, focal: tuple[float, float]) -> Edges:
    """Depth edges along the rows and the columns, sharp ones and smeared ones.

    The inverse depth of a plane is linear in the pixel, however steep; a crease bends it, a sphere
    curves it. A smeared edge alone rises from one slope to a peak and falls back to another, so it is
    sought as a peak of the slope: one that stands out from the slopes on both sides, that would be
    steeper than any surface one sees much of, and that raises the depth by more than `EDGE` beyond
    what those slopes explain. The pixels from foot to foot of the peak hang in the edge.

    Args:
        inverse_depth: [h, w], positive where known.
        known: [h, w] bool; no edge is seen beside other pixels.
        focal: focal length in pixels of the map, horizontally and vertically.
    """
    step, across = _rows(inverse_depth, known, STEEPEST / focal[0])
    columns, below = _rows(np.ascontiguousarray(inverse_depth.T), np.ascontiguousarray(known.T), STEEPEST / focal[1])
    return Edges(np.maximum(step, columns.T), across, np.ascontiguousarray(below.T))


@kernel
def _rows(inverse_depth: Any, known: Any, steepest: float) -> Any:
    """Heights of smeared edges and the edges to the right, by rows."""
    height, width = inverse_depth.shape
    step = np.zeros((height, width), np.float32)
    across = np.zeros((height, width), np.bool_)
    gaps = np.full(width + 1, np.nan, np.float32)  # gaps[x] lies between x - 1 and x; NaN beside the unknown
    for y in range(height):
        row = inverse_depth[y]
        for x in range(1, width):
            gaps[x] = row[x] - row[x - 1] if known[y, x] and known[y, x - 1] else np.nan
        for x in range(1, width):
            top = abs(gaps[x])
            if not top > steepest * max(row[x], row[x - 1]) or abs(gaps[x - 1]) > top or abs(gaps[x + 1]) >= top:
                continue
            left, first = _foot(gaps, x, -1)
            right, last = _foot(gaps, x, 1)
            slope = max(left, right, np.float32(0))
            if slope > STANDS_OUT * top:
                continue
            start, end = row[first - 1], row[last]
            outer = 0.5 * (left + right) if min(left, right) >= 0 else slope
            rise = abs(end - start) - outer * (last - first + 1)
            if rise <= EDGE * max(start, end):
                continue
            for k in range(first, last + 1):
                across[y, k - 1] = True
            for k in range(first, last):
                step[y, k] = max(step[y, k], rise)
    return step, across


@kernel
def _foot(gaps: Any, peak: int, way: int) -> Any:
    """The slope on one side of an edge, −1 where nothing is known there, and the edge's outermost gap."""
    if np.isnan(gaps[peak + way]):
        return np.float32(-1), peak
    sign = np.float32(1 if gaps[peak] > 0 else -1)
    top = sign * gaps[peak]
    flattest, end, reach = top, peak, REACH
    for n in range(1, REACH + 1):
        k = peak + way * n
        if n > reach or not sign * gaps[k] <= flattest + SWELL * top:
            break
        if sign * gaps[k] < flattest:
            flattest, end = max(sign * gaps[k], np.float32(0)), k
        if flattest == 0:
            break
        if 2 * sign * gaps[k] < top:  # a smeared edge ends about twice as far out as it is half as steep
            reach = min(reach, 2 * n + 1)
    # Where the next edge is close, what the foot is short of is little beside what a thin thing would lose;
    # and a peak with nothing beside it is sharp, though a round thing's rim falls off towards it.
    crowded = abs(gaps[end + way]) > FLAT * top
    foot = peak
    while (end - foot) * way > 1:
        flat = FLAT if crowded or foot == peak else FLAT / 2
        if sign * gaps[foot + way] - flattest <= flat * (top - flattest):
            break
        foot += way
    return flattest, foot
