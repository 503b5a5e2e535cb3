"""Silhouettes in two layers: the colours of both surfaces beside a depth step, and the near surface's coverage."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.core.surfels import CREASE_RATIO, DEPTH_EDGE_RATIO
from spackle.lifting.edges import Floats
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import inlined_kernel, kernel

REACH = 3  # pixels on each side of a step that may be mixtures
STEADILY = 0.5  # a difference belongs to a plane if the next differences on both sides exceed this share of it
WINDOW = 5  # both surfaces are estimated from this number of pixels to each side
PURE = np.array([1.0, 0.01, 0.15, 1.0], np.float32)  # weight of a colour on each ring around a step
STEADY = np.array(
    [1.0, 0.1, 0.5, 1.0], np.float32
)  # weight of a depth on each ring: round objects curve away at rims
UNEXPLAINED = np.float32(
    0.002
)  # a mixture does not explain a pixel whose squared difference from it is larger
FRINGE = np.float32(
    6.0
)  # a fringe's squared difference from the far colour exceeds this number of variances
BLUR = np.float32(1.2)  # pixels over which the map's outline is smoothed
SURE = np.float32(0.2)  # least distance in pixels between a pixel's centre and the map's outline
STEPS, STEP = 6, 0.33  # number of shifts that are tried to each side, and their size in pixels
SHIFT_COST = 0.04  # cost of a shift by one step, in variances of the colours
RAMPS = np.array([1.75, 0.8])  # tried widths of a blurred outline: pixels from no to full coverage
ASTRAY = 4.0  # weight of a pixel's distance from all mixtures, as part of the variance
TEXTURE = np.float32(
    1.5
)  # a hidden colour may differ from the mean by this number of standard deviations


@dataclasses.dataclass(frozen=True)
class Layers:
    """Both surfaces beside the depth steps of a map. Far from steps, `ring` and `alpha` are 0, and both layers hold the
    pixel's values.
    """

    ring: NDArray[
        np.uint8
    ]  # [H, W] distance to the nearest step in pixels, from 1; 0 beyond `REACH`
    alpha: Floats  # [H, W] share of a pixel that the near surface covers
    depth: Floats  # [2, H, W] inverse depth of the near and the far surface
    slope: Floats  # [2, H, W, 2] derivative of the inverse depth by pixel x and y
    color: Floats  # [2, H, W, 3] linear RGB


def find_layers(inverse_depth: Floats, slope: Floats, colors: Floats) -> Layers:
    """Find a near colour, a far colour and alpha for each pixel beside a depth step; they mix to the photo's colour.

    A lens blurs a silhouette, so that a pixel or two on each side show both surfaces. Both surfaces are continued
    across the step, with colours from pixels that show one surface alone. The map's outline, which may lie a pixel or
    two beside the photo's outline, is shifted to it. `slope` [H, W, 2] is the derivative of `inverse_depth` [H, W] by
    pixel x and y; `colors` [H, W, 3] are the photo's linear RGB.
    """
    height, width = inverse_depth.shape
    ring, levels = _rings(inverse_depth)
    depth, slopes, color = (np.stack([image, image]) for image in (inverse_depth, slope, colors))
    alpha, inside, texture = (np.zeros((n, height, width), np.float32) for n in (1, 1, 2))
    found = (inside[0], depth, slopes, color, texture)
    parallel_for_chunks(
        lambda a, b: _survey(a, b, inverse_depth, colors, ring, levels, *found), height
    )
    looks = (colors, ring, inside[0], color, texture)
    parallel_for_chunks(lambda a, b: _match(a, b, *looks, alpha[0]), height)
    _unmix(colors, ring, inside[0], alpha[0], color, texture)
    return Layers(ring, alpha[0], depth, slopes, color)


@kernel
def _rings(image: Any) -> Any:
    """Rings of pixels around depth steps; for the first ring also the inverse depths [H, W, 2] on both sides."""
    height, width = image.shape
    ring = np.zeros((height, width), np.uint8)
    levels = np.zeros((height, width, 2), np.float32)
    for y in range(height):
        for x in range(width):
            for k in range(2):
                v, u = y + k, x + 1 - k
                if v >= height or u >= width:
                    continue
                high, low = max(image[y, x], image[v, u]), min(image[y, x], image[v, u])
                if high - low <= DEPTH_EDGE_RATIO * low:
                    continue
                # On a steep plane, such as ground near the horizon, the change continues on both sides.
                jump = image[v, u] - image[y, x]
                before = image[y, x] - image[y - k, x - 1 + k] if (y if k else x) > 0 else jump
                after = (
                    image[v + k, u + 1 - k] - image[v, u]
                    if (v + 1 < height if k else u + 1 < width)
                    else jump
                )
                if min(before * jump, after * jump) > STEADILY * jump * jump:
                    continue
                for b, a in ((y, x), (v, u)):
                    if ring[b, a] == 0 or high - low > levels[b, a, 0] - levels[b, a, 1]:
                        ring[b, a] = 1
                        levels[b, a, 0], levels[b, a, 1] = high, low
    for n in range(1, REACH):
        for y in range(height):
            for x in range(width):
                if ring[y, x] != n:
                    continue
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        if ring[v, u] == 0:
                            ring[v, u] = n + 1
    return ring, levels


@kernel
def _survey(
    start: int, stop: int, image: Any, colors: Any, ring: Any, levels: Any,
    inside: Any, depth: Any, slope: Any, color: Any, texture: Any,
) -> None:  # fmt: skip
    """Estimate both surfaces, their mean colours, and each pixel's distance from the outline, in rows start..stop."""
    height, width = image.shape
    m = np.zeros((2, 9), np.float64)  # per side: weight, x, y, d, xx, yy, xy, xd, yd
    s = np.zeros((2, 7), np.float64)  # per side: weight, colour, its square
    level = np.zeros(2, np.float32)
    for y in range(start, stop):
        for x in range(width):
            if ring[y, x] == 0:
                continue
            high, low, closest = np.float32(0), np.float32(0), 1000
            for v in range(max(y - REACH, 0), min(y + REACH + 1, height)):
                for u in range(max(x - REACH, 0), min(x + REACH + 1, width)):
                    away = (v - y) ** 2 + (u - x) ** 2
                    if ring[v, u] == 1 and away < closest:
                        high, low, closest = levels[v, u, 0], levels[v, u, 1], away
            middle = np.float32(0.5) * (high + low)
            near = image[y, x] > middle
            level[0], level[1] = high, low
            level[0 if near else 1] = image[y, x]
            for side in range(2):
                for k in range(9):
                    m[side, k] = 0
                for k in range(7):
                    s[side, k] = 0
            blurred, total = 0.0, 0.0
            for v in range(max(y - WINDOW, 0), min(y + WINDOW + 1, height)):
                for u in range(max(x - WINDOW, 0), min(x + WINDOW + 1, width)):
                    d = image[v, u]
                    dx, dy = u - x, v - y
                    side = 0 if d > middle else 1
                    if abs(dx) <= REACH and abs(dy) <= REACH:
                        w = np.exp(-np.float32(dx * dx + dy * dy) / (2 * BLUR * BLUR))
                        total += w
                        blurred += w * (1 - side)
                    if d > high + (high - middle) or d < low - (middle - low):
                        continue
                    w = np.exp(-np.float32(dx * dx + dy * dy) / np.float32(REACH * REACH))
                    r = ring[v, u]
                    if abs(d - level[side]) < np.float32(DEPTH_EDGE_RATIO) * 2 * d:
                        wd = w * STEADY[r]
                        m[side, 0] += wd
                        m[side, 1] += wd * dx
                        m[side, 2] += wd * dy
                        m[side, 3] += wd * d
                        m[side, 4] += wd * dx * dx
                        m[side, 5] += wd * dy * dy
                        m[side, 6] += wd * dx * dy
                        m[side, 7] += wd * dx * d
                        m[side, 8] += wd * dy * d
                    wc = w * PURE[r]
                    s[side, 0] += wc
                    for c in range(3):
                        s[side, 1 + c] += wc * colors[v, u, c]
                        s[side, 4 + c] += wc * colors[v, u, c] * colors[v, u, c]
            part = min(max(blurred / total, 0.02), 0.98)
            far_in = np.float32(BLUR * np.log(part / (1 - part)) / 1.702)
            inside[y, x] = max(far_in, SURE) if near else min(far_in, -SURE)
            for side in range(2):
                if (
                    near or side == 0
                ):  # a pixel of the far surface keeps the map's depth; near rims are ragged
                    at, across, down = _plane(m[side], level[side])
                    depth[side, y, x] = at
                    slope[side, y, x, 0], slope[side, y, x, 1] = across, down
                variance = 0.0
                for c in range(3):
                    if s[side, 0] > 0:
                        mean = s[side, 1 + c] / s[side, 0]
                        color[side, y, x, c] = mean
                        variance += max(s[side, 4 + c] / s[side, 0] - mean * mean, 0.0)
                texture[side, y, x] = variance


@inlined_kernel
def _share(colors: Any, color: Any, y: int, x: int) -> Any:
    """The near colour's share in the mixture closest to a pixel, the squared distance from the pixel to this mixture,
    and the squared distance between both colours.
    """
    apart, along, away = np.float32(0), np.float32(0), np.float32(0)
    for c in range(3):
        difference, own = color[0, y, x, c] - color[1, y, x, c], colors[y, x, c] - color[1, y, x, c]
        apart += difference * difference
        along += difference * own
        away += own * own
    share = along / max(apart, np.float32(1e-9))
    return share, max(away - share * along, np.float32(0)), apart


@kernel
def _match(
    start: int, stop: int, colors: Any, ring: Any, inside: Any, color: Any, texture: Any, alpha: Any
) -> None:
    """Shift the map's outline to the photo's outline, and compute each pixel's alpha, in rows start..stop."""
    height, width = ring.shape
    shifts = 2 * STEPS + 1
    costs = np.zeros(len(RAMPS) * shifts)
    for y in range(start, stop):
        for x in range(width):
            if ring[y, x] == 0:
                continue
            for k in range(len(costs)):
                costs[k] = SHIFT_COST * (k % shifts - STEPS) ** 2
            for v in range(max(y - REACH, 0), min(y + REACH + 1, height)):
                for u in range(max(x - REACH, 0), min(x + REACH + 1, width)):
                    if ring[v, u] == 0:
                        continue
                    share, beside, apart = _share(colors, color, v, u)
                    varied = texture[0, v, u] + texture[1, v, u] + ASTRAY * beside
                    weight = apart / max(varied, np.float32(1e-9))
                    for k in range(len(costs)):
                        a = 0.5 + (inside[v, u] + (k % shifts - STEPS) * STEP) / RAMPS[k // shifts]
                        off = min(max(a, 0.0), 1.0) - share
                        costs[k] += weight * off * off
            best = 0
            for k in range(len(costs)):
                if costs[k] < costs[best]:
                    best = k
            shift = float(best % shifts - STEPS)
            if 0 < best % shifts < shifts - 1:  # refine by the minimum of a parabola
                bend = costs[best - 1] - 2 * costs[best] + costs[best + 1]
                if bend > 0:
                    shift += 0.5 * (costs[best - 1] - costs[best + 1]) / bend
            alpha[y, x] = min(
                max(0.5 + (inside[y, x] + shift * STEP) / RAMPS[best // shifts], 0.0), 1.0
            )


@kernel
def _unmix(colors: Any, ring: Any, inside: Any, alpha: Any, color: Any, texture: Any) -> None:
    """Change both colours in place so that they mix to the photo's colour; the texture limits the change.

    If the limit allows no exact mixture, the colours stay unchanged, and alpha gives the closest one. A pixel far
    from any mixture, such as the shaded edge of a round object, belongs to one surface alone. The fringe of a
    sharpening camera along an outline counts as the near surface, because it would stay visible on the background.
    """
    height, width = ring.shape
    rest = np.zeros(3, np.float32)
    pure = np.zeros((2, 3), np.float32)
    for y in range(height):
        for x in range(width):
            if ring[y, x] == 0:
                continue
            a, left = alpha[y, x], np.float32(0)
            share, beside, apart = _share(colors, color, y, x)
            fringe = (
                share < 0
                and share * share * apart + beside > FRINGE * texture[1, y, x] + UNEXPLAINED
            )
            whole = a * a * a + (1 - a) * (1 - a) * (1 - a)
            for c in range(3):
                pure[0, c], pure[1, c] = color[0, y, x, c], color[1, y, x, c]
                rest[c] = colors[y, x, c] - (a * pure[0, c] + (1 - a) * pure[1, c])
            for c in range(3):
                missing = rest[c]
                for side in range(2):
                    part = a if side == 0 else 1 - a
                    limit = TEXTURE * np.sqrt(texture[side, y, x])
                    change = min(max(rest[c] * part * part / whole, -limit), limit)
                    moved = min(max(color[side, y, x, c] + change, np.float32(0)), np.float32(1))
                    missing -= part * (moved - color[side, y, x, c])
                    color[side, y, x, c] = moved
                left += missing * missing
            if inside[y, x] <= 0 and fringe:
                alpha[y, x] = 1
                continue
            if left <= UNEXPLAINED:
                continue
            if beside <= UNEXPLAINED and 0 < share < 1:
                alpha[y, x] = share
                for c in range(3):
                    color[0, y, x, c], color[1, y, x, c] = pure[0, c], pure[1, c]
            else:
                alpha[y, x] = 1 if inside[y, x] > 0 else 0


@kernel
def _plane(m: Any, level: Any) -> Any:
    """Inverse depth and slope of the plane fitted to weighted moments; `level` and slope 0 if all weights are 0."""
    if m[0] < 1e-6:
        return np.float32(level), np.float32(0), np.float32(0)
    mx, my, md = m[1] / m[0], m[2] / m[0], m[3] / m[0]
    cxx, cyy, cxy = m[4] / m[0] - mx * mx + 0.3, m[5] / m[0] - my * my + 0.3, m[6] / m[0] - mx * my
    cxd, cyd = m[7] / m[0] - mx * md, m[8] / m[0] - my * md
    determinant = cxx * cyy - cxy * cxy
    across, down = (cxd * cyy - cyd * cxy) / determinant, (cyd * cxx - cxd * cxy) / determinant
    limit = np.float32(CREASE_RATIO) * md
    across, down = min(max(across, -limit), limit), min(max(down, -limit), limit)
    return (
        np.float32(max(md - across * mx - down * my, 0.5 * md)),
        np.float32(across),
        np.float32(down),
    )
