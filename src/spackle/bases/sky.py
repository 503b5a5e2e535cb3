"""The sky: one distance for all of it, behind everything else."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle._numba import kernel
from spackle.color import bright_or_blue
from spackle.filters import greatest_around

NEAR_QUANTILE = 0.9  # of the inverse depth: what counts as the scene's near side
FAR_QUANTILE = 0.05  # and as its far side
FAR = 0.1  # at the photo's border a sky is at least ten times as far away as the near side
GETS_NEAR = 0.25  # and nowhere nearer than this: a predicted sky often sinks towards the horizon
LEVEL = 0.02  # and no nearer than the far side of all else, by no more than this in units of the near side
OUTDOORS_M = 10.0  # farther than rooms are long: so is a sky, or where its depth is unknown what else is far
BRIGHT = 0.6  # sRGB; a sky is that bright, or blue
DIM = 0.35  # and may go on in clouds as dark as that
SMOOTH = 0.12  # largest change between neighbouring pixels of the sky, sum of the channels
LEAST_SHARE = 0.01  # of the photo
MOST_NEAR = 0.25  # of a sky may be nearer than at the border: a floor that runs to the horizon comes nearer steadily
MOST_LEAKS = 0.1  # of a sky's outline: where it goes on nearer in the same colours, it is a floor or a ceiling
LEAP = 1.5  # more than this factor between the inverse depths of neighbours: there the sky ends
CLOSING_PX = 2  # specks in the sky that are as far as it is, belong to it
BEYOND = 0.1  # the sky's inverse depth, in units of the far side of all else
CLEAR = 1.1  # and all else is at least by this factor nearer


def push_sky(inverse_depth: Tensor, rgb: Tensor, known: Tensor) -> tuple[Tensor, Tensor, float]:
    """Find the sky and put it at one distance, behind everything else.

    A sky begins at the upper border of the photo (sRGB [H, W, 3]), spreads without sharp changes, is bright or blue,
    and its inverse depth [H, W] is unknown or among the farthest: a nearer region is a wall or a ceiling, whatever its
    colour. One distance, because a sky whose depth varies swims as the camera moves.

    Returns:
        Inverse depth [H, W], where it is known [H, W], and the sky's share of the photo; as given if there is no sky.
    """
    nothing = (inverse_depth, known, 0.0)
    near = _quantile(inverse_depth, known, NEAR_QUANTILE)
    far = ~known | (inverse_depth <= FAR * near)
    if not far[0].any():
        return nothing
    reach = known & (inverse_depth <= GETS_NEAR * near)
    bright, dim = far & bright_or_blue(rgb, BRIGHT), reach & bright_or_blue(rgb, DIM)
    sky = torch.from_numpy(_flood(*(a.contiguous().numpy() for a in (rgb, bright[0], bright | dim))))
    rest = known & ~sky
    if float(sky.float().mean()) < LEAST_SHARE or not rest.any():
        return nothing
    horizon = _quantile(inverse_depth, rest, FAR_QUANTILE)
    if not _stands_behind(sky, inverse_depth, known, near, horizon) or _leaks(sky, inverse_depth, rgb, known):
        return nothing
    grown = greatest_around(sky, CLOSING_PX)  # close narrow gaps
    sky |= ~greatest_around(~grown, CLOSING_PX) & reach
    distance = BEYOND * min(horizon, FAR * near)
    inverse_depth = torch.where(sky, distance, torch.where(known, inverse_depth.clamp_min(CLEAR * distance), 0.0))
    return inverse_depth, known | sky, float(sky.float().mean())


def _quantile(inverse_depth: Tensor, where: Tensor, q: float) -> float:
    """Of up to a hundred thousand of the pixels: enough, and soon sorted."""
    values = inverse_depth[where]
    return float(values[:: 1 + len(values) // 100_000].quantile(q)) if len(values) else 0.0


@kernel
def _flood(rgb: Any, first_row: Any, candidates: Any) -> Any:
    """[H, W] the candidates that smooth steps connect to the chosen ones of the first row."""
    height, width = candidates.shape
    found = np.zeros((height, width), np.bool_)
    stack = np.empty(height * width, np.int64)
    count = 0
    for x in range(width):
        if first_row[x]:
            found[0, x] = True
            stack[count] = x
            count += 1
    while count:
        count -= 1
        y, x = stack[count] // width, stack[count] % width
        for k in range(4):
            v, u = y + (k == 0) - (k == 1), x + (k == 2) - (k == 3)
            if v < 0 or u < 0 or v >= height or u >= width or found[v, u] or not candidates[v, u]:
                continue
            change = abs(rgb[y, x, 0] - rgb[v, u, 0]) + abs(rgb[y, x, 1] - rgb[v, u, 1])
            if change + abs(rgb[y, x, 2] - rgb[v, u, 2]) <= SMOOTH:
                found[v, u] = True
                stack[count] = v * width + u
                count += 1
    return found


def _stands_behind(sky: Tensor, inverse_depth: Tensor, known: Tensor, near: float, horizon: float) -> bool:
    """Whether the sky is outdoors and about as far as the far side of all else; without depth, whether that is far."""
    depths = inverse_depth[sky & known]
    if 2 * len(depths) < int(sky.sum()):
        return horizon * OUTDOORS_M <= 1
    middle = float(depths.median())
    if middle * OUTDOORS_M > 1:
        return False
    return middle <= horizon + LEVEL * near and float((depths > FAR * near).float().mean()) <= MOST_NEAR


def _leaks(sky: Tensor, inverse_depth: Tensor, rgb: Tensor, known: Tensor) -> bool:
    """Whether what has been left out of the sky for its depth alone goes on as the sky does."""
    looks, outline, leaks = bright_or_blue(rgb, DIM), 0, 0
    for axis in (0, 1):
        size = sky.shape[axis] - 1
        for one, other in ((0, 1), (1, 0)):
            inside, outside = (
                [t.narrow(axis, start, size) for t in (sky, inverse_depth, rgb, known, looks)] for start in (one, other)
            )
            rim = inside[0] & ~outside[0]
            alike = ((inside[2] - outside[2]).abs().sum(-1) <= SMOOTH) & outside[4] & outside[3]
            continues = ~inside[3] | (outside[1] <= LEAP * inside[1])
            outline += int(rim.sum())
            leaks += int((rim & alike & continues).sum())
    return leaks > MOST_LEAKS * outline
