"""A depth map of any size on the photo's grid, without mixing what stands in front with what stands behind."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle._numba import kernel
from spackle.bases.edges import Bools, Edges, Floats

SLOPE_REACH = 3  # pixels of the map beside an edge in which its side's slope is sought
HOLE, OPEN, SETTLED = 0, 1, 2  # what is known of a pixel's depth: nothing, no more than its two sides, all


@dataclasses.dataclass(frozen=True)
class Sampled:
    """A map's inverse depth on the photo's grid. Open pixels have what the map says, mixed as it may be."""

    inverse_depth: Floats  # [H, W]
    state: NDArray[np.uint8]  # [H, W] HOLE, OPEN or SETTLED
    step: Floats  # [H, W] height of the edge that an open pixel hangs in
    slope: tuple[Floats, Floats]  # [H, W] each: change of the inverse depth by pixel x and y, as flat as it is near


def sample(inverse_depth: Floats, known: Bools, edges: Edges, height: int, width: int) -> Sampled:
    """Resample a map to height×width.

    Between four pixels of one surface the inverse depth is bilinear, so a plane stays the plane it is.
    Where an edge runs between them, or one hangs in an edge, the photo's pixel stays open unless a
    sound pixel of the map is right there; what that one says is continued along its surface. Unknown
    pixels never count; where they have more than half of the weight, the photo's pixel is a hole, unless it
    covers one that is known.

    Args:
        inverse_depth: [h, w], positive where known.
        known: [h, w] bool.
        edges: of this map.
    """
    sound = known & (edges.step == 0)
    across = _flattest(inverse_depth, sound, edges.across)
    down = _flattest(*(np.ascontiguousarray(a.T) for a in (inverse_depth, sound, edges.down))).T
    rows, columns = inverse_depth.shape
    if (rows, columns) == (height, width):
        state = np.where(known, np.where(sound, SETTLED, OPEN), HOLE).astype(np.uint8)
        return Sampled(inverse_depth, state, edges.step, (across, np.ascontiguousarray(down)))
    fields = (inverse_depth, known, edges.step, edges.across, edges.down, across, np.ascontiguousarray(down))
    values, state, step = _sample(*fields, height, width)
    y, x = (((np.arange(n) + 0.5) * size / n).astype(int) for n, size in ((height, rows), (width, columns)))
    slope = (across[y][:, x] * np.float32(columns / width), down[y][:, x] * np.float32(rows / height))
    return Sampled(values, state, step, slope)


@kernel
def _flattest(inverse_depth: Any, sound: Any, edge: Any) -> Any:
    """The flattest slope along its row that each pixel's surface has within reach.

    The flattest, because what a smeared edge leaves beside its foot is always steeper than the surface.
    """
    height, width = inverse_depth.shape
    slope = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            best = np.float32(np.inf)
            for way in (-1, 1):
                for n in range(SLOPE_REACH):
                    left = x + way * n - (way < 0)
                    if left < 0 or left + 1 >= width or edge[y, left] or not (sound[y, left] and sound[y, left + 1]):
                        break
                    change = inverse_depth[y, left + 1] - inverse_depth[y, left]
                    if abs(change) < abs(best):
                        best = change
            slope[y, x] = best if best < np.inf else 0
    return slope


@kernel
def _sample(
    depths: Any, known: Any, steps: Any, across: Any, down: Any, sx: Any, sy: Any, height: int, width: int
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
            between = (x1 > x0 and (across[y0, x0] or across[y1, x0])) or (y1 > y0 and (down[y0, x0] or down[y0, x1]))
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
                if closest < 0.5 + 1e-6:  # the only one that is known of those that the photo's pixel covers
                    values[y, x], state[y, x] = here, SETTLED
                continue
            state[y, x] = SETTLED
            if not between and step == 0:
                values[y, x] = max(bilinear, 0.5 * low) if count == 4 else planes / mass
            elif closest < 0.5 + 1e-6:  # no pixel of the photo is closer to that pixel of the map
                values[y, x] = here
            else:
                values[y, x], state[y, x], heights[y, x] = mixed / mass, OPEN, max(step, high - low)
    return values, state, heights
