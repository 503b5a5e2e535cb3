"""How far away the surfaces are that a masked thing hides, from the picture around the mask.

Rooms and streets consist of planes, whose inverse depth is linear in the picture. So planes are
fitted around the mask and continued behind it; what the planes leave is continued smoothly.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.filters import maximum_filter
from spackle.core.hole_filling import fill_from_far_side

Floats = NDArray[np.float64]

# The rim around a mask: so wide as a fraction of the root of the mask's area, and at least so many
# pixels.
RIM_WIDTH_RATIO = 0.35
MIN_RIM_PX = 4
RIM_SAMPLES = 1500  # pixels of the rim to which planes are fitted
MAX_PLANES = 3  # such as a floor and two walls
MIN_PLANE_SHARE = 0.1  # of the rim, that a plane must explain
PLANE_TOLERANCE = 0.02  # relative error of the inverse depth up to which a pixel is on a plane
TRIALS = 300  # planes through three random pixels; at a third of all pixels on a plane, 11 are good
MAX_LOG_ERROR = 0.3  # a pixel off all planes counts so much, however far off it is
PLANE_COST = 0.003  # mean error that one more plane must save
# A pixel around the mask that is nearer than the planes by this ratio is another thing in front,
# which says nothing about the background.
NEARER_RATIO = 1.15
NOTHING = 1e-3  # inverse depth, relative to the planes', where the rim shows nothing at all
SLIT_RATIO = 0.004  # half the width of a slit between Gaussians, as a fraction of the diagonal
MAX_DEVIATION = 0.2  # of a pixel, from the planes, as the logarithm of a ratio, to count as noise
MAD_TO_SIGMA = 1.4826  # median absolute deviation of a normal distribution to its σ


@dataclasses.dataclass(frozen=True)
class BackgroundDepth:
    """The surfaces behind a mask, as the camera would see them without what is masked."""

    inverse_depth: Tensor  # [H, W] 1/z; outside of the mask that of the visible surface
    noise: float  # relative standard deviation of the inverse depth around the mask


def background_depth(depth: Tensor, is_open: Tensor, mask: Tensor) -> BackgroundDepth:
    """The surfaces behind a mask, continued from around it.

    Args:
        depth: [H, W] z of the visible surfaces.
        is_open: [H, W] bool: pixels that show nothing, or hardly anything.
        mask: [H, W] bool, neither empty nor the whole picture.
    """
    # [H, W] inverse depth of what is visible; where nothing is, 0, as if infinitely far away.
    visible = torch.where(is_open, 0, 1 / depth.double().clamp_min(1e-30)).numpy()  # no 1 / 0
    known = ~mask.numpy()
    rim = _rim(mask)
    on_surface = rim & ~is_open.numpy()
    if np.count_nonzero(on_surface) < 3:  # no plane goes through fewer pixels
        # Hardly anything but emptiness surrounds the mask, so there is emptiness behind the thing,
        # too: inverse depth 0, without noise.
        return BackgroundDepth(torch.from_numpy(np.where(known, visible, 0)).float(), 0.0)

    # Rooms and streets consist of planes, so planes are continued behind the mask. Surfaces differ
    # from them by a ratio of inverse depths, which is 1 on a plane; it is continued smoothly.
    planes = _planes_through_rim(visible, on_surface)  # [H, W]
    ratio = np.where(is_open.numpy(), NOTHING, visible / planes).clip(NOTHING, 1 / NOTHING)

    # Around the mask, some pixels say nothing about the background: slits between Gaussians are no
    # sky, and what is nearer than the planes is another thing in front.
    slits = is_open & ~_without_slits(is_open)
    says_something = known & ~slits.numpy() & (ratio < NEARER_RATIO)
    filled, _ = fill_from_far_side(
        torch.from_numpy(ratio), torch.empty(0, *mask.shape), torch.from_numpy(says_something),
        far_bias=0.0,
    )  # fmt: skip
    behind = filled.double().numpy() * planes

    # The noise is how much surfaces around the mask usually differ from the planes. The median
    # absolute deviation is little moved by edges and by things in front.
    deviation = np.abs(np.log(ratio[on_surface]))
    regular = deviation[deviation < MAX_DEVIATION]
    noise = MAD_TO_SIGMA * float(np.median(regular)) if len(regular) else MAX_DEVIATION
    return BackgroundDepth(torch.from_numpy(np.where(known, visible, behind)).float(), noise)


def _rim(mask: Tensor) -> NDArray[np.bool_]:
    """[H, W] bool: the pixels around a mask."""
    width = max(MIN_RIM_PX, round(RIM_WIDTH_RATIO * math.sqrt(int(mask.sum()))))
    return (maximum_filter(mask, width) & ~mask).numpy()


def _without_slits(is_open: Tensor) -> Tensor:
    """[H, W] bool: the pixels that show nothing, without narrow slits (a morphological opening)."""
    radius = max(1, round(SLIT_RATIO * math.hypot(*is_open.shape)))
    core = ~maximum_filter(~is_open, radius)
    return maximum_filter(core, radius)


def _planes_through_rim(visible: Floats, on_surface: NDArray[np.bool_]) -> Floats:
    """[H, W] positive inverse depth of the planes that best explain the surfaces around a mask.

    Args:
        visible: [H, W] inverse depth.
        on_surface: [H, W] bool: the pixels to explain.
    """
    height, width = visible.shape
    rows, columns = np.nonzero(on_surface)
    random = np.random.default_rng(0)  # the same result each time
    if len(rows) > RIM_SAMPLES:
        chosen = random.choice(len(rows), RIM_SAMPLES, replace=False)
        rows, columns = rows[chosen], columns[chosen]
    side = max(height, width)
    terms = _plane_terms(rows, columns, side)  # [n, 3]
    inverse_depth = visible[rows, columns]  # [n]

    planes = _fit_planes(terms, inverse_depth, random)
    all_rows, all_columns = np.indices((height, width))
    all_terms = _plane_terms(all_rows, all_columns, side)  # [H, W, 3]
    if not planes:  # no plane explains enough, as in a wood
        return np.full((height, width), np.median(inverse_depth))

    # In a corner of a room, each wall hides how the other would go on: of the planes, the nearest
    # is seen at each pixel. At an edge of a thing, its sides end at the edge: the farthest is seen.
    # So all choices of planes are tried both ways, and the one that explains the rim best is taken.
    # Each plane more must pay, or noise would be explained by planes.
    # Beyond its horizon, the inverse depth of a plane is negative: it counts as very far away.
    smallest = NOTHING * float(np.median(inverse_depth))
    best_error = math.inf
    best = np.empty(0)  # replaced in the first round, whose error is finite
    for count in range(1, len(planes) + 1):
        for some in itertools.combinations(planes, count):
            for nearest in (True, False):
                seen = _composite(terms, some, nearest).clip(smallest)
                errors = np.minimum(np.abs(np.log(seen / inverse_depth)), MAX_LOG_ERROR)
                error = float(errors.mean()) + PLANE_COST * count
                if error < best_error:
                    best_error = error
                    best = _composite(all_terms, some, nearest).clip(smallest)
    return best


def _plane_terms(rows: NDArray[np.int64], columns: NDArray[np.int64], side: int) -> Floats:
    """The terms x, y and 1 [..., 3] of a plane's inverse depth; `side` pixels are the unit."""
    return np.stack([columns / side, rows / side, np.ones(rows.shape)], axis=-1)


def _composite(terms: Floats, planes: tuple[Floats, ...], nearest: bool) -> Floats:
    """The inverse depth [...] of the nearest or else the farthest of several planes."""
    inverse_depths = [terms @ plane for plane in planes]
    combined = np.maximum if nearest else np.minimum
    result: Floats = combined.reduce(inverse_depths)
    return result


def _fit_planes(terms: Floats, inverse_depth: Floats, random: np.random.Generator) -> list[Floats]:
    """Coefficients [3] of planes, each of which explains a good part of some pixels (RANSAC).

    A plane's inverse depth is linear in the picture: the product of a pixel's terms and the plane's
    coefficients.

    Args:
        terms: [n, 3] of each pixel: x, y and 1.
        inverse_depth: [n] of the pixels.
        random: draws the pixels through which planes are tried.
    """
    planes: list[Floats] = []
    unexplained = np.ones(len(terms), np.bool_)
    while len(planes) < MAX_PLANES:
        left = np.flatnonzero(unexplained)
        if len(left) < max(3, MIN_PLANE_SHARE * len(terms)):
            break
        triples = random.choice(left, (TRIALS, 3))
        matrices = terms[triples]  # [TRIALS, 3, 3]
        is_proper = np.abs(np.linalg.det(matrices)) > 1e-9  # three pixels in a row give no plane
        if not is_proper.any():
            break
        candidates = np.linalg.solve(
            matrices[is_proper], inverse_depth[triples[is_proper]][..., None]
        )[..., 0]  # [m, 3]
        errors = np.abs(terms[left] @ candidates.T / inverse_depth[left, None] - 1)  # [left, m]
        counts = (errors < PLANE_TOLERANCE).sum(axis=0)
        best = int(counts.argmax())
        if counts[best] < max(3, MIN_PLANE_SHARE * len(terms)):
            break

        # The plane through three pixels carries their noise; that of all its pixels does not. The
        # weights make the errors relative, as above: terms · plane / inverse depth should be 1.
        on_plane = left[errors[:, best] < PLANE_TOLERANCE]
        weights = 1 / inverse_depth[on_plane]
        plane: Floats = np.linalg.lstsq(
            terms[on_plane] * weights[:, None], np.ones(len(on_plane)), rcond=None
        )[0].astype(np.float64)
        planes.append(plane)
        unexplained[on_plane] = False
    return planes
