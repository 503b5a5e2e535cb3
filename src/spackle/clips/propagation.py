"""Give the filled holes of a frame the colours of the previous frame, so that they do not flicker.

The paper completes single views. In a clip, the aux Gaussians of a frame (those that fill its
holes) take colours from the previous view; colours that a frame of the clip showed weigh more than
made-up ones. All blending is in linear light.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.clips.flow import Flow, Track, extend_flow, inside, pixel_grid, sample, track
from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.hole_filling import fill_from_far_side
from spackle.render import Renderer, touched_tiles
from spackle.render.protocol import Rendering
from spackle.residual.features import CELL, TINY, hole_mask

# Factor on the trust in a colour per frame: a colour that was seen lasts over fifty frames.
TRUST_DECAY = 0.98
COMPLETED_TRUST = 0.9  # trust in a completed colour; that in a colour from the photo is 1
# A pixel of the previous frame nearer by this relative difference belongs to another surface.
NEARER_SURFACE_RATIO = 0.1
# A pixel in which the previous frame has more weight counts as propagated.
MIN_PROPAGATED_WEIGHT = 0.5
MIN_LIGHT_SHARE = 0.05  # lower bound of a share of a pixel's light, for safe division
# The colour of aux Gaussians is not remembered where they give a smaller share of a pixel's light.
MIN_REMEMBERED_SHARE = 0.25
MAX_EXPOSURE_GAIN = 2.0  # largest change of exposure between two frames


@dataclasses.dataclass(frozen=True)
class FrameMemory:
    """The state of a completed view that the next frame needs."""

    rendering: Rendering  # of the completed view
    # [H, W, 3] linear light of the view; in holes the light of the aux Gaussians alone.
    light: Tensor
    inverse_depth: Tensor  # [H, W] of the same surfaces, positive
    # [H, W] in 0..1: 1 if the base shows the pixel, about TRUST_DECAY^n if a base showed it n
    # frames ago.
    trust: Tensor


def propagate_colors(
    base: Gaussians,
    aux: Gaussians,
    camera: Camera,
    renderer: Renderer,
    renderings: tuple[Rendering, Rendering],
    previous: FrameMemory | None,
    flow: Flow,
) -> tuple[Gaussians, FrameMemory]:
    """Give the aux Gaussians of a frame colours of the previous view.

    Args:
        base: the Gaussians that the frame shows.
        aux: the Gaussians that fill the holes of the view, made without earlier frames.
        camera: the view.
        renderer: renders the view again.
        renderings: of the view, with the base alone, and with `aux`.
        previous: memory of the previous view; None at the start. A view of another shot, which
            shows less than 30 % of this view's content, is ignored.
        flow: finds the optical flow between two images.

    Returns:
        The recoloured Gaussians, and the memory for the next frame.
    """
    base_rendering, rendering = renderings
    hole = hole_mask(base_rendering.alpha)
    completed_light, inverse_depth = surfaces_behind_base(base_rendering, rendering, hole)
    aux_share = torch.where(hole, rendering.alpha - base_rendering.alpha, 1.0).clamp_min(0)
    no_weight = torch.zeros_like(aux_share)
    memory = FrameMemory(
        rendering, completed_light, inverse_depth, _trust(hole, aux_share, no_weight)
    )
    if previous is None or not bool(hole.any()):
        return aux, memory
    tracked = track(rendering.rgb, previous.rendering.rgb, flow)
    if not tracked.same_shot(~hole):
        return aux, memory

    # What the previous view shows at each pixel, at this frame's exposure.
    motion = extend_flow(tracked, inverse_depth, ~hole, camera)
    recalled, weight = _recall(previous, pixel_grid(motion) + motion, inverse_depth)
    recalled = recalled * _exposure_gain(previous, completed_light, tracked, hole)
    weight = torch.where(hole, TRUST_DECAY * weight, 0.0)

    # Pixels of a hole that the previous view does not show are fresh. Their completed colour takes
    # over the change of the pixels around that the previous view shows.
    change = recalled - completed_light
    fresh = completed_light + _change_of_new_pixels(change, hole, weight, inverse_depth)
    blended = (fresh + weight[..., None] * (recalled - fresh)).clamp(0, 1)
    light = torch.where(hole[..., None], blended, completed_light)

    # The colour of a faint cell is too noisy to measure a change.
    change_weight = torch.where(hole & (aux_share >= MIN_REMEMBERED_SHARE), aux_share, 0.0)
    recolored = _recolored(aux, camera, light - completed_light, change_weight)
    recolored_rendering = renderer.render(
        [base, recolored],
        camera,
        tiles=touched_tiles(aux, camera),
        previous_rendering=rendering,
    )
    trust = _trust(hole, aux_share, weight)
    return recolored, FrameMemory(recolored_rendering, light, inverse_depth, trust)


def _trust(hole: Tensor, aux_share: Tensor, weight: Tensor) -> Tensor:
    """[H, W] in 0..1: how much the next frame may trust the colour of each pixel.

    Args:
        hole: [H, W] bool: pixels that the frame does not show; all others have trust 1.
        aux_share: [H, W] share of a pixel's light that comes from the Gaussians that fill holes.
        weight: [H, W] share of a pixel's colour that was taken from the previous frame. The share
            is the trust in that colour.
    """
    # A colour in a hole was taken from the previous frame, and keeps its trust, or the completion
    # made it up, and has a fixed trust (0.9). Where the Gaussians are too faint, their colour
    # cannot be measured, and has no trust.
    trust_in_hole = weight.clamp_min(COMPLETED_TRUST)
    trust_in_hole = torch.where(aux_share < MIN_REMEMBERED_SHARE, 0.0, trust_in_hole)
    return torch.where(hole, trust_in_hole, 1.0)


def surfaces_behind_base(
    base_rendering: Rendering, rendering: Rendering, hole: Tensor
) -> tuple[Tensor, Tensor]:
    """Light and depth of a view; in holes, only those of the Gaussians that fill them.

    "Base" Gaussians are what the frame shows, "aux" Gaussians fill the holes that it leaves.

    Args:
        base_rendering: of the base Gaussians alone.
        rendering: of base and aux Gaussians.
        hole: [H, W] bool: pixels that the base does not cover.

    Returns:
        Linear light [H, W, 3], and inverse depth [H, W], positive; where nothing was drawn, it is
        the smallest of all.
    """
    # A pixel is the sum of each Gaussian's light times its weight, and alpha is the sum of weights.
    # So the light of the aux Gaussians is what they add to the light, divided by what they add to
    # alpha.
    aux_share = (rendering.alpha - base_rendering.alpha).clamp_min(MIN_LIGHT_SHARE)
    base_light = srgb_to_linear(base_rendering.rgb)
    light = srgb_to_linear(rendering.rgb)
    aux_light = ((light - base_light) / aux_share[..., None]).clamp(0, 1)

    # The same for depth, which a rendering divides by alpha.
    depth_sum = rendering.depth * rendering.alpha
    base_depth_sum = base_rendering.depth * base_rendering.alpha
    aux_depth = (depth_sum - base_depth_sum) / aux_share
    depth = torch.where(hole & (aux_depth > 0), aux_depth, rendering.depth)

    # Where nothing was drawn, the inverse depth must still be positive.
    inverse_depth = torch.where(depth > 0, 1 / depth.clamp_min(TINY), 0.0)
    is_drawn = inverse_depth > 0
    farthest = inverse_depth.new_tensor(1.0)
    if bool(is_drawn.any()):
        farthest = inverse_depth[is_drawn].min()
    return (
        torch.where(hole[..., None], aux_light, light),
        torch.where(is_drawn, inverse_depth, farthest),
    )


def _recall(previous: FrameMemory, uv: Tensor, inverse_depth: Tensor) -> tuple[Tensor, Tensor]:
    """What the previous view shows at given positions, bilinearly, without nearer surfaces.

    Args:
        previous: the previous view.
        uv: [H, W, 2] positions (x, y) in its pixels, one for each pixel of this view.
        inverse_depth: [H, W] of the surface that each pixel of this view shows. Where the previous
            view has a nearer surface at the position, it does not show this one.

    Returns:
        Linear light [H, W, 3], the weighted mean of the four pixels around the position, and trust
        [H, W] in 0..1: low where a nearer surface hides the one of this view, 0 outside of the
        previous view.
    """
    height, width = previous.trust.shape
    corner = (uv - 0.5).floor()  # of the four pixels around, that with the lowest indices
    fraction = uv - 0.5 - corner
    light = torch.zeros_like(previous.light)
    trust = torch.zeros_like(previous.trust)
    weight_sum = torch.zeros_like(previous.trust)
    for dy in (0, 1):
        for dx in (0, 1):
            column = (corner[..., 0].long() + dx).clamp(0, width - 1)
            row = (corner[..., 1].long() + dy).clamp(0, height - 1)
            weight_x = fraction[..., 0] if dx == 1 else 1 - fraction[..., 0]
            weight_y = fraction[..., 1] if dy == 1 else 1 - fraction[..., 1]

            # By how much the previous view is nearer, relative to this one. Their depths can be
            # compared, because those of a clip are aligned, and because the camera moves so little
            # between two frames that the depth of a surface hardly changes.
            nearer = (previous.inverse_depth[row, column] / inverse_depth - 1).clamp_min(0)
            # From 1 for the same surface down to 0 for one that is clearly nearer.
            same_surface_weight = torch.exp(-((nearer / NEARER_SURFACE_RATIO) ** 2))
            has_trust = previous.trust[row, column] > 0
            weight = weight_x * weight_y * same_surface_weight * has_trust
            light += weight[..., None] * previous.light[row, column]
            trust += weight * previous.trust[row, column]
            weight_sum += weight

    # The light is divided by the sum of weights, so that hidden pixels do not darken it. The trust
    # is not: without hidden pixels the weights add up to 1, and what is missing lowers the trust.
    mean_light = light / weight_sum.clamp_min(1e-6)[..., None]
    return mean_light, torch.where(inside(uv, height, width), trust, 0.0)


def _exposure_gain(previous: FrameMemory, light: Tensor, tracked: Track, hole: Tensor) -> Tensor:
    """[3]: how much brighter this frame is than the previous one, by channel, at most twice.

    It is measured on the surfaces that both frames show.

    Args:
        previous: the previous view.
        light: [H, W, 3] linear light of this view.
        tracked: the flow from this view to the previous one.
        hole: [H, W] bool: pixels that the base does not cover.
    """
    in_both = tracked.reliable & ~hole
    previous_light = sample(previous.light, pixel_grid(light) + tracked.flow)[in_both]  # [n, 3]
    gain = light[in_both].mean(0) / previous_light.mean(0).clamp_min(1e-4)
    # Without such surfaces, the means are NaN.
    gain = torch.nan_to_num(gain, nan=1.0)
    return gain.clamp(1 / MAX_EXPOSURE_GAIN, MAX_EXPOSURE_GAIN)


def _change_of_new_pixels(
    change: Tensor, hole: Tensor, weight: Tensor, inverse_depth: Tensor
) -> Tensor:
    """[H, W, 3]: the change of a hole's propagated pixels, spread over its new pixels.

    A hole's pixel is propagated if its colour comes mainly from the previous view, and else new.
    The spread change falls to 0 at the hole's rim, and is 0 at all pixels that are not new.

    Args:
        change: [H, W, 3] the previous view's linear light, at this frame's exposure, minus that of
            this view, as it was completed without earlier frames.
        hole: [H, W] bool: pixels that the base does not cover.
        weight: [H, W] of the previous view's colour; where it is over ½, a pixel is propagated.
        inverse_depth: [H, W] of the view.
    """
    is_propagated = weight > MIN_PROPAGATED_WEIGHT
    known = ~hole | is_propagated
    if not bool(is_propagated.any()) or bool(known.all()):
        return torch.zeros_like(change)

    # The change is known at propagated pixels, and is 0 outside of the hole. Between them it is
    # interpolated smoothly. `far_bias` is 0, because a change of colour belongs to neither surface
    # at the rim, so that near and far pixels count alike.
    known_change = torch.where(is_propagated[..., None], change, 0.0).permute(2, 0, 1)
    _, spread = fill_from_far_side(inverse_depth, known_change, known, far_bias=0.0)
    return torch.where(known[..., None], 0.0, spread.permute(1, 2, 0))


def _recolored(aux: Gaussians, camera: Camera, change: Tensor, weight: Tensor) -> Gaussians:
    """The Gaussians that fill holes, with the mean change of colour in their cell added.

    A cell has 2×2 pixels.

    Args:
        aux: the Gaussians.
        camera: the view, in which each Gaussian lies in one cell.
        change: [H, W, 3] of linear light.
        weight: [H, W] of each pixel's change in the mean.
    """
    weighted = torch.cat([change * weight[..., None], weight[..., None]], dim=-1)  # [H, W, 4]
    cell_means = avg_pool2d(weighted.permute(2, 0, 1)[None], CELL, ceil_mode=True)[0]  # [4, h, w]
    # The mean of change times weight, divided by the mean weight, is the weighted mean.
    mean_change = cell_means[:3] / cell_means[3:].clamp_min(1e-6)

    uv, _ = camera.project(aux.means)
    column, row = (uv / CELL).floor().long().unbind(-1)  # [N]
    height, width = mean_change.shape[1:]
    own_change = mean_change[:, row.clamp(0, height - 1), column.clamp(0, width - 1)].T  # [N, 3]
    return dataclasses.replace(aux, colors=(aux.colors + own_change).clamp(0, 1))
