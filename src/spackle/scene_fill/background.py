"""Which empty pixels of a view are background, such as sky, and which are holes to be filled.

The rule: where at least half of the cameras see no emptiness, or one camera sees the whole scene
without any (a photo's own camera), nothing is background. Elsewhere, a region of emptiness that is
open to the picture's border is background, unless a single side of the picture cuts it off and the
space behind it is hidden from the other cameras, as beneath a lawn. A region that surfaces enclose
is a hole, unless the other cameras see that nothing is behind it, as behind a cup's handle.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.filters import maximum_filter, nearest_known_pixels
from spackle.core.gaussians import Gaussians
from spackle.render.protocol import Rendering
from spackle.residual.features import hole_mask
from spackle.runtime.kernels import kernel

# A view with a smaller fraction of empty pixels sees no emptiness: a photo's own view has some at
# its edges between surfaces.
CLOSED_VIEW_RATIO = 0.01
# A camera that has this share of all Gaussians in its frame is that of the photo of the scene.
WHOLE_SCENE_SHARE = 0.98
FRAME_MARGIN = 0.05  # as a fraction of the frame's sides: bases reach a little beyond the photo
# Emptiness flows in from the picture's border through gaps that are wider than twice this fraction
# of the picture's width. A slit that a moved camera has uncovered is narrower.
GAP_WIDTHS = 0.02
# Smaller enclosed regions are specks at the edges of surfaces, which nobody sees. Filling them
# would leave others, so that a second fill of the same views would add more.
MIN_HOLE_PX = 8
WITNESSES = 8  # other cameras that are asked what lies behind enclosed emptiness
WITNESS_SIDE_PX = 160  # long side of the pictures in which they are asked
RAYS_A_REGION = 64  # about so many of the pixels of a region are asked for
# Points along each of these rays, evenly in log depth, from this part of the nearest surface's
# depth to this multiple of the farthest one's.
RAY_DEPTHS = 48
NEAREST_RATIO = 0.5
FARTHEST_RATIO = 4.0
SURFACE_TOLERANCE = 0.03  # a point is behind a surface if it is so much, relatively, farther away
# A point is hidden if at least this share of the cameras that know of it say so; those that are
# unsure count half.
HIDDEN_SHARE = 0.9
UNSURE_WEIGHT = 0.5
BEHIND_RIM_RATIO = 1.05  # points so much farther away than the rim are behind it
MIN_WITNESSES = 2  # if fewer know of a point, nothing is known; a single other camera is enough


def _every_nth(camera: Camera) -> slice:
    """The rows or columns of a view of a camera that its small picture keeps."""
    step = max(1, math.ceil(max(camera.width, camera.height) / WITNESS_SIDE_PX))
    return slice(step // 2, None, step)  # the middle of each block of step×step pixels


@dataclasses.dataclass(frozen=True)
class Witness:
    """What a camera knows of the scene, in a small picture.

    Other views ask it whether there may be a surface at a point that they cannot see themselves.
    """

    camera: Camera  # of the small picture, float64
    depth: Tensor  # [h, w] z of opaque pixels, 0 elsewhere
    is_open: Tensor  # [h, w] bool: emptiness that is known to be background

    def with_background(self, camera: Camera, is_open: Tensor) -> Witness:
        """The same view, with the background [H, W] bool of the view of `camera`."""
        every = _every_nth(camera)
        return dataclasses.replace(self, is_open=is_open[every, every])

    @staticmethod
    def of(camera: Camera, depth: Tensor, is_open: Tensor) -> Witness:
        """The witness of a view: every n-th of its rows and columns.

        Args:
            camera: of the view.
            depth: [H, W] z of opaque pixels, 0 elsewhere.
            is_open: [H, W] bool: emptiness that is known to be background.
        """
        every = _every_nth(camera)
        step = every.step
        small_depth = depth[every, every].double()
        height, width = small_depth.shape

        # Each small pixel stands for a block of step×step pixels. The last blocks may reach over
        # the picture or end before it, so the frame is first made to consist of whole blocks.
        blocks = camera.to("cpu", torch.float64).cropped(0, 0, width * step, height * step)
        return Witness(blocks.resized(width, height), small_depth, is_open[every, every])


@dataclasses.dataclass(frozen=True)
class ViewEmptiness:
    """Where a view of a scene is empty, and what surrounds the empty pixels."""

    camera: Camera
    is_empty: Tensor  # [H, W] bool: opacity below the threshold of holes
    is_open: Tensor  # [H, W] bool: emptiness that is open to the picture's border
    rim_depth: Tensor  # [H, W] float32 z of the surface that is nearest in the picture
    witness: Witness  # which knows of no background yet

    @staticmethod
    def of(rendering: Rendering, camera: Camera) -> ViewEmptiness:
        """The emptiness of a rendered view [H, W], on the CPU."""
        rendering = rendering.to(torch.device("cpu")).detach()
        is_empty = hole_mask(rendering.alpha)
        is_open = _open_to_border(is_empty)
        depth = torch.where(is_empty, 0, rendering.depth)

        # [2, H, W] row and column of the surface pixel that is nearest in the picture. Both are
        # negative if the view shows no surface; then the depth 0 of the first pixel is taken.
        nearest = nearest_known_pixels(is_empty).long()
        row, column = nearest.clamp_min(0)
        nothing_known = torch.zeros_like(is_empty)
        return ViewEmptiness(
            camera, is_empty, is_open, depth[row, column], Witness.of(camera, depth, nothing_known)
        )

    @property
    def empty_ratio(self) -> float:
        """The fraction of pixels that are empty, 0..1."""
        return float(self.is_empty.float().mean())

    @property
    def open_ratio(self) -> float:
        """The fraction of pixels that are empty and open to the picture's border, 0..1."""
        return float(self.is_open.float().mean())


@dataclasses.dataclass(frozen=True)
class ViewBackground:
    """The background of a view."""

    is_background: Tensor  # [H, W] bool: empty pixels that are to stay empty
    # [H, W] bool: those of them that are open to the picture's border; nothing may appear there
    is_open: Tensor


def find_background(
    gaussians: Gaussians, views: Sequence[ViewEmptiness]
) -> list[ViewBackground] | None:
    """The background of each view; None if all emptiness is holes.

    The other cameras are witnesses of what lies behind an empty region of a view. Where they see
    through the space, nothing is there: background. Where surfaces hide the space from them, there
    may be something that no camera has seen: a hole.

    Args:
        gaussians: the scene.
        views: the scene as its cameras see it.
    """
    if has_no_background(gaussians, views):
        return None
    # Through each empty pixel that is asked about goes a ray, with points at these depths.
    depths = _ray_depths([view.witness for view in views])

    def with_backgrounds(backgrounds: Sequence[Tensor]) -> list[Witness]:
        """All witnesses, knowing the background [H, W] bool of their views."""
        return [
            view.witness.with_background(view.camera, is_open)
            for view, is_open in zip(views, backgrounds, strict=True)
        ]

    # First the regions that are open to the border. Sky and the space around a thing reach several
    # sides of the picture; what a single side cuts off may be a hole, so the others are asked.
    cut_regions = [_cut_by_one_side(view.is_open) for view in views]
    witnesses = with_backgrounds(
        [view.is_open & ~cut for view, cut in zip(views, cut_regions, strict=True)]
    )
    open_backgrounds = []
    for index, view in enumerate(views):
        others = _spread_witnesses(witnesses, index)
        answers = _ask_regions(view, cut_regions[index], others, depths)
        open_backgrounds.append(view.is_open & ~answers.is_hidden)

    # Then the regions that surfaces enclose, with what is now known of the open ones.
    witnesses = with_backgrounds(open_backgrounds)
    result = []
    for index, view in enumerate(views):
        enclosed = view.is_empty & ~view.is_open
        answers = _ask_regions(view, enclosed, _spread_witnesses(witnesses, index), depths)
        is_open = open_backgrounds[index]
        result.append(ViewBackground(is_open | answers.is_clear | answers.is_speck, is_open))
    return result


def has_no_background(gaussians: Gaussians, views: Sequence[ViewEmptiness]) -> bool:
    """Whether all emptiness is a hole: half of the views have none, or one shows the whole scene
    without any at its border.

    Such a scene is a room, or was made from a photo, which has a surface in each pixel.
    """
    # Views in which hardly a pixel is empty.
    closed_views = [view for view in views if view.empty_ratio <= CLOSED_VIEW_RATIO]
    if 2 * len(closed_views) >= len(views):
        return True
    # In a photo's scene from which somebody has deleted something, the photo's own view has holes,
    # but surfaces enclose them.
    return any(
        view.open_ratio <= CLOSED_VIEW_RATIO
        and _share_in_frame(gaussians, view.camera) >= WHOLE_SCENE_SHARE
        for view in views
    )


def _share_in_frame(gaussians: Gaussians, camera: Camera) -> float:
    """The share of Gaussians whose centres a camera has in its frame, 0..1."""
    uv, z = camera.project(gaussians.means.detach())  # [N, 2], [N]
    size = uv.new_tensor([camera.width, camera.height])
    is_inside = (uv >= -FRAME_MARGIN * size) & (uv <= (1 + FRAME_MARGIN) * size)  # [N, 2]
    return float((is_inside.all(-1) & (z > 0)).float().mean())


def _open_to_border(empty: Tensor) -> Tensor:
    """[H, W] bool: the empty pixels that a wide gap connects with the picture's border.

    `empty` [H, W] bool are the pixels without a surface.
    """
    # Only what is far enough from all surfaces lets emptiness pass. At its end, it spreads as far
    # again, to the surfaces around.
    radius = max(1, round(GAP_WIDTHS * empty.shape[1]))
    passable = ~maximum_filter(~empty, radius)
    regions = torch.from_numpy(_label_regions(passable.numpy()))
    at_border = torch.cat([regions[0], regions[-1], regions[:, 0], regions[:, -1]])
    is_open = torch.isin(regions, at_border[at_border > 0])
    return maximum_filter(is_open, radius) & empty


def _cut_by_one_side(is_open: Tensor) -> Tensor:
    """[H, W] bool: the regions of a mask [H, W] that reach exactly one side of the picture."""
    regions = torch.from_numpy(_label_regions(is_open.numpy()))
    side_count = torch.zeros_like(regions)
    for side in (regions[0], regions[-1], regions[:, 0], regions[:, -1]):
        side_count += torch.isin(regions, side[side > 0])
    return side_count == 1


def _spread_witnesses(witnesses: Sequence[Witness], index: int) -> list[Witness]:
    """Up to 8 other witnesses than the one at `index`, whose eyes are far from one another."""
    others = [witness for place, witness in enumerate(witnesses) if place != index]
    if len(others) <= WITNESSES:
        return others
    eyes = torch.stack([witness.camera.position for witness in others])
    distances = (eyes - witnesses[index].camera.position).norm(dim=1)
    chosen = []
    for _ in range(WITNESSES):
        farthest = int(distances.argmax())
        chosen.append(others[farthest])
        distances = torch.minimum(distances, (eyes - eyes[farthest]).norm(dim=1))
    return chosen


def _ray_depths(witnesses: Sequence[Witness]) -> Tensor:
    """[D] float64: depths along a ray, from before the nearest surface to behind the farthest."""
    depths = np.concatenate([view.depth[view.depth > 0].numpy() for view in witnesses])
    if not len(depths):
        return torch.ones(1, dtype=torch.float64)
    # Quantiles, because of stray Gaussians.
    near, far = np.quantile(depths, [0.01, 0.99])
    first = NEAREST_RATIO * float(near)
    last = FARTHEST_RATIO * float(far)
    parts = torch.linspace(0, 1, RAY_DEPTHS, dtype=torch.float64)
    return first * (last / first) ** parts


@dataclasses.dataclass(frozen=True)
class RegionAnswers:
    """What other cameras say of regions of emptiness: [H, W] bool, true in whole regions."""

    is_hidden: Tensor  # most rays end hidden: behind no hidden point is a clear one
    is_clear: Tensor  # most rays pass clear points behind the rim, and no hidden one
    is_speck: Tensor  # the region is too small to be seen


def _ask_regions(
    view: ViewEmptiness, mask: Tensor, witnesses: Sequence[Witness], depths: Tensor
) -> RegionAnswers:
    """What other cameras say of the space behind each region of a mask.

    Args:
        view: the view.
        mask: [H, W] bool: some of its empty pixels.
        witnesses: the other cameras.
        depths: [D] of the points that are asked for along a ray.
    """
    regions = torch.from_numpy(_label_regions(mask.numpy())).flatten().long()  # [H·W]
    pixels = regions.nonzero()[:, 0]
    if not len(pixels):
        return RegionAnswers(*(torch.zeros_like(mask) for _ in range(3)))

    # Some pixels of each region, evenly among its pixels. First all pixels are put in the order of
    # their regions; a pixel's rank is its place among those of its region; then every stride-th
    # rank is asked, from the middle of the first stride.
    pixels = pixels[regions[pixels].argsort(stable=True)]
    sizes = regions.bincount()
    first_places = sizes[1:].cumsum(0) - sizes[1:]  # of the regions 1, 2, … in `pixels`
    labels = regions[pixels]
    ranks = torch.arange(len(pixels)) - first_places[labels - 1]
    strides = (sizes[labels] / RAYS_A_REGION).ceil().long()
    asked = pixels[(ranks + strides // 2) % strides == 0]

    camera = view.camera.to("cpu", torch.float64)
    uv = camera.pixel_centers().flatten(0, 1)[asked].double()
    rim_depth = view.rim_depth.flatten()[asked].double()
    is_hidden, is_clear = _ask_rays(camera, uv, rim_depth, witnesses, depths)

    asked_labels = regions[asked]
    asked_counts = asked_labels.bincount(minlength=len(sizes))

    def where_most(answers: Tensor) -> Tensor:
        """[H, W] bool: the regions in which most of the rays [n] have the answer."""
        counts = asked_labels[answers].bincount(minlength=len(sizes))
        # No ray was asked for the label 0 of all other pixels.
        return (2 * counts > asked_counts)[regions].reshape(mask.shape)

    is_speck = (sizes < MIN_HOLE_PX)[regions].reshape(mask.shape) & mask
    return RegionAnswers(where_most(is_hidden), where_most(is_clear), is_speck)


def _ask_rays(
    camera: Camera, uv: Tensor, rim_depth: Tensor, witnesses: Sequence[Witness], depths: Tensor
) -> tuple[Tensor, Tensor]:
    """Two [n] bool: rays that end hidden, and rays that are clear, behind the rim of their region.

    A ray ends hidden if its last point of which the witnesses know is hidden. It is clear if it
    passes clear points and no hidden one.

    A witness calls a point hidden if it lies behind a surface; clear if it lies before one, or
    before known background. It is unsure of a point before other emptiness, which may be a hole,
    and says nothing of a point outside of its frame.

    Args:
        camera: of the view, float64.
        uv: [n, 2] its pixels.
        rim_depth: [n] z of the surface around each of them.
        witnesses: the other cameras.
        depths: [D] z of the points along each ray.
    """
    z_of_points = depths[:, None].expand(-1, len(uv))
    points = camera.unproject(uv.expand(*z_of_points.shape, 2), z_of_points)  # [D, n, 3]
    hidden_count = torch.zeros(z_of_points.shape)
    clear_count = torch.zeros(z_of_points.shape)
    unsure_count = torch.zeros(z_of_points.shape)
    for witness in witnesses:
        place, z = witness.camera.project(points)
        is_inside = witness.camera.has_in_frame(place, z)
        column = torch.where(is_inside, place[..., 0].floor(), 0).long()
        row = torch.where(is_inside, place[..., 1].floor(), 0).long()

        surface_depth = witness.depth[row, column]
        shows_surface = is_inside & (surface_depth > 0)
        is_open = is_inside & witness.is_open[row, column]
        hidden_count += shows_surface & (z > surface_depth * (1 + SURFACE_TOLERANCE))
        clear_count += shows_surface & (z < surface_depth * (1 - SURFACE_TOLERANCE))
        clear_count += is_open
        unsure_count += is_inside & ~shows_surface & ~is_open

    # A point of which too few witnesses know is neither hidden nor clear. A share of 0 / 0 is NaN,
    # which compares as false.
    known_count = hidden_count + clear_count
    is_known = known_count >= max(1, min(MIN_WITNESSES, len(witnesses)))
    hidden_share = hidden_count / (known_count + UNSURE_WEIGHT * unsure_count)
    is_hidden = is_known & (hidden_share >= HIDDEN_SHARE)

    # Before the rim there is nothing, as the view itself shows.
    is_behind_rim = z_of_points > BEHIND_RIM_RATIO * rim_depth
    hidden = is_hidden & is_behind_rim
    clear = is_known & ~is_hidden & is_behind_rim

    # The numbers of the last hidden and the last clear point of each ray: from 1 on, in the order
    # of the depths; 0 if there is none.
    numbers = torch.arange(1, len(depths) + 1)[:, None]
    last_hidden = (numbers * hidden).amax(0)
    last_clear = (numbers * clear).amax(0)
    return last_hidden > last_clear, (last_hidden == 0) & (last_clear > 0)


@kernel
def _label_regions(mask: Any) -> Any:
    """[H, W] int32: the number, from 1 on, of each true pixel's region in a mask; 0 elsewhere.

    A region's pixels are connected above, below, left and right. `mask` is [H, W] bool.
    """
    height, width = mask.shape
    labels = np.zeros((height, width), np.int32)
    stack = np.empty((height * width, 2), np.int32)  # pixels whose neighbours are still to visit
    region = 0
    for first_row in range(height):
        for first_column in range(width):
            if not mask[first_row, first_column] or labels[first_row, first_column] != 0:
                continue
            region += 1
            labels[first_row, first_column] = region
            stack[0, 0] = first_row
            stack[0, 1] = first_column
            count = 1
            while count > 0:
                count -= 1
                y = stack[count, 0]
                x = stack[count, 1]
                for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                    row = y + dy
                    column = x + dx
                    if row < 0 or column < 0 or row >= height or column >= width:
                        continue
                    if mask[row, column] and labels[row, column] == 0:
                        labels[row, column] = region
                        stack[count, 0] = row
                        stack[count, 1] = column
                        count += 1
    return labels
