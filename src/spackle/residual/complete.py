"""Completion (paper, section 3.4): 𝒢̃_aug of the masked cells (eq. 7), one view at a time or one set for a whole path.

The union 𝒢_final = 𝒢_base ∪ 𝒢̃_aug (eq. 8) is `Gaussians.cat([base, aux])`; rendering it is eq. 9.
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
from spackle.gaussians import Gaussians
from spackle.render import Renderer, place_of, touched_tiles
from spackle.render.protocol import Rendering
from spackle.residual.compose import compose
from spackle.residual.hole_features import CELL, MASK_THRESHOLD, PROCESSOR, Cues, hole_area_ratio, in_cells
from spackle.residual.network import ResidualNet, predict_deltas
from spackle.residual.occlusion_guard import OcclusionGuard, free_factors, moved_away, push_behind, without_pits
from spackle.residual.rim_underlay import rim_underlay
from spackle.residual.seeds import BEHIND, FINE_SPREAD_PX, Rim, Seeds, make_seeds
from spackle.residual.texture import EXEMPLAR, PaintedTexture, Texture, sharpened
from spackle.residual.view_order import QUIET_HAR, SettledFrames, farthest_first, reach_of

PASSES = 2  # a second look closes what the first one's blobs left thin
CLOSED_HAR = 1e-4  # fewer holes than this need no second look
WIDEST = 8  # views of a path whose own content stays in front from the first
OPPOSITE = 2  # views that are completed before anything goes beneath the rims of either
PAINTED_VIEWS = 2  # of a scene for which an inpainter paints: the widest ones
FLAT = 0.01  # sRGB: pixels that differ less from their cell's mean need no Gaussians of their own
SEEDS_HAR = 0.01  # holes of a path's view that are smaller are the seeds' alone: nobody sees the network's work there


@dataclasses.dataclass(frozen=True)
class Completer:
    """Everything that completion needs besides the view.

    Base Gaussians are only ever read: what is returned comes on top of them. The renderer draws and the network
    computes on the renderer's device; everything else happens on the processor. Of a view its images travel there,
    once each, and its new Gaussians back.
    """

    base: Gaussians
    photo_camera: Camera
    renderer: Renderer
    network: ResidualNet | None = None  # None: deltas of zero, so the seeds alone fill the holes
    texture: Texture | None = EXEMPLAR  # None: colours as the network or the seeds have them
    threshold: float = MASK_THRESHOLD
    precision: Precision = "auto"  # of the network: auto is bfloat16 where the hardware multiplies it natively

    @functools.cached_property
    def there(self) -> Completer:
        """The same with base and network on the renderer's device."""
        place = place_of(self.renderer)
        if self.base.means.device.type == place.type == "cpu":
            return self
        network = None if self.network is None else copy.deepcopy(self.network).to(place)
        return dataclasses.replace(self, base=self.base.to(place), network=network)

    def photo_guard(self) -> OcclusionGuard:
        """What the photo itself shows: no completion may stand in front of that."""
        rendering = self.renderer.render(self.there.base, self.photo_camera)
        return OcclusionGuard.of(rendering, self.photo_camera, self.threshold)

    def complete_view(
        self,
        camera: Camera,
        guards: Sequence[OcclusionGuard] | None = None,
        aux: Gaussians | None = None,
        rendering: Rendering | None = None,
    ) -> Gaussians:
        """New aux Gaussians for one view, 𝒢̃_aug of eq. 7; the arguments are those of `completed_view`."""
        return self.completed_view(camera, guards, aux, rendering)[0]

    @torch.no_grad()
    def completed_view(
        self,
        camera: Camera,
        guards: Sequence[OcclusionGuard] | None = None,
        aux: Gaussians | None = None,
        rendering: Rendering | None = None,
    ) -> tuple[Gaussians, Rendering]:
        """New aux Gaussians, and the view with them: as if all were drawn at once, at the cost of what changes.

        Args:
            camera: the view to complete.
            guards: views whose content must stay in front; the photo's alone where None.
            aux: aux Gaussians that are there already.
            rendering: base and aux from this view, where that is at hand.
        """
        guards = [self.photo_guard()] if guards is None else guards
        stage = _Stage([self.there.base] if aux is None else [self.there.base, aux], self.renderer)
        added, view = self.there._fill(stage, stage.look(camera, rendering), camera, guards)
        home = self.base.means.device
        return Gaussians.cat(added).to(home), view.to(home)

    @torch.no_grad()
    def complete_scene(
        self,
        cameras: Sequence[Camera],
        exact: bool = False,
        progress: Callable[[int, int], None] | None = None,
        seen: dict[int, Tensor] | None = None,
    ) -> Gaussians:
        """One set of aux Gaussians for a whole path, the same from every frame.

        Views are visited from the widest inwards, spread over the path. Each sees what the earlier ones
        added, and may add only behind what the photo, the widest views and the views before it show:
        in its holes, and beneath their rims. What lies beneath a rim of one of the two widest views may be
        what the other one shows in a hole, and fills better: it has to wait for both.

        Args:
            cameras: the frames of a path, in their order; with `exact` any views.
            exact: look at every view and complete it if it has a hole; else skip frames beside one that needs
                nothing, so that holes too small to see may stay open.
            progress: called with (views visited, views in all).
            seen: gets the pictures [H, W, 3], uint8, of views that were looked at once all was added, by their index.
        """
        if not cameras:
            return Gaussians.empty()
        order = farthest_first(cameras, self.photo_camera)
        guards, stage = {-1: self.photo_guard()}, _Stage([self.there.base], self.renderer)
        for index in reversed(order[:WIDEST]):  # the widest last: it is the first to be completed
            view = stage.look(cameras[index])
            guards[index] = OcclusionGuard.of(view, cameras[index], self.threshold)
        settled, aux, filled = SettledFrames(len(cameras)), [Gaussians.empty()], 0
        waiting: list[tuple[int, Gaussians]] = []  # a view, and what lies beneath its rims
        enough = CLOSED_HAR if exact else QUIET_HAR
        for count, index in enumerate(order):
            if exact or not settled.known(index):
                camera = cameras[index]
                view = stage.look(camera) if count else view
                holes = hole_area_ratio(view.alpha, self.threshold)
                # Nobody is spoken for where all are looked at.
                reach = float(holes == 0) if exact else reach_of(holes, view.alpha, self.threshold)
                if not reach:
                    others = [guard for of, guard in guards.items() if of != index]
                    subject = self.there
                    chosen = subject._seeds_alone if holes < SEEDS_HAR and not exact else subject._for_view(filled)
                    beneath: list[Gaussians] | None = [] if len(cameras) > 1 else None
                    added, view = chosen._fill(stage, view, camera, others, enough, beneath)
                    aux += added
                    waiting += [(index, rims) for rims in beneath or ()]
                    filled += 1
                    if seen:
                        seen.clear()
                    guards[index] = OcclusionGuard.of(view, camera, self.threshold)
                    if filled >= OPPOSITE:
                        hidden = _behind_others(waiting, cameras, guards)
                        stage.add(*hidden)
                        aux += hidden
                        waiting.clear()
                elif seen is not None:
                    seen[index] = to_bytes(view.rgb)
                settled.looked(index, reach)
            if progress:
                progress(count + 1, len(order))
        return Gaussians.cat([*aux, *_behind_others(waiting, cameras, guards)]).to(self.base.means.device)

    def _fill(
        self,
        stage: _Stage,
        view: Rendering,
        camera: Camera,
        guards: Sequence[OcclusionGuard],
        enough: float = CLOSED_HAR,
        beneath: list[Gaussians] | None = None,
    ) -> tuple[list[Gaussians], Rendering]:
        """What fills the holes of the view that the stage shows, and the view with it.

        `beneath` gets what lies beneath the holes' rims.
        """
        added = [Gaussians.empty()]
        for turn in range(PASSES):
            # What the network's blobs leave thin, the seeds close: it would only leave it thin again.
            new = (self._seeds_alone if turn else self)._propose(view, camera, guards, beneath)
            if not len(new):
                break
            added.append(new)
            view = stage.look_again(new)
            if hole_area_ratio(view.alpha, self.threshold) < enough:
                break
        return added, view

    @property
    def _seeds_alone(self) -> Completer:
        return dataclasses.replace(self, network=None, texture=None)

    def _for_view(self, number: int) -> Completer:
        """An inpainter is asked for the first views of a scene; they show nearly all of what later ones need."""
        if number < PAINTED_VIEWS or not isinstance(self.texture, PaintedTexture):
            return self
        return dataclasses.replace(self, texture=EXEMPLAR)

    def _propose(
        self, rendering: Rendering, camera: Camera, guards: Sequence[OcclusionGuard], beneath: list[Gaussians] | None
    ) -> Gaussians:
        """Masked selection (eq. 7): a Gaussian for each masked cell of a rendering, with a texture one for each pixel.

        They lie behind what the guards show. `beneath` gets those beneath the rims, which are not held back yet.
        """
        cues = Cues.of(rendering, self.threshold)
        if not bool(cues.mask.any()):
            return Gaussians.empty()
        seeds, eye = make_seeds(cues, camera, self.photo_camera), camera.position
        chosen, deltas, picture, rim = seeds.select(cues.mask), None, None, None
        if self.network is None and self.texture is None:
            cells = compose(chosen, None, camera)
        else:
            rim, patches = Rim.with_patches(cues, seeds, camera, self.photo_camera)
            if self.network is not None:
                deltas = predict_deltas(self.network, cues, seeds, rim, self.precision)[cues.mask]
            cells = compose(chosen, deltas, camera)
            if self.texture is not None:
                structure = cues.rgb.clone()
                structure[cues.mask] = linear_to_srgb(cells.colors)
                picture = self.texture.colors(structure, rendering, cues, seeds, rim, patches)
        away, depths, parts = free_factors(cells, eye, guards), camera.to_camera(cells.means)[:, 2], []
        away = torch.where(away > 0, without_pits(depths * away, cues.mask) / depths, 0)
        if picture is not None:
            wanted, blobs = (in_cells(image)[cues.mask] for image in (picture, sharpened(picture)))
            rough = (wanted - wanted.mean((1, 2), keepdim=True)).abs().amax((1, 2, 3)) > FLAT
            index = rough.nonzero()[:, 0]
            pixels = _pixels(chosen.select(index), None if deltas is None else deltas[index], camera, blobs[index])
            parts.append(moved_away(pixels, eye, away[index].repeat_interleave(CELL**2)))
            # As a lifted photo has them: behind the pixels' Gaussians one for each cell.
            cells = dataclasses.replace(cells, colors=srgb_to_linear(wanted.clamp(0, 1)).mean((1, 2)))
            away = away / (1 - BEHIND)
        parts.append(moved_away(cells, eye, away))
        if beneath is not None:
            filled = seeds.inverse_depth.clone()
            if rim is not None:  # beyond the photo's border nothing beneath the rim covers what was moved away
                there = rim.beyond[cues.mask] & (away > 0)
                filled[cues.mask] = torch.where(there, 1 / (depths * away), filled[cues.mask])
            beneath.append(rim_underlay(cues, dataclasses.replace(seeds, inverse_depth=filled), camera))
        return Gaussians.cat(parts)


class _Stage:
    """Sets of Gaussians on the renderer's device, and how a camera sees them.

    Each set travels there once, and of each view the images travel back once.
    """

    def __init__(self, sets: Sequence[Gaussians], renderer: Renderer) -> None:
        self._renderer, self._device = renderer, place_of(renderer)
        self._sets = [part.to(self._device) for part in sets]

    def look(self, camera: Camera, rendering: Rendering | None = None) -> Rendering:
        """What a camera sees, on the processor; `rendering` where it has been drawn already."""
        drawn = self._renderer.render(self._sets, camera) if rendering is None else rendering.to(self._device)
        self._camera, self._drawn = camera, drawn
        return drawn.to(PROCESSOR)

    def add(self, *sets: Gaussians) -> None:
        """More Gaussians, which the next look sees."""
        self._sets += [part.to(self._device) for part in sets]

    def look_again(self, new: Gaussians) -> Rendering:
        """Add Gaussians, and look from the last camera: only tiles that they touch are drawn."""
        self.add(new)
        tiles = touched_tiles(self._sets[-1], self._camera, self._renderer)
        self._drawn = self._renderer.render(self._sets, self._camera, tiles=tiles, onto=self._drawn)
        return self._drawn.to(PROCESSOR)


def _behind_others(
    waiting: Sequence[tuple[int, Gaussians]], cameras: Sequence[Camera], guards: Mapping[int, OcclusionGuard]
) -> list[Gaussians]:
    """What lies beneath the rims of some views, each behind what the guards of all other views show."""
    return [
        push_behind(rims, cameras[index].position, [guard for of, guard in guards.items() if of != index])
        for index, rims in waiting
    ]


def _pixels(chosen: Seeds, deltas: Tensor | None, camera: Camera, colors: Tensor) -> Gaussians:
    """Gaussians [4n] for the pixels of chosen cells: flat seeds [n], deltas [n, 14], or None, and sRGB [n, 2, 2, 3]."""
    own = None if deltas is None else deltas.repeat_interleave(CELL**2, 0)
    pixels = compose(chosen.for_pixels(), own, camera, FINE_SPREAD_PX)
    return dataclasses.replace(pixels, colors=srgb_to_linear(colors.flatten(0, 2).clamp(0, 1)))
