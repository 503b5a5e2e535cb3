"""Silhouettes in two layers: the colours of both surfaces, and how much the near one covers.

A lens blurs a silhouette, so that a pixel or two on each side of a depth step show both surfaces.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.lifting.edges import Floats
from spackle.lifting.step_surfaces import MAX_RING, estimate_surfaces, find_step_rings
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import inlined_kernel, kernel

# A mixture does not explain a pixel whose squared difference from it is larger.
MAX_UNEXPLAINED = np.float32(0.002)
# The fringe of a sharpened outline differs from the far colour by more than this number of
# variances.
FRINGE_VARIANCES = np.float32(6.0)
SHIFTS_EACH_WAY = 6  # number of shifts of the outline that are tried to each side
SHIFT_STEP_PX = 0.33
SHIFT_COST = 0.04  # of a shift by one step, in variances of the colours
# Tried widths of a blurred outline: pixels from no to full coverage.
RAMP_WIDTHS_PX = np.array([1.75, 0.8])
OFF_MIXTURE_WEIGHT = 4.0  # of a pixel's distance from all mixtures, as part of the variance
# A hidden colour may differ from its surface's mean by this number of standard deviations.
MAX_COLOR_DEVIATIONS = np.float32(1.5)
MIN_SQUARED_CONTRAST = np.float32(1e-9)  # between both colours, for a safe division


@dataclasses.dataclass(frozen=True)
class Layers:
    """Both surfaces beside the depth steps of a map.

    Far from steps, `ring` and `alpha` are 0, and both layers hold the pixel's values.
    """

    ring: NDArray[np.uint8]  # [H, W] distance to the nearest step in pixels, 1 to 3; 0 beyond
    alpha: Floats  # [H, W] share of a pixel that the near surface covers
    depth: Floats  # [2, H, W] inverse depth of the near and the far surface
    slope: Floats  # [2, H, W, 2] derivative of the inverse depth by pixel x and y
    color: Floats  # [2, H, W, 3] linear RGB


def find_layers(
    inverse_depth: Floats, slope: Floats, colors: Floats, *, unmix: bool = True
) -> Layers:
    """Find a near colour, a far colour and alpha for each pixel beside a depth step.

    They mix to the photo's colour: alpha·near + (1 - alpha)·far. Both surfaces are continued across
    the step, with colours from pixels that show one surface alone. The map's outline, which may lie
    a pixel or two beside the photo's outline, is shifted to it.

    Args:
        inverse_depth: [H, W] 1/z, positive.
        slope: [H, W, 2] its derivative by pixel x and y.
        colors: [H, W, 3] the photo's linear RGB.
        unmix: if False, each pixel shows one surface alone, with the photo's colour: outlines that
            lie in the background (`guessed_outlines.py`) have nothing to separate.
    """
    height, width = inverse_depth.shape
    ring, side_depths = find_step_rings(inverse_depth)

    # First both surfaces with their mean colours …
    both_depths = np.stack([inverse_depth, inverse_depth])
    both_slopes = np.stack([slope, slope])
    both_colors = np.stack([colors, colors])
    outline_distance, variance = estimate_surfaces(
        inverse_depth, colors, ring, side_depths, both_depths, both_slopes, both_colors
    )

    if not unmix:
        is_near = (ring > 0) & (outline_distance > 0)
        return Layers(ring, is_near.astype(np.float32), both_depths, both_slopes, both_colors)

    # … then the coverage that explains the photo best with these colours …
    alpha = np.zeros((height, width), np.float32)
    parallel_for_chunks(
        lambda start, stop: _fit_coverage(
            start, stop, colors, ring, outline_distance, both_colors, variance, alpha
        ),
        height,
    )

    # … and last colours that give exactly the photo with this coverage.
    _unmix(colors, ring, outline_distance, alpha, both_colors, variance)
    return Layers(ring, alpha, both_depths, both_slopes, both_colors)


@inlined_kernel
def _closest_mixture(photo: Any, surface_colors: Any, y: int, x: int) -> Any:
    """The mixture of near and far colour that is closest to a pixel's colour.

    Args:
        photo: [H, W, 3] the photo.
        surface_colors: [2, H, W, 3] near and far colour.
        y, x: the pixel.

    Returns:
        The near colour's share in the mixture (of any sign and size), the squared distance of the
        pixel's colour from it, and the squared distance between both colours.
    """
    # Project the pixel's colour on the line through both colours. With n the near, f the far and p
    # the pixel's colour, these are the sums (n - f)², (n - f)·(p - f) and (p - f)² over channels.
    contrast = np.float32(0)
    along = np.float32(0)
    from_far = np.float32(0)
    for c in range(3):
        difference = surface_colors[0, y, x, c] - surface_colors[1, y, x, c]
        own = photo[y, x, c] - surface_colors[1, y, x, c]
        contrast += difference * difference
        along += difference * own
        from_far += own * own
    share = along / max(contrast, MIN_SQUARED_CONTRAST)
    return share, max(from_far - share * along, np.float32(0)), contrast


@kernel
def _fit_coverage(
    start: int,
    stop: int,
    photo: Any,
    ring: Any,
    outline_distance: Any,
    surface_colors: Any,
    variance: Any,
    alpha: Any,
) -> None:
    """Shift the map's outline to the photo's outline, and compute each pixel's coverage from it.

    For every pixel, 13 shifts and two widths of the outline's blur are tried. Each predicts how
    much of the pixels around is covered; the best prediction agrees with their colours.

    Args:
        start, stop: the rows to do.
        photo: [H, W, 3] the photo in linear RGB.
        ring: [H, W] uint8: distance to the nearest depth step, or 0.
        outline_distance: [H, W] distance from the near surface's outline in the map, in pixels;
            positive inside of it, negative outside.
        surface_colors: [2, H, W, 3] mean colours of the near and the far surface.
        variance: [2, H, W] their variances.
        alpha: [H, W]: the coverage, 0..1, of pixels in a ring is written here.
    """
    height, width = ring.shape
    shifts = 2 * SHIFTS_EACH_WAY + 1
    costs = np.zeros(len(RAMP_WIDTHS_PX) * shifts)  # by width, then by shift
    for y in range(start, stop):
        for x in range(width):
            if ring[y, x] == 0:
                continue
            for k in range(len(costs)):
                costs[k] = SHIFT_COST * (k % shifts - SHIFTS_EACH_WAY) ** 2
            for v in range(max(y - MAX_RING, 0), min(y + MAX_RING + 1, height)):
                for u in range(max(x - MAX_RING, 0), min(x + MAX_RING + 1, width)):
                    if ring[v, u] == 0:
                        continue
                    # A pixel counts more, the better its colours tell both surfaces apart.
                    share, off_mixture, contrast = _closest_mixture(photo, surface_colors, v, u)
                    spread = variance[0, v, u] + variance[1, v, u]
                    spread = spread + OFF_MIXTURE_WEIGHT * off_mixture
                    weight = contrast / max(spread, MIN_SQUARED_CONTRAST)
                    for k in range(len(costs)):
                        shift_px = (k % shifts - SHIFTS_EACH_WAY) * SHIFT_STEP_PX
                        a = 0.5 + (outline_distance[v, u] + shift_px) / RAMP_WIDTHS_PX[k // shifts]
                        error = min(max(a, 0.0), 1.0) - share
                        costs[k] += weight * error * error

            best = 0
            for k in range(len(costs)):
                if costs[k] < costs[best]:
                    best = k
            shift = float(best % shifts - SHIFTS_EACH_WAY)
            # Refine the shift by the minimum of a parabola through three costs.
            if 0 < best % shifts < shifts - 1:
                bend = costs[best - 1] - 2 * costs[best] + costs[best + 1]
                if bend > 0:
                    shift += 0.5 * (costs[best - 1] - costs[best + 1]) / bend
            coverage = (
                0.5
                + (outline_distance[y, x] + shift * SHIFT_STEP_PX) / RAMP_WIDTHS_PX[best // shifts]
            )
            alpha[y, x] = min(max(coverage, 0.0), 1.0)


@inlined_kernel
def _move_colors(y: int, x: int, a: Any, residual: Any, surface_colors: Any, variance: Any) -> Any:
    """Move the near and the far colour of a pixel so that their mixture changes by `residual`.

    A surface that covers the part p of the pixel changes its colour by residual·p²/(a³ + (1 - a)³),
    because the one that covers more is surer to have caused the difference. In the mixture, each
    change counts p times, so that both together give the residual. No colour moves by more than 1.5
    standard deviations.

    Args:
        y, x: the pixel.
        a: the part that the near surface covers; the far one covers 1 - a.
        residual: [3] change of the mixture.
        surface_colors: [2, H, W, 3] near and far colour, changed in place.
        variance: [2, H, W] of each surface's colours.

    Returns:
        The squared length of the part of the residual that is left.
    """
    cubes = a * a * a + (1 - a) * (1 - a) * (1 - a)
    unexplained = np.float32(0)
    for c in range(3):
        missing = residual[c]
        for side in range(2):
            part = a if side == 0 else 1 - a
            limit = MAX_COLOR_DEVIATIONS * np.sqrt(variance[side, y, x])
            change = min(max(residual[c] * part * part / cubes, -limit), limit)
            new_color = min(
                max(surface_colors[side, y, x, c] + change, np.float32(0)), np.float32(1)
            )
            missing -= part * (new_color - surface_colors[side, y, x, c])
            surface_colors[side, y, x, c] = new_color
        unexplained += missing * missing
    return unexplained


@kernel
def _unmix(
    photo: Any, ring: Any, outline_distance: Any, alpha: Any, surface_colors: Any, variance: Any
) -> None:
    """Change both colours so that they mix to the photo's colour, as far as they may.

    A colour may move by 1.5 standard deviations of its surface's colours. If that allows no exact
    mixture, the colours stay unchanged, and alpha gives the closest one. A pixel far from any
    mixture, such as the shaded edge of a round object, belongs to one surface alone. A camera's
    sharpening makes a fringe along an outline. It counts as the near surface, because on the
    background it would be visible as a line when the near object has moved away from it.

    Args:
        photo: [H, W, 3] the photo in linear RGB.
        ring: [H, W] uint8: distance to the nearest depth step; pixels with 0 are left alone.
        outline_distance: [H, W] distance from the near surface's outline in the map, in pixels;
            positive inside of it, negative outside.
        alpha: [H, W] coverage by the near surface, changed in place.
        surface_colors: [2, H, W, 3] near and far colour, changed in place.
        variance: [2, H, W] of each surface's colours.
    """
    height, width = ring.shape
    residual = np.zeros(3, np.float32)
    unchanged = np.zeros((2, 3), np.float32)
    for y in range(height):
        for x in range(width):
            if ring[y, x] == 0:
                continue
            a = alpha[y, x]
            share, off_mixture, contrast = _closest_mixture(photo, surface_colors, y, x)
            # A fringe overshoots: seen from the near colour, its colour lies clearly beyond the far
            # one, so that the near share is negative. `from_far` is its squared distance from the
            # far colour: along the line through both colours, plus across this line.
            from_far = share * share * contrast + off_mixture
            is_fringe = (
                share < 0 and from_far > FRINGE_VARIANCES * variance[1, y, x] + MAX_UNEXPLAINED
            )

            # Move both colours by what their mixture lacks.
            for c in range(3):
                unchanged[0, c] = surface_colors[0, y, x, c]
                unchanged[1, c] = surface_colors[1, y, x, c]
                residual[c] = photo[y, x, c] - (a * unchanged[0, c] + (1 - a) * unchanged[1, c])

            unexplained = _move_colors(y, x, a, residual, surface_colors, variance)
            if outline_distance[y, x] <= 0 and is_fringe:
                alpha[y, x] = 1
                continue
            if unexplained <= MAX_UNEXPLAINED:  # the new colours explain the pixel
                continue

            # If they do not, the old colours may still mix to the pixel, with another coverage. If
            # these do not either, the pixel shows a single surface.
            if off_mixture <= MAX_UNEXPLAINED and 0 < share < 1:
                alpha[y, x] = share
                for c in range(3):
                    surface_colors[0, y, x, c] = unchanged[0, c]
                    surface_colors[1, y, x, c] = unchanged[1, c]
            else:
                alpha[y, x] = 1 if outline_distance[y, x] > 0 else 0
