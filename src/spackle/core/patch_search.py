"""Kernels of patch matching: the cost of a patch, the search for better patches, and the vote.

A patch is a square of 7×7 pixels. There are two *sources* of patches: the picture (0), and the
picture mirrored from left to right (1). The *match* of a pixel of the hole is the source, row and
column of the centre of a patch. A patch is *usable* if all its pixels are known.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from spackle.runtime.kernels import kernel, reordering_kernel
from spackle.runtime.parallel_kernels import kernel_for_items

PATCH_RADIUS = 3
PATCH_SIDE = 2 * PATCH_RADIUS + 1  # patches have 7×7 pixels
MIN_VOTE_WEIGHT = 1e-6  # of a bad match, so that the weights of a pixel never add up to 0
LARGE_COST = np.float32(1e30)  # larger than the cost of any patch

# Multipliers of a good mixer of 32 bits (lowbias32, by Chris Wellons).
HASH_MULTIPLIER_1 = np.uint32(0x7FEB352D)
HASH_MULTIPLIER_2 = np.uint32(0x846CA68B)
PIXEL_SEED_STEP = np.uint32(9781)  # a prime, by which the random numbers of pixels differ

# Rows and columns to the four neighbours of a pixel: below, above, right, left.
NEIGHBOR_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1))


class CostInputs(NamedTuple):
    """The images on which the cost of a patch depends; [h, w] is the size of the picture."""

    padded_rgb: Tensor  # [h + 6, w + 6, 3] the picture with three zeros at each side
    weights: Tensor  # [h + 6, w + 6] of pixels in a patch; 0 beyond the picture
    traits: Tensor  # [h, w, 4] tone and depth, scaled: squared differences are costs
    source_rgb: Tensor  # [2, h, w, 3] the picture and its mirror image
    source_traits: Tensor  # [2, h, w, 4] the traits and their mirror image
    distance_weight: np.float32  # cost of a squared pixel between a hole pixel and its patch


@kernel
def hash_uint32(value: Any) -> Any:
    """A uint32 that looks random, but depends on the given number alone."""
    # Each shift mixes high bits into the low ones, each multiplication low bits into the high ones.
    value = np.uint32(value)
    value ^= value >> np.uint32(16)
    value = np.uint32(value * HASH_MULTIPLIER_1)
    value ^= value >> np.uint32(15)
    value = np.uint32(value * HASH_MULTIPLIER_2)
    value ^= value >> np.uint32(16)
    return value


@reordering_kernel
def _color_cost(
    padded_rgb: Any, weights: Any, source_rgb: Any, y: int, x: int, v: int, u: int, limit: Any
) -> Any:
    """Weighted mean of the squared colour differences of two patches of 7×7 pixels.

    One patch lies around (y, x) in the picture, and may have hole pixels. The other one lies around
    (v, u) in a source of patches, and is known as a whole.

    Args:
        padded_rgb: [h + 6, w + 6, 3] the picture with three zeros at each side, because the patch
            around (y, x) may reach beyond the picture.
        weights: [h + 6, w + 6] weights of the pixels of `padded_rgb`; 0 beyond the picture.
        source_rgb: [h, w, 3] the picture or its mirror image.
        y: row of the hole's pixel in the picture without padding.
        x: column of the hole's pixel in the picture without padding.
        v: row of the other patch's centre.
        u: column of the other patch's centre.
        limit: a patch with a larger mean is not wanted, so the sum stops early, and the result is
            infinity.
    """
    weight_sum = np.float32(0)
    for j in range(PATCH_SIDE):
        for i in range(PATCH_SIDE):
            weight_sum += weights[y + j, x + i]
    max_total = limit * weight_sum

    total = np.float32(0)
    for j in range(PATCH_SIDE):
        for i in range(PATCH_SIDE):
            # The padding is as wide as the patch's radius, so the patch around (y, x) begins at
            # (y, x) in the padded picture.
            row, column = v + j - PATCH_RADIUS, u + i - PATCH_RADIUS
            red = padded_rgb[y + j, x + i, 0] - source_rgb[row, column, 0]
            green = padded_rgb[y + j, x + i, 1] - source_rgb[row, column, 1]
            blue = padded_rgb[y + j, x + i, 2] - source_rgb[row, column, 2]
            total += weights[y + j, x + i] * (red * red + green * green + blue * blue)
        # Once a row, because a test for each pixel would cost more than it saves.
        if total > max_total:
            return np.float32(np.inf)
    return total / weight_sum


@kernel
def patch_cost(inputs: Any, y: int, x: int, source: int, v: int, u: int, limit: Any) -> Any:
    """The cost, float32, of the patch around (v, u) for the hole pixel (y, x).

    It is the sum of three terms: the squared differences of tone (blurred colour) and depth at both
    centres, the weighted squared distance of the centres in the picture, and the mean squared
    difference of the colours in the 7×7 pixels around them.

    Args:
        inputs: the images, `CostInputs`.
        y: row of the hole's pixel.
        x: column of the hole's pixel.
        source: 0 for the picture, 1 for its mirror image.
        v: row of the patch's centre in the source.
        u: column of the patch's centre in the source.
        limit: a patch with a larger cost is not wanted, so the computation stops early, and the
            result is infinity.
    """
    # Traits are tone and depth, scaled so that squared differences are costs.
    traits, source_traits = inputs.traits, inputs.source_traits
    cost = np.float32(0)
    for c in range(traits.shape[2]):
        difference = traits[y, x, c] - source_traits[source, v, u, c]
        cost += difference * difference

    # The distance is measured in the picture. A patch of the mirror image is turned back for it.
    last_column = traits.shape[1] - 1
    rows_apart = y - v
    columns_apart = x - (last_column - u if source else u)
    distance2 = np.float32(rows_apart * rows_apart + columns_apart * columns_apart)
    cost += inputs.distance_weight * distance2
    # The colours take most of the time, and are needed only if the rest is cheap enough.
    if cost >= limit:
        return np.float32(np.inf)
    return cost + _color_cost(
        inputs.padded_rgb, inputs.weights, inputs.source_rgb[source], y, x, v, u, limit - cost
    )


@kernel_for_items
def score_match(n: int, hole_pixels: Any, matches: Any, inputs: Any, costs: Any) -> None:
    """Compute the cost of the match of a hole pixel.

    Args:
        n: number of the hole pixel.
        hole_pixels: [holes, 2] rows and columns.
        matches: [holes, 3] source, row and column of each pixel's patch.
        inputs: the images, `CostInputs`.
        costs: [holes] written.
    """
    y, x = hole_pixels[n]
    source, v, u = matches[n]
    # No patch costs as much as this limit, so every cost is computed to its end.
    costs[n] = patch_cost(inputs, y, x, source, v, u, LARGE_COST)


@kernel_for_items
def start_match(
    n: int, hole_pixels: Any, has_coarse: bool, coarse_numbers: Any, coarse_matches: Any,
    is_usable: Any, usable_centers: Any, matches: Any,
) -> None:  # fmt: skip
    """Take the first match of a hole pixel from the level of half the size, or at random.

    A match is the source of a patch (0 for the picture, 1 for its mirror image), and the row and
    column of the patch's centre in the source.

    Args:
        hole_pixels: [holes, 2] rows and columns.
        has_coarse: whether there is a coarser level; else all matches are random.
        coarse_numbers: [⌈h/2⌉, ⌈w/2⌉] numbers of the coarser level's hole pixels; −1 elsewhere.
        coarse_matches: [m, 3] the coarser level's matches, by these numbers.
        is_usable: [2, h, w] whether the patch around a pixel of each source has no hole pixel.
        usable_centers: [k, 2] rows and columns of the picture's patches without hole pixels.
        matches: [holes, 3] written.
    """
    coarse_height, coarse_width = coarse_numbers.shape
    height, width = is_usable.shape[1:]
    y, x = hole_pixels[n]
    # A random patch of the picture stays where the coarser level has no match that fits.
    center = usable_centers[hash_uint32(np.uint32(n)) % np.uint32(len(usable_centers))]
    matches[n, 0], matches[n, 1], matches[n, 2] = 0, center[0], center[1]
    if not has_coarse:
        return

    k = coarse_numbers[min(y // 2, coarse_height - 1), min(x // 2, coarse_width - 1)]
    if k < 0:
        return
    source = coarse_matches[k, 0]
    # Halving an odd width rounds up, as if the picture had one more column at its right. In the
    # mirror image, that column comes first, so that doubled columns are one too large there:
    # `shift` is -1 for an odd width, and 0 for an even one.
    shift = width - 2 * coarse_width if source else 0
    row = 2 * coarse_matches[k, 1] + y % 2
    column = 2 * coarse_matches[k, 2] + x % 2 + shift
    is_inside = 0 <= row < height and 0 <= column < width
    if is_inside and is_usable[source, row, column]:
        matches[n, 0], matches[n, 1], matches[n, 2] = source, row, column


@kernel_for_items
def improve_match(
    n: int, hole_pixels: Any, numbers: Any, old_matches: Any, old_costs: Any,
    is_usable: Any, usable_centers: Any, step: int, seed: Any, inputs: Any,
    matches: Any, costs: Any,
) -> None:  # fmt: skip
    """Try other patches for a hole pixel, and keep the best one.

    The candidates are the patches beside those of the neighbours' matches, a random patch, and
    random patches closer and closer to the best one.

    Args:
        n: number of the hole pixel.
        hole_pixels: [holes, 2] rows and columns.
        numbers: [h, w] numbers of the hole pixels; −1 elsewhere.
        old_matches: [holes, 3] source, row and column of each pixel's patch.
        old_costs: [holes] of these matches.
        is_usable: [2, h, w] whether the patch around a pixel of each source has no hole pixel.
        usable_centers: [k, 2] rows and columns of the picture's patches without hole pixels.
        step: distance in pixels to the neighbours.
        seed: uint32 that makes the random numbers of this call differ from those of others.
        inputs: the images, `CostInputs`.
        matches: [holes, 3] written.
        costs: [holes] written.
    """
    source_count, height, width = is_usable.shape
    y, x = hole_pixels[n]
    cost = old_costs[n]
    source = np.int64(old_matches[n, 0])
    row, column = np.int64(old_matches[n, 1]), np.int64(old_matches[n, 2])

    # If a neighbour's patch fits, the patch beside it probably fits here.
    for direction in NEIGHBOR_DIRECTIONS:
        dy, dx = direction[0] * step, direction[1] * step
        if not (0 <= y + dy < height and 0 <= x + dx < width):
            continue
        k = numbers[y + dy, x + dx]
        if k < 0:
            continue
        new_source = np.int64(old_matches[k, 0])
        v, u = np.int64(old_matches[k, 1]) - dy, np.int64(old_matches[k, 2]) - dx
        if 0 <= v < height and 0 <= u < width and is_usable[new_source, v, u]:
            new_cost = patch_cost(inputs, y, x, new_source, v, u, cost)
            if new_cost < cost:
                cost, source, row, column = new_cost, new_source, v, u

    # A random patch of either source, because the good ones may lie far from all matches.
    random = hash_uint32(np.uint32(n) * PIXEL_SEED_STEP + seed)
    center = usable_centers[random % np.uint32(len(usable_centers))]
    random = hash_uint32(random)
    new_source = np.int64(random % np.uint32(source_count))
    v, u = np.int64(center[0]), np.int64(width - 1 - center[1] if new_source else center[1])
    new_cost = patch_cost(inputs, y, x, new_source, v, u, cost)
    if new_cost < cost:
        cost, source, row, column = new_cost, new_source, v, u

    # Random patches around the best one, in squares that shrink from half the picture's side.
    radius = max(height, width) // 4
    while radius >= 1:
        random = hash_uint32(random)
        side = np.uint32(2 * radius + 1)
        v = row + np.int64(random % side) - radius
        u = column + np.int64((random >> np.uint32(12)) % side) - radius  # other random bits
        if 0 <= v < height and 0 <= u < width and is_usable[source, v, u]:
            new_cost = patch_cost(inputs, y, x, source, v, u, cost)
            if new_cost < cost:
                cost, row, column = new_cost, v, u
        radius //= 4

    costs[n] = cost
    matches[n, 0], matches[n, 1], matches[n, 2] = source, row, column


@kernel_for_items
def vote_color(
    n: int, hole_pixels: Any, numbers: Any, matches: Any, costs: Any,
    mean_cost: Any, source_rgb: Any, rgb: Any,
) -> None:  # fmt: skip
    """Set the colour of a hole pixel to the mean over all patches that cover it.

    Each hole pixel has a match: a patch of 7×7 pixels that is to be copied around it, so the
    patches of all hole pixels nearby cover a pixel. A patch has the weight exp(−cost / mean_cost),
    plus a millionth that keeps the weights from adding up to 0.

    Args:
        n: number of the hole pixel.
        hole_pixels: [holes, 2] rows and columns.
        numbers: [h, w] numbers of the hole pixels; −1 elsewhere.
        matches: [holes, 3] source, row and column of the centre of each pixel's patch.
        costs: [holes] of these matches.
        mean_cost: float32, above 0.
        source_rgb: [2, h, w, 3] the picture and its mirror image.
        rgb: [h, w, 3] written at the hole pixels.
    """
    height, width = numbers.shape
    y, x = hole_pixels[n]
    red, green, blue = np.float32(0), np.float32(0), np.float32(0)
    weight_sum = np.float32(0)
    for dy in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
        for dx in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            if not (0 <= y + dy < height and 0 <= x + dx < width):
                continue
            k = numbers[y + dy, x + dx]
            if k < 0:
                continue
            # This pixel lies at (−dy, −dx) from the neighbour, so its colour comes from the
            # pixel at (−dy, −dx) from the centre of the neighbour's patch.
            source, v, u = matches[k, 0], matches[k, 1] - dy, matches[k, 2] - dx
            weight = np.float32(math.exp(-costs[k] / mean_cost)) + np.float32(MIN_VOTE_WEIGHT)
            red += weight * source_rgb[source, v, u, 0]
            green += weight * source_rgb[source, v, u, 1]
            blue += weight * source_rgb[source, v, u, 2]
            weight_sum += weight
    rgb[y, x, 0] = red / weight_sum
    rgb[y, x, 1] = green / weight_sum
    rgb[y, x, 2] = blue / weight_sum
