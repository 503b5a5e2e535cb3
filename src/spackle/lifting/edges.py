"""Find the edges of a depth map, and move them to the photo's outlines on the photo's grid."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.hole_filling import fill_from_far_side
from spackle.core.surfels import DEPTH_EDGE_RATIO
from spackle.runtime.kernels import inlined_kernel, kernel

STEEPEST = (
    5.0  # tangent of 79°: only surfaces at a larger angle to the image plane may be smeared edges
)
REACH = 16  # most pixels of the map from a smeared edge's steepest pixel to its end
FLAT = 0.1  # a smeared edge ends where its slope falls to about this share of the peak
SWELL = 0.25  # if the slope rises again by this share of the peak, the rise belongs to another edge

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Edges:
    step: Floats  # [h, w] height, in inverse depth, of the smeared edge around a pixel; 0 outside of smeared edges
    across: Bools  # [h, w] an edge runs between a pixel and its right neighbour
    down: Bools  # [h, w] an edge runs between a pixel and its lower neighbour


def find_edges(inverse_depth: Floats, known: Bools, focal: tuple[float, float]) -> Edges:
    """Find sharp and smeared depth edges along the rows and the columns of inverse depth [h, w].

    The slope of the inverse depth rises to a peak and falls again only at an edge. A peak is an edge if it is steeper
    than a surface of slope `STEEPEST`; `focal` (horizontal, vertical) is in pixels of the map. The inverse depth must
    also change by more than the share `DEPTH_EDGE_RATIO`, in addition to the change that the slopes on both sides explain. The
    pixels between the two feet of the peak belong to the smeared edge. No edge is found beside unknown pixels (`known`
    [h, w] false).
    """
    step, across = _rows(inverse_depth, known, STEEPEST / focal[0])
    columns, below = _rows(
        np.ascontiguousarray(inverse_depth.T), np.ascontiguousarray(known.T), STEEPEST / focal[1]
    )
    return Edges(np.maximum(step, columns.T), across, np.ascontiguousarray(below.T))


@kernel
def _rows(inverse_depth: Any, known: Any, steepest: float) -> Any:
    height, width = inverse_depth.shape
    step = np.zeros((height, width), np.float32)
    across = np.zeros((height, width), np.bool_)
    gaps = np.empty(
        width + 1, np.float32
    )  # gaps[x] is the change from x - 1 to x; NaN beside unknown pixels
    for y in range(height):
        row = inverse_depth[y]
        gaps[0] = gaps[width] = np.nan
        for x in range(1, width):
            gaps[x] = row[x] - row[x - 1] if known[y, x] and known[y, x - 1] else np.nan
        for x in range(1, width):
            top = abs(gaps[x])
            if (
                not top > steepest * max(row[x], row[x - 1])
                or abs(gaps[x - 1]) > top
                or abs(gaps[x + 1]) >= top
            ):
                continue
            left, first = _foot(gaps, x, -1)
            right, last = _foot(gaps, x, 1)
            slope = max(left, right, np.float32(0))
            start, end = row[first - 1], row[last]
            outer = 0.5 * (left + right) if min(left, right) >= 0 else slope
            rise = abs(end - start) - outer * (last - first + 1)
            if rise <= DEPTH_EDGE_RATIO * max(start, end):
                continue
            for k in range(first, last + 1):
                across[y, k - 1] = True
            for k in range(first, last):
                step[y, k] = max(step[y, k], rise)
    return step, across


@kernel
def _foot(gaps: Any, peak: int, way: int) -> Any:
    """The slope next to an edge on one side (−1 if unknown), and the index of the edge's last gap on that side."""
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
        if (
            2 * sign * gaps[k] < top
        ):  # a smeared edge is about twice as wide as its part above half the peak
            reach = min(reach, 2 * n + 1)
    # If another edge is close, this edge ends early and does not cut into a thin object between both edges.
    # A peak without steep gaps beside it is a sharp edge, even if the rim of a round object curves towards it.
    crowded = abs(gaps[end + way]) > FLAT * top
    foot = peak
    while (end - foot) * way > 1:
        flat = FLAT if crowded or foot == peak else FLAT / 2
        if sign * gaps[foot + way] - flattest <= flat * (top - flattest):
            break
        foot += way
    return flattest, foot


SLOPE_REACH = 3  # the slope beside an edge is measured within this number of the map's pixels
HOLE, OPEN, SETTLED = (
    0,
    1,
    2,
)  # a pixel's depth is unknown, undecided between the two sides of an edge, or known


@dataclasses.dataclass(frozen=True)
class Sampled:
    """A map's inverse depth on the photo's grid. Open pixels keep the map's value, even if it mixes two surfaces."""

    inverse_depth: Floats  # [H, W]
    state: NDArray[np.uint8]  # [H, W] HOLE, OPEN or SETTLED
    step: Floats  # [H, W] height of the edge around an open pixel
    slope: tuple[
        Floats, Floats
    ]  # [H, W] each: flattest change of the inverse depth by pixel x and y nearby


def sample(inverse_depth: Floats, known: Bools, edges: Edges, height: int, width: int) -> Sampled:
    """Resample a map's inverse depth [h, w] to height×width; `known` [h, w] marks the valid pixels.

    Between four map pixels of one surface the inverse depth is interpolated bilinearly, so a plane stays a plane. If an
    edge runs between these four, or one of them lies in a smeared edge, the photo's pixel stays open. If unknown map
    pixels have more than half of the weight, the photo's pixel is a hole. But a pixel of the photo that covers the
    centre of a map pixel outside of smeared edges gets the map pixel's depth, extended along the surface.
    """
    sound = known & (edges.step == 0)
    across = _flattest(inverse_depth, sound, edges.across)
    down = _flattest(*(np.ascontiguousarray(a.T) for a in (inverse_depth, sound, edges.down))).T
    rows, columns = inverse_depth.shape
    if (rows, columns) == (height, width):
        state = np.where(known, np.where(sound, SETTLED, OPEN), HOLE).astype(np.uint8)
        return Sampled(inverse_depth, state, edges.step, (across, np.ascontiguousarray(down)))
    fields = (
        inverse_depth,
        known,
        edges.step,
        edges.across,
        edges.down,
        across,
        np.ascontiguousarray(down),
    )
    values, state, step = _sample(*fields, height, width)
    y, x = (
        ((np.arange(n) + 0.5) * size / n).astype(int)
        for n, size in ((height, rows), (width, columns))
    )
    slope = (
        across[y][:, x] * np.float32(columns / width),
        down[y][:, x] * np.float32(rows / height),
    )
    return Sampled(values, state, step, slope)


@kernel
def _flattest(inverse_depth: Any, sound: Any, edge: Any) -> Any:
    """The flattest slope near each pixel in its row, because right beside a smeared edge the slope is too steep."""
    height, width = inverse_depth.shape
    slope = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            best = np.float32(np.inf)
            for way in (-1, 1):
                for n in range(SLOPE_REACH):
                    left = x + way * n - (way < 0)
                    if (
                        left < 0
                        or left + 1 >= width
                        or edge[y, left]
                        or not (sound[y, left] and sound[y, left + 1])
                    ):
                        break
                    change = inverse_depth[y, left + 1] - inverse_depth[y, left]
                    if abs(change) < abs(best):
                        best = change
            slope[y, x] = best if best < np.inf else 0
    return slope


@kernel
def _sample(
    depths: Any,
    known: Any,
    steps: Any,
    across: Any,
    down: Any,
    sx: Any,
    sy: Any,
    height: int,
    width: int,
) -> Any:
    rows, columns = depths.shape
    values: Any = np.zeros((height, width), np.float32)
    state = np.zeros((height, width), np.uint8)
    heights = np.zeros((height, width), np.float32)
    for y in range(height):
        v = (y + 0.5) * rows / height - 0.5
        y0 = min(max(int(np.floor(v)), 0), max(rows - 2, 0))
        y1 = min(y0 + 1, rows - 1)
        for x in range(width):
            u = (x + 0.5) * columns / width - 0.5
            x0 = min(max(int(np.floor(u)), 0), max(columns - 2, 0))
            x1 = min(x0 + 1, columns - 1)
            between = (x1 > x0 and (across[y0, x0] or across[y1, x0])) or (
                y1 > y0 and (down[y0, x0] or down[y0, x1])
            )
            here, closest = np.float32(0), np.inf
            step, low, high = np.float32(0), np.float32(np.inf), np.float32(0)
            count, bilinear, total, mass, mixed, planes = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(4):
                r, c = (y1 if k >= 2 else y0), (x1 if k % 2 else x0)
                # Beyond the outermost pixels' centres `linear` extrapolates and `weight` does not.
                linear = (v - y0 if k >= 2 else y0 + 1 - v) * (u - x0 if k % 2 else x0 + 1 - u)
                weight = max(1 - abs(v - r), 0.0) * max(1 - abs(u - c), 0.0)
                total += weight
                if not known[r, c]:
                    continue
                depth = depths[r, c]
                low, high, step = min(low, depth), max(high, depth), max(step, steps[r, c])
                plane = max(depth + sx[r, c] * (u - c) + sy[r, c] * (v - r), 0.5 * depth)
                count += 1
                bilinear += linear * depth
                mass += weight
                mixed += weight * depth
                planes += weight * plane
                away = max(abs(u - c) * width / columns, abs(v - r) * height / rows)
                if steps[r, c] == 0 and away < closest:
                    here, closest = np.float32(plane), away
            if mass < 0.5 * total:
                if closest < 0.5 + 1e-6:  # the photo's pixel covers this known map pixel
                    values[y, x], state[y, x] = here, SETTLED
                continue
            state[y, x] = SETTLED
            if not between and step == 0:
                values[y, x] = max(bilinear, 0.5 * low) if count == 4 else planes / mass
            elif closest < 0.5 + 1e-6:  # no other pixel of the photo is closer to this map pixel
                values[y, x] = here
            else:
                values[y, x], state[y, x], heights[y, x] = mixed / mass, OPEN, max(step, high - low)
    return values, state, heights


CHANGE_COST = 35.0  # cost of a channel's change from 0 to 1, or of crossing a smeared edge, in pixels of path length
NEAR_COST = (
    300.0  # cost of filling a hole from a pixel that is much too near, in pixels of path length
)


def assign_open_pixels(sampled: Sampled, rgb: Floats) -> Floats:
    """Give every open pixel, then every hole pixel, the depth of the known pixel to which its cheapest path leads.

    A path costs its length plus the change of sRGB [H, W, 3] along it, so that depth spreads within objects and stops
    at their outlines. In a smeared edge the change of the smeared depth adds to the cost. So the paths from both sides
    meet in the middle of the edge if the photo shows no outline. The depth of each side is extended along its surface.
    In a hole, a start pixel nearer than the hole's far side costs extra, because most holes are background that is
    hidden from a second camera. Returns inverse depth [H, W]; settled pixels are unchanged.
    """
    depth, hole = sampled.inverse_depth.copy(), sampled.state == HOLE
    for state in (OPEN, HOLE):
        pixels = np.flatnonzero(sampled.state == state)
        if not len(pixels):
            continue
        cost = np.where(sampled.state > state, np.float32(0), np.float32(np.inf))
        source, far, step = np.arange(cost.size), depth, sampled.step
        if state == HOLE:
            far = fill_from_far_side(*(torch.from_numpy(a) for a in (depth, depth[None], ~hole)))[
                0
            ].numpy()
            step = np.full_like(step, np.inf)
        _spread(cost, source, depth, step, far, rgb, pixels)
        source, width = source[pixels], cost.shape[1]
        found = depth.reshape(-1)[source]
        if state == OPEN:
            across, down = (slope.reshape(-1)[source] for slope in sampled.slope)
            lean = across * (pixels % width - source % width) + down * (
                pixels // width - source // width
            )
            found = np.maximum(found + lean, 0.5 * found)
        depth.reshape(-1)[pixels] = found
    return depth


@inlined_kernel
def color_change(rgb: Any, y: int, x: int, v: int, u: int) -> Any:
    """Sum of the channel differences between the pixels (y, x) and (v, u) of a photo [H, W, 3]."""
    change = abs(rgb[y, x, 0] - rgb[v, u, 0]) + abs(rgb[y, x, 1] - rgb[v, u, 1])
    return change + abs(rgb[y, x, 2] - rgb[v, u, 2])


@kernel
def _spread(
    cost: Any, source: Any, depths: Any, steps: Any, far: Any, rgb: Any, pixels: Any
) -> None:
    """Find the cheapest path of each of `pixels`: write its cost and its start (as y·W + x) to `cost` and `source`.

    The caller sets the cost of start pixels to 0, every other cost to infinity, and each source to the pixel itself.
    """
    height, width = depths.shape
    way, changed, before = -1, True, True
    while changed or before:
        before, changed = changed, False
        for i in range(len(pixels)):
            n = pixels[
                i if way < 0 else len(pixels) - 1 - i
            ]  # this sweep has visited the neighbours that are tried
            y, x = n // width, n % width
            for k in range(4):
                v, u = (y + way, x + k - 1) if k < 3 else (y, x + way)
                if v < 0 or u < 0 or v >= height or u >= width or cost[v, u] == np.inf:
                    continue
                length = 1.0 if v == y or u == x else 1.4142135
                climb = abs(depths[y, x] - depths[v, u]) / max(steps[y, x], np.float32(1e-12))
                total = cost[v, u] + length + CHANGE_COST * (color_change(rgb, y, x, v, u) + climb)
                if cost[v, u] == 0 and steps[y, x] == np.inf:
                    total += NEAR_COST * max(0.0, 1 - far[y, x] / depths[v, u])
                if np.float32(total) < cost[y, x]:
                    cost[y, x] = total
                    source[n] = source[v * width + u]
                    changed = True
        way = -way
