"""Which Gaussians belong to a thing that somebody has marked in pictures of a scene.

A mask marks what is visible. Behind it lie the thing's inside and back, which belong to it, and
then the background, which must stay. So everything in front of the background is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.render.protocol import Renderer, Rendering
from spackle.residual.features import hole_mask
from spackle.scene_fill.background_depth import background_depth

# A thing's colour reaches so far over its outline, as a fraction of the picture's diagonal.
FRINGE_RATIO = 0.002
# What is nearer than the background by so many standard deviations of the background's noise is in
# front of it; as a ratio of depths it is between the two bounds.
NOISE_SIGMAS = 3.0
MIN_MARGIN = 0.01
MAX_MARGIN = 0.05
# A Gaussian whose share of all pixels together is smaller does not show; only its place counts.
MIN_VISIBLE_PX = 0.1
MIN_SHARE = 0.5  # of what shows of a Gaussian must lie in the thing
# If less of a mask shows something in front of the background, the mask marks a part of a surface,
# such as a poster on a wall.
MIN_THING_SHARE = 0.05
GREY = 0.5  # colour of all Gaussians while it is measured in which pixels they show


def marked_gaussians(
    gaussians: Gaussians, marks: Sequence[tuple[Camera, Tensor]], renderer: Renderer
) -> Tensor:
    """[N] bool: the Gaussians of the thing that masks mark.

    They are those in front of the surfaces that surround a mask in its picture; if nothing is, such
    as in the mask of a poster on a wall, those that show in the mask. With several masks, a
    Gaussian must be marked by each one whose camera could see it.

    Args:
        gaussians: N Gaussians.
        marks: cameras in the scene's frame, each with its mask [H, W] bool, true on the thing. A
            mask may be larger than the thing.
        renderer: renders the scene as the cameras see it.

    Raises:
        ValueError: there are no marks, or a mask has another size than its camera.
    """
    if not marks:
        raise ValueError("`marks` is empty: give a camera and its mask")
    device = gaussians.means.device
    gaussians = gaussians.detach().with_harmonics_count(0).to(renderer.device)
    is_marked = torch.zeros(len(gaussians), dtype=torch.bool)
    is_refused = torch.zeros(len(gaussians), dtype=torch.bool)
    for camera, mask in marks:
        if tuple(mask.shape) != (camera.height, camera.width):
            shape = f"{mask.shape[1]}×{mask.shape[0]}" if mask.ndim == 2 else str(mask.shape)
            size = f"{camera.width}×{camera.height}"
            raise ValueError(f"a mask of {shape} pixels for a camera of {size}")
        marked, refused = _votes(gaussians, camera, mask.cpu().bool(), renderer)
        is_marked |= marked
        is_refused |= refused
    return (is_marked & ~is_refused).to(device)


def _votes(
    gaussians: Gaussians, camera: Camera, mask: Tensor, renderer: Renderer
) -> tuple[Tensor, Tensor]:
    """[N] bool twice: the Gaussians that a mask marks, and those that its camera sees elsewhere.

    A Gaussian that lies outside of the camera's frame, or in the mask but not in front, is neither.
    """
    if not bool(mask.any()):
        raise ValueError("a mask marks no pixel")
    with torch.no_grad():
        rendering = renderer.render(gaussians, camera).to(torch.device("cpu"))
    fringe_px = round(FRINGE_RATIO * math.hypot(camera.width, camera.height))
    # Even a mask that follows the outline cuts Gaussians there in two.
    wide_mask = maximum_filter(mask, max(1, fringe_px))
    thing, background, margin = _thing_in_picture(rendering, wide_mask)
    fringe = maximum_filter(thing, fringe_px) & wide_mask & ~thing
    if int(thing.sum()) < MIN_THING_SHARE * int(mask.sum()):
        fringe = mask

    # Each Gaussian's place in the picture.
    means = gaussians.means.cpu().double()
    uv, z = camera.to("cpu", torch.float64).project(means)
    column = uv[:, 0].floor()
    row = uv[:, 1].floor()
    is_inside = (z > 0) & (column >= 0) & (column < camera.width)
    is_inside &= (row >= 0) & (row < camera.height)
    index = torch.where(is_inside, row * camera.width + column, 0).long()

    def at_center(image: Tensor) -> Tensor:
        """The values [N] of an image [H, W] at the Gaussians' centres."""
        return image.flatten()[index]

    inverse_depth = torch.where(is_inside, 1 / z, 0)
    in_front = inverse_depth > at_center(background) * (1 + margin)
    is_masked = is_inside & at_center(wide_mask)

    # Of a Gaussian that shows, what shows decides, because it may reach over the outline. Of one
    # that is hidden, only the centre is known.
    shown, shown_in_thing, shown_in_fringe = _shown_pixels(
        gaussians, camera, [torch.ones_like(mask), thing | fringe, fringe], renderer
    )
    is_visible = shown > MIN_VISIBLE_PX
    mostly_in_thing = shown_in_thing > MIN_SHARE * shown
    mostly_in_fringe = shown_in_fringe > MIN_SHARE * shown
    is_own = in_front & torch.where(is_visible, mostly_in_thing, is_masked)
    is_fringe = is_visible & mostly_in_fringe
    is_marked = is_own | is_fringe

    is_refused = is_inside & ~is_masked & ~is_marked
    return is_marked, is_refused


def _thing_in_picture(rendering: Rendering, wide_mask: Tensor) -> tuple[Tensor, Tensor, float]:
    """Where a masked thing is visible, and what lies behind it.

    Args:
        rendering: the view.
        wide_mask: [H, W] bool.

    Returns:
        [H, W] bool: the masked pixels that show something in front of the background; the
        background's inverse depth [H, W]; and by which ratio less the depth of something in front
        of the background is at least.
    """
    is_open = hole_mask(rendering.alpha)
    behind = background_depth(rendering.depth, is_open, wide_mask)
    margin = min(max(NOISE_SIGMAS * behind.noise, MIN_MARGIN), MAX_MARGIN)
    nearness = 1 / rendering.depth.clamp_min(1e-30)
    in_front = nearness > behind.inverse_depth * (1 + margin)
    thing = wide_mask & in_front & (rendering.alpha > 0)
    return thing, behind.inverse_depth, margin


def _shown_pixels(
    gaussians: Gaussians, camera: Camera, regions: Sequence[Tensor], renderer: Renderer
) -> list[Tensor]:
    """In how many pixels of up to three regions [H, W] each Gaussian shows, [N] for each region.

    A pixel that is shared with others counts in part. It is the derivative of the picture's light
    by the Gaussian's own: each region is asked in a colour of its own.
    """
    colors = torch.full_like(gaussians.colors, GREY).requires_grad_()
    grey = Gaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors
    )
    with torch.enable_grad():
        light = srgb_to_linear(renderer.render(grey, camera).rgb)  # [H, W, 3]
        total = light.new_zeros(())
        for channel, region in enumerate(regions):
            total = total + (light[..., channel] * region.to(light.device)).sum()
        total.backward()  # type: ignore[no-untyped-call]
    assert colors.grad is not None
    return [colors.grad[:, channel].cpu() for channel in range(len(regions))]
