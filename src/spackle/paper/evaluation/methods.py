"""The compared methods: each renders new viewpoints of a photo from the same base prediction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import complete_view, hole_mask
from spackle.residual.completion import compose
from spackle.residual.features import ViewFeatures
from spackle.residual.initializer import initialize
from spackle.residual.network import find_rim, predict_deltas
from spackle.scene_fill import FillContext, fill_scene, fill_view
from spackle.scene_fill.occlusion_guard import OcclusionGuard, move_behind_surfaces


class MethodView(NamedTuple):
    """A view rendered by a method, and its aux Gaussians."""

    rgb: Tensor  # [H, W, 3] sRGB 0..1
    alpha: Tensor | None  # [H, W]; None if the hole is filled in 2D
    aux: Gaussians | None  # added for the view; None if the method has no aux Gaussians


Fill = Callable[
    [Camera, Rendering], MethodView
]  # from a view's camera and the base's rendering of the view


LEAST_AUX = 64  # the least number of aux Gaussians per view in the paper (training details)


def make_method(
    name: str,
    cameras: Sequence[Camera],
    context: FillContext,
    inpainter: Inpainter | None = None,
    direct_ft: Callable[[], tuple[Gaussians, float]] | None = None,
) -> Fill:
    """Make the function that fills the views of a photo's base by a method of `METHODS`.

    Args:
        name: a name in `METHODS`.
        cameras: the cameras of all views of a setting, because a method may complete all views together.
        context: the base, the network and the renderer.
        inpainter: for inpaint2d.
        direct_ft: needed by the method direct-ft; returns the fine-tuned base's Gaussians, and the factor that
            converts camera positions to the unit of these Gaussians.
    """
    context = context.placed
    guard = context.photo_guard() if name in ("spackle", "seeds", "dense") else None

    def on_top(aux_of: Callable[[Camera, Rendering], Gaussians]) -> Fill:
        """A method that renders the base together with the aux Gaussians from `aux_of`."""

        def fill(camera: Camera, before: Rendering) -> MethodView:
            aux = aux_of(camera, before)
            drawn = context.renderer.render([context.base, aux], camera) if len(aux) else before
            return MethodView(drawn.rgb, drawn.alpha, aux)

        return fill

    if name == "base":
        return on_top(lambda camera, before: Gaussians.empty())
    if name == "paper":
        return on_top(partial(_paper_aux, context))
    if name == "dense":
        return on_top(partial(_dense_aux, context, guard))
    if name == "spackle-scene":
        scene = fill_scene(context, cameras, exact=True).aux
        return on_top(lambda camera, before: scene)
    if name in ("spackle", "seeds"):  # each view is completed separately (paper, section 3.4)
        return partial(_per_view, context if name == "spackle" else context.seeds_alone, guard)
    if name == "inpaint2d":
        assert inpainter is not None
        return partial(_inpaint_2d, inpainter)
    assert direct_ft is not None
    return partial(_direct_ft, context.renderer, *direct_ft())


def _paper_aux(context: FillContext, camera: Camera, before: Rendering) -> Gaussians:
    """Aux Gaussians by the paper's eqs. 2 to 9."""
    return complete_view(
        context.base,
        camera,
        context.photo_camera,
        context.renderer,
        context.network,
        threshold=context.threshold,
        least=LEAST_AUX,
        rendering=before,
        photo=context.photo,
        precision=context.precision,
    )


def _per_view(
    context: FillContext, guard: OcclusionGuard | None, camera: Camera, before: Rendering
) -> MethodView:
    assert guard is not None
    filled = fill_view(context, camera, [guard], before)
    return MethodView(filled.rendering.rgb, filled.rendering.alpha, filled.aux)


@torch.no_grad()
def _dense_aux(
    context: FillContext, guard: OcclusionGuard | None, camera: Camera, before: Rendering
) -> Gaussians:
    """An aux Gaussian for every 2×2 cell, hole or not: the ablation of mask-guided seeds (tab:mask_guided_init)."""
    assert guard is not None
    network, photo_camera = context.network, context.photo_camera
    features = ViewFeatures.of(before)
    seeds, deltas = initialize(features, camera, photo_camera), None
    if network is not None:
        rim, _ = find_rim(features, seeds, camera, photo_camera, context.photo)
        deltas = predict_deltas(
            network, features, seeds, rim, context.precision, dense=True
        ).flatten(0, 1)
    aux = compose(seeds.select(torch.ones_like(features.mask)), deltas, camera)
    return move_behind_surfaces(aux, camera.position, [guard])


def _inpaint_2d(inpainter: Inpainter, camera: Camera, before: Rendering) -> MethodView:
    hole = hole_mask(before.alpha)
    flat = (before.rgb, hole, known_inverse_depth(before.depth, hole))
    return MethodView(inpainter.paint(*(image[None] for image in flat))[0], None, None)


def _direct_ft(
    renderer: Renderer, base: Gaussians, unit: float, camera: Camera, before: Rendering
) -> MethodView:
    """The paper's naive decoupled framework: render a base that was fine-tuned on completed views; no aux Gaussians."""
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= unit
    drawn = renderer.render(base, dataclasses.replace(camera, world_to_camera=pose))
    return MethodView(drawn.rgb, drawn.alpha, None)
