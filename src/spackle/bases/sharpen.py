"""Deciding on which side of a depth edge a pixel stands, by what the photo shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle._numba import kernel
from spackle.bases.edges import Bools, Floats
from spackle.bases.upsample import HOLE, OPEN, SETTLED, Sampled
from spackle.surface import EDGE

COLOR_COST = 100.0  # pixels of detour that a change from 0 to 1 in one channel is worth
DEPTH_COST = 40.0  # and the way from one side of a smeared edge to the other
ROUNDS = 4  # sweeps down and up; a path may turn as often
LEAN = 0.25  # how far a side's surface may be continued into an edge, relative to its inverse depth
VOTERS = 2  # pixels to each side that are heard on where an outline runs
SAME_COLOR = 0.1  # sum of the channels' differences at which a vote counts a quarter
VOTES, RELAXATIONS = 2, 10
SAME_SURFACE = EDGE / 2


def settle(sampled: Sampled, rgb: Floats) -> tuple[Floats, Bools]:
    """Give every open pixel the depth of the side that it is best connected to.

    A path over the image costs its length, the colour change along it and the change of the smeared
    depth: so a side's depth, continued along its surface, spreads to the colour edge, and where there
    is none to the middle of what was smeared. Then neighbours of a like colour outvote the few that
    stand alone, and what came from several places of one surface is evened out.

    Args:
        sampled: the map on the photo's grid.
        rgb: [H, W, 3] sRGB.

    Returns:
        Inverse depth [H, W] and where it is known; settled pixels as they were.
    """
    open_pixels = np.flatnonzero(sampled.state == OPEN)
    known = sampled.state != HOLE
    if not len(open_pixels):
        return sampled.inverse_depth, known
    source = _spread(sampled.inverse_depth, sampled.state, sampled.step, rgb, open_pixels)
    reached = source >= 0
    known.reshape(-1)[open_pixels[~reached]] = False
    open_pixels, source = open_pixels[reached], source[reached]
    depth = _continued(sampled, open_pixels, source)
    for _ in range(VOTES):
        depth = _vote(depth, known, rgb, open_pixels)
    _relax(depth, known, open_pixels)
    return depth, known


def _continued(sampled: Sampled, pixels: NDArray[np.int64], source: NDArray[np.int64]) -> Floats:
    """Each pixel on the plane of its source."""
    width = sampled.state.shape[1]
    at_source = sampled.inverse_depth.reshape(-1)[source]
    across, down = (slope.reshape(-1)[source] for slope in sampled.slope)
    lean = across * (pixels % width - source % width) + down * (pixels // width - source // width)
    depth = sampled.inverse_depth.copy()
    depth.reshape(-1)[pixels] = at_source + np.clip(lean, -LEAN * at_source, LEAN * at_source)
    return depth


@kernel
def _spread(depths: Any, state: Any, steps: Any, rgb: Any, pixels: Any) -> Any:
    """For each open pixel the settled one, as y·W + x, that the cheapest path leads to; −1 for none."""
    height, width = depths.shape
    cost = np.where(state == SETTLED, np.float32(0), np.float32(np.inf))
    source = np.arange(height * width)
    for sweep in range(2 * ROUNDS):
        way = 1 if sweep % 2 else -1  # the neighbours that this sweep has already visited
        changed = False
        for i in range(len(pixels)):
            n = pixels[i if way < 0 else len(pixels) - 1 - i]
            y, x = n // width, n % width
            for k in range(4):
                v, u = (y + way, x + k - 1) if k < 3 else (y, x + way)
                if v < 0 or u < 0 or v >= height or u >= width or cost[v, u] == np.inf:
                    continue
                change = abs(rgb[y, x, 0] - rgb[v, u, 0]) + abs(rgb[y, x, 1] - rgb[v, u, 1])
                change += abs(rgb[y, x, 2] - rgb[v, u, 2])
                climb = abs(depths[y, x] - depths[v, u]) / max(steps[y, x], np.float32(1e-12))
                length = 1.0 if v == y or u == x else 1.4142135
                total = np.float32(cost[v, u] + length + COLOR_COST * change + DEPTH_COST * climb)
                if total < cost[y, x]:
                    cost[y, x] = total
                    source[n] = source[v * width + u]
                    changed = True
        if not changed and sweep > 0:
            break
    found = source[pixels]
    for i in range(len(pixels)):
        if cost[pixels[i] // width, pixels[i] % width] == np.inf:
            found[i] = -1
    return found


@kernel
def _vote(depths: Any, known: Any, rgb: Any, pixels: Any) -> Any:
    """Open pixels near an edge change sides where most neighbours, by colour and distance, stand on the other."""
    height, width = depths.shape
    result = depths.copy()
    for n in pixels:
        y, x = n // width, n % width
        top, bottom = max(y - VOTERS, 0), min(y + VOTERS + 1, height)
        left, right = max(x - VOTERS, 0), min(x + VOTERS + 1, width)
        low = high = depths[y, x]
        for v in range(top, bottom):
            for u in range(left, right):
                if known[v, u]:
                    low, high = min(low, depths[v, u]), max(high, depths[v, u])
        if high - low <= EDGE * high:
            continue
        middle = 0.5 * (low + high)
        balance, strongest = 0.0, 0.0
        for v in range(top, bottom):
            for u in range(left, right):
                if not known[v, u]:
                    continue
                change = abs(rgb[y, x, 0] - rgb[v, u, 0]) + abs(rgb[y, x, 1] - rgb[v, u, 1])
                change = (change + abs(rgb[y, x, 2] - rgb[v, u, 2])) / SAME_COLOR
                vote = 1 / (1 + change * change) ** 2
                if (depths[v, u] > middle) == (depths[y, x] > middle):
                    balance += vote
                    continue
                balance -= vote
                vote /= (v - y) ** 2 + (u - x) ** 2
                if vote > strongest:
                    strongest, other = vote, depths[v, u]
        if balance < 0:
            result[y, x] = other
    return result


@kernel
def _relax(depths: Any, known: Any, pixels: Any) -> None:
    """Move open pixels to the mean of opposite neighbours on their surface, in place; a plane stays as it is."""
    height, width = depths.shape
    for _ in range(RELAXATIONS):
        for n in pixels:
            y, x = n // width, n % width
            here = depths[y, x]
            total, count = np.float32(0), 0
            for dy, dx in ((0, 1), (1, 0)):
                if y - dy < 0 or x - dx < 0 or y + dy >= height or x + dx >= width:
                    continue
                if not (known[y - dy, x - dx] and known[y + dy, x + dx]):
                    continue
                before, after = depths[y - dy, x - dx], depths[y + dy, x + dx]
                if max(abs(before - here), abs(after - here)) < SAME_SURFACE * here:
                    total += before + after
                    count += 2
            if count:
                depths[y, x] = total / count
