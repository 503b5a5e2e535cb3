"""What is compared: ways to a view of a photo from elsewhere, all on top of one base prediction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.device import Precision
from spackle.gaussians import Gaussians
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet, hole_mask
from spackle.residual.base_values import make_seeds
from spackle.residual.compose import compose
from spackle.residual.network import predict_deltas
from spackle.residual.rim import find_rim
from spackle.residual.view_features import ViewFeatures
from spackle.scene_fill import FillContext, OcclusionGuard, Texture, exemplar_texture, fill_scene, fill_view
from spackle.scene_fill.occlusion_guard import push_behind


@dataclasses.dataclass(frozen=True)
class Shot:
    """A photo's base, and the views that are wanted of it."""

    prediction: BasePrediction
    cameras: Sequence[Camera]
    before: Sequence[Rendering]  # the base from each of them
    renderer: Renderer

    @property
    def base(self) -> Gaussians:
        return self.prediction.gaussians

    @cached_property
    def guard(self) -> OcclusionGuard:
        """What the photo shows, which no completion may cover."""
        return self.context(None).photo_guard()

    def context(
        self, network: ResidualNet | None, precision: Precision = "auto", texture: Texture | None = exemplar_texture
    ) -> FillContext:
        """What fills its holes; with seeds alone where there is no network."""
        return FillContext(self.base, self.prediction.camera, self.renderer, network, texture, precision=precision)

    def draw(self, aux: Gaussians, index: int) -> View:
        """A view with aux Gaussians on top of the base."""
        if not len(aux):
            return View(self.before[index].rgb, self.before[index].alpha, 0)
        drawn = self.renderer.render([self.base, aux], self.cameras[index])
        return View(drawn.rgb, drawn.alpha, len(aux))


@dataclasses.dataclass(frozen=True)
class View:
    """What a method makes of one view."""

    rgb: Tensor  # [H, W, 3] sRGB 0..1
    alpha: Tensor | None  # [H, W]; None where the hole is not filled by anything in 3D
    aux: int | None  # Gaussians added for it; None where there are none by nature


Method = Callable[[Shot], Iterator[View]]  # the views of a shot, in its order, one at a time: there may be many


def _per_view(
    shot: Shot, network: ResidualNet | None, precision: Precision = "auto", texture: Texture | None = exemplar_texture
) -> Iterator[View]:
    """Aux Gaussians for each view by itself (paper, section 3.4); seeds alone where there is no network."""
    context = shot.context(network, precision, texture)
    for camera, before in zip(shot.cameras, shot.before, strict=True):
        filled = fill_view(context, camera, [shot.guard], before)
        yield View(filled.rendering.rgb, filled.rendering.alpha, len(filled.aux))


def _one_scene(shot: Shot, network: ResidualNet | None, precision: Precision) -> Iterator[View]:
    """One set of aux Gaussians for all views of a shot together."""
    aux = fill_scene(shot.context(network, precision), shot.cameras, exact=True).aux
    for index in range(len(shot.cameras)):
        yield shot.draw(aux, index)


@torch.no_grad()
def _dense(shot: Shot, network: ResidualNet | None, precision: Precision) -> Iterator[View]:
    """An aux Gaussian for every 2×2 cell, hole or not: the ablation of the mask-guided seeds (tab:mask_guided_init)."""
    photo_camera = shot.prediction.camera
    for index, (camera, before) in enumerate(zip(shot.cameras, shot.before, strict=True)):
        cues = ViewFeatures.of(before)
        seeds = make_seeds(cues, camera, photo_camera)
        deltas = None
        if network is not None:
            rim, _ = find_rim(cues, seeds, camera, photo_camera)
            deltas = predict_deltas(network, cues, seeds, rim, precision, dense=True).flatten(0, 1)
        aux = compose(seeds.select(torch.ones_like(cues.mask)), deltas, camera)
        yield shot.draw(push_behind(aux, camera.position, [shot.guard]), index)


def _inpaint_2d(shot: Shot, inpainter: Inpainter) -> Iterator[View]:
    """The base's render with its hole inpainted as a flat picture."""
    for before in shot.before:
        hole = hole_mask(before.alpha)
        flat = (before.rgb, hole, known_inverse_depth(before.depth, hole))
        yield View(inpainter.paint(*(image[None] for image in flat))[0], None, None)


def _direct_ft(shot: Shot, prediction: BasePrediction, unit: float) -> Iterator[View]:
    """The paper's naive decoupled framework: another base, trained on completed views, by itself."""
    for camera in shot.cameras:
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= unit
        drawn = shot.renderer.render(prediction.gaussians, dataclasses.replace(camera, world_to_camera=pose))
        yield View(drawn.rgb, drawn.alpha, None)


class MethodNames(NamedTuple):
    """A method's names."""

    title: str  # in tables
    description: str  # in captions


METHODS = {
    "base": MethodNames("base alone", "the base's render, holes black"),
    "spackle": MethodNames("Spackle", "aux Gaussians for each view by itself, as in the paper"),
    "spackle-scene": MethodNames("Spackle, one scene", "one set of aux Gaussians for all views of a setting"),
    "network": MethodNames("network", "as Spackle, without the exemplar's texture: the paper's method"),
    "seeds": MethodNames("seeds", "as Spackle, without a network: deltas of zero"),
    "dense": MethodNames("dense grid", "an aux Gaussian for every cell, in one pass"),
    "inpaint2d": MethodNames("2D inpainting", "the base's render, its hole inpainted as a flat picture"),
    "direct-ft": MethodNames("direct FT", "the base fine-tuned on completed views, no aux Gaussians"),
}


def make_method(
    name: str,
    network: ResidualNet | None,
    direct_ft: Callable[[], tuple[BasePrediction, float]] | None = None,
    precision: Precision = "auto",
    inpainter: Inpainter | None = None,
) -> Method:
    """A method of `METHODS`.

    Args:
        name: which one.
        network: of the residual, run at `precision`; None for seeds alone.
        direct_ft: predicts the photo with the other base, and gives that one's unit of length in this one's.
        precision: see `network`.
        inpainter: of inpaint2d.
    """
    if name == "direct-ft":
        assert direct_ft is not None
        prediction, unit = direct_ft()
        return partial(_direct_ft, prediction=prediction, unit=unit)
    if name == "inpaint2d":
        assert inpainter is not None
        return partial(_inpaint_2d, inpainter=inpainter)
    methods: dict[str, Method] = {
        "base": lambda shot: (View(before.rgb, before.alpha, 0) for before in shot.before),
        "spackle": partial(_per_view, network=network, precision=precision),
        "spackle-scene": partial(_one_scene, network=network, precision=precision),
        "network": partial(_per_view, network=network, precision=precision, texture=None),
        "seeds": partial(_per_view, network=None, texture=None),
        "dense": partial(_dense, network=network, precision=precision),
    }
    return methods[name]
