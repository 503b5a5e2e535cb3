"""One view's completion in steps that can be timed: `Completer.completed_view` with a clock in it."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import MAX_DISPARITY, DepthRange, extremes
from spackle.device import Precision
from spackle.errors import InputError
from spackle.evaluation.suite.clock import Lap
from spackle.gaussians import Gaussians
from spackle.render import Renderer, touched_tiles
from spackle.render.protocol import Rendering
from spackle.residual import Completer, Cues, ResidualNet, Seeds, hole_area_ratio, make_seeds
from spackle.residual.complete import CLOSED_HAR, PASSES
from spackle.residual.compose import compose
from spackle.residual.network import predict_deltas
from spackle.residual.occlusion_guard import OcclusionGuard, push_behind
from spackle.residual.seeds import Rim

RENDER = "base render of the view"
CUES, NETWORK, PLACE, REDRAW = "mask, cues, seeds, rim", "network", "compose, push behind the photo", "redraw"
HALVINGS, CLOSE = 14, 0.01  # of the search for a disparity; within this relative distance it is found


@dataclasses.dataclass(frozen=True)
class HoledView:
    """A view that has holes, and what fills them."""

    base: Gaussians
    photo_camera: Camera
    camera: Camera
    renderer: Renderer
    network: ResidualNet | None
    precision: Precision = "auto"

    @property
    def completer(self) -> Completer:
        return Completer(self.base, self.photo_camera, self.renderer, self.network, precision=self.precision)


@dataclasses.dataclass(frozen=True)
class Look:
    """What one of the looks at a view saw and drew."""

    cues: Cues
    seeds: Seeds
    rim: Rim | None  # where the network was asked
    new: Gaussians
    tiles: Tensor


def fill(view: HoledView, shield: OcclusionGuard, lap: Lap) -> tuple[list[Look], Rendering]:
    """Render and complete a view; what `Completer.completed_view` does, in stages."""
    rendering = view.renderer.render(view.base, view.camera)
    lap(RENDER)
    looks: list[Look] = []
    added = [Gaussians.empty()]
    for turn in range(PASSES):
        cues = Cues.of(rendering)
        if not bool(cues.mask.any()):
            break
        seeds = make_seeds(cues, view.camera, view.photo_camera)
        network = view.network if turn == 0 else None
        rim = None if network is None else Rim.of(cues, seeds, view.camera, view.photo_camera)
        lap(CUES)
        deltas = None
        if network is not None and rim is not None:
            deltas = predict_deltas(network, cues, seeds, rim, view.precision)[cues.mask]
        lap(NETWORK)
        new = push_behind(compose(seeds.select(cues.mask), deltas, view.camera), view.camera.position, [shield])
        lap(PLACE)
        added.append(new)
        tiles = touched_tiles(new, view.camera)
        rendering = view.renderer.render([view.base, *added], view.camera, tiles=tiles, onto=rendering)
        lap(REDRAW)
        looks.append(Look(cues, seeds, rim, new, tiles))
        if hole_area_ratio(rendering.alpha) < CLOSED_HAR:
            break
    return looks, rendering


def check_fill(view: HoledView, shield: OcclusionGuard) -> tuple[list[Look], Rendering]:
    """What `fill` finds; RuntimeError where that is not what the completer finds: other work would be timed."""
    looks, rendering = fill(view, shield, lambda name: None)
    aux, expected = view.completer.completed_view(view.camera, [shield])
    mine = Gaussians.cat([Gaussians.empty(), *(look.new for look in looks)])
    if len(mine) != len(aux) or not torch.allclose(rendering.rgb, expected.rgb, atol=1e-3):
        raise RuntimeError("the stages that are timed are not those of the completer")
    return looks, rendering


def find_view(base: Gaussians, camera: Camera, renderer: Renderer, share: float) -> tuple[float, Camera]:
    """The disparity at which a share of the view from the right is holes, by bisection; and that view.

    Raises:
        InputError: there is no such view.
    """
    even = camera.even()
    depths = DepthRange.of(base)

    def holes(disparity: float) -> float:
        return hole_area_ratio(renderer.render(base, extremes(even, disparity, depths)[1]).alpha)

    low, high = 0.0, MAX_DISPARITY
    if not holes(low) < share < holes(high):
        raise InputError(f"no view up to disparity {MAX_DISPARITY:g} has {share:.0%} holes")
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        found = holes(middle)
        low, high = (middle, high) if found < share else (low, middle)
        if abs(found / share - 1) < CLOSE:
            return middle, extremes(even, middle, depths)[1]
    return high, extremes(even, high, depths)[1]
