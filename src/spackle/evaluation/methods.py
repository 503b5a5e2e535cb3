"""What is compared (methods.json): ways to views of a photo from elsewhere, all on top of one base prediction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.evaluation.rows import load_data
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
    aux: Gaussians | None  # added for it; None where there are none by nature


Fill = Callable[[Camera, Rendering], MethodView]  # of a view and the base's rendering of it
Method = Callable[[Sequence[Camera]], Fill]  # of all views of a setting, which a method may complete together


class MethodFacts(NamedTuple):
    title: str  # in tables
    says: str  # in notes
    color: str  # in plots: Okabe and Ito's, which the colour-blind tell apart
    form: str  # of a plot's dots


METHODS = {name: MethodFacts(**facts) for name, facts in load_data("methods.json").items()}
LEAST_AUX = 64  # that the paper keeps in each view (training details)
RESIDUAL = ("paper", "spackle", "spackle-scene", "dense")  # methods that run the residual network


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
        return _direct_ft(context, *direct_ft())
    if name == "inpaint2d":
        assert inpainter is not None
        return _inpaint_2d(inpainter)
    methods: dict[str, Method] = {
        "base": lambda cameras: lambda camera, before: MethodView(before.rgb, before.alpha, Gaussians.empty()),
        "paper": lambda cameras: _paper(context.placed),
        "spackle": lambda cameras: _per_view(context),
        "spackle-scene": lambda cameras: _one_scene(context, cameras),
        "seeds": lambda cameras: _per_view(context.seeds_alone),
        "dense": lambda cameras: _dense(context),
    }
    return methods[name]


def _paper(context: FillContext) -> Fill:
    """Aux Gaussians for each view, as eqs. 2 to 9 say."""
    photo = context.photo

    def fill(camera: Camera, before: Rendering) -> MethodView:
        aux = complete_view(
            context.base,
            camera,
            context.photo_camera,
            context.renderer,
            context.network,
            threshold=context.threshold,
            least=LEAST_AUX,
            rendering=before,
            photo=photo,
            precision=context.precision,
        )
        return _drawn(context, aux, camera, before)

    return fill


def _per_view(context: FillContext) -> Fill:
    """Aux Gaussians for each view by itself (paper, section 3.4)."""
    guard = context.photo_guard()

    def fill(camera: Camera, before: Rendering) -> MethodView:
        filled = fill_view(context, camera, [guard], before)
        return MethodView(filled.rendering.rgb, filled.rendering.alpha, filled.aux)

    return fill


def _one_scene(context: FillContext, cameras: Sequence[Camera]) -> Fill:
    """One set of aux Gaussians for all views together."""
    aux = fill_scene(context, cameras, exact=True).aux
    return lambda camera, before: _drawn(context, aux, camera, before)


def _dense(context: FillContext) -> Fill:
    """An aux Gaussian for every 2×2 cell, hole or not: the ablation of the mask-guided seeds (tab:mask_guided_init)."""
    guard, network, photo_camera = context.photo_guard(), context.network, context.photo_camera

    @torch.no_grad()
    def fill(camera: Camera, before: Rendering) -> MethodView:
        features = ViewFeatures.of(before)
        seeds = make_seeds(features, camera, photo_camera)
        deltas = None
        if network is not None:
            rim, _ = find_rim(features, seeds, camera, photo_camera, context.photo)
            deltas = predict_deltas(network, features, seeds, rim, context.precision, dense=True).flatten(0, 1)
        aux = compose(seeds.select(torch.ones_like(features.mask)), deltas, camera)
        return _drawn(context, push_behind(aux, camera.position, [guard]), camera, before)

    return fill


def _drawn(context: FillContext, aux: Gaussians, camera: Camera, before: Rendering) -> MethodView:
    """A view with aux Gaussians on top of the base."""
    drawn = context.renderer.render([context.base, aux], camera) if len(aux) else before
    return MethodView(drawn.rgb, drawn.alpha, aux)


def _inpaint_2d(inpainter: Inpainter) -> Method:
    """The base's render with its hole inpainted as a flat picture."""

    def fill(camera: Camera, before: Rendering) -> MethodView:
        hole = hole_mask(before.alpha)
        flat = (before.rgb, hole, known_inverse_depth(before.depth, hole))
        return MethodView(inpainter.paint(*(image[None] for image in flat))[0], None, None)

    return lambda cameras: fill


def _direct_ft(context: FillContext, base: Gaussians, unit: float) -> Method:
    """The paper's naive decoupled framework: another base, trained on completed views, by itself."""

    def fill(camera: Camera, before: Rendering) -> MethodView:
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= unit
        drawn = context.renderer.render(base, dataclasses.replace(camera, world_to_camera=pose))
        return MethodView(drawn.rgb, drawn.alpha, None)

    return lambda cameras: fill
