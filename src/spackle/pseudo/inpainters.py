"""Completing the uncovered part of a photo's views (paper, "Dataset"); another inpainter is another class here."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from spackle.errors import InputError
from spackle.fill import far_fill
from spackle.pseudo.opencv import OpencvInpainter
from spackle.pseudo.propainter import SIDE, PropainterInpainter
from spackle.pseudo.views import ViewStack
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, hole_mask


@dataclasses.dataclass(frozen=True)
class InpainterOptions:
    """What only an inpainter with a network takes."""

    weights: Path | None = None  # a folder
    side: int = SIDE  # pixels of the long side at which it works
    device: str | None = None  # "cpu" or "cuda"; where None, CUDA if there is any


class Inpainter(Protocol):
    """Turns renderings with holes into targets."""

    name: str
    version: str  # another version may give other pixels

    def complete(self, views: ViewStack) -> Tensor:
        """Targets [V, H, W, 3] sRGB in 0..1: new colours where `views.mask` is, elsewhere `views.rgb` as it is."""
        ...


class NoInpainter:
    """Leaves the holes as they are: the targets are for somebody else to complete."""

    name = "none"
    version = "1"

    def complete(self, views: ViewStack) -> Tensor:
        """The renderings themselves."""
        return views.rgb


class GeometryInpainter:
    """Fills each hole once, where it is widest, and carries the fill along the path as Gaussians.

    Depth and colour grow from the hole's rim, the far side first, and become aux Gaussians behind
    everything that the photo shows. All views are then drawn from one scene, so what fills a hole stays where it is
    from view to view.
    """

    name = "geometry"
    version = "1"

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer

    @torch.no_grad()
    def complete(self, views: ViewStack) -> Tensor:
        """Views of the completed scene, in the holes."""
        completer = Completer(views.base, views.photo_camera, self.renderer)
        aux = completer.complete_scene(views.cameras, exact=True)
        targets = []
        for index, camera in enumerate(views.cameras):
            target, hole = views.rgb[index], views.mask[index]
            if bool(hole.any()):
                drawn = self.renderer.render([views.base, aux], camera)
                target = torch.where(hole[..., None], closed(drawn), target)
            targets.append(target)
        return torch.stack(targets)


def closed(drawn: Rendering) -> Tensor:
    """The colours [H, W, 3] of a view, the few pixels that are still uncovered grown from those around them."""
    left = hole_mask(drawn.alpha)
    known = ~left & (drawn.depth > 0)
    if not bool(left.any()) or not bool(known.any()):
        return drawn.rgb
    inverse_depth = torch.where(known, 1.0 / drawn.depth.clamp_min(1e-6), 0.0)
    return far_fill(inverse_depth, drawn.rgb.permute(2, 0, 1), known)[1].permute(1, 2, 0)


INPAINTERS: dict[str, Callable[[Renderer, InpainterOptions], Inpainter]] = {
    "geometry": lambda renderer, options: GeometryInpainter(renderer),
    "opencv": lambda renderer, options: OpencvInpainter(),
    "propainter": lambda renderer, options: PropainterInpainter(options.weights, options.side, options.device),
    "none": lambda renderer, options: NoInpainter(),
}


def get_inpainter(name: str, renderer: Renderer, options: InpainterOptions | None = None) -> Inpainter:
    """An inpainter by its name.

    Raises:
        InputError: an unknown one, or one whose package or weights are not there.
    """
    if name not in INPAINTERS:
        raise InputError(f"--inpainter {name}: unknown; there are {', '.join(inpainter_names())}")
    return INPAINTERS[name](renderer, options or InpainterOptions())


def inpainter_names() -> Sequence[str]:
    """What `get_inpainter` takes."""
    return tuple(INPAINTERS)
