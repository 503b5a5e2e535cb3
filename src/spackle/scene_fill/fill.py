"""Complete one view, or a whole path with one scene.

To the residual's cells this adds occlusion guards, texture and a second pass. Base Gaussians are never changed. The
renderer and the network run on the renderer's device, everything else on the CPU. Each rendering is copied to the CPU
once, and its new Gaussians are copied back once.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.color import linear_to_srgb, srgb_to_linear, to_bytes
from spackle.device import Precision
from spackle.filters import far_fill, greatest_around
from spackle.gaussians import Gaussians
from spackle.render import Renderer, device_of, touched_tiles
from spackle.render.protocol import Rendering
from spackle.residual.base_values import BLOB_CELLS, Seeds, make_seeds, placed_behind
from spackle.residual.complete import compose
from spackle.residual.network import ResidualNet, find_rim, predict_deltas
from spackle.residual.view_features import CELL, MASK_THRESHOLD, PROCESSOR, ViewFeatures, hole_area_ratio
from spackle.scene_fill.occlusion_guard import OcclusionGuard, free_factors, moved_away, push_behind, without_pits
from spackle.scene_fill.texture import HoleView, Texture, exemplar_texture, in_cells, sharpened
from spackle.surface import BEHIND, PIXEL_SPREAD, surface_slope

PASSES = 2  # a second pass closes the places that the first one's blobs left thin
WIDEST = 8  # widest views of a path: they guard their surfaces from the start
# The two widest views, on opposite sides, show nearly all holes. They alone get the chosen texture; later views get
# the exemplar's. Both are completed before anything is added beneath the rims of either.
OPPOSITE = 2
FLAT = 0.01  # sRGB: pixels that differ less from their cell's mean need no Gaussians of their own
SEEDS_HAR = 0.01  # in a path's view with a smaller HAR the seeds alone fill: the network's work would go unnoticed
FEW_HOLES = 1e-3  # a smaller HAR is invisible in a frame of a path
LEAST_VISITS = 24  # at least this many frames of a path are checked, or half of them if that is more
COARSE = 3  # an underlay is smooth: one Gaussian, COARSE times as large, for COARSE × COARSE cells
REACH_CELLS = COARSE * BLOB_CELLS  # how far an underlay extends beneath a rim: the reach of one of its Gaussians
EVERY = (slice(None, None, COARSE),) * 2  # the cells that have an underlay's Gaussian


@dataclasses.dataclass(frozen=True)
class FillContext:
    """The base of a photo, and everything that is needed to fill the holes of its views."""

    base: Gaussians
    photo_camera: Camera
    renderer: Renderer
    network: ResidualNet | None = None  # None: deltas of zero, so the seeds alone fill the holes
    texture: Texture | None = exemplar_texture  # None: the colours of the network or the seeds
    threshold: float = MASK_THRESHOLD
    precision: Precision = "auto"  # the network's: auto is bfloat16 if the hardware multiplies it natively

    @functools.cached_property
    def placed(self) -> FillContext:
        """The same context, with base and network on the renderer's device."""
        device = device_of(self.renderer)
        if self.base.means.device.type == device.type:
            return self
        network = None if self.network is None else copy.deepcopy(self.network).to(device)
        return dataclasses.replace(self, base=self.base.to(device), network=network)

    @functools.cached_property
    def photo(self) -> Tensor | None:
        """[H, W, 3] sRGB: the base rendered at the photo's camera, for a network that `sees_photo`; else None."""
        seen = self.network is not None and self.network.sees_photo
        return self.renderer.render(self.placed.base, self.photo_camera).rgb if seen else None

    @property
    def seeds_alone(self) -> FillContext:
        """The same context, without network and texture."""
        return dataclasses.replace(self, network=None, texture=None)

    def photo_guard(self) -> OcclusionGuard:
        """The guard of the photo's view: no aux Gaussian may lie in front of the surfaces that it shows."""
        rendering = self.renderer.render(self.placed.base, self.photo_camera)
        return OcclusionGuard.of(rendering, self.photo_camera, self.threshold)


@dataclasses.dataclass(frozen=True)
class FilledView:
    """The aux Gaussians of one view, and its rendering with them."""

    aux: Gaussians
    rendering: Rendering


@dataclasses.dataclass(frozen=True)
class FilledScene:
    """One set of aux Gaussians for all views."""

    aux: Gaussians
    pictures: Mapping[int, Tensor]  # [H, W, 3] uint8 by index: completed views that were rendered anyway


@torch.no_grad()
def fill_view(
    context: FillContext,
    camera: Camera,
    guards: Sequence[OcclusionGuard] | None = None,
    rendering: Rendering | None = None,
) -> FilledView:
    """Complete one view by itself; only the tiles that change are drawn again.

    Args:
        context: the photo's base, and what fills its holes.
        camera: the view.
        guards: views whose surfaces must stay in front; only the photo's if None.
        rendering: the base rendered from this view, if it is already available.
    """
    guards = [context.photo_guard()] if guards is None else guards
    stage, device = _Stage(context.placed), context.base.means.device
    view = stage.look(camera, rendering)
    aux, _, view = _fill(context.placed, stage, view, camera, guards, 0, beneath=False)
    return FilledView(Gaussians.cat(aux).to(device), view.to(device))


@torch.no_grad()
def fill_scene(
    context: FillContext,
    cameras: Sequence[Camera],
    exact: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> FilledScene:
    """Complete a whole path by one set of aux Gaussians, which all frames share.

    Views are visited from the widest inwards, spread over the path. Each view is rendered with the Gaussians of earlier
    ones, and adds its own in its holes and beneath the holes' rims, always behind the surfaces that the photo, the
    widest views and earlier views show. Gaussians beneath the rims of the two widest views are added after both are
    completed, because each of them may show, and fill better, what lies beneath a rim of the other.

    Args:
        context: the photo's base, and what fills its holes.
        cameras: the frames of a path in order; with `exact`, any views.
        exact: check every view, and complete it if it has any hole. Otherwise holes too small to see may stay open, and
            only half of a long path's frames are checked.
        progress: called with (views visited so far, total number of views to visit).
    """
    if not cameras:
        return FilledScene(Gaussians.empty(context.base.means.device), {})
    placed, device, threshold = context.placed, context.base.means.device, context.threshold
    order, stage = farthest_first(cameras, context.photo_camera), _Stage(placed)
    enough = 0 if exact else FEW_HOLES
    visited = order if exact else order[: max(LEAST_VISITS, len(order) // 2)]
    guards = {-1: context.photo_guard()}
    for index in reversed(order[:WIDEST]):  # the widest last: it is completed first
        view = stage.look(cameras[index])
        guards[index] = OcclusionGuard.of(view, cameras[index], threshold)
    pictures, filled = dict[int, Tensor](), 0
    aux = [Gaussians.empty()]
    waiting: list[tuple[int, Gaussians]] = []  # a view's index, and the Gaussians beneath its rims

    def others(index: int) -> list[OcclusionGuard]:
        return [guard for of, guard in guards.items() if of != index]

    def underlays() -> list[Gaussians]:
        return [push_behind(rims, cameras[index].position, others(index)) for index, rims in waiting]

    for count, index in enumerate(visited):
        camera, view = cameras[index], stage.look(cameras[index]) if count else view
        holes = hole_area_ratio(view.alpha, threshold)
        if holes <= enough:
            pictures[index] = to_bytes(view.rgb)
        else:
            means = placed.seeds_alone if holes < SEEDS_HAR and not exact else placed
            if filled >= OPPOSITE and means.texture is not None:
                means = dataclasses.replace(means, texture=exemplar_texture)
            new, rims, view = _fill(means, stage, view, camera, others(index), enough, beneath=len(cameras) > 1)
            aux += new
            waiting += [(index, part) for part in rims]
            filled += 1
            pictures.clear()
            guards[index] = OcclusionGuard.of(view, camera, threshold)
            if filled >= OPPOSITE:
                hidden = underlays()
                stage.add(*hidden)
                aux += hidden
                waiting.clear()
        if progress:
            progress(count + 1, len(visited))
    if waiting:
        pictures.clear()
    return FilledScene(Gaussians.cat([*aux, *underlays()]).to(device), pictures)


def farthest_first(cameras: Sequence[Camera], photo_camera: Camera) -> list[int]:
    """Indices of the views: the widest first, then always the one farthest from all earlier ones.

    So the first n views are spread evenly over the path, for any n.
    """
    if not cameras:
        return []
    eyes = torch.stack([camera.position.double() for camera in cameras])
    distance = (eyes - photo_camera.position.double()).norm(dim=-1)
    order: list[int] = []
    for _ in cameras:
        pick = int(distance.argmax())
        order.append(pick)
        distance = torch.minimum(distance, (eyes - eyes[pick]).norm(dim=-1))
        distance[pick] = -1.0
    return order


def _fill(
    context: FillContext,
    stage: _Stage,
    view: Rendering,
    camera: Camera,
    guards: Sequence[OcclusionGuard],
    enough: float,
    *,
    beneath: bool,
) -> tuple[list[Gaussians], list[Gaussians], Rendering]:
    """Gaussians in the holes of the stage's view, Gaussians beneath their rims if `beneath`, and the completed view."""
    aux, rims = [Gaussians.empty()], []
    for turn in range(PASSES):
        # The seeds close what the network's blobs left thin: the network would only leave it thin again.
        means = context.seeds_alone if turn else context
        features = ViewFeatures.of(view, context.threshold)
        if not bool(features.mask.any()):
            break
        new, underlay = _propose(means, view, features, camera, guards)
        if beneath:
            rims.append(rim_underlay(features.mask, underlay, camera))
        if not len(new):
            break
        aux.append(new)
        view = stage.look_again(new)
        if hole_area_ratio(view.alpha, context.threshold) <= enough:
            break
    return aux, rims, view


def _propose(
    context: FillContext,
    view: Rendering,
    features: ViewFeatures,
    camera: Camera,
    guards: Sequence[OcclusionGuard],
) -> tuple[Gaussians, Seeds]:
    """One Gaussian for each masked cell, all behind the guards' surfaces.

    With a texture, a cell whose pixels differ also has one for each pixel.

    Also returns the seeds, from which `rim_underlay` continues beneath the rims.
    """
    mask, seeds = features.mask, make_seeds(features, camera, context.photo_camera)
    chosen, eye, deltas, picture, beyond, parts = seeds.select(mask), camera.position, None, None, None, []
    if context.network is not None or context.texture is not None:
        rim, patches = find_rim(features, seeds, camera, context.photo_camera, context.photo)
        beyond = rim.beyond[mask]
    if context.network is not None:
        deltas = predict_deltas(context.network, features, seeds, rim, context.precision)[mask]
    cells = compose(chosen, deltas, camera)
    if context.texture is not None:
        structure = features.rgb.clone()
        structure[mask] = linear_to_srgb(cells.colors)
        picture = context.texture(HoleView(view, features, seeds, rim, patches, structure))
    depths, factors = camera.to_camera(cells.means)[:, 2], free_factors(cells, eye, guards)
    factors = torch.where(factors > 0, without_pits(depths * factors, mask) / depths, 0)
    if picture is not None:
        wanted, blobs = (in_cells(image)[mask] for image in (picture, sharpened(picture)))
        rough = (wanted - wanted.mean((1, 2), keepdim=True)).abs().amax((1, 2, 3)) > FLAT
        index = rough.nonzero()[:, 0]
        pixels = _pixels(chosen.select(index), None if deltas is None else deltas[index], camera, blobs[index])
        parts.append(moved_away(pixels, eye, factors[index].repeat_interleave(CELL**2)))
        # As in a lifted photo, each cell has one Gaussian behind those of its pixels.
        cells = dataclasses.replace(cells, colors=srgb_to_linear(wanted.clamp(0, 1)).mean((1, 2)))
        factors = factors / (1 - BEHIND)
    parts.append(moved_away(cells, eye, factors))
    inverse_depth = seeds.inverse_depth.clone()
    if beyond is not None:  # beyond the photo's border, what lies beneath the rim must follow what was moved away
        moved = beyond & (factors > 0)
        inverse_depth[mask] = torch.where(moved, 1 / (depths * factors), inverse_depth[mask])
    return Gaussians.cat(parts), dataclasses.replace(seeds, inverse_depth=inverse_depth)


def _pixels(seeds: Seeds, deltas: Tensor | None, camera: Camera, colors: Tensor) -> Gaussians:
    """Gaussians [4n] for the pixels of n cells, from flat seeds [n], deltas [n, 14] or None, and sRGB [n, 2, 2, 3]."""
    offsets = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
    fields = (seeds.inverse_depth, seeds.slope, seeds.rgb, *([] if deltas is None else [deltas]))
    inverse_depth, slope, rgb, *repeated = (field.repeat_interleave(len(offsets), 0) for field in fields)
    rise = (seeds.slope[:, None] * offsets).sum(-1).flatten()
    inverse_depth = (inverse_depth + rise).clamp_min(0.5 * inverse_depth)
    fine = Seeds((seeds.uv[:, None] + offsets).flatten(0, 1), inverse_depth, slope, rgb, seeds.unit)
    pixels = compose(fine, repeated[0] if repeated else None, camera, PIXEL_SPREAD)
    return dataclasses.replace(pixels, colors=srgb_to_linear(colors.flatten(0, 2).clamp(0, 1)))


def rim_underlay(mask: Tensor, seeds: Seeds, camera: Camera) -> Gaussians:
    """Gaussians that extend the holes' seeds beneath the surfaces around the holes.

    From another view the rim of a hole moves, and a slit opens between the visible surface and the hole's filling. The
    underlay closes most such slits in advance: fewer views of a path remain to be completed, and they agree.

    Args:
        mask: [h, w] bool: the cells of the view's holes.
        seeds: the seeds of all cells.
        camera: the view.
    """
    rim = (greatest_around(mask, REACH_CELLS) & ~mask)[EVERY]
    if not bool(rim.any()) or bool(rim.all()):
        return Gaussians.empty()
    coarse, rgb = far_fill(seeds.inverse_depth[EVERY], seeds.rgb[EVERY].permute(2, 0, 1), ~rim)
    # Beneath the rim, behind all visible or filled surfaces within a blob's reach.
    depth, chosen = seeds.inverse_depth.clone(), mask.new_zeros(mask.shape)
    depth[EVERY], chosen[EVERY] = coarse, rim
    placed = placed_behind(depth, chosen, seeds.inverse_depth, COARSE * BLOB_CELLS)[EVERY]
    slope = surface_slope(placed) / (COARSE * CELL)
    beneath = compose(Seeds(seeds.uv[EVERY], placed, slope, rgb.permute(1, 2, 0), seeds.unit).select(rim), None, camera)
    return dataclasses.replace(beneath, scales=COARSE * beneath.scales)


class _Stage:
    """The base, the Gaussians added to it, and their last rendering, all on the renderer's device."""

    def __init__(self, context: FillContext) -> None:
        self._renderer, self._device, self._sets = context.renderer, device_of(context.renderer), [context.base]

    def look(self, camera: Camera, rendering: Rendering | None = None) -> Rendering:
        """The rendering from a camera, copied to the CPU; `rendering`, if given, is used instead of a new one."""
        drawn = self._renderer.render(self._sets, camera) if rendering is None else rendering.to(self._device)
        self._camera, self._drawn = camera, drawn
        return drawn.to(PROCESSOR)

    def add(self, *sets: Gaussians) -> None:
        """Add Gaussians, which the next `look` includes."""
        self._sets += [part.to(self._device) for part in sets]

    def look_again(self, new: Gaussians) -> Rendering:
        """Add Gaussians, and render from the last camera again; only the tiles that they touch are redrawn."""
        self.add(new)
        tiles = touched_tiles(new, self._camera)
        self._drawn = self._renderer.render(self._sets, self._camera, tiles=tiles, onto=self._drawn)
        return self._drawn.to(PROCESSOR)
