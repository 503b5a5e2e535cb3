"""How a photo's views become targets: drawn from one completed scene, left open, or painted by an inpainter."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.dataset.views import ViewStack
from spackle.fill import far_fill
from spackle.inpaint import INPAINTERS, Inpainter, InpainterOptions, get_inpainter, known_inverse_depth
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, hole_mask

COMPLETIONS = ("geometry", *INPAINTERS, "none")  # what --inpainter may name


@dataclasses.dataclass(frozen=True)
class Completion:
    """A way to targets [V, H, W, 3] sRGB: new colours where a stack's mask is, elsewhere its rgb as it is."""

    name: str
    version: str  # another version may give other pixels
    complete: Callable[[ViewStack], Tensor]
    notice: str = ""  # as of `Inpainter`
    files: Mapping[str, Path] = dataclasses.field(default_factory=dict)


def open_completion(name: str, options: InpainterOptions, renderer: Renderer) -> Completion:
    """One of `COMPLETIONS`; InputError where its package or its weights are missing."""
    if name == "none":  # the targets are for somebody else to complete
        return Completion(name, "1", lambda views: views.rgb)
    if name == "geometry":
        return Completion(name, "1", partial(draw_from_scene, renderer=renderer))
    inpainter = get_inpainter(name, options)
    return Completion(name, inpainter.version, partial(paint, inpainter), inpainter.notice, inpainter.files)


@torch.no_grad()
def draw_from_scene(views: ViewStack, renderer: Renderer) -> Tensor:
    """Each hole as one scene shows it, completed by seeds alone in the widest view: it stays where it is in all."""
    aux = Completer(views.base, views.photo_camera, renderer, texture=None).complete_scene(views.cameras, exact=True)
    targets = []
    for camera, target, hole in zip(views.cameras, views.rgb, views.mask, strict=True):
        if bool(hole.any()):
            target = torch.where(hole[..., None], _closed(renderer.render([views.base, aux], camera)), target)
        targets.append(target)
    return torch.stack(targets)


def _closed(drawn: Rendering) -> Tensor:
    """The colours [H, W, 3] of a view, the few pixels that are still uncovered grown from those around them."""
    left = hole_mask(drawn.alpha)
    inverse_depth = known_inverse_depth(drawn.depth, left)
    known = inverse_depth > 0
    if not bool(left.any()) or not bool(known.any()):
        return drawn.rgb
    return far_fill(inverse_depth, drawn.rgb.permute(2, 0, 1), known)[1].permute(1, 2, 0)


def paint(inpainter: Inpainter, views: ViewStack) -> Tensor:
    """The views' pictures, their holes painted."""
    order = path_order(views.cameras)
    inverse_depth = known_inverse_depth(views.depth, views.mask)
    targets = torch.empty_like(views.rgb)
    targets[order] = inpainter.paint(views.rgb[order], views.mask[order], inverse_depth[order])
    return targets


def path_order(cameras: Sequence[Camera]) -> list[int]:
    """Views as a flight along the path meets them: the first one, the photo's, is put where it is the least detour."""
    eyes = torch.stack([camera.position.double() for camera in cameras])
    others = list(range(1, len(cameras)))
    orders = [[*others[:place], 0, *others[place:]] for place in range(len(cameras))]
    return min(orders, key=lambda order: float(eyes[order].diff(dim=0).norm(dim=-1).sum()))
