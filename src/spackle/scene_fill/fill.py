"""Complete one view, or all views of a path with one set of aux Gaussians.

The renderer and the network run on the renderer's device; all other code runs on the CPU.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear, to_uint8
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.core.hole_filling import fill_from_far_side
from spackle.core.surfels import BEHIND_SURFACE_RATIO, PIXEL_SIGMA_PX, inverse_depth_slope
from spackle.render import Renderer, touched_tiles
from spackle.render.protocol import Rendering
from spackle.residual.completion import compose
from spackle.residual.features import CELL, CPU, MASK_THRESHOLD, ViewFeatures, hole_area_ratio
from spackle.residual.initializer import (
    BLOB_CELLS,
    InitialGaussians,
    initialize,
    placed_behind_surfaces,
)
from spackle.residual.network import ResidualNet, find_rim, predict_deltas
from spackle.runtime.device import Precision
from spackle.runtime.progress import Progress
from spackle.scene_fill.occlusion_guard import (
    OcclusionGuard,
    move_behind_surfaces,
    moved_away,
    unoccluding_scales,
    without_pits,
)
from spackle.scene_fill.texture import HoleView, Texture, exemplar_texture, in_cells, sharpened

PASSES = 2  # the second pass fills cells in which the first pass left alpha below the threshold
WIDEST = 8  # so many of the widest views protect their surfaces from the start
# The two widest views lie on opposite sides and show nearly all holes. Only these two views get the chosen texture;
# later views get the exemplar texture. Rim underlays are added after both views are completed.
OPPOSITE = 2
FLAT = 0.01  # sRGB: if a cell's pixels differ less from the cell's mean, the cell gets one Gaussian
SEEDS_HAR = 0.01  # a path's view with a smaller HAR is filled without the network, whose effect would be invisible
FEW_HOLES = 1e-3  # a smaller HAR is invisible in a frame of a path
LEAST_VISITS = 24  # half of a path's frames are checked, and at least this many
COARSE = 3  # an underlay is smooth: each of its Gaussians is COARSE times as large and covers COARSE × COARSE cells
REACH_CELLS = (
    COARSE * BLOB_CELLS
)  # an underlay extends this far beneath a rim: the reach of one underlay Gaussian
EVERY = (slice(None, None, COARSE),) * 2  # the cells that have an underlay Gaussian


@dataclasses.dataclass(frozen=True)
class FillContext:
    """The base of a photo, and all settings for filling the holes of its views."""

    base: Gaussians
    photo_camera: Camera
    renderer: Renderer
    network: ResidualNet | None = None  # None: all deltas are zero
    texture: Texture | None = (
        exemplar_texture  # None: Gaussians keep the colours of the network or the seeds
    )
    threshold: float = MASK_THRESHOLD
    precision: Precision = (
        "auto"  # of the network; auto is bfloat16 if the hardware multiplies it natively
    )

    @functools.cached_property
    def placed(self) -> FillContext:
        """The same context, with base and network on the renderer's device."""
        device = self.renderer.device
        if self.base.means.device.type == device.type:
            return self
        network = None if self.network is None else copy.deepcopy(self.network).to(device)
        return dataclasses.replace(self, base=self.base.to(device), network=network)

    @functools.cached_property
    def photo(self) -> Tensor | None:
        """[H, W, 3] sRGB: the base rendered at the photo's camera; None unless the network `sees_photo`."""
        seen = self.network is not None and self.network.sees_photo
        return self.renderer.render(self.placed.base, self.photo_camera).rgb if seen else None

    @property
    def seeds_alone(self) -> FillContext:
        """The same context, without network and texture."""
        return dataclasses.replace(self, network=None, texture=None)

    def photo_guard(self) -> OcclusionGuard:
        """The occlusion guard of the photo's own view."""
        rendering = self.renderer.render(self.placed.base, self.photo_camera)
        return OcclusionGuard.of(rendering, self.photo_camera, self.threshold)


@dataclasses.dataclass(frozen=True)
class FilledView:
    """The aux Gaussians of one view, and the view rendered with base and aux Gaussians."""

    aux: Gaussians
    rendering: Rendering


@dataclasses.dataclass(frozen=True)
class FilledScene:
    """One set of aux Gaussians for all views."""

    aux: Gaussians
    pictures: Mapping[
        int, Tensor
    ]  # [H, W, 3] uint8 sRGB: final renderings, by view index, of some views


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
        guards: views whose surfaces aux Gaussians must not hide; None: only the photo's view.
        rendering: the base rendered from this view, if already available.
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
    progress: Progress | None = None,
    *,
    always_filled: Collection[int] = (),
) -> FilledScene:
    """Complete all views of a path with one set of aux Gaussians.

    Views are visited in the order of `farthest_first`. Each view is rendered with base Gaussians and all earlier aux
    Gaussians, and then gets new aux Gaussians in its holes and beneath the rims of its holes. New Gaussians lie behind
    all surfaces that the photo, the widest views and earlier views show. The rims of the first two views get
    underlays once both views are filled, because one view may show, and fill better, what the other's rims hide.

    Args:
        context: the photo's base and the settings of the fill.
        cameras: the frames of a path in order; with `exact`, any views.
        exact: check every view, and complete every view that has a hole. Otherwise invisibly small holes may remain,
            and only half of a long path's frames are checked.
        progress: called with (number of visited views, number of views to visit).
        always_filled: indices of cameras that are checked even if they are not in that half. Order and half follow
            from the places of the eyes alone, so a view that shows more from the same place would be left out.
    """
    if not cameras:
        return FilledScene(Gaussians.empty(context.base.means.device), {})
    placed, device, threshold = context.placed, context.base.means.device, context.threshold
    order, stage = farthest_first(cameras, context.photo_camera), _Stage(placed)
    enough = 0 if exact else FEW_HOLES
    visited = order if exact else order[: max(LEAST_VISITS, len(order) // 2)]
    visited = visited + [index for index in order[len(visited) :] if index in always_filled]
    guards, bare = {-1: context.photo_guard()}, dict[int, Rendering]()
    for index in order[:WIDEST]:
        bare[index] = stage.look(cameras[index])
        guards[index] = OcclusionGuard.of(bare[index], cameras[index], threshold)
    pictures, filled = dict[int, Tensor](), 0
    aux = [Gaussians.empty()]
    waiting: list[tuple[int, Gaussians]] = []  # a view's index, and the Gaussians beneath its rims

    def others(index: int) -> list[OcclusionGuard]:
        return [guard for of, guard in guards.items() if of != index]

    def underlays() -> list[Gaussians]:
        return [
            move_behind_surfaces(rims, cameras[index].position, others(index))
            for index, rims in waiting
        ]

    for count, index in enumerate(visited):
        camera = cameras[index]
        view = stage.look(camera, bare.pop(index, None))
        holes = hole_area_ratio(view.alpha, threshold)
        if holes <= enough:
            pictures[index] = to_uint8(view.rgb)
        else:
            means = placed.seeds_alone if holes < SEEDS_HAR and not exact else placed
            if filled >= OPPOSITE and means.texture is not None:
                means = dataclasses.replace(means, texture=exemplar_texture)
            new, rims, view = _fill(
                means, stage, view, camera, others(index), enough, beneath=len(cameras) > 1
            )
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
    """Indices of views: first the view farthest from the photo, then always the view farthest from all earlier views.

    The first n views are thus spread evenly over the path, for any n.
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
    """Returns the Gaussians in a view's holes, the rim underlays (if `beneath`), and the completed view."""
    aux, rims = [Gaussians.empty()], []
    for turn in range(PASSES):
        # The network would predict the same faint Gaussians again.
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
) -> tuple[Gaussians, InitialGaussians]:
    """Gaussians of the masked cells, behind the guards' surfaces; and the seeds for `rim_underlay`.

    Each cell has one Gaussian. With a texture, a cell whose pixels differ has a Gaussian for each pixel too.
    """
    mask, seeds = features.mask, initialize(features, camera, context.photo_camera)
    chosen, eye, deltas, picture, beyond, parts = (
        seeds.select(mask),
        camera.position,
        None,
        None,
        None,
        [],
    )
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
    depths, factors = camera.to_camera(cells.means)[:, 2], unoccluding_scales(cells, eye, guards)
    factors = torch.where(factors > 0, without_pits(depths * factors, mask) / depths, 0)
    if picture is not None:
        wanted, blobs = (in_cells(image)[mask] for image in (picture, sharpened(picture)))
        rough = (wanted - wanted.mean((1, 2), keepdim=True)).abs().amax((1, 2, 3)) > FLAT
        index = rough.nonzero()[:, 0]
        pixels = _pixels(
            chosen.select(index), None if deltas is None else deltas[index], camera, blobs[index]
        )
        parts.append(moved_away(pixels, eye, factors[index].repeat_interleave(CELL**2)))
        # As in a lifted photo, a cell's own Gaussian lies behind the Gaussians of its pixels.
        cells = dataclasses.replace(cells, colors=srgb_to_linear(wanted.clamp(0, 1)).mean((1, 2)))
        factors = factors / (1 - BEHIND_SURFACE_RATIO)
    parts.append(moved_away(cells, eye, factors))
    inverse_depth = seeds.inverse_depth.clone()
    if (
        beyond is not None
    ):  # beyond the photo's border, the underlay must follow the cells that were moved away
        moved = beyond & (factors > 0)
        inverse_depth[mask] = torch.where(moved, 1 / (depths * factors), inverse_depth[mask])
    return Gaussians.cat(parts), dataclasses.replace(seeds, inverse_depth=inverse_depth)


def _pixels(
    seeds: InitialGaussians, deltas: Tensor | None, camera: Camera, colors: Tensor
) -> Gaussians:
    """Gaussians [4n] for the pixels of n cells, from flat seeds [n], deltas [n, 14] or None, and sRGB [n, 2, 2, 3]."""
    offsets = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
    fields = (seeds.inverse_depth, seeds.slope, seeds.rgb, *([] if deltas is None else [deltas]))
    inverse_depth, slope, rgb, *repeated = (
        field.repeat_interleave(len(offsets), 0) for field in fields
    )
    rise = (seeds.slope[:, None] * offsets).sum(-1).flatten()
    inverse_depth = (inverse_depth + rise).clamp_min(0.5 * inverse_depth)
    fine = InitialGaussians(
        (seeds.uv[:, None] + offsets).flatten(0, 1), inverse_depth, slope, rgb, seeds.unit
    )
    pixels = compose(fine, repeated[0] if repeated else None, camera, PIXEL_SIGMA_PX)
    return dataclasses.replace(pixels, colors=srgb_to_linear(colors.flatten(0, 2).clamp(0, 1)))


def rim_underlay(mask: Tensor, seeds: InitialGaussians, camera: Camera) -> Gaussians:
    """Gaussians that continue the filling of holes (`mask` [h, w] bool) beneath the surfaces around the holes.

    From another view, a slit appears between the rim of a hole and the hole's filling. The underlay closes most slits
    in advance. `seeds` are those of all cells of the view.
    """
    rim = (maximum_filter(mask, REACH_CELLS) & ~mask)[EVERY]
    if not bool(rim.any()) or bool(rim.all()):
        return Gaussians.empty()
    coarse, rgb = fill_from_far_side(
        seeds.inverse_depth[EVERY], seeds.rgb[EVERY].permute(2, 0, 1), ~rim
    )
    depth, chosen = seeds.inverse_depth.clone(), mask.new_zeros(mask.shape)
    depth[EVERY], chosen[EVERY] = coarse, rim
    placed = placed_behind_surfaces(depth, chosen, seeds.inverse_depth, COARSE * BLOB_CELLS)[EVERY]
    slope = inverse_depth_slope(placed) / (COARSE * CELL)
    beneath = compose(
        InitialGaussians(seeds.uv[EVERY], placed, slope, rgb.permute(1, 2, 0), seeds.unit).select(
            rim
        ),
        None,
        camera,
    )
    return dataclasses.replace(beneath, scales=COARSE * beneath.scales)


class _Stage:
    """The base, the added Gaussians, and the last rendering of both, on the renderer's device."""

    def __init__(self, context: FillContext) -> None:
        self._renderer, self._device, self._sets = (
            context.renderer,
            context.renderer.device,
            [context.base],
        )

    def look(self, camera: Camera, bare: Rendering | None = None) -> Rendering:
        """The rendering from a camera, copied to the CPU; `bare`, if given, is the rendering of the base alone."""
        self._camera = camera
        if bare is None:
            self._drawn = self._renderer.render(self._sets, camera)
            return self._drawn.to(CPU)
        self._drawn = bare.to(self._device)
        return self._redraw(self._sets[1:])

    def add(self, *sets: Gaussians) -> None:
        self._sets += [part.to(self._device) for part in sets]

    def look_again(self, new: Gaussians) -> Rendering:
        """Add Gaussians, and render from the last camera again."""
        self.add(new)
        return self._redraw([new])

    def _redraw(self, new: Sequence[Gaussians]) -> Rendering:
        """Render again from the last camera; only tiles that the Gaussians in `new` touch are redrawn."""
        tiles = touched_tiles(new, self._camera)
        if bool(tiles.any()):
            self._drawn = self._renderer.render(
                self._sets, self._camera, tiles=tiles, previous_rendering=self._drawn
            )
        return self._drawn.to(CPU)
