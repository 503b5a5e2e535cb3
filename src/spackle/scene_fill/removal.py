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
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.core.hole_filling import fill_from_far_side
from spackle.render import get_renderer
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
CONTACT_RATIO = 0.06  # relative distance of a thing from the surface behind it, where it touches it
MAX_COLOR_RATIO = 0.7  # of the distances in colour from the thing and from what surrounds it
OUTLINE_RATIO = 0.1  # relative distance of a thing from the background that makes an outline
OUTLINE_PX = 2  # how far from an outline pixels show both the thing and the background
MAX_FOOT_RATIO = 0.04  # of the picture's diagonal: as far as a foot is looked for at most
# A Gaussian whose share of all pixels together is smaller does not show; only its place counts.
MIN_VISIBLE_PX = 0.1
MIN_SHARE = 0.5  # of what shows of a Gaussian must lie in the thing
# People paint over the outline by at most so much, as a fraction of the picture's diagonal. If at
# least this share of the rest of a mask is in front of the background, depth tells the thing from
# the background; else, as with a poster on a wall or with depths that were guessed from a photo, it
# does not, and all that shows in the mask goes.
ROUGHNESS_RATIO = 0.02
MIN_THING_SHARE = 0.9
MAX_EMPTY_SHARE = 0.05  # of a view's pixels; a view with less emptiness has a background
# Colour of all Gaussians while it is measured in which pixels they show. It keeps the picture away
# from 0 and 1, where it is cut off and would not answer to a Gaussian's colour.
GREY = 0.5


def marked_gaussians(
    gaussians: Gaussians,
    marks: Sequence[tuple[Camera, Tensor]],
    renderer: Renderer | None = None,
    *,
    is_invented: Tensor | None = None,
) -> Tensor:
    """[N] bool: the Gaussians of the thing that masks mark.

    They are those in front of the surfaces that surround a mask in its picture. Where depth does
    not tell a thing from these surfaces, such as a poster on a wall, they are those that show in
    the mask. With several masks, a Gaussian must be in each one whose camera has it in its frame.

    Args:
        gaussians: N Gaussians.
        marks: cameras in the scene's frame, each with its mask [H, W] bool, true on the thing. A
            mask may be larger than the thing.
        renderer: by default the best of this machine, on its GPU if it has one.
        is_invented: [N] bool: Gaussians that a fill has added. Those in a mask are marked, also
            behind the thing, because they were made up while the thing stood there.

    Raises:
        ValueError: there are no marks, or a mask has another size than its camera.
    """
    if not marks:
        raise ValueError("`marks` is empty: give a camera and its mask")
    renderer = renderer or get_renderer()
    device = gaussians.means.device
    gaussians = gaussians.detach().with_harmonics_count(0).to(renderer.device)
    is_marked = torch.zeros(len(gaussians), dtype=torch.bool)
    is_refused = torch.zeros(len(gaussians), dtype=torch.bool)
    for camera, mask in marks:
        if tuple(mask.shape) != (camera.height, camera.width):
            shape = f"{mask.shape[1]}×{mask.shape[0]}" if mask.ndim == 2 else str(mask.shape)
            size = f"{camera.width}×{camera.height}"
            raise ValueError(f"a mask of {shape} pixels for a camera of {size}")
        mask = mask.cpu().bool()
        marked, refused, is_masked = _votes(gaussians, camera, mask, renderer)
        is_marked |= marked
        if is_invented is not None:
            is_marked |= is_invented.cpu() & is_masked
        is_refused |= refused
    return (is_marked & ~is_refused).to(device)


@torch.no_grad()
def uncovered_pixels(
    before: Gaussians, after: Gaussians, cameras: Sequence[Camera], renderer: Renderer
) -> list[Tensor]:
    """[H, W] bool for each camera: the holes that a removal has made and that should be filled.

    They were opaque before. Where the thing stood before nothing, such as the sky of a scene that
    has none, its place stays empty: the emptiness around it is continued into it.

    Args:
        before: the whole scene.
        after: the scene without the thing.
        cameras: the views, in the scene's frame. If the first one sees hardly any emptiness, there
            is a background everywhere.
        renderer: renders the views.
    """
    holes_before = [hole_mask(renderer.render(before, camera).alpha).cpu() for camera in cameras]
    has_background = float(holes_before[0].float().mean()) < MAX_EMPTY_SHARE
    uncovered = []
    for camera, was_open in zip(cameras, holes_before, strict=True):
        opened = hole_mask(renderer.render(after, camera).alpha).cpu() & ~was_open
        if not has_background and not bool(opened.all()):
            # 1 where nothing was, 0 where something was, continued smoothly from around the new
            # holes into them. Only these values matter, so they stand in for the depth, too; with a
            # far bias of 0, all sides count alike.
            openness = was_open.float()
            _, continued = fill_from_far_side(openness, openness[None], ~opened, far_bias=0.0)
            opened &= continued[0] < 0.5  # nearer to something than to nothing
        uncovered.append(opened)
    return uncovered


def _votes(
    gaussians: Gaussians, camera: Camera, mask: Tensor, renderer: Renderer
) -> tuple[Tensor, Tensor, Tensor]:
    """[N] bool three times: the Gaussians that a mask marks, those that its camera sees elsewhere,
    and those with their centres in the mask.

    A Gaussian that lies outside of the camera's frame, or in the mask but not in front, is neither
    marked nor seen elsewhere.

    Args:
        gaussians: N Gaussians, on the renderer's device.
        camera: of the mask.
        mask: [H, W] bool, true on the thing.
        renderer: renders the scene.

    Raises:
        ValueError: the mask marks no pixel.
    """
    if not bool(mask.any()):
        raise ValueError("a mask marks no pixel")
    with torch.no_grad():
        rendering = renderer.render(gaussians, camera).to(torch.device("cpu"))

    # Even a mask that follows the outline cuts Gaussians there in two, so it is widened a little.
    fringe_px = round(FRINGE_RATIO * math.hypot(camera.width, camera.height))
    wide_mask = maximum_filter(mask, max(1, fringe_px))

    # The pixels of the mask that are in front of the background by the margin, a ratio of depths.
    thing, background, margin = _thing_in_picture(rendering, wide_mask)

    # The thing goes on where depth does not tell it from the background: in the fringe, over which
    # its colour reaches, and at its foot, where it touches what it stands on. For what is visible,
    # the foot begins where the thing is less than twice the margin in front; for what is hidden,
    # which must also have the thing's colour, where it is as near as things that touch.
    fringe = maximum_filter(thing, fringe_px) & wide_mask & ~thing
    fringe |= _foot(thing, rendering, background, margin, 2 * margin) & wide_mask & ~thing
    contact = _foot(thing, rendering, background, margin, CONTACT_RATIO)

    # A poster on a wall is nowhere in front of the wall. Then all that the mask shows is the thing.
    surface_margin = margin
    if not _tells_thing(thing | fringe, mask):
        fringe = mask
        contact = mask
        surface_margin = CONTACT_RATIO

    # Each Gaussian's place in the picture, as the index of its pixel, row by row.
    means = gaussians.means.cpu().double()
    uv, z = camera.to("cpu", torch.float64).project(means)
    column = uv[:, 0].floor()
    row = uv[:, 1].floor()
    is_inside = camera.has_in_frame(uv, z)
    index = torch.where(is_inside, row * camera.width + column, 0).long()

    def at_center(image: Tensor) -> Tensor:
        """The values [N] of an image [H, W] at the Gaussians' centres."""
        return image.flatten()[index]

    inverse_depth = torch.where(is_inside, 1 / z, 0)
    in_front = inverse_depth > at_center(background) * (1 + margin)
    is_masked = is_inside & at_center(wide_mask)

    # Of a Gaussian that shows, what shows decides, because it may reach over the outline. Of one
    # that is hidden, only the centre is known.
    shown, shown_in_thing = _shown_pixels(
        gaussians, camera, [torch.ones_like(mask), thing | fringe], renderer
    )
    is_visible = shown > MIN_VISIBLE_PX
    mostly_in_thing = shown_in_thing > MIN_SHARE * shown

    # The surface of the background shines through a thing a little, but lies behind its surface.
    on_surface = z < at_center(rendering.depth) * (1 + surface_margin)
    is_own = is_visible & mostly_in_thing & (in_front | on_surface)
    is_inner = ~is_visible & is_masked & in_front

    # Beneath the surface of a thing often lies a second layer of it, which where the thing stands
    # on a floor is no longer in front of the floor. There, the colour tells it from the floor.
    is_contact = is_masked & at_center(contact)
    is_near_floor = z * at_center(background) < 1 + CONTACT_RATIO  # its depth by the floor's
    has_color = _has_color_of_thing(gaussians, index, rendering, wide_mask)
    is_layer = ~is_visible & is_contact & is_near_floor & has_color
    is_marked = is_own | is_inner | is_layer

    # What this camera sees outside of its mask is not the thing, whatever other masks say.
    is_refused = is_inside & ~is_masked & ~is_marked
    return is_marked, is_refused, is_masked


def _has_color_of_thing(
    gaussians: Gaussians, index: Tensor, rendering: Rendering, wide_mask: Tensor
) -> Tensor:
    """[N] bool: the Gaussians whose colour is nearer to what a view shows at their place than to
    the colours around the mask.

    Args:
        gaussians: N Gaussians.
        index: [N] the place of each one's pixel in the picture, row by row.
        rendering: the view.
        wide_mask: [H, W] bool.
    """
    # If nothing is around the mask, there is no other colour to which a Gaussian could belong.
    if bool(wide_mask.all()):
        return torch.ones_like(index, dtype=torch.bool)

    # The thing's colour is what the view shows at a Gaussian's place. The background's is continued
    # into the mask from around it; with equal depths, all of what is around counts alike.
    shown = rendering.rgb.flatten(0, 1)[index]  # [N, 3]
    flat = torch.ones(wide_mask.shape)
    _, around = fill_from_far_side(flat, rendering.rgb.movedim(-1, 0), ~wide_mask, far_bias=0.0)
    around_there = around.movedim(0, -1).flatten(0, 1)[index]  # [N, 3]

    # Clearly nearer: a Gaussian between the two colours stays.
    own = linear_to_srgb(gaussians.colors.cpu())
    from_thing = (own - shown).norm(dim=-1)
    from_around = (own - around_there).norm(dim=-1)
    has_color: Tensor = from_thing < MAX_COLOR_RATIO * from_around
    return has_color


def _thing_in_picture(rendering: Rendering, wide_mask: Tensor) -> tuple[Tensor, Tensor, float]:
    """Where a masked thing is visible, and what lies behind it.

    Args:
        rendering: the view.
        wide_mask: [H, W] bool.

    Returns:
        [H, W] bool: the masked pixels that show something in front of the background; the
        background's inverse depth [H, W]; and the margin: what is in front of the background has
        more than (1 + margin) times its inverse depth.
    """
    is_open = hole_mask(rendering.alpha)
    behind = background_depth(rendering.depth, is_open, wide_mask)
    # The background's own noise must not be taken for things in front of it.
    margin = min(max(NOISE_SIGMAS * behind.noise, MIN_MARGIN), MAX_MARGIN)
    nearness = 1 / rendering.depth.clamp_min(1e-30)  # inverse depth of what is visible
    in_front = nearness > behind.inverse_depth * (1 + margin)
    thing = wide_mask & in_front & (rendering.alpha > 0)
    return thing, behind.inverse_depth, margin


def _tells_thing(thing: Tensor, mask: Tensor) -> bool:
    """Whether what is in front of the background fills a mask, but for what is roughly painted.

    Args:
        thing: [H, W] bool: the pixels that show something in front of the background.
        mask: [H, W] bool.
    """
    roughness_px = round(ROUGHNESS_RATIO * math.hypot(*mask.shape))
    core = mask & ~maximum_filter(~mask, roughness_px)
    if not bool(core.any()):
        core = mask
    return int((thing & core).sum()) >= MIN_THING_SHARE * int(core.sum())


def _foot(
    thing: Tensor, rendering: Rendering, background: Tensor, margin: float, height: float
) -> Tensor:
    """[H, W] bool: the pixels in which a thing may touch the surface that it stands on.

    Where a thing rises from a floor, it is hardly nearer than the floor that is seen beside it, so
    depth cannot tell the two apart. A little higher up in the picture, the floor behind the thing
    is farther away. The foot reaches until this distance is the margin: from there on, depth tells.

    Args:
        thing: [H, W] bool: the pixels in which the thing is in front of the background.
        rendering: the view.
        background: [H, W] inverse depth behind the thing.
        margin: the thing has at least (1 + margin) times the background's inverse depth.
        height: the foot has at most (1 + height) times the background's inverse depth.
    """
    nearness = 1 / rendering.depth.clamp_min(1e-30)  # inverse depth of what is visible
    # The lowest part of the thing, just in front of the background.
    rising = thing & (nearness < background * (1 + height))
    # At an outline before a far background, too, pixels lie between the two depths: they show both.
    is_far_in_front = nearness > background * (1 + OUTLINE_RATIO)
    rising &= ~maximum_filter(is_far_in_front, OUTLINE_PX)
    if not bool(rising.any()):
        return rising
    # How fast the background recedes from row to row and column to column, relative to its depth.
    logarithm = background.clamp_min(1e-30).log()
    down, right = torch.gradient(logarithm)
    recession = float(torch.hypot(down, right)[rising].median())
    # After so many pixels, the background has receded by the margin.
    largest_px = MAX_FOOT_RATIO * math.hypot(*thing.shape)
    reach_px = largest_px if recession <= 0 else min(largest_px, margin / recession)
    return maximum_filter(rising, math.ceil(reach_px))


def _shown_pixels(
    gaussians: Gaussians, camera: Camera, regions: Sequence[Tensor], renderer: Renderer
) -> list[Tensor]:
    """In how many pixels of up to three regions [H, W] each Gaussian shows, [N] for each region.

    A pixel that is shared with others counts in part.
    """
    # A pixel's light is the sum of the Gaussians' light, each times its weight in this pixel. So
    # the derivative of a region's light by that of a Gaussian is the sum of its weights there: the
    # number of pixels. Each region is measured in a colour channel of its own, all in one go.
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
