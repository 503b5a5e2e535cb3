"""Bring a depth map to the photo's size without mixing the two sides of a depth edge."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.lifting.edges import Bools, Edges, Floats
from spackle.runtime.kernels import inlined_kernel, kernel

# States of a pixel of the photo.
HOLE = 0  # its depth is unknown
OPEN = 1  # it lies in an edge: its depth is that of one side, but which one is undecided
SETTLED = 2  # its depth is known

SLOPE_WINDOW_PX = 3  # the slope beside an edge is measured within this number of the map's pixels
MIN_PLANE_RATIO = 0.5  # a surface is never extended to less than this share of an inverse depth
# A pixel of the photo covers the centre of a map pixel within half a pixel; 1e-6 is for rounding.
COVERED_PX = 0.5 + 1e-6


@dataclasses.dataclass(frozen=True)
class ResampledMap:
    """A map's inverse depth on the photo's grid."""

    inverse_depth: Floats  # [H, W]; open pixels keep the map's value, even if it mixes two surfaces
    state: NDArray[np.uint8]  # [H, W] HOLE, OPEN or SETTLED
    edge_height: Floats  # [H, W] height, in inverse depth, of the edge around an open pixel
    # [H, W] each: the flattest change of the inverse depth by pixel x, and by pixel y, nearby.
    slope: tuple[Floats, Floats]


def resample_map(
    inverse_depth: Floats, known: Bools, edges: Edges, height: int, width: int
) -> ResampledMap:
    """Resample a map's inverse depth to the size of the photo.

    A smeared edge is a depth edge that the map blurs over several pixels. Each pixel of the photo
    becomes settled (its depth is known), open (it lies in an edge, and its side is undecided) or a
    hole (its depth is unknown).

    Between four map pixels of one surface the inverse depth is interpolated bilinearly, so a plane
    stays a plane. If an edge runs between these four, or one of them lies in a smeared edge, the
    photo's pixel stays open. If unknown map pixels have more than half of the weight, the photo's
    pixel is a hole. There is one exception: a pixel of the photo that covers the centre of a map
    pixel outside of smeared edges gets this map pixel's depth, extended along its surface.

    Args:
        inverse_depth: [h, w] 1/z.
        known: [h, w] bool: pixels of the map with a depth.
        edges: the depth edges of the map.
        height, width: of the photo.
    """
    # The depth of a pixel in a smeared edge belongs to no surface.
    on_one_surface = known & (edges.smear_height == 0)
    slope_x = _flattest_slopes(inverse_depth, on_one_surface, edges.right)
    slope_y = _flattest_slopes(
        np.ascontiguousarray(inverse_depth.T),
        np.ascontiguousarray(on_one_surface.T),
        np.ascontiguousarray(edges.below.T),
    )
    slope_y = np.ascontiguousarray(slope_y.T)
    rows, columns = inverse_depth.shape

    # A map of the photo's size needs no interpolation.
    if (rows, columns) == (height, width):
        state = np.where(known, np.where(on_one_surface, SETTLED, OPEN), HOLE).astype(np.uint8)
        return ResampledMap(inverse_depth, state, edges.smear_height, (slope_x, slope_y))

    values, state, edge_height = _resample(
        inverse_depth,
        known,
        edges.smear_height,
        edges.right,
        edges.below,
        slope_x,
        slope_y,
        height,
        width,
    )
    # Each pixel of the photo takes the slope of the map pixel (y, x) in which it lies. That is a
    # change from one map pixel to the next; the ratio of the sizes makes it one by photo pixel.
    y = ((np.arange(height) + 0.5) * rows / height).astype(int)
    x = ((np.arange(width) + 0.5) * columns / width).astype(int)
    slope = (
        slope_x[y][:, x] * np.float32(columns / width),
        slope_y[y][:, x] * np.float32(rows / height),
    )
    return ResampledMap(values, state, edge_height, slope)


@kernel
def _flattest_slopes(inverse_depth: Any, on_one_surface: Any, edge_right: Any) -> Any:
    """[h, w]: the flattest slope near each pixel in its row, in inverse depth a pixel.

    Right beside a smeared edge the slope is too steep, because the smear reaches further than the
    edge that was found. So up to three changes on each side are compared, up to the next edge.

    Args:
        inverse_depth: [h, w] float32.
        on_one_surface: [h, w] bool: pixels with a depth outside of smeared edges.
        edge_right: [h, w] bool: an edge runs between a pixel and its right neighbour.
    """
    height, width = inverse_depth.shape
    slope = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            flattest = np.float32(np.inf)
            for direction in (-1, 1):
                for n in range(SLOPE_WINDOW_PX):
                    # The left one of the two pixels between which the change is measured.
                    left = x + n if direction > 0 else x - n - 1
                    if left < 0 or left + 1 >= width or edge_right[y, left]:
                        break
                    if not (on_one_surface[y, left] and on_one_surface[y, left + 1]):
                        break
                    change = inverse_depth[y, left + 1] - inverse_depth[y, left]
                    if abs(change) < abs(flattest):
                        flattest = change
            slope[y, x] = flattest if flattest < np.inf else 0
    return slope


@kernel
def _resample(
    inverse_depth: Any,
    known: Any,
    smear_height: Any,
    edge_right: Any,
    edge_below: Any,
    slope_x: Any,
    slope_y: Any,
    height: int,
    width: int,
) -> Any:
    """Resample a map [h, w] to the photo's size [H, W], without mixing both sides of an edge.

    A pixel between map pixels of one surface is interpolated. One in a depth edge stays open: its
    side is undecided. One between unknown map pixels is a hole.

    Args:
        inverse_depth: [h, w] float32.
        known: [h, w] bool: pixels with a depth.
        smear_height: [h, w]: height of the smeared edge to which a pixel belongs, or 0.
        edge_right, edge_below: [h, w] bool: an edge runs to the right of a pixel, or below it.
        slope_x, slope_y: [h, w] change of inverse depth by pixel of the map.
        height, width: H and W.

    Returns:
        [H, W] each: inverse depth float32, the state HOLE, OPEN or SETTLED as uint8, and the height
        of the edge around an open pixel, float32.
    """
    rows, columns = inverse_depth.shape
    values: Any = np.zeros((height, width), np.float32)
    state = np.zeros((height, width), np.uint8)
    edge_height = np.zeros((height, width), np.float32)
    for y in range(height):
        # The pixel's centre lies at (u, v), in pixels of the map from the first one's centre.
        v = (y + 0.5) * rows / height - 0.5
        for x in range(width):
            u = (x + 0.5) * columns / width - 0.5
            values[y, x], state[y, x], edge_height[y, x] = _resample_pixel(
                u,
                v,
                inverse_depth,
                known,
                smear_height,
                edge_right,
                edge_below,
                slope_x,
                slope_y,
                height,
                width,
            )
    return values, state, edge_height


@inlined_kernel
def _resample_pixel(
    u: float,
    v: float,
    inverse_depth: Any,
    known: Any,
    smear_height: Any,
    edge_right: Any,
    edge_below: Any,
    slope_x: Any,
    slope_y: Any,
    height: int,
    width: int,
) -> Any:
    """Resample a map [h, w] at the centre (u, v) of one pixel of the photo.

    (u, v) is in pixels of the map, from the first one's centre. All other arguments are those of
    `_resample`: images of the map, and the photo's size.

    Returns:
        The pixel's inverse depth, its state HOLE, OPEN or SETTLED, and the height of the edge if it
        is open.
    """
    # The four map pixels around have the rows y0, y1 and the columns x0, x1. At the map's border
    # they are the outermost ones, even if the position lies beyond them.
    rows, columns = inverse_depth.shape
    y0 = min(max(int(np.floor(v)), 0), max(rows - 2, 0))
    y1 = min(y0 + 1, rows - 1)
    x0 = min(max(int(np.floor(u)), 0), max(columns - 2, 0))
    x1 = min(x0 + 1, columns - 1)
    edge_between = (x1 > x0 and (edge_right[y0, x0] or edge_right[y1, x0])) or (
        y1 > y0 and (edge_below[y0, x0] or edge_below[y0, x1])
    )

    # Of the known ones among the four map pixels around: height of the highest smeared edge, lowest
    # and highest inverse depth, number, and sums.
    smear = np.float32(0)
    low: Any = np.float32(np.inf)
    high = np.float32(0)
    known_count = 0
    known_weight = 0.0
    bilinear_sum = 0.0
    mixed_sum = 0.0
    plane_sum = 0.0
    weight_sum = 0.0  # of all four
    # Of the closest map pixel outside of smeared edges: its depth, extended to this position, and
    # its distance in pixels of the photo.
    covered_depth = np.float32(0)
    covered_distance = np.inf
    for k in range(4):
        r = y1 if k >= 2 else y0
        c = x1 if k % 2 else x0
        # Beyond the outermost pixels' centres `linear` extrapolates and `weight` does not.
        linear_y = v - y0 if k >= 2 else y0 + 1 - v
        linear_x = u - x0 if k % 2 else x0 + 1 - u
        linear = linear_y * linear_x
        weight = max(1 - abs(v - r), 0.0) * max(1 - abs(u - c), 0.0)
        weight_sum += weight
        if not known[r, c]:
            continue
        value = inverse_depth[r, c]
        low = min(low, value)
        high = max(high, value)
        smear = max(smear, smear_height[r, c])
        # The map pixel's surface, extended to the photo's pixel.
        plane = max(
            value + slope_x[r, c] * (u - c) + slope_y[r, c] * (v - r),
            MIN_PLANE_RATIO * value,
        )
        known_count += 1
        bilinear_sum += linear * value
        known_weight += weight
        mixed_sum += weight * value
        plane_sum += weight * plane
        distance = max(abs(u - c) * width / columns, abs(v - r) * height / rows)
        if smear_height[r, c] == 0 and distance < covered_distance:
            covered_depth = np.float32(plane)
            covered_distance = distance

    # Mostly unknown: a hole, unless a known map pixel lies here.
    no_edge = np.float32(0)
    covers_map_pixel = covered_distance < COVERED_PX
    if known_weight < 0.5 * weight_sum:
        if covers_map_pixel:
            return covered_depth, SETTLED, no_edge
        return np.float32(0), HOLE, no_edge

    # On one surface: interpolate it.
    if not edge_between and smear == 0:
        if known_count == 4:
            return np.float32(max(bilinear_sum, MIN_PLANE_RATIO * low)), SETTLED, no_edge
        return np.float32(plane_sum / known_weight), SETTLED, no_edge

    # In an edge: the map pixel that lies here, as no other pixel of the photo is closer to it. Else
    # the pixel stays open.
    if covers_map_pixel:
        return covered_depth, SETTLED, no_edge
    return np.float32(mixed_sum / known_weight), OPEN, max(smear, high - low)
