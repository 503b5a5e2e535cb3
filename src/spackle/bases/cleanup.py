"""From a depth map as measured to a surface that can be seen from the side: steps, noise, sky, gaps, flying pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from spackle._numba import kernel
from spackle.bases.edges import Bools, Floats, color_change
from spackle.color import bright_or_blue
from spackle.fill import far_fill
from spackle.filters import greatest_around
from spackle.surface import EDGE

SWEEPS = 200  # enough for steps about 30 pixels apart


def undo_quantisation(inverse_depth: Tensor, valid: Tensor, quantum: float, sweeps: int = SWEEPS) -> Tensor:
    """The smoothest inverse depth [H, W] that would round to the stored one, of pixels valid [H, W]; others stay out.

    Integer disparities turn a slanted plane into a staircase with a gap at every step. A stored value stands for the
    interval of ±quantum/2 (in units of the inverse depth); relaxing towards the mean of the neighbours within it
    removes the stairs. Neighbours more than 1.5 steps away belong to another surface.
    """
    low, high = inverse_depth - quantum / 2, inverse_depth + quantum / 2
    weights = []
    for axis in (1, 0):
        for neighbour, present in zip(_neighbours(inverse_depth, axis), _neighbours(valid, axis), strict=True):
            weights.append((present & ((neighbour - inverse_depth).abs() < 1.5 * quantum)).float())
    mass = sum(weights, torch.full_like(inverse_depth, 1e-6))
    smooth = inverse_depth
    for _ in range(sweeps):
        around = [n for axis in (1, 0) for n in _neighbours(smooth, axis)]
        total = sum((w * n for w, n in zip(weights, around, strict=True)), 1e-6 * smooth)
        smooth = torch.minimum(torch.maximum(total / mass, low), high)
    return torch.where(valid, smooth, inverse_depth)


def _neighbours(image: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The previous and the next pixel along an axis of [H, W]; beyond the border: linear, and false for booleans."""
    size = image.shape[axis]
    start, end = image.narrow(axis, 0, 1), image.narrow(axis, size - 1, 1)
    if image.dtype == torch.bool:
        start = end = torch.zeros_like(start)
    else:
        start = 2 * start - image.narrow(axis, min(1, size - 1), 1)
        end = 2 * end - image.narrow(axis, max(size - 2, 0), 1)
    wide = torch.cat([start, image, end], dim=axis)
    return wide.narrow(axis, 0, size), wide.narrow(axis, 2, size)


LEAST_NOISE = 5e-4  # of the inverse depth; less leaves no gaps between the Gaussians
MOST_NOISE = 0.03  # more is no noise but what the photo shows: leaves, meshes
RADIUS = 2  # pixels to each side that a plane is fitted to
FITS = 2
OUTLIERS = 4.0  # standard deviations of the noise from the plane to what belongs to another surface
ENOUGH = 6  # pixels that say where a plane is


def noise_level(inverse_depth: Floats, known: Bools) -> float:
    """Standard deviation of the noise of most pixels, relative to the inverse depth.

    By both x and y the second difference is zero on planes and straight edges; the median leaves out the rest.
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
    """Put every known pixel on the plane of its neighbourhood, where the inverse depth [h, w] is noisy; else return it.

    Noise of 0.3 % makes each Gaussian of a slanted surface face another way, and light shines through. Pixels further
    from the plane than noise explains are on another surface: they neither count nor move.
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
            if color_change(rgb, y, x, v, u) <= SMOOTH:
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


COLOR_COST = 60.0  # pixels of detour that a change from 0 to 1 in one channel is worth
NEAR_COST = 300.0  # and this many before a depth is taken that is far too near
ROUNDS = 4  # sweeps down and up; a path may turn as often
MEDIAN = 5  # window that removes specks from what was filled


def fill_missing(inverse_depth: Tensor, rgb: Tensor, valid: Tensor) -> Tensor:
    """Give every pixel without inverse depth [H, W] that of the valid pixel that it is best connected to.

    Stereo misses the strips beside silhouettes and whatever shines. A path over the image costs its length plus the
    change of sRGB [H, W, 3] along it, so depth spreads within things and stops at their outlines; a start nearer than
    the far side of the gap costs extra, because most gaps are background that the second camera could not see. Valid
    pixels stay as they are.

    Raises:
        ValueError: where nothing is valid.
    """
    if bool(valid.all()):
        return inverse_depth
    far, _ = far_fill(inverse_depth, inverse_depth[None], valid)
    spread, cost = inverse_depth.numpy().copy(), np.where(valid.numpy(), np.float32(0), np.float32(np.inf))
    _spread(spread, cost, rgb.contiguous().numpy(), valid.numpy(), far.numpy())
    filled = torch.where(valid, inverse_depth, torch.from_numpy(spread))
    return torch.where(valid, inverse_depth, _median(filled))


@kernel
def _spread(result: Any, cost: Any, rgb: Any, valid: Any, far: Any) -> None:
    """Cheapest paths from valid pixels, which cost 0, by sweeps over the image, down and up; writes their depths."""
    height, width = result.shape
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
                total = cost[v, u] + (1.0 if k % 2 else 1.4142135) + COLOR_COST * color_change(rgb, y, x, v, u)
                if valid[v, u]:
                    total += NEAR_COST * max(0.0, 1.0 - far[y, x] / result[v, u])
                if total < cost[y, x]:
                    cost[y, x] = total
                    result[y, x] = result[v, u]


def _median(image: Tensor) -> Tensor:
    """Median over a square window, [H, W]; borders repeat."""
    margin = MEDIAN // 2
    wide = pad(image[None, None], (margin, margin, margin, margin), mode="replicate")[0, 0]
    height, width = image.shape
    shifts = [wide[dy : dy + height, dx : dx + width] for dy in range(MEDIAN) for dx in range(MEDIAN)]
    return torch.stack(shifts).median(dim=0).values


def attach_flying_pixels(inverse_depth: Tensor) -> Tensor:
    """Move pixels of inverse depth [H, W] > 0 that hang between two surfaces to the one they are closer to.

    A pixel hangs when it lies strictly between its left and right (or upper and lower) neighbours with a depth edge (a
    relative jump of `EDGE`) to both, while the depth beyond goes on much more smoothly: on a steep plane it does not.
    """
    for axis in (1, 0):
        before, after = _shifted(inverse_depth, axis, -1), _shifted(inverse_depth, axis, 1)
        to_before, to_after = (inverse_depth - before).abs(), (inverse_depth - after).abs()
        gap = torch.minimum(to_before, to_after)
        between = (inverse_depth - before) * (after - inverse_depth) > 0
        beyond = torch.maximum(
            (before - _shifted(inverse_depth, axis, -2)).abs(), (after - _shifted(inverse_depth, axis, 2)).abs()
        )
        hangs = between & (gap > EDGE * inverse_depth) & (beyond < 0.5 * gap)
        inverse_depth = torch.where(hangs, torch.where(to_before < to_after, before, after), inverse_depth)
    return inverse_depth


def _shifted(image: Tensor, axis: int, by: int) -> Tensor:
    """The pixel `by` steps along an axis of [H, W]; the border pixel beyond the border."""
    index = (torch.arange(image.shape[axis]) + by).clamp(0, image.shape[axis] - 1)
    return image.index_select(axis, index)
