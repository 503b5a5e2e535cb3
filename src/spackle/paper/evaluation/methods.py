"""The compared methods: each renders new viewpoints of a photo from the same base prediction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import hole_mask
from spackle.scene_fill import FillContext, fill_scene, fill_view
from spackle.scene_fill.occlusion_guard import OcclusionGuard


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
    """Make the function by which a method fills the holes in views of a photo's Gaussians.

    Args:
        name: the method, a key of `METHODS`.
        cameras: the cameras of all views of a setting, because a method may complete all views
            together.
        context: the base, the network and the renderer.
        inpainter: needed by the method inpaint2d.
        direct_ft: needed by the method direct-ft; returns the fine-tuned base's Gaussians, and the
            factor that converts camera positions to the unit of these Gaussians.
    """
    context = context.on_renderer_device
    if name == "base":
        return _on_top_of_base(context, lambda camera, base_rendering: Gaussians.empty())
    if name == "paper":
        return _on_top_of_base(context, context.complete_as_paper)
    if name == "paper-initial":
        return _on_top_of_base(context, context.without_network.complete_as_paper)
    if name == "dense":
        # The paper's dense row differs from its method in nothing but the cells.
        return _on_top_of_base(context, partial(context.complete_as_paper, cells="all"))
    if name == "spackle-scene":
        # `exact`: every view is checked, and every hole is filled, however small.
        scene_aux = fill_scene(context, cameras, exact=True).aux
        return _on_top_of_base(context, lambda camera, base_rendering: scene_aux)

    # These two complete each view independently of other views (paper, section 3.4).
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
    """The function that renders the base's Gaussians together with others.

    `added_gaussians` makes these others, from a view's camera and the base's rendering by it.
    """

    def fill(camera: Camera, base_rendering: Rendering) -> MethodView:
        """The completed view; without added Gaussians, the base's rendering itself."""
        aux = added_gaussians(camera, base_rendering)
        completed = base_rendering
        if len(aux):
            completed = context.renderer.render([context.base, aux], camera)
        return MethodView(rgb=completed.rgb, alpha=completed.alpha, aux=aux)

    return fill


def _fill_each_view(
    context: FillContext, photo_guard: OcclusionGuard, camera: Camera, base_rendering: Rendering
) -> MethodView:
    """Complete one view by itself: fill its holes, render it, and fill holes that are still open.

    Args:
        context: the base's Gaussians, the network and the renderer.
        photo_guard: keeps added Gaussians behind the surfaces that the photo shows.
        camera: of the view.
        base_rendering: the base, rendered by this camera.
    """
    filled = fill_view(context, camera, [photo_guard], base_rendering)
    return MethodView(rgb=filled.rendering.rgb, alpha=filled.rendering.alpha, aux=filled.aux)


def _inpaint_2d(inpainter: Inpainter, camera: Camera, base_rendering: Rendering) -> MethodView:
    """The base's rendering of a view, in which an inpainter has filled the hole in the picture.

    Nothing is added to the scene, so the result has neither opacity nor Gaussians.
    """
    hole = hole_mask(base_rendering.alpha)
    inverse_depth = known_inverse_depth(base_rendering.depth, hole)
    # An inpainter takes a batch of views; this one has a single view.
    painted = inpainter.paint(base_rendering.rgb[None], hole[None], inverse_depth[None])
    return MethodView(rgb=painted[0], alpha=None, aux=None)


def _direct_ft(
    renderer: Renderer, base: Gaussians, unit: float, camera: Camera, base_rendering: Rendering
) -> MethodView:
    """Render a view of a base that was fine-tuned on completed views; no Gaussians are added.

    The paper calls this the naive decoupled framework.

    Args:
        renderer: draws the view.
        base: the Gaussians of the fine-tuned base, in that base's own unit of length.
        unit: the factor that converts the camera's position to this unit.
        camera: of the view.
        base_rendering: not used: the fine-tuned base is rendered instead.
    """
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= unit
    rendering = renderer.render(base, dataclasses.replace(camera, world_to_camera=pose))
    return MethodView(rgb=rendering.rgb, alpha=rendering.alpha, aux=None)
