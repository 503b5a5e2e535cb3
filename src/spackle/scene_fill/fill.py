"""Fill the holes of one view, or of all views of a path with one set of Gaussians.

All runs on the renderer's device, without copies to the host in between.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import to_uint8
from spackle.core.gaussians import Gaussians
from spackle.render.protocol import Rendering
from spackle.residual.features import MASK_THRESHOLD, hole_area_ratio
from spackle.runtime.progress import Progress
from spackle.scene_fill.context import FillContext
from spackle.scene_fill.hole_gaussians import cells_to_fill, fill_holes
from spackle.scene_fill.incremental_renderer import IncrementalRenderer
from spackle.scene_fill.occlusion_guard import OcclusionGuard, move_behind_surfaces
from spackle.scene_fill.texture import exemplar_texture
from spackle.scene_fill.underlay import rim_underlay

PASSES = 2  # the second pass fills cells in which the first pass left opacity below the threshold
GUARDED_VIEWS = 8  # so many of the widest views protect their surfaces from the start
# The two widest views lie on opposite sides and show nearly all holes. Only these two views get the
# chosen texture; later views get the exemplar texture. Underlays are added after both views are
# completed.
OPPOSITE_VIEWS = 2
# A view of a path with a smaller fraction of hole pixels is filled without the network, whose
# effect would be invisible.
MIN_HOLE_RATIO_FOR_NETWORK = 0.01
INVISIBLE_HOLE_RATIO = 1e-3  # a smaller fraction of hole pixels is invisible in a frame of a path
# A view of a path that differs less from a visited view shows the same, and is not visited. In the
# unit of disparity: at 1, the nearest surfaces move across the picture. Here they move by a part of
# a pixel; movements of half a pixel can already open a slit.
MIN_VIEW_DIFFERENCE = 2e-4
PHOTO = -1  # the photo's index among the guarded views


@dataclasses.dataclass(frozen=True)
class FilledView:
    """The Gaussians added in one view, and the view rendered with base and added Gaussians."""

    aux: Gaussians
    rendering: Rendering


@dataclasses.dataclass(frozen=True)
class FilledScene:
    """One set of added Gaussians for all views."""

    aux: Gaussians
    # [H, W, 3] uint8 sRGB, on the CPU: final renderings of some views, by the view's index; nobody
    # needs to render these views again
    pictures: Mapping[int, Tensor]


@torch.no_grad()
def fill_view(
    context: FillContext,
    camera: Camera,
    guards: Sequence[OcclusionGuard] | None = None,
    rendering: Rendering | None = None,
) -> FilledView:
    """Complete one view by itself.

    Args:
        context: the photo's base and the settings of the fill.
        camera: the view.
        guards: surfaces of other views, which the added Gaussians must not hide; None: those of the
            photo alone.
        rendering: the base rendered from this view, if already available.
    """
    # Everything is done on the renderer's device; the result returns to the base's device.
    device = context.base.means.device
    context = context.on_renderer_device
    if guards is None:
        guards = [context.photo_guard()]
    renderer = IncrementalRenderer(context.renderer, context.base)
    view_rendering = renderer.render(camera, rendering)
    filled = _fill_in_passes(
        context,
        renderer,
        view_rendering,
        camera,
        guards,
        max_hole_ratio=0,  # another pass, if any pixel is still a hole
        with_underlays=False,  # these only show in other views
    )
    aux = Gaussians.cat([Gaussians.empty(device), *(part.to(device) for part in filled.aux)])
    return FilledView(aux, filled.rendering.to(device))


@torch.no_grad()
def fill_scene(
    context: FillContext,
    cameras: Sequence[Camera],
    exact: bool = False,
    progress: Progress | None = None,
    fillable: Sequence[Tensor | None] | None = None,
    keep_empty: Sequence[Tensor | None] | None = None,
    guarded_views: int = GUARDED_VIEWS,
) -> FilledScene:
    """Complete all views of a path with one set of Gaussians.

    The widest views come first, then always the view that differs most from all earlier ones. Each
    view is rendered with the base (the Gaussians predicted from the photo) and all Gaussians added
    before, and then gets new Gaussians in its holes and beneath the rims of its holes. New
    Gaussians lie behind all surfaces that the photo, the widest views and earlier views show.

    Args:
        context: the photo's base and the settings of the fill.
        cameras: the frames of a path in order; with `exact`, any views.
        exact: check every view, and complete every view that has a hole. Otherwise invisibly small
            holes may remain, and a view that shows the same as a checked one is not checked.
        progress: called with (number of views that are done, number of views).
        fillable: for each view the pixels [H, W] bool whose holes may be filled, or None for all;
            None: all holes of all views. Other holes stay as they are, and count as closed.
        keep_empty: for each view the pixels [H, W] bool in which nothing may appear, such as sky;
            None: none.
        guarded_views: no new Gaussian may hide what so many of the widest views show.
    """
    device = context.base.means.device
    if not cameras:
        return FilledScene(Gaussians.empty(device), {})

    # Everything is done on the renderer's device; the result returns to the base's device.
    filling = _SceneFilling(
        context.on_renderer_device,
        cameras,
        exact,
        fillable or [None] * len(cameras),
        keep_empty or [None] * len(cameras),
        guarded_views,
    )
    # To visit a view is to render it with all Gaussians so far, and to fill its holes.
    for count, index in enumerate(filling.order, start=1):
        if filling.needs_visit(index):
            filling.visit(index)
        if progress:
            progress(count, len(filling.order))
    filled = filling.finish()
    return FilledScene(filled.aux.to(device), filled.pictures)


class _SceneFilling:
    """The state of `fill_scene` between two views: what was added, which surfaces are guarded."""

    def __init__(
        self,
        context: FillContext,
        cameras: Sequence[Camera],
        exact: bool,
        fillable: Sequence[Tensor | None],
        keep_empty: Sequence[Tensor | None],
        guarded_views: int,
    ) -> None:
        """Put the views in order, render the widest ones, and guard the surfaces they show.

        Args:
            context: the photo's base and the settings of the fill, on the renderer's device.
            cameras: the views.
            exact: visit every view, and leave no hole. Otherwise a view that shows the same as a
                visited one is left out, and invisibly small holes stay open.
            fillable: for each view the pixels [H, W] bool whose holes may be filled; None: all.
            keep_empty: for each view the pixels [H, W] bool in which nothing may appear.
            guarded_views: so many of the widest views protect their surfaces from the start.
        """
        # What is to be done.
        self.context = context
        self.cameras = cameras
        self.fillable = fillable
        self.keep_empty = keep_empty
        self.exact = exact
        self.max_hole_ratio = 0.0 if exact else INVISIBLE_HOLE_RATIO

        # The order of the visits: the widest views first, which are those that differ most.
        photo_camera = context.photo_camera
        differences = view_differences([*cameras, photo_camera], photo_camera, context.near_depth)
        self.order = farthest_first(differences)
        self.differences = differences[:-1, :-1]  # [V, V], between the views alone
        # [V] bool: views that need no visit, because a visited view shows the same.
        self.is_settled = torch.zeros(len(cameras), dtype=torch.bool)

        # No new Gaussian may hide what the photo or one of the widest views shows: each of them has
        # a guard. The key is the view's index; PHOTO stands for the photo's own view.
        self.renderer = IncrementalRenderer(context.renderer, context.base)
        self.guards = {PHOTO: context.photo_guard()}

        # The guards' renderings of the base alone, by the view's index, are kept until the view is
        # visited, but not more than by default: renderings take much memory.
        self.base_renderings: dict[int, Rendering] = {}
        for position, index in enumerate(self.order[:guarded_views]):
            rendering = self.renderer.render(cameras[index])
            self.guards[index] = self._guard(index, rendering)
            if position < GUARDED_VIEWS:
                self.base_renderings[index] = rendering

        self.filled_views = 0
        self.aux: list[Gaussians] = []  # everything that was added

        # Pairs (view's index, Gaussians that it needs beneath the rims of its holes). They wait
        # until the two widest views are filled, because one of these may show, and fill better,
        # what lies beneath the rims of the other.
        self.pending_underlays: list[tuple[int, Gaussians]] = []

        # [H, W, 3] uint8 sRGB, by the view's index: final renderings, as long as nothing is added.
        self.pictures: dict[int, Tensor] = {}

    def needs_visit(self, index: int) -> bool:
        """Whether a view may still have visible holes: no visited view shows the same."""
        return self.exact or not self.is_settled[index]

    def visit(self, index: int) -> None:
        """Render a view with everything added so far, and fill its holes if they are visible."""
        # Views that show the same as this one need no visit any more.
        self.is_settled |= self.differences[index] < MIN_VIEW_DIFFERENCE  # [V]

        camera = self.cameras[index]
        base_rendering = self.base_renderings.pop(index, None)  # no longer needed afterwards
        rendering = self.renderer.render(camera, base_rendering)
        fillable = self.fillable[index]
        hole_ratio = fillable_hole_ratio(rendering.alpha, fillable, self.context.threshold)
        if hole_ratio <= self.max_hole_ratio:
            self.pictures[index] = to_uint8(rendering.rgb)
            return

        filled = _fill_in_passes(
            self._view_context(hole_ratio),
            self.renderer,
            rendering,
            camera,
            self._other_guards(index),
            max_hole_ratio=self.max_hole_ratio,
            # Underlays are Gaussians beneath the rims of holes, for other views; a single view
            # shows nothing there.
            with_underlays=len(self.cameras) > 1,
            fillable=fillable,
        )
        self.aux += filled.aux
        self.pending_underlays += [(index, underlay) for underlay in filled.underlays]
        self.filled_views += 1
        # Later Gaussians must not hide what this view shows now.
        self.guards[index] = self._guard(index, filled.rendering)
        self.pictures.clear()  # the added Gaussians may appear in them

        # The two widest views, the first ones in the order, show nearly all holes. When they are
        # filled, what lies beneath the rims of their holes is known.
        if self.filled_views >= OPPOSITE_VIEWS:
            underlays = self._place_underlays()
            self.renderer.add(*underlays)
            self.aux += underlays

    def finish(self) -> FilledScene:
        """All added Gaussians, and the pictures that show them."""
        if self.pending_underlays:
            self.pictures.clear()  # the underlays may appear in them
        added = [*self.aux, *self._place_underlays()]
        aux = Gaussians.cat(added) if added else Gaussians.empty()
        return FilledScene(aux, self.pictures)

    def _view_context(self, hole_ratio: float) -> FillContext:
        """The context with network and texture for the next view.

        `hole_ratio` is the fraction of the view's pixels that are holes.
        """
        # In small holes, the effect of the network would be invisible.
        if hole_ratio < MIN_HOLE_RATIO_FOR_NETWORK and not self.exact:
            return self.context.without_network

        # The chosen texture may take seconds, if an inpainter makes it. The two widest views, which
        # come first, show nearly all holes; so later views do with texture copied from the view.
        if self.filled_views >= OPPOSITE_VIEWS and self.context.texture is not None:
            return dataclasses.replace(self.context, texture=exemplar_texture)
        return self.context

    def _guard(self, index: int, rendering: Rendering) -> OcclusionGuard:
        """What a view shows, in a rendering of it, and the emptiness that it keeps."""
        return OcclusionGuard.of(
            rendering, self.cameras[index], self.context.threshold, self.keep_empty[index]
        )

    def _other_guards(self, index: int) -> list[OcclusionGuard]:
        """The guarded surfaces of all views but one."""
        return [guard for view, guard in self.guards.items() if view != index]

    def _place_underlays(self) -> list[Gaussians]:
        """The pending underlays, moved behind the surfaces of all other views; none is pending
        afterwards.

        An underlay consists of Gaussians beneath the rims of one view's holes. It closes the slits
        that other views would show there.
        """
        placed = [
            move_behind_surfaces(underlay, self.cameras[index].position, self._other_guards(index))
            for index, underlay in self.pending_underlays
        ]
        self.pending_underlays.clear()
        return placed


@dataclasses.dataclass(frozen=True)
class _FilledHoles:
    """What the passes over one view have added, and the view rendered with it."""

    aux: list[Gaussians]
    # Beneath the rims of holes, not yet moved behind the surfaces of other views.
    underlays: list[Gaussians]
    rendering: Rendering


def _fill_in_passes(
    context: FillContext,
    renderer: IncrementalRenderer,
    rendering: Rendering,
    camera: Camera,
    guards: Sequence[OcclusionGuard],
    *,
    max_hole_ratio: float,
    with_underlays: bool,
    fillable: Tensor | None = None,
) -> _FilledHoles:
    """Fill the holes of a view, render it, and fill once more the holes that stayed open.

    The added Gaussians are returned, and are also added to the scene of `renderer`.

    Args:
        context: network, texture and threshold for this view.
        renderer: has just rendered this view.
        rendering: of the view, with all Gaussians added before.
        camera: of the view.
        guards: surfaces of other views, in front of which no new Gaussian may lie.
        max_hole_ratio: no further pass if at most this fraction of pixels are holes.
        with_underlays: also make Gaussians beneath the rims of the holes.
        fillable: [H, W] bool, the pixels whose holes are filled; None: all. Other holes stay open.
    """
    aux: list[Gaussians] = []  # the Gaussians that each pass adds in the holes
    underlays: list[Gaussians] = []
    for pass_index in range(PASSES):
        # Where holes stayed open, the network predicted faint Gaussians. It would do so again, so
        # the second pass goes without it.
        pass_context = context if pass_index == 0 else context.without_network
        view = pass_context.view(rendering, camera)
        # `view.mask` has all cells (2×2 pixels) that touch a hole; of these, some may be filled.
        mask = cells_to_fill(view, fillable)
        if not bool(mask.any()):
            break
        filling = fill_holes(pass_context, view, guards, mask)
        if with_underlays:
            # Holes that may not be filled are no surface that could be continued beneath a rim.
            open_cells = view.mask & ~mask
            underlays.append(rim_underlay(mask, filling.surfaces, camera, open_cells))
        if not len(filling.gaussians):
            break
        aux.append(filling.gaussians)
        rendering = renderer.render_added(filling.gaussians)
        hole_ratio = fillable_hole_ratio(rendering.alpha, fillable, context.threshold)
        if hole_ratio <= max_hole_ratio:
            break
    return _FilledHoles(aux, underlays, rendering)


def fillable_hole_ratio(
    alpha: Tensor, fillable: Tensor | None, threshold: float = MASK_THRESHOLD
) -> float:
    """The fraction of a view's pixels that are holes and may be filled, 0..1.

    Args:
        alpha: [H, W] opacity; a hole pixel's is below the threshold.
        fillable: [H, W] bool, the pixels that may be filled; None: all.
        threshold: τ_α of eq. 4.
    """
    if fillable is not None:
        alpha = torch.where(fillable.to(alpha.device), alpha, 1.0)
    return hole_area_ratio(alpha, threshold)


def farthest_first(differences: Tensor) -> list[int]:
    """Indices of V views: first the view that differs most from the photo's, then always the view
    that differs most from all earlier ones.

    The first n views are thus spread evenly over what all views show, for any n.

    Args:
        differences: [V + 1, V + 1] from `view_differences`, of the views and, last, the photo's.
    """
    nearest = differences[-1, :-1].clone()  # of each view, from the photo's or an earlier view
    order: list[int] = []
    for _ in range(len(nearest)):
        farthest = int(nearest.argmax())
        order.append(farthest)
        nearest = torch.minimum(nearest, differences[farthest, :-1])
        nearest[order] = -1.0  # not again, even if views coincide
    return order


def view_differences(cameras: Sequence[Camera], photo_camera: Camera, near_depth: float) -> Tensor:
    """[V, V] float64: how much any two of V views differ in what they show of a scene.

    Views differ if they are seen from elsewhere, and also if they look elsewhere or are wider. A
    difference of 1 moves the nearest surfaces across the picture's whole diagonal, as a disparity
    of 1 does.

    Args:
        cameras: the V views.
        photo_camera: the camera of the photo; its picture's diagonal is the unit.
        near_depth: depth of the nearest surfaces, in the scene's unit.
    """
    fx, fy = photo_camera.focal
    diagonal = math.hypot(photo_camera.width / fx, photo_camera.height / fy)  # in focal lengths
    contents = torch.stack([_shown_content(camera, near_depth) for camera in cameras])  # [V, 15]
    return torch.cdist(contents, contents) / diagonal


def _shown_content(camera: Camera, near_depth: float) -> Tensor:
    """[15] float64 numbers whose Euclidean distance says how differently two cameras see a scene.

    The first three are the eye, the others the directions to the frame's four corners. Both are
    measured as movements in the picture, in focal lengths: an eye that moves by t moves the nearest
    surfaces by t / near_depth, and a camera that turns moves everything by the angle.
    """
    corners = torch.tensor(
        [[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]],
        dtype=torch.float64,
    )
    eye = camera.position.double()
    corner_points = camera.unproject(corners, torch.ones(4, dtype=torch.float64))  # at depth 1
    directions = corner_points - eye
    # The four corners say the same turn four times, so half of each counts: √(4 · ½²) = 1.
    return torch.cat([eye / near_depth, directions.flatten() / 2])
