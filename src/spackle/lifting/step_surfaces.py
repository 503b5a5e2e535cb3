"""The near and the far surface beside each depth step: where they lie, and which colours they have.

A *depth step* is a place where the inverse depths of two neighbouring pixels belong to two
surfaces. A *ring* is the set of pixels at the same distance from the nearest step: the first ring
touches it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.core.surfels import CREASE_RATIO, DEPTH_EDGE_RATIO
from spackle.lifting.edges import Floats
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

MAX_RING = 3  # pixels on each side of a step that may be mixtures of both surfaces
# A difference belongs to a steep plane if the differences on both sides exceed this share of it.
STEADY_DIFFERENCE_RATIO = 0.5
WINDOW_PX = 5  # both surfaces are estimated from this number of pixels to each side
# Weights by ring; ring 0 stands for pixels away from steps. Colours of the first rings are mixed;
# depths there are less sure, because round objects curve away at their rims.
COLOR_WEIGHT_OF_RING = np.array([1.0, 0.01, 0.15, 1.0], np.float32)
DEPTH_WEIGHT_OF_RING = np.array([1.0, 0.1, 0.5, 1.0], np.float32)
OUTLINE_BLUR_PX = np.float32(1.2)  # standard deviation with which the map's outline is smoothed
MIN_OUTLINE_DISTANCE_PX = np.float32(0.2)  # between a pixel's centre and the map's outline
NO_STEP = 1000  # a squared distance larger than any in the window

# A logistic function of 1.702·t is close to the normal distribution's share up to t.
LOGISTIC_SCALE = 1.702
MIN_SHARE, MAX_SHARE = 0.02, 0.98  # of a surface in the window, for a finite distance

MIN_WEIGHT = 1e-6  # a surface with less weight in the window has no plane of its own
# Added to the variances of pixel x and y in the window, in pixels²: few pixels give a flat plane.
PLANE_REGULARIZATION = 0.3


@kernel
def find_step_rings(image: Any) -> Any:
    """Find the depth steps of an image [H, W] of inverse depth, and the rings around them.

    A step lies between two neighbouring pixels whose inverse depths differ by more than 3 %, unless
    the change continues on both sides, as it does on a steep plane. A ring is made of all pixels
    with the same distance from the nearest step.

    Returns:
        [H, W] uint8: the distance to the nearest step in pixels, from 1 to 3; 0 beyond; and
        [H, W, 2] float32: for pixels of the first ring the inverse depths on the near and the far
        side of the step, else 0. If two steps touch a pixel, those of the higher step.
    """
    height, width = image.shape
    rings = np.zeros((height, width), np.uint8)
    side_depths = np.zeros((height, width, 2), np.float32)
    for y in range(height):
        for x in range(width):
            for dy, dx in ((0, 1), (1, 0)):  # the neighbour to the right, then the one below
                v = y + dy
                u = x + dx
                if v >= height or u >= width:
                    continue
                high = max(image[y, x], image[v, u])
                low = min(image[y, x], image[v, u])
                if high - low <= DEPTH_EDGE_RATIO * low:
                    continue

                # On a steep plane, such as ground near the horizon, the change continues on both
                # sides. At the image's border, it is assumed to continue.
                jump = image[v, u] - image[y, x]
                change_before = jump
                if y - dy >= 0 and x - dx >= 0:
                    change_before = image[y, x] - image[y - dy, x - dx]
                change_after = jump
                if v + dy < height and u + dx < width:
                    change_after = image[v + dy, u + dx] - image[v, u]
                # A product of two changes is positive if they have the same sign.
                steady = min(change_before * jump, change_after * jump)
                if steady > STEADY_DIFFERENCE_RATIO * jump * jump:
                    continue

                for row, column in ((y, x), (v, u)):
                    known_step = side_depths[row, column, 0] - side_depths[row, column, 1]
                    if rings[row, column] == 0 or high - low > known_step:
                        rings[row, column] = 1
                        side_depths[row, column, 0] = high
                        side_depths[row, column, 1] = low

    # A ring of pixels lies around the one before.
    for ring in range(1, MAX_RING):
        for y in range(height):
            for x in range(width):
                if rings[y, x] != ring:
                    continue
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        if rings[v, u] == 0:
                            rings[v, u] = ring + 1
    return rings, side_depths


def estimate_surfaces(
    inverse_depth: Floats,
    colors: Floats,
    rings: NDArray[np.uint8],
    side_depths: Floats,
    depth: Floats,
    slope: Floats,
    color: Floats,
) -> tuple[Floats, Floats]:
    """Estimate the near and the far surface at each pixel beside a depth step.

    Args:
        inverse_depth: [H, W].
        colors: [H, W, 3] the photo in linear RGB.
        rings: [H, W] distance to the nearest step in pixels, 1 to 3; 0 beyond.
        side_depths: [H, W, 2] inverse depths on the near and the far side of a step, for pixels
            that touch it.
        depth, slope, color: [2, H, W], [2, H, W, 2] and [2, H, W, 3]: inverse depth, its derivative
            by pixel x and y, and mean colour of the near and the far surface. At first both have
            the values of the map and the photo; pixels in a ring are overwritten here.

    Returns:
        [H, W]: how far a pixel lies inside of the near surface's outline in the map, in pixels;
        negative outside. [2, H, W]: the variance of each surface's colours.
    """
    height, width = inverse_depth.shape
    outline_distance = np.zeros((height, width), np.float32)
    variance = np.zeros((2, height, width), np.float32)
    parallel_for_chunks(
        lambda start, stop: _estimate_surfaces(
            start, stop, inverse_depth, colors, rings, side_depths,
            outline_distance, depth, slope, color, variance,
        ),
        height,
    )  # fmt: skip
    return outline_distance, variance


@kernel
def _estimate_surfaces(
    start: int, stop: int, image: Any, colors: Any, rings: Any, side_depths: Any,
    outline_distance: Any, depth: Any, slope: Any, color: Any, variance: Any,
) -> None:  # fmt: skip
    """Estimate the near surface (index 0) and the far one (1) at each ring pixel of some rows.

    Args:
        start, stop: the rows to estimate.
        image: [H, W] inverse depth.
        colors: [H, W, 3] linear RGB.
        rings: [H, W] uint8: distance to the nearest step, or 0.
        side_depths: [H, W, 2]: inverse depths on both sides of a step, in the first ring.
        outline_distance: [H, W]: the distance from the near surface's outline is written here.
        depth, slope, color: [2, H, W, …] of both surfaces, written here.
        variance: [2, H, W]: sum of the variances of the colour channels, written here.
    """
    width = image.shape[1]
    # Weighted sums over the pixels around, one row for each surface. For depths d at offsets (x, y)
    # these are the sums of 1, x, y, d, xx, yy, xy, xd, yd. For colours, they are the sums of 1, of
    # the three channels, and of their squares.
    depth_moments = np.zeros((2, 9), np.float64)
    color_moments = np.zeros((2, 7), np.float64)
    surface_depths = np.zeros(2, np.float32)
    for y in range(start, stop):
        for x in range(width):
            if rings[y, x] == 0:
                continue
            high, low = _closest_step(y, x, rings, side_depths)
            middle = np.float32(0.5) * (high + low)
            is_near = image[y, x] > middle
            # The pixel's own surface has the pixel's depth, the other one that of its side of the
            # step.
            surface_depths[0] = high
            surface_depths[1] = low
            surface_depths[0 if is_near else 1] = image[y, x]
            depth_moments[:, :] = 0
            color_moments[:, :] = 0
            near_share = _sum_window(
                y, x, image, colors, rings, high, low, surface_depths, depth_moments, color_moments
            )
            outline_distance[y, x] = _outline_distance(near_share, is_near)

            for side in range(2):
                # A pixel of the near surface gets a fitted plane for both surfaces, because the map
                # is ragged at near rims. One of the far surface keeps the map's depth as its far
                # one.
                if is_near or side == 0:
                    at_center, slope_x, slope_y = _fit_plane(
                        depth_moments[side], surface_depths[side]
                    )
                    depth[side, y, x] = at_center
                    slope[side, y, x, 0] = slope_x
                    slope[side, y, x, 1] = slope_y
                variance[side, y, x] = _mean_color(color_moments[side], color[side, y, x])


@kernel
def _outline_distance(near_share: Any, is_near: bool) -> Any:
    """How far a pixel lies inside of the near surface's outline, in pixels; negative outside.

    `near_share` is the share of near pixels around the pixel, weighted by a normal distribution.
    `is_near` tells on which side of the outline the pixel itself lies.
    """
    # For a straight outline, the share depends on the distance from the outline alone. A logistic
    # function, which is easy to invert, is close to this dependence.
    near_share = min(max(near_share, MIN_SHARE), MAX_SHARE)
    log_odds = np.log(near_share / (1 - near_share))
    distance = np.float32(OUTLINE_BLUR_PX * log_odds / LOGISTIC_SCALE)
    # The smoothed outline may run on the wrong side of the pixel, whose own side is known.
    if is_near:
        return max(distance, MIN_OUTLINE_DISTANCE_PX)
    return min(distance, -MIN_OUTLINE_DISTANCE_PX)


@kernel
def _closest_step(y: int, x: int, rings: Any, side_depths: Any) -> Any:
    """The inverse depths on both sides of the depth step closest to a pixel: (near, far).

    Near surfaces have high inverse depths, and far ones low.

    Args:
        y, x: the pixel.
        rings: [H, W] distance to the nearest step in pixels: 1 in the pixels that touch a step.
        side_depths: [H, W, 2] for pixels that touch a step, the inverse depths on its near and its
            far side.
    """
    height, width = rings.shape
    high = np.float32(0)
    low = np.float32(0)
    closest = NO_STEP  # squared distance
    for v in range(max(y - MAX_RING, 0), min(y + MAX_RING + 1, height)):
        for u in range(max(x - MAX_RING, 0), min(x + MAX_RING + 1, width)):
            squared_distance = (v - y) ** 2 + (u - x) ** 2
            if rings[v, u] == 1 and squared_distance < closest:
                high = side_depths[v, u, 0]
                low = side_depths[v, u, 1]
                closest = squared_distance
    return high, low


@kernel
def _sum_window(
    y: int, x: int, image: Any, colors: Any, rings: Any, high: Any, low: Any,
    surface_depths: Any, depth_moments: Any, color_moments: Any,
) -> Any:  # fmt: skip
    """Sum depths and colours of both surfaces over the 11×11 pixels around a pixel.

    Pixels next to a step count little, because their colours mix both surfaces.

    Args:
        y, x: the pixel.
        image: [H, W] inverse depth.
        colors: [H, W, 3] linear RGB.
        rings: [H, W] uint8: distance to the nearest step, or 0.
        high, low: inverse depths on both sides of the closest step.
        surface_depths: [2] inverse depth of the near and the far surface at this pixel.
        depth_moments, color_moments: [2, 9] and [2, 7], zero at first: the weighted sums.

    Returns:
        The share of near pixels in the 7×7 pixels around, blurred.
    """
    height, width = image.shape
    middle = np.float32(0.5) * (high + low)
    near_weight = 0.0
    total_weight = 0.0
    for v in range(max(y - WINDOW_PX, 0), min(y + WINDOW_PX + 1, height)):
        for u in range(max(x - WINDOW_PX, 0), min(x + WINDOW_PX + 1, width)):
            d = image[v, u]
            dx = u - x
            dy = v - y
            side = 0 if d > middle else 1  # near or far
            if abs(dx) <= MAX_RING and abs(dy) <= MAX_RING:
                weight = np.exp(
                    -np.float32(dx * dx + dy * dy) / (2 * OUTLINE_BLUR_PX * OUTLINE_BLUR_PX)
                )
                total_weight += weight
                near_weight += weight * (1 - side)

            # A third surface, farther from the step than its other side, counts for neither.
            if d > high + (high - middle) or d < low - (middle - low):
                continue
            weight = np.exp(-np.float32(dx * dx + dy * dy) / np.float32(MAX_RING * MAX_RING))
            ring = rings[v, u]
            # Only depths that continue this pixel's surface.
            if abs(d - surface_depths[side]) < np.float32(DEPTH_EDGE_RATIO) * 2 * d:
                depth_weight = weight * DEPTH_WEIGHT_OF_RING[ring]
                depth_moments[side, 0] += depth_weight
                depth_moments[side, 1] += depth_weight * dx
                depth_moments[side, 2] += depth_weight * dy
                depth_moments[side, 3] += depth_weight * d
                depth_moments[side, 4] += depth_weight * dx * dx
                depth_moments[side, 5] += depth_weight * dy * dy
                depth_moments[side, 6] += depth_weight * dx * dy
                depth_moments[side, 7] += depth_weight * dx * d
                depth_moments[side, 8] += depth_weight * dy * d
            color_weight = weight * COLOR_WEIGHT_OF_RING[ring]
            color_moments[side, 0] += color_weight
            for c in range(3):
                color_moments[side, 1 + c] += color_weight * colors[v, u, c]
                color_moments[side, 4 + c] += color_weight * colors[v, u, c] * colors[v, u, c]
    return near_weight / total_weight


@kernel
def _mean_color(moments: Any, color: Any) -> Any:
    """Write the mean of weighted colours to `color` [3]; return the sum of the channels' variances.

    `moments` [7] has the sums of the weights, of the three channels and of their squares. If all
    weights are 0, the colour stays as it is, and the variance is 0.
    """
    total_variance = 0.0
    weight = moments[0]
    if weight > 0:
        for c in range(3):
            mean = moments[1 + c] / weight
            color[c] = mean
            total_variance += max(moments[4 + c] / weight - mean * mean, 0.0)
    return total_variance


@kernel
def _fit_plane(moments: Any, default: Any) -> Any:
    """Fit a plane of inverse depth to weighted pixels, by least squares.

    Args:
        moments: [9] sums of weight, x, y, d, xx, yy, xy, xd, yd, for inverse depths d at (x, y).
        default: the inverse depth to return if all weights are 0.

    Returns:
        The inverse depth at (0, 0), and its slopes by x and y. A slope is at most 1 % of the mean
        inverse depth a pixel.
    """
    total = moments[0]
    if total < MIN_WEIGHT:
        return np.float32(default), np.float32(0), np.float32(0)
    mean_x = moments[1] / total
    mean_y = moments[2] / total
    mean_d = moments[3] / total
    # The regularisation makes a plane through few pixels nearly flat.
    var_x = moments[4] / total - mean_x * mean_x + PLANE_REGULARIZATION
    var_y = moments[5] / total - mean_y * mean_y + PLANE_REGULARIZATION
    cov_xy = moments[6] / total - mean_x * mean_y
    cov_xd = moments[7] / total - mean_x * mean_d
    cov_yd = moments[8] / total - mean_y * mean_d

    # The normal equations of two unknowns, by Cramer's rule.
    determinant = var_x * var_y - cov_xy * cov_xy
    slope_x = (cov_xd * var_y - cov_yd * cov_xy) / determinant
    slope_y = (cov_yd * var_x - cov_xd * cov_xy) / determinant
    limit = np.float32(CREASE_RATIO) * mean_d
    slope_x = min(max(slope_x, -limit), limit)
    slope_y = min(max(slope_y, -limit), limit)
    # A surface is never extended to less than half its inverse depth.
    at_center = max(mean_d - slope_x * mean_x - slope_y * mean_y, 0.5 * mean_d)
    return np.float32(at_center), np.float32(slope_x), np.float32(slope_y)
