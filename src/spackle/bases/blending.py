"""What Gaussians have to be like, so that together they blend to what the photo shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle._numba import kernel
from spackle.bases.edges import Floats
from spackle.device import run_chunks

# Not higher: a blob that would bring the transmittance below the renderer's stop (1e-4) is not drawn at all, so
# behind a thin veil of alpha 0.9 one of opacity 0.999 would leave a hole that nothing can fill.
OPACITY = np.float32(0.99)
SPREAD_PX = 0.5  # standard deviation
WEIGHTS = np.exp(-0.5 / SPREAD_PX**2 * np.array([2, 1, 2, 1, 0, 1, 2, 1, 2])).astype(np.float32)  # of 3×3 neighbours
ROUNDS = 6
FAINT, STOP = np.float32(1 / 255), np.float32(1e-4)  # the renderer's: alphas that it skips, light at which it stops
REACH = np.float32(3.33)  # standard deviations at which an alpha becomes faint
BAND = 128  # rows that a thread takes at a time


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


class Mixture:
    """What the photo's camera sees of Gaussians: spots, which mix to a picture as the renderer mixes them."""

    def __init__(self, uv: Tensor, inverse_depth: Tensor, spread: Tensor, opacity: Tensor, height: int, width: int):
        """Sort spots by depth.

        Args:
            uv: [N, 2] centres in pixels.
            inverse_depth: [N].
            spread: [N, 2] standard deviations in pixels, along x and y.
            opacity: [N].
            height: of the picture.
            width: of the picture.
        """
        self.order = inverse_depth.argsort(descending=True, stable=True)
        self.spots = torch.cat([uv, spread, opacity[:, None]], dim=-1)[self.order].numpy()
        self.shape = (height, width, 3)

    def picture(self, colors: Tensor) -> Tensor:
        """[H, W, 3] of the spots' colours [N, 3], linear RGB."""
        image, sorted_colors = np.zeros(self.shape, np.float32), colors[self.order].numpy()
        run_chunks(lambda a, b: _mix(a, b, self.spots, sorted_colors, image), len(image), BAND)
        return torch.from_numpy(image)


@kernel
def _mix(start: int, stop: int, spots: Any, colors: Any, image: Any) -> None:
    """Rows start..stop, nearest first."""
    width = image.shape[1]
    half = np.float32(0.5)
    passes = np.ones((stop - start, width), np.float32)
    across = np.empty(width, np.float32)
    for n in range(len(spots)):
        u, v, spread_x, spread_y, opacity = spots[n]
        top = max(int(np.ceil(v - REACH * spread_y - half)), start)
        bottom = min(int(np.floor(v + REACH * spread_y - half)) + 1, stop)
        if top >= bottom:
            continue
        left = max(int(np.ceil(u - REACH * spread_x - half)), 0)
        right = min(int(np.floor(u + REACH * spread_x - half)) + 1, width)
        for x in range(left, right):
            away = (x + half - u) / spread_x
            across[x] = np.exp(-half * away * away)
        for y in range(top, bottom):
            away = (y + half - v) / spread_y
            down = opacity * np.exp(-half * away * away)
            for x in range(left, right):
                alpha, light = down * across[x], passes[y - start, x]
                if alpha < FAINT:
                    continue
                after = light * (1 - alpha)
                if after <= STOP:
                    passes[y - start, x] = 0
                    continue
                passes[y - start, x] = after
                for c in range(3):
                    image[y, x, c] += alpha * light * colors[n, c]
