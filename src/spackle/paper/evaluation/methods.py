"""The compared methods : each renders new viewpoints of a photo from the same base prediction."""

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
from spackle.residual import MIN_AUX_GAUSSIANS, hole_mask
from spackle.scene_fill import FillContext, fill_scene, fill_view
from spackle.scene_fill.occlusion_guard import OcclusionGuard, move_behind_surfaces


class MethodView(NamedTuple):
    """A view rendered by a method, and the Gaussians that the method added for it."""

    rgb: Tensor  # [H, W, 3] sRGB 0..1
    alpha: Tensor | None  # [H, W]; None if the hole is filled in 2D
    aux: Gaussians | None  # added for the view; None if the method adds no Gaussians


# Fills a view, from its camera and the base's rendering from this camera.
Fill = Callable[[Camera, Rendering], MethodView]
# Makes the Gaussians that are added for a view, from the same.
AddedGaussians = Callable[[Camera, Rendering], Gaussians]


def make_method(
    name: str,
    cameras: Sequence[Camera],
    context: FillContext,
    inpainter: Inpainter | None = None,
    direct_ft: Callable[[], tuple[Gaussians, float]] | None = None,
) -> Fill:
    """Make the function that fills the views of a photo's base (its predicted Gaussians) by a
    method of `METHODS`.

    Args:
        name: a name in `METHODS`.
        cameras: the cameras of all views of a setting, because a method may complete all views
            together.
        context: the base, the network and the renderer.
        inpainter: needed by the method inpaint2d.
        direct_ft: needed by the method direct-ft; returns the fine-tuned base's Gaussians, and the
            factor that converts camera positions to the unit of these Gaussians.
    """
    context = context.placed
    if name == "base":
        return _on_top_of_base(context, lambda camera, base_rendering: Gaussians.empty())
    if name == "paper":
        return _on_top_of_base(context, partial(_paper_aux, context))
    if name == "dense":
        return _on_top_of_base(context, partial(_dense_aux, context, context.photo_guard()))
    if name == "spackle-scene":
        scene_aux = fill_scene(context, cameras, exact=True).aux
        return _on_top_of_base(context, lambda camera, base_rendering: scene_aux)

    # Each view is completed by itself (paper, section 3.4).
    if name == "spackle":
        return partial(_fill_each_view, context, context.photo_guard())
    if name == "initial":
        return partial(_fill_each_view, context.without_network, context.photo_guard())

    if name == "inpaint2d":
        assert inpainter is not None
        return partial(_inpaint_2d, inpainter)
    assert direct_ft is not None
    tuned_base, unit = direct_ft()
    return partial(_direct_ft, context.renderer, tuned_base, unit)


def _on_top_of_base(context: FillContext, added_gaussians: AddedGaussians) -> Fill:
    """A method that renders the base together with the Gaussians that `added_gaussians` makes for
    the view.
    """

    def fill(camera: Camera, base_rendering: Rendering) -> MethodView:
        """The completed view; without added Gaussians, the base's rendering itself."""
        aux = added_gaussians(camera, base_rendering)
        completed = base_rendering
        if len(aux):
            completed = context.renderer.render([context.base, aux], camera)
        return MethodView(completed.rgb, completed.alpha, aux)

    return fill


@torch.no_grad()
def _paper_aux(context: FillContext, camera: Camera, base_rendering: Rendering) -> Gaussians:
    """The aux Gaussians of a view by the paper's eqs. 4 to 7, from the base rendered from this
    view.
    """
    view = context.view(base_rendering, camera)
    deltas = view.deltas(context.network, context.precision)
    aux = view.gaussians(view.cells(MIN_AUX_GAUSSIANS), deltas)
    return aux.to(context.base.means.device)


def _fill_each_view(
    context: FillContext, photo_guard: OcclusionGuard, camera: Camera, base_rendering: Rendering
) -> MethodView:
    """A view completed by itself in two passes, behind the surfaces that the photo shows
    (`photo_guard`).
    """
    filled = fill_view(context, camera, [photo_guard], base_rendering)
    return MethodView(filled.rendering.rgb, filled.rendering.alpha, filled.aux)


@torch.no_grad()
def _dense_aux(
    context: FillContext, photo_guard: OcclusionGuard, camera: Camera, base_rendering: Rendering
) -> Gaussians:
    """An aux Gaussian for every 2×2 pixels, hole or not: the ablation of the mask (the paper's
    tab:mask_guided_init).

    The Gaussians are moved behind the surfaces that the photo shows (`photo_guard`).
    """
    view = context.view(base_rendering, camera)
    all_cells = torch.ones_like(view.mask)
    deltas = view.deltas(context.network, context.precision, dense=True)
    aux = view.gaussians(all_cells, deltas)
    return move_behind_surfaces(aux, camera.position, [photo_guard])


def _inpaint_2d(inpainter: Inpainter, camera: Camera, base_rendering: Rendering) -> MethodView:
    """The base's rendering with its hole inpainted as a flat picture; an inpainter takes a batch of
    views.
    """
    hole = hole_mask(base_rendering.alpha)
    inverse_depth = known_inverse_depth(base_rendering.depth, hole)
    painted = inpainter.paint(base_rendering.rgb[None], hole[None], inverse_depth[None])
    return MethodView(painted[0], None, None)


def _direct_ft(
    renderer: Renderer, base: Gaussians, unit: float, camera: Camera, base_rendering: Rendering
) -> MethodView:
    """The paper's naive decoupled framework: render a base that was fine-tuned on completed views;
    nothing is added.

    Args:
        renderer: draws the view.
        base: the Gaussians of the fine-tuned base.
        unit: the factor that converts camera positions to the unit of these Gaussians.
        camera: of the view.
        base_rendering: not used: the fine-tuned base is rendered instead.
    """
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= unit
    rendering = renderer.render(base, dataclasses.replace(camera, world_to_camera=pose))
    return MethodView(rendering.rgb, rendering.alpha, None)
