"""A photo and its depth map, lifted: from the map as measured to surface-aligned Gaussians.

On the way its steps, noise, sky, gaps and flying pixels are cleaned up, so that it can be seen from the side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from spackle._numba import kernel
from spackle.bases import BasePrediction, Progress
from spackle.bases.depth_map import DepthMap
from spackle.bases.edges import Bools, Floats, color_change, find_edges, sample, settle
from spackle.bases.quadtree import LEVELS
from spackle.bases.splats import layered_gaussians
from spackle.camera import Camera
from spackle.color import bright_or_blue, srgb_to_linear
from spackle.errors import InputError
from spackle.filters import far_fill, greatest_around
from spackle.image import Photo, resize_photo
from spackle.surface import EDGE


class RgbdBase:
    """Lifts a photo by a depth map that came with it."""

    name = "rgbd"

    def __init__(self, depth: DepthMap, lens_source: str = "calibration") -> None:
        self.depth = depth
        self.lens_source = lens_source  # of the map's intrinsics; "" if they are the user's

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels at its working size; InputError for a map of another aspect ratio."""
        depth, (width, height) = self.depth, photo.framed_size
        depth.check_shape(height, width, photo.path)
        own = None if depth.K is None else Camera(depth.K, torch.eye(4), *depth.depth.shape[::-1])
        if photo.frame is not None:
            frame = photo.frame
            values, valid = (frame.inside(grid, width, height) for grid in (depth.depth, depth.valid))
            depth = dataclasses.replace(depth, depth=values, valid=valid)
            own = own and own.resized(width, height).cropped(frame.left, frame.top, photo.width, photo.height)
        photo = resize_photo(photo)
        camera = photo.camera if own is None else own.resized(photo.width, photo.height)
        prediction = lift(photo.rgb, depth, camera)
        notes = (
            prediction.notes
            | {"depth_range": self.depth.range_in_words}
            | ({"depth": depth.note} if depth.note else {})
        )
        return dataclasses.replace(prediction, notes=notes, lens_source="" if own is None else self.lens_source)


def lift(rgb: Tensor, depth: DepthMap, camera: Camera, levels: int = LEVELS) -> BasePrediction:
    """A photo and its depth to Gaussians, see `layered_gaussians`.

    Args:
        rgb: [H, W, 3] sRGB in 0..1.
        depth: any size of the same aspect ratio.
        camera: the photo's, at the world's origin.
        levels: of tiles that share a Gaussian; 0 for one a pixel.

    Raises:
        InputError: not one pixel has a depth.
    """
    rgb = rgb.detach().float()
    inverse_depth, known = _inverse_depth(depth, rgb, camera)
    inverse_depth, known, sky = push_sky(inverse_depth, rgb, known)
    missing = 1.0 - float(known.float().mean())
    if not known.any():
        raise InputError(f"{depth.path}: no depth is left at {camera.width}×{camera.height}: give a denser map")
    inverse_depth = fill_missing(inverse_depth, rgb, known)
    inverse_depth = attach_flying_pixels(inverse_depth)
    gaussians = layered_gaussians(inverse_depth, srgb_to_linear(rgb), camera, levels)
    notes: dict[str, float | int | str] = {"depth_filled": round(missing, 4)}
    if sky:
        notes["sky"] = round(sky, 4)
    if depth.depth.shape != inverse_depth.shape:
        notes["depth_resampled_from"] = f"{depth.depth.shape[1]}×{depth.depth.shape[0]}"
    return BasePrediction(gaussians, camera, notes)


def _inverse_depth(depth: DepthMap, rgb: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Inverse depth on the photo's grid and where it is known, [H, W] each; a clean map of that size stays as it is."""
    values = depth.depth.detach().float()
    valid = depth.valid & torch.isfinite(values) & (values > 0)
    inverse = torch.where(valid, 1.0 / values, 0.0)
    if depth.quantity == "disparity" and depth.quantum is not None:
        inverse = undo_quantisation(inverse, valid, depth.quantum)
    known = valid.contiguous().numpy()
    smooth = smooth_noise(inverse.contiguous().numpy(), known)
    rows, columns = known.shape
    fx, fy = camera.focal
    edges = find_edges(smooth, known, (fx * columns / camera.width, fy * rows / camera.height))
    sampled = sample(smooth, known, edges, camera.height, camera.width)
    settled, found = settle(sampled, rgb.contiguous().numpy())
    return torch.from_numpy(settled), torch.from_numpy(found)


SWEEPS = 200  # enough for steps about 30 pixels apart


def undo_quantisation(inverse_depth: Tensor, valid: Tensor, quantum: float, sweeps: int = SWEEPS) -> Tensor:
    """The smoothest inverse depth [H, W] that would round to the stored one, of pixels valid [H, W]; others stay out.

    Integer disparities turn a slanted plane into a staircase with a gap at every step. A stored value stands for the
    interval of ±quantum/2 (in units of the inverse depth); relaxing towards the mean of the neighbours within it
    removes the stairs. Neighbours more than 1.5 steps away belong to another surface.
    """
    low, high = inverse_depth - quantum / 2, inverse_depth + quantum / 2
    near = zip(_neighbours(inverse_depth), _neighbours(valid), strict=True)
    weights = [(known & ((other - inverse_depth).abs() < 1.5 * quantum)).float() for other, known in near]
    mass = sum(weights, torch.full_like(inverse_depth, 1e-6))
    smooth = inverse_depth
    for _ in range(sweeps):
        total = sum((w * n for w, n in zip(weights, _neighbours(smooth), strict=True)), 1e-6 * smooth)
        smooth = torch.minimum(torch.maximum(total / mass, low), high)
    return torch.where(valid, smooth, inverse_depth)


def _neighbours(image: Tensor) -> Iterator[Tensor]:
    """The left, right, upper and lower neighbours of [H, W]; beyond the border: linear, and false for booleans."""
    for axis in (1, 0):
        size = image.shape[axis]
        start, end = image.narrow(axis, 0, 1), image.narrow(axis, size - 1, 1)
        if image.dtype == torch.bool:
            start = end = torch.zeros_like(start)
        else:
            start = 2 * start - image.narrow(axis, min(1, size - 1), 1)
            end = 2 * end - image.narrow(axis, max(size - 2, 0), 1)
        wide = torch.cat([start, image, end], dim=axis)
        yield from (wide.narrow(axis, 0, size), wide.narrow(axis, 2, size))


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
    bend, seen = inverse_depth, known
    for _ in range(2):  # by y, then by x
        bend = (bend[:-2] - 2 * bend[1:-1] + bend[2:]).T
        seen = (seen[:-2] & seen[1:-1] & seen[2:]).T
    if not seen.any():
        return 0.0
    return float(np.median(np.abs(bend[seen]) / inverse_depth[1:-1, 1:-1][seen])) / (0.6745 * 6)


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
    wide = pad(image[None, None], [MEDIAN // 2] * 4, mode="replicate")[0, 0]
    return wide.unfold(0, MEDIAN, 1).unfold(1, MEDIAN, 1).flatten(2).median(dim=-1).values


def attach_flying_pixels(inverse_depth: Tensor) -> Tensor:
    """Move pixels of inverse depth [H, W] > 0 that hang between two surfaces to the one they are closer to.

    A pixel hangs when it lies strictly between its left and right (or upper and lower) neighbours with a depth edge (a
    relative jump of `EDGE`) to both, while the depth beyond goes on much more smoothly: on a steep plane it does not.
    """
    for axis in (1, 0):
        before2, before, after, after2 = (_shifted(inverse_depth, axis, by) for by in (-2, -1, 1, 2))
        to_before, to_after = (inverse_depth - before).abs(), (inverse_depth - after).abs()
        gap = torch.minimum(to_before, to_after)
        between = (inverse_depth - before) * (after - inverse_depth) > 0
        beyond = torch.maximum((before - before2).abs(), (after - after2).abs())
        hangs = between & (gap > EDGE * inverse_depth) & (beyond < 0.5 * gap)
        inverse_depth = torch.where(hangs, torch.where(to_before < to_after, before, after), inverse_depth)
    return inverse_depth


def _shifted(image: Tensor, axis: int, by: int) -> Tensor:
    """The pixel `by` steps along an axis of [H, W]; the border pixel beyond the border."""
    index = (torch.arange(image.shape[axis]) + by).clamp(0, image.shape[axis] - 1)
    return image.index_select(axis, index)
