"""PatchMatch (Barnes et al. 2009, Wexler et al. 2007): fill a hole by patches of the picture.

It works from coarse to fine. The cost of the patch at q for a pixel p of the hole, with colours I,
log inverse depth z and blurred colours L, is

    mean |I(p + o) - I(q + o)|²  +  (0.15 dz / σz)²  +  2 |L(p) - L(q)|²  +  0.05 (|p - q| / size)²

`match_patches` is the entry; `_LevelSearch` finds the patches at one resolution, by the kernels of
`patch_search.py`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from spackle.core.filters import (
    distance_to_nearest,
    gaussian_blur,
    maximum_filter,
    nearest_known_pixels,
)
from spackle.core.patch_search import (
    PATCH_RADIUS,
    CostInputs,
    improve_match,
    score_match,
    start_match,
    vote_color,
)
from spackle.runtime.parallel_kernels import kernel_for_pixels

MIN_COARSEST_SIDE_PX = 48  # short side of the coarsest level; patches need room around the hole
SEARCH_ROUNDS = 6  # number of searches and votes at each level
NEIGHBOR_STEPS = (4, 1)  # distances, in pixels, to the neighbours whose matches a search tries
SEED_STEP = 7919  # a prime, by which the random numbers of searches differ

# The tone L of a pixel is its blurred colour.
TONE_BLUR_CELLS = 4.0  # standard deviation, in pixels of the finest level, of that blur
MIN_TONE_BLUR_PX = 0.5  # least standard deviation at the coarse levels
DEPTH_WEIGHT = 0.15
TONE_WEIGHT = math.sqrt(2)
DISTANCE_WEIGHT = 0.05
MIN_DEPTH_SPREAD = 0.05  # least σz; the depth of a wall that faces the camera hardly varies

FADING_PER_PX = 0.8  # a pixel's weight in a patch is 0.8^d at a depth of d pixels in the hole
MIN_PIXEL_WEIGHT = 1e-30  # a patch deep in a hole still has a mean
SAME_SURFACE_DEPTH = 0.25  # greatest difference in z / σz between a pixel and its mirror image
MIN_MEAN_COST = 1e-8  # votes divide by the mean cost


@dataclasses.dataclass(frozen=True)
class Patches:
    """A picture whose hole is filled by patches of its known part."""

    rgb: Tensor  # [H, W, 3] sRGB; unchanged outside of the hole
    mismatch: Tensor  # [H, W] root of the cost of each pixel's patch; 0 outside of the hole
    # [H, W, 3] source (1: the mirrored picture), row and column of the centre of each pixel's
    # patch; −1 outside of the hole
    matches: Tensor


def match_patches(guess: Tensor, hole: Tensor, inverse_depth: Tensor) -> Patches:
    """Fill a hole in a picture with colours of small square patches from its known part.

    Args:
        guess: [H, W, 3] sRGB, with smooth colours in the hole.
        hole: [H, W] bool, true at the pixels to fill.
        inverse_depth: [H, W], positive everywhere; patches come from a similar depth.

    Returns:
        The filled picture, the patch that each hole pixel matches best, and how badly it matches.
    """
    levels = _build_pyramid(guess.detach().float(), hole, inverse_depth.detach().float())
    matches = None
    # The coarsest level comes first, because each level starts from the matches of the coarser one.
    for number in reversed(range(len(levels))):
        matches = _match_level(levels[number], matches, level_number=number)

    finest = levels[0]
    # Outside of the hole, a pixel has no patch: −1 marks this. There is no match at all if the
    # picture has no hole, or no patch without a hole pixel.
    mismatch = finest.rgb.new_zeros(hole.shape)
    positions = finest.rgb.new_full((*hole.shape, 3), -1, dtype=torch.int32)
    if matches is not None:
        positions[finest.hole] = matches.positions
        mismatch[finest.hole] = matches.costs.sqrt()
    return Patches(rgb=finest.rgb, mismatch=mismatch, matches=positions)


@dataclasses.dataclass(frozen=True)
class _Level:
    """One level of the pyramid, h × w pixels."""

    rgb: Tensor  # [h, w, 3] float32; votes change the hole's pixels in place
    traits: Tensor  # [h, w, 4] tone and depth, scaled so that squared differences are costs
    hole: Tensor  # [h, w] bool
    weights: Tensor  # [h + 6, w + 6] weights of pixels in a patch; 0 beyond the picture


def _build_pyramid(guess: Tensor, hole: Tensor, inverse_depth: Tensor) -> list[_Level]:
    """Halve the picture again and again; returns all sizes, the finest level first.

    The coarsest level is the last one on which patches still have room around the hole.

    Args:
        guess: [H, W, 3] float32 sRGB.
        hole: [H, W] bool.
        inverse_depth: [H, W] float32.
    """
    depth = _relative_log_depth(inverse_depth, hole)  # [H, W, 1]
    tone = guess  # is blurred at each level; unlike `rgb`, it keeps the smooth colours in the hole
    rgb = guess.clone(memory_format=torch.contiguous_format)
    hole = hole.contiguous()
    nearest = nearest_known_pixels(hole)
    _mirror_into_hole(hole.shape, rgb, hole, depth[..., 0].contiguous(), nearest)

    levels: list[_Level] = []
    while True:
        # The blur is given in pixels of the finest level. At half the resolution, half as many
        # pixels are the same blur in the scene.
        tone_blur = max(TONE_BLUR_CELLS / 2 ** len(levels), MIN_TONE_BLUR_PX)
        # Two patches are compared not only by their pixels, but also by the tone and depth of their
        # centres. These traits are scaled so that their squared differences are costs.
        traits = [TONE_WEIGHT * gaussian_blur(tone, tone_blur), DEPTH_WEIGHT * depth]
        level = _Level(
            rgb=rgb.contiguous(),
            traits=torch.cat(traits, dim=-1).contiguous(),
            hole=hole,
            weights=_pixel_weights(hole),
        )
        levels.append(level)

        # A reduced pixel belongs to the hole if any of its four pixels does.
        coarse_hole = avg_pool2d(hole[None].float(), 2, ceil_mode=True)[0] > 0
        is_small = min(hole.shape) < 2 * MIN_COARSEST_SIDE_PX  # half of it would be too small
        # A level that is all hole would have no patches, and without a hole none are needed.
        if is_small or bool(coarse_hole.all()) or not bool(hole.any()):
            return levels
        rgb = _reduce_by_half(rgb)
        tone = _reduce_by_half(tone)
        depth = _reduce_by_half(depth)
        hole = coarse_hole


def _relative_log_depth(inverse_depth: Tensor, hole: Tensor) -> Tensor:
    """log inverse depth [H, W, 1] in units of its standard deviation at the known pixels."""
    log_depth = inverse_depth.clamp_min(1e-9).log()[..., None]  # clamped: log 0 is infinite
    spread = 0.0
    if bool((~hole).any()):
        spread = float(log_depth[~hole].std(correction=0))
    return log_depth / max(spread, MIN_DEPTH_SPREAD)


def _pixel_weights(hole: Tensor) -> Tensor:
    """Weights [h + 6, w + 6] of a picture's pixels [h, w] when two patches are compared.

    Known pixels have the weight 1. The guess deep in a hole is unreliable, so it counts less:
    0.8^d for a pixel that is d pixels away from the nearest known one. The picture is padded with
    three pixels of weight 0 at each side, because a patch of 7×7 pixels may reach beyond it.
    """
    distance = distance_to_nearest(nearest_known_pixels(hole))
    # Above zero, because a mean over a patch deep in the hole divides by the sum of the weights.
    weights = (FADING_PER_PX**distance).clamp_min(MIN_PIXEL_WEIGHT)
    return pad(weights, (PATCH_RADIUS,) * 4)


def _reduce_by_half(image: Tensor) -> Tensor:
    """Means of 2×2 pixels of an image [h, w, C], as [⌈h/2⌉, ⌈w/2⌉, C].

    The last row or column of an odd number has means of the fewer pixels that are there.
    """
    planes = image.permute(2, 0, 1)
    means = avg_pool2d(planes, 2, ceil_mode=True, count_include_pad=False)
    return means.permute(1, 2, 0)


@kernel_for_pixels
def _mirror_into_hole(y: int, x: int, rgb: Any, hole: Any, depth: Any, nearest: Any) -> None:
    """Fill a hole pixel, in place, with its mirror image about the nearest known pixel.

    A mirrored texture is a better start of the search than a smooth guess. A hole pixel keeps its
    colour if its mirror image is unknown or lies on another surface.

    Args:
        y, x: the pixel.
        rgb: [h, w, 3] changed in the hole.
        hole: [h, w] bool.
        depth: [h, w] log inverse depth in units of its standard deviation.
        nearest: [2, h, w] row and column of the nearest known pixel.
    """
    if not hole[y, x]:
        return
    height, width = hole.shape
    # (v, u) is the mirror image: the nearest known pixel lies halfway to it.
    v = 2 * nearest[0, y, x] - y
    u = 2 * nearest[1, y, x] - x
    is_inside = 0 <= v < height and 0 <= u < width
    if is_inside and not hole[v, u] and abs(depth[v, u] - depth[y, x]) < SAME_SURFACE_DEPTH:
        for channel in range(3):
            rgb[y, x, channel] = rgb[v, u, channel]


@dataclasses.dataclass(frozen=True)
class _Matches:
    """The best patches for the n pixels of a level's hole."""

    numbers: Tensor  # [h, w] int32, the number of each hole pixel; −1 outside of the hole
    positions: Tensor  # [n, 3] int32, source, row and column of the centre of each pixel's patch
    costs: Tensor  # [n]


def _match_level(level: _Level, coarse: _Matches | None, level_number: int) -> _Matches | None:
    """Find the patch that matches each hole pixel of a level best, and colour the hole by them.

    A search for better patches alternates with a vote, which sets the hole's colours to the means
    of the patches that cover them.

    Args:
        level: its colours in the hole are changed in place.
        coarse: the matches of the level of half the size; None makes a random start.
        level_number: 0 is the finest; it makes the random numbers of the levels differ.

    Returns:
        The matches; None if the level has no hole, or no patch that is known as a whole.
    """
    is_usable = _usable_patches(level.hole)
    if not bool(is_usable.any()) or not bool(level.hole.any()):
        return None
    search = _LevelSearch(level, is_usable)
    search.start_from(coarse)
    if coarse is not None:
        search.vote(mean_cost=1.0)  # all costs are still zero, so every patch has the same weight
    for search_round in range(SEARCH_ROUNDS):
        search.score()
        for step in NEIGHBOR_STEPS:
            # No other search gets the same number: from round to round it grows by two, and of the
            # two steps, one is even and one is odd.
            round_number = level_number * SEARCH_ROUNDS + search_round
            search_number = round_number * len(NEIGHBOR_STEPS) + step
            search.improve(step, seed=np.uint32(search_number * SEED_STEP))
        search.vote(mean_cost=float(search.matches.costs.mean()))
    return search.matches


def _usable_patches(hole: Tensor) -> Tensor:
    """Whether a patch around each pixel [h, w] lies inside the picture and has no hole pixel."""
    # A patch has a hole pixel if there is one within its radius around the centre.
    is_usable = ~maximum_filter(hole, PATCH_RADIUS)
    # Nor may a patch reach beyond the picture's border.
    is_usable[:PATCH_RADIUS] = False
    is_usable[-PATCH_RADIUS:] = False
    is_usable[:, :PATCH_RADIUS] = False
    is_usable[:, -PATCH_RADIUS:] = False
    return is_usable


class _LevelSearch:
    """The search for patches at one level of the pyramid."""

    def __init__(self, level: _Level, is_usable: Tensor) -> None:
        """Number the hole's pixels and build the images that the kernels read.

        Args:
            level: the picture with its hole; `vote` changes the hole's colours in place.
            is_usable: [h, w] whether the patch around each pixel is usable.
        """
        height, width = level.hole.shape
        self._rgb = level.rgb
        self._hole_pixels = level.hole.nonzero().int()  # [n, 2] rows, columns
        self._usable_centers = is_usable.nonzero().int()  # [k, 2]
        self._is_usable = _with_mirror_image(is_usable)
        self._inputs = CostInputs(
            # Zeros around the picture let a patch at its border reach beyond it.
            padded_rgb=pad(level.rgb, (0, 0, *(PATCH_RADIUS,) * 4)),
            weights=level.weights,
            traits=level.traits,
            source_rgb=_with_mirror_image(level.rgb),
            source_traits=_with_mirror_image(level.traits),
            # Distances are measured in units of the picture's long side, and weighted as squares.
            distance_weight=np.float32(DISTANCE_WEIGHT / max(height, width) ** 2),
        )

        # Matches and costs are kept for the hole's pixels only, in the order of these numbers.
        count = len(self._hole_pixels)
        numbers = self._hole_pixels.new_full((height, width), -1)
        numbers[level.hole] = torch.arange(count, dtype=torch.int32, device=numbers.device)
        self.matches = _Matches(numbers, numbers.new_empty(count, 3), level.rgb.new_zeros(count))

    def start_from(self, coarse: _Matches | None) -> None:
        """Take the first matches from the coarser level; at random if `coarse` is None."""
        # Without a coarser level, the kernel reads nothing of one, but its arguments must be
        # arrays; this level's own stand in.
        parents = self.matches if coarse is None else coarse
        start_match(
            len(self._hole_pixels),
            self._hole_pixels,
            coarse is not None,  # has_coarse
            parents.numbers,
            parents.positions,
            self._is_usable,
            self._usable_centers,
            self.matches.positions,
        )

    def score(self) -> None:
        """Compute anew how badly each hole pixel's patch matches (its cost).

        `vote` has changed the colours of the hole, with which patches are compared.
        """
        score_match(
            len(self._hole_pixels),
            self._hole_pixels,
            self.matches.positions,
            self._inputs,
            self.matches.costs,
        )

    def improve(self, step: int, seed: np.uint32) -> None:
        """Search better patches for all hole pixels, and keep the best one of each.

        Args:
            step: the matches of the neighbours that are this many pixels away are tried, too.
            seed: makes the random candidates of this search differ from those of other searches.
        """
        # All pixels read the old matches of their neighbours, in copies that nobody changes, so the
        # result does not depend on the order in which pixels are done.
        old_positions = self.matches.positions.clone()
        old_costs = self.matches.costs.clone()
        improve_match(
            len(self._hole_pixels),
            self._hole_pixels,
            self.matches.numbers,
            old_positions,
            old_costs,
            self._is_usable,
            self._usable_centers,
            step,
            seed,
            self._inputs,
            self.matches.positions,
            self.matches.costs,
        )

    def vote(self, mean_cost: float) -> None:
        """Give the hole's pixels the mean colours of the patches that cover them.

        A patch weighs exp(−cost / mean_cost), so one that costs much more than the mean weighs
        little.
        """
        vote_color(
            len(self._hole_pixels),
            self._hole_pixels,
            self.matches.numbers,  # of the hole's pixels
            self.matches.positions,
            self.matches.costs,
            np.float32(max(mean_cost, MIN_MEAN_COST)),
            self._inputs.source_rgb,
            self._rgb,
        )
        # The next search compares patches of the padded copy, which must have the new colours.
        inner = slice(PATCH_RADIUS, -PATCH_RADIUS)
        self._inputs.padded_rgb[inner, inner] = self._rgb


def _with_mirror_image(image: Tensor) -> Tensor:
    """A copy [2, h, w, ...] of an image [h, w, ...] and of the image mirrored left to right."""
    return torch.stack([image, image.flip(1)])
