"""What Gaussians of half a pixel have to be like, so that together they blend to what the photo shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle._numba import kernel
from spackle.bases.edges import Floats
from spackle.device import run_chunks

# Not higher: a blob that would bring the transmittance below the renderer's stop (1e-4) is not drawn at all, so
# behind a thin veil of alpha 0.9 one of opacity 0.999 would leave a hole that nothing can fill.
OPACITY = np.float32(0.99)
SPREAD_PX = 0.5  # standard deviation
WEIGHTS = np.exp(-0.5 / SPREAD_PX**2 * np.array([2, 1, 2, 1, 0, 1, 2, 1, 2])).astype(np.float32)  # of 3×3 neighbours
ROUNDS = 6
UNTOUCHED = 3  # rings around a step whose colours stay
GRAIN = 64


def blended_opacities(alpha: Floats, ring: NDArray[np.uint8]) -> Floats:
    """Opacities [H, W] of near Gaussians that cover alpha [H, W] of the pixels, neighbours' light included.

    Of full opacity each; `ring` [H, W] is 0 where a pixel is of one surface alone.
    """
    result = alpha.copy()
    for _ in range(ROUNDS):
        _thin(alpha, ring, result)
    return result


@kernel
def _thin(alpha: Any, ring: Any, result: Any) -> None:
    """One sweep, in place."""
    height, width = alpha.shape
    for y in range(height):
        for x in range(width):
            if ring[y, x] == 0 or alpha[y, x] <= 0 or alpha[y, x] >= 1:
                continue
            passes = np.float32(1)
            for k in range(9):
                v, u = min(max(y + k // 3 - 1, 0), height - 1), min(max(x + k % 3 - 1, 0), width - 1)
                if k != 4 and ring[v, u] > 0:
                    passes *= 1 - OPACITY * WEIGHTS[k] * result[v, u]
            result[y, x] = min(max(1 - (1 - alpha[y, x]) / passes, np.float32(0)), np.float32(1))


def blended_colors(colors: Floats, inverse_depth: Floats, ring: NDArray[np.uint8]) -> Floats:
    """Linear RGB [H, W, 3] of one Gaussian a pixel, sharpened by what the blobs will blur.

    The photo's camera sees each pixel through the Gaussians of its neighbours that are nearer. What this changes is
    taken off in advance, but for the rings beside depth steps and the photo's border.
    """
    result = colors.copy()
    run_chunks(lambda a, b: _sharpen(a, b, colors, inverse_depth, ring, result), len(colors), GRAIN)
    return result


@kernel
def _sharpen(start: int, stop: int, colors: Any, inverse_depth: Any, ring: Any, result: Any) -> None:
    """Rows start..stop."""
    height, width = inverse_depth.shape
    order, depth = np.empty(9, np.int64), np.empty(9, np.float32)
    for y in range(start, stop):
        for x in range(width):
            if 0 < ring[y, x] < UNTOUCHED or y == 0 or x == 0 or y == height - 1 or x == width - 1:
                continue
            count = 0
            for k in range(9):
                v, u = y + k // 3 - 1, x + k % 3 - 1
                at = count
                while at > 0 and depth[at - 1] < inverse_depth[v, u]:  # nearest first
                    depth[at], order[at] = depth[at - 1], order[at - 1]
                    at -= 1
                depth[at], order[at] = inverse_depth[v, u], k
                count += 1
            for c in range(3):
                light, passes = np.float32(0), np.float32(1)
                for n in range(count):
                    k = order[n]
                    share = passes * OPACITY * WEIGHTS[k]
                    light += share * colors[y + k // 3 - 1, x + k % 3 - 1, c]
                    passes -= share
                light += passes * colors[y, x, c]  # the backing's
                sharp = 2 * colors[y, x, c] - light
                result[y, x, c] = min(max(sharp, np.float32(0)), np.float32(1))
