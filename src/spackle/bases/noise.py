"""Evening out what a sensor's noise does to a surface."""

from __future__ import annotations

from typing import Any

import numpy as np

from spackle._numba import kernel
from spackle.bases.edges import Bools, Floats
from spackle.surface import EDGE

LEAST_NOISE = 5e-4  # of the inverse depth; less leaves no gaps between the Gaussians
MOST_NOISE = 0.03  # more is no noise but what the photo shows: leaves, meshes
RADIUS = 2  # pixels to each side that a plane is fitted to
FITS = 2
OUTLIERS = 4.0  # standard deviations of the noise from the plane to what belongs to another surface
ENOUGH = 6  # pixels that say where a plane is


def noise_level(inverse_depth: Floats, known: Bools) -> float:
    """Standard deviation of the noise of most pixels, relative to the inverse depth.

    The second difference by both x and y is nought on every plane and along every crease and edge that is
    straight, and little on what is curved; the median leaves out the rest.
    """
    if min(inverse_depth.shape) < 3:
        return 0.0
    bend, seen = _second_difference(inverse_depth), known
    bend = _second_difference(bend.T).T
    for axis in (0, 1):
        seen = np.logical_and.reduce([np.take(seen, range(n, seen.shape[axis] - 2 + n), axis) for n in range(3)])
    if not seen.any():
        return 0.0
    return float(np.median(np.abs(bend[seen]) / inverse_depth[1:-1, 1:-1][seen])) / (0.6745 * 6)


def _second_difference(image: Floats) -> Floats:
    return image[:-2] - 2 * image[1:-1] + image[2:]


def smooth_noise(inverse_depth: Floats, known: Bools) -> Floats:
    """Put every pixel on the plane that its neighbourhood lies on, where the map is noisy; else leave the map as it is.

    Noise of 0.3 % makes each Gaussian of a slanted surface face another way, and light shines through.
    Pixels further from the plane than noise would explain are on another surface: they neither count
    nor move.

    Args:
        inverse_depth: [h, w], positive where known.
        known: [h, w] bool; others neither count nor move.
    """
    noise = noise_level(inverse_depth, known)
    if not LEAST_NOISE <= noise <= MOST_NOISE:
        return inverse_depth
    planes: Floats = _on_planes(inverse_depth, known, OUTLIERS * noise)
    return planes


@kernel
def _on_planes(depths: Any, known: Any, tolerance: float) -> Any:
    height, width = depths.shape
    result = depths.copy()
    for y in range(height):
        for x in range(width):
            if not known[y, x]:
                continue
            here = depths[y, x]
            at, across, down = here, 0.0, 0.0
            for fit in range(FITS):
                count, sx, sy, sd, sxx, syy, sxy, sxd, syd = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for dy in range(max(-RADIUS, -y), min(RADIUS, height - 1 - y) + 1):
                    for dx in range(max(-RADIUS, -x), min(RADIUS, width - 1 - x) + 1):
                        if not known[y + dy, x + dx]:
                            continue
                        off = depths[y + dy, x + dx] - (at + across * dx + down * dy)
                        # As long as the slope is not known any that is no edge has to be allowed for.
                        steep = EDGE * max(abs(dx), abs(dy)) if fit == 0 else 0.0
                        if abs(off) > (tolerance + steep) * here:
                            continue
                        d = depths[y + dy, x + dx] - here
                        count += 1
                        sx, sy, sd = sx + dx, sy + dy, sd + d
                        sxx, syy, sxy = sxx + dx * dx, syy + dy * dy, sxy + dx * dy
                        sxd, syd = sxd + dx * d, syd + dy * d
                if count < ENOUGH:
                    break
                cxx, cyy, cxy = sxx - sx * sx / count, syy - sy * sy / count, sxy - sx * sy / count
                cxd, cyd = sxd - sx * sd / count, syd - sy * sd / count
                determinant = cxx * cyy - cxy * cxy
                if determinant < 1e-3:
                    break
                across = (cxd * cyy - cyd * cxy) / determinant
                down = (cyd * cxx - cxd * cxy) / determinant
                at = here + (sd - across * sx - down * sy) / count
            if abs(at - here) <= tolerance * here:
                result[y, x] = at
    return result
