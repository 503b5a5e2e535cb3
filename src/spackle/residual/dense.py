"""The residual's kernels once more, for a GPU: whole grids, one torch operation at a time.

Each gives what its twin gives on a processor but for rounding, and runs on any device: tests hold the two together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from spackle.camera import Camera, beside
from spackle.color import linear_to_srgb, srgb_to_linear
from spackle.filters import greatest_around
from spackle.gaussians import Gaussians
from spackle.render.protocol import Rendering

AT_ONCE = 32  # steps of all walks together, before a look at which have not ended
ENOUGH = 1 << 22  # places that are looked at together


def on_gpu(tensor: Tensor) -> bool:
    """Whether a tensor lies where kernels of the processor do not reach."""
    return tensor.device.type != "cpu"


def cells_of(rendering: Rendering, threshold: float, least: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour [h, w, 3], inverse depth, opacity and mask [h, w] of `Cues`; `least` is divided by at least."""
    rgb, depth, alpha = (image.detach().float() for image in rendering.tensors)
    height, width = alpha.shape
    planes = torch.cat([srgb_to_linear(rgb).movedim(-1, 0), depth[None], alpha[None]])
    wide = pad(planes[None], (0, width % 2, 0, height % 2), mode="replicate")[0]
    cells = wide.reshape(len(wide), wide.shape[1] // 2, 2, wide.shape[2] // 2, 2)  # [5, h, 2, w, 2]
    open_ = cells[4] < threshold
    far = torch.where(open_, 0, cells[3].clamp_min(least)).amax((1, 3))
    total = cells[4].sum((1, 3))
    colors = linear_to_srgb(cells[:3].sum((2, 4)) / total.clamp_min(least)).movedim(0, -1)
    inverse_depth = torch.where(far > 0, 1 / far.clamp_min(least), 0)
    return colors, inverse_depth, total / 4, open_.any(3).any(1)


def sources_of(mask: Tensor, inverse_depth: Tensor) -> Tensor:
    """[h, w] bool, see `seeds._sources`: chosen without waiting for the GPU."""
    covered = ~mask
    around = avg_pool2d(covered.float()[None, None], 3, stride=1, padding=1, count_include_pad=False)[0, 0]
    solid = covered & (around > 0.5)
    return torch.where(solid.any(), solid, torch.where(covered.any(), covered, inverse_depth > 0))


def inside_photo(inverse_depth: Tensor, uv: Tensor, camera: Camera, photo_camera: Camera) -> Tensor:
    """[h, w] bool: which cells' points lie in the photo's frame, in float64; `uv` are their centres [h, w, 2]."""
    place, inverse = uv.double(), inverse_depth.double()
    lens, photo_lens = (view.K.detach().double().tolist() for view in (camera, photo_camera))
    here, there = (view.world_to_camera.detach().double() for view in (camera, photo_camera))
    motion = (there @ here.inverse()).tolist()
    across, down = (place[..., 0] - lens[0][2]) / lens[0][0], (place[..., 1] - lens[1][2]) / lens[1][1]
    x, y, z = (row[0] * across + row[1] * down + row[2] + row[3] * inverse for row in motion[:3])
    u, v = photo_lens[0][0] * x + photo_lens[0][2] * z, photo_lens[1][1] * y + photo_lens[1][2] * z
    inside: Tensor = (z > 0) & (u >= 0) & (u < photo_camera.width * z) & (v >= 0) & (v < photo_camera.height * z)
    return inside


def placed_behind(filled: Tensor, chosen: Tensor, seen: Tensor, radius: int, share: float) -> Tensor:
    """See `seeds.placed_behind`."""
    near = torch.where(seen > 0, seen, torch.inf)
    farthest = -greatest_around(-near, radius)
    return torch.where(chosen, torch.minimum(filled, farthest) * share, filled)


class Walk(NamedTuple):
    """For each masked cell, what its line meets; elsewhere the cell itself."""

    found: Tensor  # [h, w, c] values at the far rim
    mirrored: Tensor  # [h, w, c] values as far beyond the rim as the cell is before it, if that is the same surface
    distance: Tensor  # [h, w] cells to the rim; 0 elsewhere, and where no line meets anything


def walk(
    uv: Tensor, rgb: Tensor, depths: Tensor, mask: Tensor, epipole: Sequence[float], same: float, still: float
) -> Walk:
    """See `epipolar_walk.walk`: of each masked cell its far rim; `still` is the length below which there is no line."""
    height, width = mask.shape
    flat = mask.flatten().nonzero()[:, 0]
    y, x = flat.div(width, rounding_mode="floor").double(), (flat % width).double()
    place = uv.flatten(0, 1)[flat].double()
    across, down = epipole[0] - epipole[2] * place[:, 0], epipole[1] - epipole[2] * place[:, 1]
    length = (across * across + down * down).sqrt()
    line = length > still
    length = torch.where(line, length, 1)
    across, down = torch.where(line, across / length, 1), torch.where(line, down / length, 0)

    def cell(dy: Tensor, dx: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Numbers of the cells at an offset, and whether they lie in the picture."""
        v, u = (rows + dy + 0.5).floor().long(), (columns + dx + 0.5).floor().long()
        there = (v >= 0) & (u >= 0) & (v < height) & (u < width)
        return v.clamp(0, height - 1) * width + u.clamp(0, width - 1), there

    closed, depth = mask.flatten(), depths.flatten()

    def steps_to_rim(turn: float) -> Tensor:
        """Steps of one cell to the first that is not masked, [n]; 0 where the picture ends before."""
        count, active, first = torch.zeros_like(flat), torch.arange(len(flat), device=flat.device), 1
        while len(active):
            k = torch.arange(first, first + AT_ONCE, device=flat.device).double()
            dy, dx, rows, columns = (t[active, None] for t in (turn * down, turn * across, y, x))
            number, there = cell(k * dy, k * dx, rows, columns)
            ends = ~there | ~closed[number]
            ended, step = ends.any(1), ends.long().argmax(1)  # of several the first
            met = ended & there.gather(1, step[:, None])[:, 0]
            count[active] = torch.where(met, first + step, 0)
            active, first = active[~ended], first + AT_ONCE
        return count

    best, steps, side = depth.new_full(flat.shape, torch.inf), torch.zeros_like(flat), torch.zeros_like(y)
    for turn in (1.0, -1.0):
        count = steps_to_rim(turn)
        met, _ = cell(count * turn * down, count * turn * across, y, x)
        farther = (count > 0) & (depth[met] < best)
        best, steps = torch.where(farther, depth[met], best), torch.where(farther, count, steps)
        side = torch.where(farther, turn, side)
    rim, _ = cell(steps * side * down, steps * side * across, y, x)  # the cell itself where nothing is met
    twice, there = cell(2 * steps * side * down, 2 * steps * side * across, y, x)
    ratio = depth[twice] / best
    alike = (steps > 0) & there & ~closed[twice] & (ratio < same) & (ratio > 1 / same)
    colors = rgb.flatten(0, 1)
    found, mirrored, distance = colors.clone(), colors.clone(), depth.new_zeros(depth.shape)
    found[flat], distance[flat] = colors[rim], steps.to(depth)
    mirrored[flat] = colors[torch.where(alike, twice, rim)]
    return Walk(found.view_as(rgb), mirrored.view_as(rgb), distance.view_as(depths))


def free_factors(
    eye: Tensor, aux: Gaussians, guards: Sequence[tuple[Camera, Tensor]], steps: int, window: int, reach: float,
    most: float, clearance: float,
) -> Tensor:  # fmt: skip
    """See `occlusion_guard.push_behind`: the least factor [N] of 1 / (1 - k / steps) that no guard blocks, or 0."""
    factors = 1 / (1 - torch.arange(steps, dtype=torch.float64, device=aux.means.device) / steps)
    covariances, rays = aux.to(dtype=torch.float64).covariances(), (aux.means - eye).double()
    share = max(1, ENOUGH // steps)
    parts = zip(torch.split(rays, share), torch.split(covariances, share), strict=True)
    free = torch.cat([_free(eye.double(), *part, factors, guards, window, reach, most, clearance) for part in parts])
    return torch.where(free.any(1), factors[free.long().argmax(1)], 0)


def _free(
    eye: Tensor, rays: Tensor, covariances: Tensor, factors: Tensor, guards: Sequence[tuple[Camera, Tensor]],
    window: int, reach: float, most: float, clearance: float,
) -> Tensor:  # fmt: skip
    """[N, steps] bool: no guard blocks a Gaussian that is moved away from the eye by a factor."""
    points = eye + factors[:, None] * rays[:, None]
    blocked = torch.zeros(points.shape[:2], dtype=torch.bool, device=points.device)
    for camera, guard in guards:
        height, width = guard.shape
        pose, lens = beside(camera.world_to_camera, points), camera.K.tolist()
        local = points @ pose[:3, :3].T + pose[:3, 3]
        z = local[..., 2]
        front = z > 0
        tangent = local[..., :2] / torch.where(front, z, 1)[..., None]
        place, extent = [], []
        for axis in (0, 1):
            row = (lens[axis][axis] * factors / torch.where(front, z, 1))[..., None] * (
                pose[axis, :3] - tangent[..., axis, None] * pose[2, :3]
            )
            variance = torch.einsum("nsa,nab,nsb->ns", row, covariances, row)
            place.append(lens[axis][axis] * tangent[..., axis] + lens[axis][2])
            extent.append((reach * variance.clamp_min(0).sqrt() + 1).clamp_max(most))
        seen = front
        for at, far, size in zip(place, extent, (width, height), strict=True):
            seen = seen & (at >= -far) & (at <= size + far)
        # Windows of the guard, side by side, cover the reach.
        around = [((far - window).clamp_min(0) / (2 * window)).ceil().long() for far in extent]
        depths = guard.flatten().double()
        wide, tall = (int(torch.where(seen, count, 0).amax()) for count in around)
        for j in range(-tall, tall + 1):
            row_ = (place[1] + 2 * window * j).floor().clamp(0, height - 1).long()
            for i in range(-wide, wide + 1):
                column = (place[0] + 2 * window * i).floor().clamp(0, width - 1).long()
                within = seen & (around[0] >= abs(i)) & (around[1] >= abs(j))
                blocked |= within & (z < depths[row_ * width + column] * (1 + clearance))
    return ~blocked
