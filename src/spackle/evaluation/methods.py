"""What is compared: ways to views of a photo from elsewhere, all on top of one base prediction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.render.protocol import Rendering
from spackle.residual import complete_view, hole_mask
from spackle.residual.base_values import make_seeds
from spackle.residual.complete import compose
from spackle.residual.network import find_rim, predict_deltas
from spackle.residual.view_features import ViewFeatures
from spackle.scene_fill import FillContext, fill_scene, fill_view
from spackle.scene_fill.occlusion_guard import push_behind


class MethodView(NamedTuple):
    """What a method makes of one view."""

    rgb: Tensor  # [H, W, 3] sRGB 0..1
    alpha: Tensor | None  # [H, W]; None where the hole is not filled by anything in 3D
    aux: int | None  # Gaussians added for it; None where there are none by nature


# (cameras, the base's renderings from them) to a view for each, one at a time: there may be many.
Method = Callable[[Sequence[Camera], Sequence[Rendering]], Iterator[MethodView]]
LEAST_AUX = 64  # that the paper keeps in each view (training details)
METHODS = {  # title in tables, description in captions
    "base": ("base alone", "the base's render, holes black"),
    "paper": (
        "Spackle, eqs. 2 to 9",
        "the paper's method: one pass for each view, an aux Gaussian for each masked cell",
    ),
    "spackle": ("Spackle", "ours: each view by itself in two passes, behind what the photo shows, with texture"),
    "spackle-scene": ("Spackle, one scene", "one set of aux Gaussians for all views of a setting"),
    "seeds": ("seeds", "as Spackle, without a network: deltas of zero"),
    "dense": ("dense grid", "an aux Gaussian for every cell, in one pass"),
    "inpaint2d": ("2D inpainting", "the base's render, its hole inpainted as a flat picture"),
    "direct-ft": ("direct FT", "the base fine-tuned on completed views, no aux Gaussians"),
}


def make_method(
    name: str,
    context: FillContext,
    inpainter: Inpainter | None = None,
    direct_ft: Callable[[], tuple[Gaussians, float]] | None = None,
) -> Method:
    """A method of `METHODS` on a photo's base.

    Args:
        name: see `METHODS`.
        context: the base, and what fills its views' holes.
        inpainter: of inpaint2d.
        direct_ft: of direct-ft, asked now: the photo by the other base, and that one's unit of length in this one's.
    """
    if name == "direct-ft":
        assert direct_ft is not None
        return partial(_direct_ft, context, *direct_ft())
    if name == "inpaint2d":
        assert inpainter is not None
        return partial(_inpaint_2d, inpainter)
    methods: dict[str, Method] = {
        "base": lambda cameras, before: (MethodView(view.rgb, view.alpha, 0) for view in before),
        "paper": partial(_paper, context),
        "spackle": partial(_per_view, context),
        "spackle-scene": partial(_one_scene, context),
        "seeds": partial(_per_view, context.seeds_alone),
        "dense": partial(_dense, context),
    }
    return methods[name]


def _paper(context: FillContext, cameras: Sequence[Camera], before: Sequence[Rendering]) -> Iterator[MethodView]:
    """Aux Gaussians for each view, as eqs. 2 to 9 say."""
    placed = context.placed
    for camera, rendering in zip(cameras, before, strict=True):
        aux = complete_view(
            placed.base,
            camera,
            placed.photo_camera,
            placed.renderer,
            placed.network,
            threshold=placed.threshold,
            least=LEAST_AUX,
            rendering=rendering,
            photo=placed.photo,
            precision=placed.precision,
        )
        yield _drawn(placed, aux, camera, rendering)


def _per_view(context: FillContext, cameras: Sequence[Camera], before: Sequence[Rendering]) -> Iterator[MethodView]:
    """Aux Gaussians for each view by itself (paper, section 3.4)."""
    guard = context.photo_guard()
    for camera, rendering in zip(cameras, before, strict=True):
        filled = fill_view(context, camera, [guard], rendering)
        yield MethodView(filled.rendering.rgb, filled.rendering.alpha, len(filled.aux))


def _one_scene(context: FillContext, cameras: Sequence[Camera], before: Sequence[Rendering]) -> Iterator[MethodView]:
    """One set of aux Gaussians for all views together."""
    aux = fill_scene(context, cameras, exact=True).aux
    for camera, rendering in zip(cameras, before, strict=True):
        yield _drawn(context, aux, camera, rendering)


@torch.no_grad()
def _dense(context: FillContext, cameras: Sequence[Camera], before: Sequence[Rendering]) -> Iterator[MethodView]:
    """An aux Gaussian for every 2×2 cell, hole or not: the ablation of the mask-guided seeds (tab:mask_guided_init)."""
    guard, network, photo_camera = context.photo_guard(), context.network, context.photo_camera
    for camera, rendering in zip(cameras, before, strict=True):
        features = ViewFeatures.of(rendering)
        seeds = make_seeds(features, camera, photo_camera)
        deltas = None
        if network is not None:
            rim, _ = find_rim(features, seeds, camera, photo_camera, context.photo)
            deltas = predict_deltas(network, features, seeds, rim, context.precision, dense=True).flatten(0, 1)
        aux = compose(seeds.select(torch.ones_like(features.mask)), deltas, camera)
        yield _drawn(context, push_behind(aux, camera.position, [guard]), camera, rendering)


def _drawn(context: FillContext, aux: Gaussians, camera: Camera, before: Rendering) -> MethodView:
    """A view with aux Gaussians on top of the base."""
    drawn = context.renderer.render([context.base, aux], camera) if len(aux) else before
    return MethodView(drawn.rgb, drawn.alpha, len(aux))


def _inpaint_2d(inpainter: Inpainter, cameras: Sequence[Camera], before: Sequence[Rendering]) -> Iterator[MethodView]:
    """The base's render with its hole inpainted as a flat picture."""
    for view in before:
        hole = hole_mask(view.alpha)
        flat = (view.rgb, hole, known_inverse_depth(view.depth, hole))
        yield MethodView(inpainter.paint(*(image[None] for image in flat))[0], None, None)


def _direct_ft(
    context: FillContext, base: Gaussians, unit: float, cameras: Sequence[Camera], before: Sequence[Rendering]
) -> Iterator[MethodView]:
    """The paper's naive decoupled framework: another base, trained on completed views, by itself."""
    for camera in cameras:
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= unit
        drawn = context.renderer.render(base, dataclasses.replace(camera, world_to_camera=pose))
        yield MethodView(drawn.rgb, drawn.alpha, None)
