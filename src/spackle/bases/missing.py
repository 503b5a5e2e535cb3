"""Filling the gaps of a depth map along what the photo shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from spackle._numba import kernel
from spackle.fill import far_fill

COLOR_COST = 60.0  # pixels of detour that a change from 0 to 1 in one channel is worth
NEAR_COST = 300.0  # and this many before a depth is taken that is far too near
ROUNDS = 4  # sweeps down and up; a path may turn as often
MEDIAN = 5  # window that removes specks from what was filled


def fill_missing(inverse_depth: Tensor, rgb: Tensor, valid: Tensor) -> Tensor:
    """Give every pixel without depth the depth of the measured pixel that it is best connected to.

    Stereo misses the strips beside silhouettes and whatever shines. A path over the image costs its
    length plus the colour change along it, so depth spreads within things and stops at their outlines;
    starting from a surface nearer than the far side of the gap costs extra, because most gaps are
    background that the second camera could not see.

    Args:
        inverse_depth: [H, W], positive where valid.
        rgb: [H, W, 3] sRGB.
        valid: [H, W] bool.

    Returns:
        [H, W], positive; valid pixels as they were.

    Raises:
        ValueError: where nothing is valid.
    """
    if bool(valid.all()):
        return inverse_depth
    far, _ = far_fill(inverse_depth, inverse_depth[None], valid)
    spread = _spread(inverse_depth.numpy(), rgb.contiguous().numpy(), valid.numpy(), far.numpy())
    filled = torch.where(valid, inverse_depth, torch.from_numpy(spread))
    return torch.where(valid, inverse_depth, _median(filled))


@kernel
def _spread(inverse_depth: Any, rgb: Any, valid: Any, far: Any) -> Any:
    """Cheapest paths from valid pixels by sweeps over the image, down and up; returns their depths."""
    height, width = inverse_depth.shape
    cost = np.where(valid, np.float32(0), np.float32(np.inf))
    result = inverse_depth.copy()
    for sweep in range(2 * ROUNDS):
        for i in range(height * width):
            n = i if sweep % 2 == 0 else height * width - 1 - i
            y, x = n // width, n % width
            if valid[y, x]:
                continue
            for k in range(9):
                v, u = y + k // 3 - 1, x + k % 3 - 1
                if k == 4 or v < 0 or u < 0 or v >= height or u >= width or cost[v, u] == np.inf:
                    continue
                change = abs(rgb[y, x, 0] - rgb[v, u, 0]) + abs(rgb[y, x, 1] - rgb[v, u, 1])
                change += abs(rgb[y, x, 2] - rgb[v, u, 2])
                total = cost[v, u] + (1.0 if k % 2 else 1.4142135) + COLOR_COST * change
                if valid[v, u]:
                    total += NEAR_COST * max(0.0, 1.0 - far[y, x] / result[v, u])
                if total < cost[y, x]:
                    cost[y, x] = total
                    result[y, x] = result[v, u]
    return result


def _median(image: Tensor) -> Tensor:
    """Median over a square window, [H, W]; borders repeat."""
    margin = MEDIAN // 2
    wide = pad(image[None, None], (margin, margin, margin, margin), mode="replicate")[0, 0]
    height, width = image.shape
    shifts = [wide[dy : dy + height, dx : dx + width] for dy in range(MEDIAN) for dx in range(MEDIAN)]
    return torch.stack(shifts).median(dim=0).values
