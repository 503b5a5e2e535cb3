"""Fill the holes of one view, or of all views of a path with one set of Gaussians.

The renderer and the network run on the renderer's device; all other code runs on the CPU.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import to_uint8
from spackle.core.gaussians import Gaussians
from spackle.render.protocol import Rendering
from spackle.residual.features import hole_area_ratio
from spackle.runtime.progress import Progress
from spackle.scene_fill.context import FillContext
from spackle.scene_fill.hole_gaussians import fill_holes
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
MIN_VIEWS_TO_FILL = 24  # half of a path's frames are checked, and at least this many
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
    # [H, W, 3] uint8 sRGB: final renderings of some views, by the view's index
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
        context, renderer, view_rendering, camera, guards, max_hole_ratio=0, with_underlays=False
    )
    aux = Gaussians.cat([Gaussians.empty(), *filled.aux])
    return FilledView(aux.to(device), filled.rendering.to(device))


@torch.no_grad()
def fill_scene(
    context: FillContext,
    cameras: Sequence[Camera],
    exact: bool = False,
    progress: Progress | None = None,
    *,
    always_filled: Collection[int] = (),
) -> FilledScene:
    """Complete all views of a path with one set of Gaussians.

    The widest views come first, then always the view farthest from all earlier ones. Each view is
    rendered with the base (the Gaussians predicted from the photo) and all Gaussians added before,
    and then gets new Gaussians in its holes and beneath the rims of its holes. New Gaussians lie
    behind all surfaces that the photo, the widest views and earlier views show.

    Args:
        context: the photo's base and the settings of the fill.
        cameras: the frames of a path in order; with `exact`, any views.
        exact: check every view, and complete every view that has a hole. Otherwise invisibly small
            holes may remain, and only half of a long path's frames are checked.
        progress: called with (number of visited views, number of views to visit).
        always_filled: indices of cameras that are checked even if they are not in that half. The
            half is chosen by the cameras' positions alone. So it may leave out a view that stands
            at the place of another, but shows more (it is wider, or looks elsewhere).
    """
    device = context.base.means.device
    if not cameras:
        return FilledScene(Gaussians.empty(device), {})

    # Everything is done on the renderer's device; the result returns to the base's device.
    filling = _SceneFilling(context.on_renderer_device, cameras, exact, always_filled)
    for count, index in enumerate(filling.views_to_fill, start=1):
        filling.visit(index)
        if progress:
            progress(count, len(filling.views_to_fill))
    filled = filling.finish()
    return FilledScene(filled.aux.to(device), filled.pictures)


class _SceneFilling:
    """The state of `fill_scene` between two views: what was added, which surfaces are guarded."""

    def __init__(
        self,
        context: FillContext,
        cameras: Sequence[Camera],
        exact: bool,
        always_filled: Collection[int],
    ) -> None:
        """Choose the views to fill, render the widest ones, and guard the surfaces they show.

        Args:
            context: the photo's base and the settings of the fill, on the renderer's device.
            cameras: the views.
            exact: visit every view, and leave no hole. Otherwise only half of the views are
                visited, and invisibly small holes stay open.
            always_filled: indices of views that are visited in any case.
        """
        self.context = context
        self.cameras = cameras
        self.exact = exact
        order = farthest_first(cameras, context.photo_camera)
        if exact:
            self.views_to_fill = order
            self.max_hole_ratio = 0.0
        else:
            # The first half is spread over the whole path. The views of the second half lie between
            # them, and show hardly anything that their neighbours do not show.
            first_half = max(MIN_VIEWS_TO_FILL, len(order) // 2)
            others = [index for index in order[first_half:] if index in always_filled]
            self.views_to_fill = [*order[:first_half], *others]
            self.max_hole_ratio = INVISIBLE_HOLE_RATIO

        # No new Gaussian may hide what the photo or one of the widest views shows.
        self.renderer = IncrementalRenderer(context.renderer, context.base)
        self.guards = {PHOTO: context.photo_guard()}  # by the view's index; PHOTO: the photo's
        # Renderings of the base alone, by the view's index; dropped when the view is visited.
        self.base_renderings: dict[int, Rendering] = {}
        for index in order[:GUARDED_VIEWS]:
            self.base_renderings[index] = self.renderer.render(cameras[index])
            self.guards[index] = OcclusionGuard.of(
                self.base_renderings[index], cameras[index], context.threshold
            )

        self.filled_views = 0
        self.aux = [Gaussians.empty()]  # everything that was added

        # Pairs (view's index, Gaussians that it needs beneath the rims of its holes). They wait
        # until the two widest views are filled, because one of these may show, and fill better,
        # what lies beneath the rims of the other.
        self.pending_underlays: list[tuple[int, Gaussians]] = []

        # [H, W, 3] uint8 sRGB, by the view's index: final renderings, as long as nothing is added.
        self.pictures: dict[int, Tensor] = {}

    def visit(self, index: int) -> None:
        """Render a view with everything added so far, and fill its holes if they are visible."""
        camera = self.cameras[index]
        base_rendering = self.base_renderings.pop(index, None)  # no longer needed afterwards
        rendering = self.renderer.render(camera, base_rendering)
        hole_ratio = hole_area_ratio(rendering.alpha, self.context.threshold)
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
            with_underlays=len(self.cameras) > 1,  # a single view shows nothing beneath its rims
        )
        self.aux += filled.aux
        self.pending_underlays += [(index, underlay) for underlay in filled.underlays]
        self.filled_views += 1
        self.guards[index] = OcclusionGuard.of(filled.rendering, camera, self.context.threshold)
        self.pictures.clear()  # the added Gaussians may appear in them

        # The two widest views show nearly all holes. When they are filled, what lies beneath the
        # rims of their holes is known.
        if self.filled_views >= OPPOSITE_VIEWS:
            underlays = self._place_underlays()
            self.renderer.add(*underlays)
            self.aux += underlays

    def finish(self) -> FilledScene:
        """All added Gaussians, and the pictures that show them."""
        if self.pending_underlays:
            self.pictures.clear()  # the underlays may appear in them
        aux = Gaussians.cat([*self.aux, *self._place_underlays()])
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
    """What the passes over one view have added, and the view rendered with it, on the CPU."""

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
) -> _FilledHoles:
    """Fill the holes of a view, render it, and fill the holes that stayed open.

    The added Gaussians are returned, and are also added to the scene of `renderer`.

    Args:
        context: network, texture and threshold for this view.
        renderer: has just rendered this view.
        rendering: of the view, with all Gaussians added before.
        camera: of the view.
        guards: surfaces of other views, in front of which no new Gaussian may lie.
        max_hole_ratio: no further pass if at most this fraction of pixels are holes.
        with_underlays: also make Gaussians beneath the rims of the holes.
    """
    aux: list[Gaussians] = []  # the Gaussians that each pass adds in the holes
    underlays: list[Gaussians] = []
    for pass_index in range(PASSES):
        # Where holes stayed open, the network predicted faint Gaussians. It would do so again, so
        # the second pass goes without it.
        pass_context = context if pass_index == 0 else context.without_network
        view = pass_context.view(rendering, camera)
        if not bool(view.mask.any()):
            break
        filling = fill_holes(pass_context, view, guards)
        if with_underlays:
            underlays.append(rim_underlay(view.mask, filling.surfaces, camera))
        if not len(filling.gaussians):
            break
        aux.append(filling.gaussians)
        rendering = renderer.render_added(filling.gaussians)
        if hole_area_ratio(rendering.alpha, context.threshold) <= max_hole_ratio:
            break
    return _FilledHoles(aux, underlays, rendering)


def farthest_first(cameras: Sequence[Camera], photo_camera: Camera) -> list[int]:
    """Indices of views: first the view farthest from the photo, then always the view farthest from
    all earlier views.

    The first n views are thus spread evenly over the path, for any n.
    """
    if not cameras:
        return []
    eyes = torch.stack([camera.position.double() for camera in cameras])  # [views, 3]
    distance = (eyes - photo_camera.position.double()).norm(dim=-1)
    order: list[int] = []
    for _ in cameras:
        farthest = int(distance.argmax())
        order.append(farthest)
        distance = torch.minimum(distance, (eyes - eyes[farthest]).norm(dim=-1))
        distance[farthest] = -1.0  # not again, even if views coincide
    return order
