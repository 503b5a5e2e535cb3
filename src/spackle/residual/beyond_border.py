"""Extends the photo beyond its border, where no camera has looked: floors as floors, walls as walls, sky as sky.

What reaches the border is extended along the epipolar line, at the same distance from the photo's plane. So a level
floor and a wall stay the planes that they are, from wherever they are seen.
"""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.camera import Camera, beside
from spackle.color import bright_or_blue
from spackle.fill import FAR_BIAS, far_fill
from spackle.filters import broadly_blurred, nearest_known
from spackle.residual.epipolar_walk import WIDENING, walk, widened
from spackle.residual.view_features import ViewFeatures

AT_BORDER = 0.03  # of the photo's width: what ends farther inside is not extended beyond it
DETOUR = 2.0  # how many times farther than the nearest seen cell a line's far rim may lie
MIXED, CARRIED = 0.1, 0.2  # of the view's width from the border: colours of all around; those traced along the line
FEW = 0.005  # share of a view's cells: so few lie between others, and what is around them closes them
SKY, CALM, CALM_CELLS = 0.85, 0.2, 4.0  # a sky is so bright, or blue; its colours vary so little among so many cells
AT_ONCE = 0.03  # of the view's width from the border: from there a sky is extended as it is
LEAST = 1e-9


def fill_around(
    features: ViewFeatures,
    across: Tensor,
    uv: Tensor,
    known: Tensor,
    inside: Tensor,
    camera: Camera,
    photo_camera: Camera,
) -> tuple[Tensor, Tensor]:
    """Inverse depth [h, w] and colours [3, h, w] of all cells, the photo continued beyond its border.

    Args:
        features: of the view.
        across: [h, w] inverse depth, in holes that of all around.
        uv: [h, w, 2] pixels of the cells.
        known: [h, w] bool: cells to start from.
        inside: [h, w] bool: cells whose points lie in the photo's frame; there what is behind is extended.
        camera, photo_camera: the view's and the photo's.
    """
    mask, bias = features.mask, FAR_BIAS * inside
    beyond = mask & ~inside
    if int(beyond.count_nonzero()) <= FEW * beyond.numel():
        return far_fill(features.inverse_depth, features.rgb.permute(2, 0, 1), known, far_bias=bias)
    # A cell's point times its inverse depth, in the photo's frame: ray + shift * inverse depth.
    here, there = (view.world_to_camera.double() for view in (camera, photo_camera))
    motion = beside(there @ here.inverse(), uv)
    lens, photo_lens = (beside(view.K, uv) for view in (camera, photo_camera))
    rays = (uv - lens[:2, 2]) / lens.diagonal()[:2] @ motion[:3, :2].T + motion[:3, 2]
    points = rays + motion[:3, 3] * across[..., None]
    depth = points[..., 2:].clamp_min(LEAST)
    place = points[..., :2] / depth * photo_lens.diagonal()[:2] + photo_lens[:2, 2]
    size = beside(torch.tensor([photo_camera.width, photo_camera.height]), place)
    ends = torch.minimum(place, size - place).amin(-1) < AT_BORDER * photo_camera.width
    looks = torch.cat([features.rgb, _sky(features.rgb, known)[..., None]], dim=-1)
    values = torch.cat([looks, (across / depth[..., 0])[..., None], ends[..., None].float()], dim=-1)

    found, _, steps = walk(uv, values, across, mask, camera, photo_camera.position)
    apart = _cells_to_known(mask)
    traced = beyond & (steps > 0) & (steps <= DETOUR * apart)
    hidden = traced & (found[..., 5] == 0)  # by something nearer, beside which the photo is extended
    found = widened(found, traced & ~hidden, WIDENING * steps)
    away = 1 / found[..., 4].clamp_min(LEAST) - motion[2, 3]
    traced = traced & ~hidden & (away > 0) & (rays[..., 2] > 0)
    nearest = torch.where(known, features.inverse_depth, 0).amax()
    extended = torch.minimum((rays[..., 2] / away.clamp_min(LEAST)).clamp_min(LEAST), nearest)

    bias = torch.where(hidden, FAR_BIAS, bias)
    depths, mixed = far_fill(features.inverse_depth, looks.movedim(-1, 0), known, far_bias=bias)
    depths, colors = torch.where(traced, extended, depths), torch.where(traced, found[..., :4].movedim(-1, 0), mixed)
    others = beyond & ~traced
    if bool(others.any()):
        refilled = far_fill(depths, colors, traced | known, far_bias=bias)
        depths, colors = (torch.where(others, *both) for both in zip(refilled, (depths, colors), strict=True))
    far = apart / mask.shape[1]
    sky = colors[3] * (rays[..., 1] < 0) * (far / AT_ONCE).clamp_max(1)  # there is none below the middle of the photo
    share = torch.maximum((far - MIXED) / (CARRIED - MIXED), sky).clamp(0, 1) * beyond
    return depths, torch.lerp(mixed[:3], colors[:3], share)


def _sky(rgb: Tensor, known: Tensor) -> Tensor:
    """How much known cells [h, w], of sRGB colours [h, w, 3], look like a sky: [h, w] from 0 to 1."""
    seen = known[..., None].float()
    sums = broadly_blurred(torch.cat([rgb * seen, rgb.square() * seen, seen], dim=-1), CALM_CELLS)
    means = sums[..., :6] / sums[..., 6:].clamp_min(LEAST)
    variance = (means[..., 3:] - means[..., :3].square()).sum(-1).clamp_min(0)
    return bright_or_blue(rgb, SKY) * torch.exp(-variance / CALM**2)


def _cells_to_known(mask: Tensor) -> Tensor:
    """[h, w] cells from each masked one to the nearest that is not."""
    near = torch.from_numpy(nearest_known(mask.contiguous().numpy()))
    rows, columns = (torch.arange(size) for size in mask.shape)
    return torch.hypot((near[0] - rows[:, None]).float(), (near[1] - columns).float())
