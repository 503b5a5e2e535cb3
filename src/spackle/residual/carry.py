"""Carrying what fills the holes from one frame of a clip into the next, so that it does not flicker.

Each frame's completion knows nothing of the others. Here its aux Gaussians keep their places but take on the colours
that stood there a frame ago, followed back by the motion of what is behind. Where an earlier frame has seen what is
hidden now, that is the truth, and it is carried as such. All blending is of linear light.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.camera import Camera
from spackle.color import srgb_to_linear
from spackle.fill import far_fill
from spackle.gaussians import Gaussians
from spackle.render import Renderer, touched_tiles
from spackle.rendering import Rendering
from spackle.residual.cues import CELL, hole_mask
from spackle.residual.motion import Flow, Track, extend, inside, pixel_grid, sample, track

KEEP = 0.98  # of the trust in a colour, from frame to frame: what was seen outlives fifty frames
GUESS = 0.9  # trust in what a completion made up; what was seen has 1
NEARER = 0.1  # a past that stood this much nearer, relatively, is something else
CARRIED = 0.5  # more weight than this on the past, and the pixel counts as carried
THIN = 0.05  # least share of a pixel's light that is divided by
FAINT = 0.25  # what has a smaller share of a pixel is too uncertain to be remembered
MAX_GAIN = 2.0  # of the exposure, between two frames


@dataclasses.dataclass(frozen=True)
class Memory:
    """What is known of a view once its frame is done."""

    shown: Tensor  # [H, W, 3] sRGB of the completed view
    light: Tensor  # [H, W, 3] linear: what was seen, and in the holes what stands behind their veil
    inverse_depth: Tensor  # [H, W] of the same, positive
    trust: Tensor  # [H, W] in 0..1: 1 where it was seen, about KEEP^n where that was n frames ago


@dataclasses.dataclass(frozen=True)
class Frame:
    """A completed view whose holes are as they were, as far as they were there."""

    aux: Gaussians
    view: Rendering
    memory: Memory
    flow: Tensor | None  # [H, W, 2] into the view before, holes included; None where there is none


def carry(
    base: Gaussians,
    aux: Gaussians,
    camera: Camera,
    renderer: Renderer,
    views: Sequence[Rendering],
    past: Memory | None,
    flow: Flow,
) -> Frame:
    """Give the aux Gaussians of a frame the colours of the past.

    Args:
        base: the frame's own Gaussians.
        aux: what completes them in this view, made without the past.
        camera: the view.
        renderer: draws the view again.
        views: the view of the base alone, and with `aux`.
        past: of the view before; None at the start. One of another shot is passed over, see `Track.same_shot`.
        flow: finds the motion between two pictures.
    """
    before, own = views
    hole = hole_mask(before.alpha)
    made_up, inverse_depth = behind(before, own, hole)
    share = torch.where(hole, own.alpha - before.alpha, 1.0).clamp_min(0)
    start = Memory(own.rgb, made_up, inverse_depth, _trust(hole, share, torch.zeros_like(share)))
    found = None if past is None else track(own.rgb, past.shown, flow)
    if past is None or found is None or not found.same_shot(~hole):
        return Frame(aux, own, start, None)
    motion = extend(found, inverse_depth, ~hole, camera)
    if not bool(hole.any()):
        return Frame(aux, own, start, motion)
    recalled, weight = _recall(past, pixel_grid(motion) + motion, inverse_depth)
    recalled = recalled * _exposure(made_up, past, found, hole)
    weight = torch.where(hole, KEEP * weight, 0.0)
    fresh = made_up + _beside(recalled - made_up, hole, weight, inverse_depth)
    blended = (fresh + weight[..., None] * (recalled - fresh)).clamp(0, 1)
    light = torch.where(hole[..., None], blended, made_up)
    # In what is faint, a cell's own colour is all noise: no change can be told from it.
    changed = _recoloured(aux, camera, light - made_up, torch.where(hole & (share >= FAINT), share, 0.0))
    view = renderer.render([base, changed], camera, tiles=touched_tiles(aux, camera), onto=own)
    return Frame(changed, view, Memory(view.rgb, light, inverse_depth, _trust(hole, share, weight)), motion)


def _trust(hole: Tensor, share: Tensor, weight: Tensor) -> Tensor:
    """[H, W] trust in a view's light: what is seen has 1, what fills a hole its past's weight or that of a guess."""
    filled = torch.where(share < FAINT, 0.0, weight.clamp_min(GUESS))
    return torch.where(hole, filled, 1.0)


def behind(before: Rendering, own: Rendering, hole: Tensor) -> tuple[Tensor, Tensor]:
    """Linear light [H, W, 3] and inverse depth [H, W] of a view; in holes those of what was added to the base."""
    share = (own.alpha - before.alpha).clamp_min(THIN)
    there, now = srgb_to_linear(before.rgb), srgb_to_linear(own.rgb)
    added = ((now - there) / share[..., None]).clamp(0, 1)
    depth = (own.depth * own.alpha - before.depth * before.alpha) / share
    depth = torch.where(hole & (depth > 0), depth, own.depth)
    inverse = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    smallest = inverse[inverse > 0].min() if bool((inverse > 0).any()) else inverse.new_tensor(1.0)
    return torch.where(hole[..., None], added, now), torch.where(inverse > 0, inverse, smallest)


def _recall(past: Memory, uv: Tensor, inverse_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Light [H, W, 3] that stood at uv [H, W, 2] in the past, and how far it is trusted, [H, W].

    Of the four pixels around, those count that do not stand clearly nearer than what is looked for: they are
    the edge of the thing that hides it.
    """
    height, width = past.trust.shape
    corner = (uv - 0.5).floor()
    part = uv - 0.5 - corner
    light, mass, trust = torch.zeros_like(past.light), torch.zeros_like(past.trust), torch.zeros_like(past.trust)
    for dy in (0, 1):
        for dx in (0, 1):
            column = (corner[..., 0].long() + dx).clamp(0, width - 1)
            row = (corner[..., 1].long() + dy).clamp(0, height - 1)
            share = (part[..., 0] if dx else 1 - part[..., 0]) * (part[..., 1] if dy else 1 - part[..., 1])
            nearer = (past.inverse_depth[row, column] / inverse_depth - 1).clamp_min(0)
            share = share * torch.exp(-((nearer / NEARER) ** 2)) * (past.trust[row, column] > 0)
            light += share[..., None] * past.light[row, column]
            trust += share * past.trust[row, column]
            mass += share
    there = inside(uv, height, width)
    return light / mass.clamp_min(1e-6)[..., None], torch.where(there, trust, 0.0)


def _exposure(light: Tensor, past: Memory, found: Track, hole: Tensor) -> Tensor:
    """[3] how much brighter the frame is than the one before, where both show the same."""
    same = found.sure & ~hole
    was = sample(past.light, pixel_grid(light) + found.flow)[same]
    gain = light[same].mean(0) / was.mean(0).clamp_min(1e-4)
    return torch.nan_to_num(gain, nan=1.0).clamp(1 / MAX_GAIN, MAX_GAIN)


def _beside(change: Tensor, hole: Tensor, weight: Tensor, inverse_depth: Tensor) -> Tensor:
    """The change [H, W, 3] of what is carried, spread over what is new, down to nothing at the rim: no seams."""
    carried = weight > CARRIED
    known = ~hole | carried
    values = torch.where(carried[..., None], change, 0.0).permute(2, 0, 1)
    if not bool(carried.any()) or bool(known.all()):
        return torch.zeros_like(change)
    _, spread = far_fill(inverse_depth, values, known, far_bias=0.0)
    return torch.where(known[..., None], 0.0, spread.permute(1, 2, 0))


def _recoloured(aux: Gaussians, camera: Camera, change: Tensor, share: Tensor) -> Gaussians:
    """Aux Gaussians whose colours change as the pixels [H, W, 3] of their cells do, on the mean over their shares."""
    weighted = torch.cat([change * share[..., None], share[..., None]], dim=-1)
    sums = avg_pool2d(weighted.permute(2, 0, 1)[None], CELL, ceil_mode=True)[0]
    mean = sums[:3] / sums[3:].clamp_min(1e-6)
    uv, _ = camera.project(aux.means)
    column, row = (uv / CELL).floor().long().unbind(-1)
    height, width = mean.shape[1:]
    picked = mean[:, row.clamp(0, height - 1), column.clamp(0, width - 1)].T
    return dataclasses.replace(aux, colors=(aux.colors + picked).clamp(0, 1))


def flicker(view: Tensor, earlier: Tensor, flow: Tensor, chosen: Tensor) -> float | None:
    """Mean absolute difference of a view [H, W, 3] from an earlier one that is warped by a flow [H, W, 2].

    Args:
        view: sRGB.
        earlier: sRGB, of the same size.
        flow: from the view's pixels to the earlier one's.
        chosen: [H, W] bool, the pixels that count.

    Returns:
        In sRGB of 0..1; None where no pixel counts.
    """
    uv = pixel_grid(flow) + flow
    chosen = chosen & inside(uv, *chosen.shape)
    if not bool(chosen.any()):
        return None
    return float((view - sample(earlier, uv)).abs().mean(-1)[chosen].mean())
