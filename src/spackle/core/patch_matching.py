"""PatchMatch (Barnes et al. 2009, Wexler et al. 2007): fill a hole by patches of the picture, from coarse to fine.

The cost of the patch at q for a cell p of the hole, with colours I, log inverse depth z and blurred colours L, is

    mean |I(p + o) - I(q + o)|²  +  (0.15 dz / σz)²  +  2 |L(p) - L(q)|²  +  0.05 (|p - q| / size)²
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.core.filters import (
    distance_to_nearest,
    gaussian_blur,
    maximum_filter,
    nearest_known_pixels,
)
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel, reordering_kernel

PATCH_RADIUS = 3  # patches have 7×7 cells
PATCH_SIDE = 2 * PATCH_RADIUS + 1
COARSEST = 48  # least short side of a level, in cells
ROUNDS = 6  # number of searches and votes at each level
NEIGHBOR_STEPS = (4, 1)  # distances, in cells, to the neighbours whose matches a search tries
TONE_BLUR_CELLS = 4.0  # standard deviation, in cells, of the blur that makes the tone L
FADING = 0.8  # a cell's weight in a patch is 0.8^d at a depth of d cells in the hole
FAINTEST_CELL = np.float32(1e-30)  # least weight of a cell
DEPTH_WEIGHT, TONE_WEIGHT, OFFSET_WEIGHT = 0.15, math.sqrt(2), 0.05
LEAST_SPREAD = 0.05  # least σz; the depth of a wall that faces the camera hardly varies
SAME_SURFACE = 0.25  # greatest difference in z / σz between a cell and its mirror image
MIN_VOTE_WEIGHT, MIN_MEAN_COST = 1e-6, 1e-8

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int32]
# The best patches for the n cells of a hole: numbers of the cells [h, w], -1 outside of the hole; source, row and
# column of each patch's centre [n, 3]; costs [n].
Matches = tuple[Ints, Ints, Floats]


@dataclasses.dataclass(frozen=True)
class Patches:
    """A picture whose hole is filled by patches of its known part."""

    rgb: Tensor  # [H, W, 3] sRGB; unchanged outside of the hole
    mismatch: Tensor  # [H, W] root of the cost of each cell's patch; 0 outside of the hole
    matches: Tensor  # [H, W, 3] picture (1: mirrored), row and column of each cell's patch; -1 outside of the hole


def match_patches(guess: Tensor, hole: Tensor, inverse_depth: Tensor) -> Patches:
    """Fill a hole by patches of the known part.

    Args:
        guess: [H, W, 3] sRGB, with smooth colours in the hole.
        hole: [H, W] bool.
        inverse_depth: [H, W], positive everywhere.
    """
    levels = _pyramid(guess.detach().float(), hole, inverse_depth.detach().float())
    matches = None
    for number in reversed(range(len(levels))):
        matches = _match(levels[number], matches, number)
    mismatch, places = np.zeros(hole.shape, np.float32), np.full((*hole.shape, 3), -1, np.int32)
    if matches is not None:
        _, places[levels[0].hole], costs = matches
        mismatch[levels[0].hole] = np.sqrt(costs)
    return Patches(*(torch.from_numpy(grid) for grid in (levels[0].rgb, mismatch, places)))


@dataclasses.dataclass(frozen=True)
class _Level:
    """One level of the pyramid, h × w cells."""

    rgb: Floats  # [h, w, 3]; votes change the hole's cells in place
    traits: Floats  # [h, w, 4] tone and depth, scaled so that squared differences are costs
    hole: Bools  # [h, w]
    weights: Floats  # [h + 6, w + 6] weights of cells in a patch; 0 beyond the picture


def _pyramid(guess: Tensor, hole: Tensor, inverse_depth: Tensor) -> list[_Level]:
    """Build the pyramid, finest level first."""
    depth = inverse_depth.clamp_min(1e-9).log()[..., None]
    depth = depth / max(
        float(depth[~hole].std(correction=0)) if bool((~hole).any()) else 0.0, LEAST_SPREAD
    )
    rgb, tone, levels = guess.clone(memory_format=torch.contiguous_format), guess, list[_Level]()
    _mirror(rgb.numpy(), hole.numpy(), depth[..., 0].numpy(), nearest_known_pixels(hole.numpy()))
    while True:
        traits = [
            TONE_WEIGHT * gaussian_blur(tone, max(TONE_BLUR_CELLS / 2 ** len(levels), 0.5)),
            DEPTH_WEIGHT * depth,
        ]
        weights = np.zeros([size + 2 * PATCH_RADIUS for size in hole.shape], np.float32)
        inside = distance_to_nearest(nearest_known_pixels(hole.numpy())).numpy()
        weights[PATCH_RADIUS:-PATCH_RADIUS, PATCH_RADIUS:-PATCH_RADIUS] = np.maximum(
            np.float32(FADING) ** inside, FAINTEST_CELL
        )
        picture, marks = (image.contiguous().numpy() for image in (rgb, torch.cat(traits, dim=-1)))
        levels.append(_Level(picture, marks, hole.numpy(), weights))
        coarse_hole = avg_pool2d(hole[None].float(), 2, ceil_mode=True)[0] > 0
        if min(hole.shape) < 2 * COARSEST or bool(coarse_hole.all()) or not bool(hole.any()):
            return levels
        planes = (image.permute(2, 0, 1) for image in (rgb, tone, depth))
        means = (avg_pool2d(plane, 2, ceil_mode=True, count_include_pad=False) for plane in planes)
        rgb, tone, depth = (mean.permute(1, 2, 0) for mean in means)
        hole = coarse_hole


@kernel
def _mirror(rgb: Any, hole: Any, depth: Any, near: Any) -> None:
    """Fill each hole cell, in place, with its mirror image about the nearest known cell, if both depths are similar."""
    height, width = hole.shape
    for y in range(height):
        for x in range(width):
            if hole[y, x]:
                v, u = 2 * near[0, y, x] - y, 2 * near[1, y, x] - x
                inside = 0 <= v < height and 0 <= u < width
                if inside and not hole[v, u] and abs(depth[v, u] - depth[y, x]) < SAME_SURFACE:
                    rgb[y, x] = rgb[v, u]


def _match(level: _Level, coarse: Matches | None, number: int) -> Matches | None:
    """Alternate search and vote at a level; None without a hole, or without any patch."""
    usable = ~maximum_filter(torch.from_numpy(level.hole), PATCH_RADIUS).numpy()
    usable[:PATCH_RADIUS] = usable[-PATCH_RADIUS:] = False
    usable[:, :PATCH_RADIUS] = usable[:, -PATCH_RADIUS:] = False
    if not usable.any() or not level.hole.any():
        return None
    height, width = level.hole.shape
    cells, pool = (np.argwhere(mask).astype(np.int32) for mask in (level.hole, usable))
    numbers = np.full((height, width), -1, np.int32)
    numbers[level.hole] = np.arange(len(cells))
    grids = (level.rgb, level.traits, usable)
    sources, traits, valid = (
        np.ascontiguousarray(np.stack([grid, grid[:, ::-1]])) for grid in grids
    )
    places, costs = np.empty((len(cells), 3), np.int32), np.zeros(len(cells), np.float32)
    parents = coarse or (numbers, places, costs)
    _begin(cells, coarse is not None, *parents[:2], valid, pool, places)
    padded = np.pad(level.rgb, ((PATCH_RADIUS, PATCH_RADIUS), (PATCH_RADIUS, PATCH_RADIUS), (0, 0)))
    target = (
        padded,
        level.weights,
        level.traits,
        sources,
        traits,
        np.float32(OFFSET_WEIGHT / max(height, width) ** 2),
    )

    def run(function: Callable[..., None], *given: Any) -> None:
        parallel_for_chunks(lambda start, stop: function(start, stop, cells, *given), len(cells))

    def vote(mean: float) -> None:
        run(_vote, numbers, places, costs, np.float32(max(mean, MIN_MEAN_COST)), sources, level.rgb)
        padded[PATCH_RADIUS:-PATCH_RADIUS, PATCH_RADIUS:-PATCH_RADIUS] = level.rgb

    if coarse is not None:
        vote(1.0)  # all costs are still zero
    for turn in range(ROUNDS):
        run(_score, places, *target, costs)
        for jump in NEIGHBOR_STEPS:
            seed = np.uint32(((number * ROUNDS + turn) * len(NEIGHBOR_STEPS) + jump) * 7919)
            run(
                _search,
                numbers,
                places.copy(),
                costs.copy(),
                valid,
                pool,
                jump,
                seed,
                *target,
                places,
                costs,
            )
        vote(float(costs.mean()))
    return numbers, places, costs


@kernel
def _begin(
    cells: Any, refine: bool, coarse_numbers: Any, coarse: Any, valid: Any, pool: Any, places: Any
) -> None:
    """Initialise matches by the coarser level's matches, or at random."""
    rows, columns = coarse_numbers.shape
    height, width = valid.shape[1:]
    for n in range(len(cells)):
        y, x = cells[n]
        pick = pool[_hash(np.uint32(n)) % np.uint32(len(pool))]
        places[n, 0], places[n, 1], places[n, 2] = 0, pick[0], pick[1]
        k = coarse_numbers[min(y // 2, rows - 1), min(x // 2, columns - 1)] if refine else -1
        if k >= 0:
            # Columns of a mirrored picture count from the right.
            m, side = coarse[k, 0], width - 2 * columns if coarse[k, 0] else 0
            row, column = 2 * coarse[k, 1] + y % 2, 2 * coarse[k, 2] + x % 2 + side
            if 0 <= row < height and 0 <= column < width and valid[m, row, column]:
                places[n, 0], places[n, 1], places[n, 2] = m, row, column


@kernel
def _hash(value: Any) -> Any:
    value = np.uint32(value)
    value ^= value >> np.uint32(16)
    value = np.uint32(value * np.uint32(0x7FEB352D))
    value ^= value >> np.uint32(15)
    value = np.uint32(value * np.uint32(0x846CA68B))
    value ^= value >> np.uint32(16)
    return value


@reordering_kernel
def _patch_cost(
    padded: Any, weights: Any, source: Any, y: int, x: int, v: int, u: int, bound: Any
) -> Any:
    """Weighted mean of the squared differences of two patches; infinite if the mean exceeds the bound."""
    total, mass = np.float32(0), np.float32(0)
    for j in range(PATCH_SIDE):
        for i in range(PATCH_SIDE):
            mass += weights[y + j, x + i]
    limit = bound * mass
    for j in range(PATCH_SIDE):
        for i in range(PATCH_SIDE):
            red = padded[y + j, x + i, 0] - source[v + j - PATCH_RADIUS, u + i - PATCH_RADIUS, 0]
            green = padded[y + j, x + i, 1] - source[v + j - PATCH_RADIUS, u + i - PATCH_RADIUS, 1]
            blue = padded[y + j, x + i, 2] - source[v + j - PATCH_RADIUS, u + i - PATCH_RADIUS, 2]
            total += weights[y + j, x + i] * (red * red + green * green + blue * blue)
        if total > limit:
            return np.float32(np.inf)
    return total / mass


@kernel
def _cost(
    padded: Any, weights: Any, own: Any, sources: Any, traits: Any, offset: Any,
    y: int, x: int, m: int, v: int, u: int, bound: Any,
) -> Any:  # fmt: skip
    """The cost of source m's patch at (v, u) for the cell (y, x); infinite beyond the bound."""
    cost = np.float32(0)
    for c in range(own.shape[2]):
        apart = own[y, x, c] - traits[m, v, u, c]
        cost += apart * apart
    across = x - (own.shape[1] - 1 - u if m else u)
    cost += offset * np.float32((y - v) * (y - v) + across * across)
    if cost >= bound:
        return np.float32(np.inf)
    return cost + _patch_cost(padded, weights, sources[m], y, x, v, u, bound - cost)


@kernel
def _score(
    start: int, stop: int, cells: Any, places: Any,
    padded: Any, weights: Any, own: Any, sources: Any, traits: Any, offset: Any, costs: Any,
) -> None:  # fmt: skip
    for n in range(start, stop):
        y, x = cells[n]
        m, v, u = places[n]
        costs[n] = _cost(
            padded, weights, own, sources, traits, offset, y, x, m, v, u, np.float32(1e30)
        )


@kernel
def _search(
    start: int, stop: int, cells: Any, numbers: Any, before: Any, worth: Any, valid: Any, pool: Any, jump: int,
    seed: Any, padded: Any, weights: Any, own: Any, sources: Any, traits: Any, offset: Any, places: Any, costs: Any,
) -> None:  # fmt: skip
    """Improve the matches of cells start..stop: try neighbours' matches, a random patch, and patches near the best."""
    mirrors, height, width = valid.shape
    for n in range(start, stop):
        y, x = cells[n]
        best, bm, bv, bu = (
            worth[n],
            np.int64(before[n, 0]),
            np.int64(before[n, 1]),
            np.int64(before[n, 2]),
        )
        for turn in range(4):
            dy = jump if turn == 0 else -jump if turn == 1 else 0
            dx = jump if turn == 2 else -jump if turn == 3 else 0
            if not (0 <= y + dy < height and 0 <= x + dx < width):
                continue
            k = numbers[y + dy, x + dx]
            if k < 0:
                continue
            m, v, u = (
                np.int64(before[k, 0]),
                np.int64(before[k, 1]) - dy,
                np.int64(before[k, 2]) - dx,
            )
            if 0 <= v < height and 0 <= u < width and valid[m, v, u]:
                cost = _cost(padded, weights, own, sources, traits, offset, y, x, m, v, u, best)
                if cost < best:
                    best, bm, bv, bu = cost, m, v, u
        chance = _hash(np.uint32(n) * np.uint32(9781) + seed)
        pick = pool[chance % np.uint32(len(pool))]
        chance = _hash(chance)
        m = np.int64(chance % np.uint32(mirrors))
        v, u = np.int64(pick[0]), np.int64(width - 1 - pick[1] if m else pick[1])
        cost = _cost(padded, weights, own, sources, traits, offset, y, x, m, v, u, best)
        if cost < best:
            best, bm, bv, bu = cost, m, v, u
        reach = max(height, width) // 4
        while reach >= 1:
            chance = _hash(chance)
            span = np.uint32(2 * reach + 1)
            v = bv + np.int64(chance % span) - reach
            u = bu + np.int64((chance >> np.uint32(12)) % span) - reach
            if 0 <= v < height and 0 <= u < width and valid[bm, v, u]:
                cost = _cost(padded, weights, own, sources, traits, offset, y, x, bm, v, u, best)
                if cost < best:
                    best, bv, bu = cost, v, u
            reach //= 4
        costs[n] = best
        places[n, 0], places[n, 1], places[n, 2] = bm, bv, bu


@kernel
def _vote(
    start: int,
    stop: int,
    cells: Any,
    numbers: Any,
    places: Any,
    costs: Any,
    mean: Any,
    sources: Any,
    rgb: Any,
) -> None:
    """Set the colours of cells start..stop to weighted means of all patches that cover the cells."""
    height, width = numbers.shape
    for n in range(start, stop):
        y, x = cells[n]
        red, green, blue, mass = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for dy in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            for dx in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
                if not (0 <= y + dy < height and 0 <= x + dx < width):
                    continue
                k = numbers[y + dy, x + dx]
                if k < 0:
                    continue
                m, v, u = places[k, 0], places[k, 1] - dy, places[k, 2] - dx
                weight = np.float32(np.exp(-costs[k] / mean)) + np.float32(MIN_VOTE_WEIGHT)
                red += weight * sources[m, v, u, 0]
                green += weight * sources[m, v, u, 1]
                blue += weight * sources[m, v, u, 2]
                mass += weight
        rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2] = red / mass, green / mass, blue / mass
