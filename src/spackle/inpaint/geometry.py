"""Filling each hole once, in 3D, and leaving the holes as they are."""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.inpaint.protocol import InpainterOptions, PlainInpainter, ViewStack


class NoInpainter(PlainInpainter):
    """Leaves the holes as they are: the targets are for somebody else to complete."""

    name = "none"
    version = "1"

    def __init__(self, options: InpainterOptions) -> None:
        """Take no option."""

    def complete(self, views: ViewStack) -> Tensor:
        """The renderings themselves."""
        return views.rgb


class GeometryInpainter(PlainInpainter):
    """Draws each hole from one completed scene, so what fills a hole stays where it is from view to view."""

    name = "geometry"
    version = "1"

    def __init__(self, options: InpainterOptions) -> None:
        """Take `complete_scene`; ValueError where there is none."""
        if options.complete_scene is None:
            raise ValueError("the geometry inpainter needs complete_scene")
        self._complete_scene = options.complete_scene

    @torch.no_grad()
    def complete(self, views: ViewStack) -> Tensor:
        """Views of the completed scene, in the holes."""
        draw = self._complete_scene(views.base, views.photo_camera, views.cameras)
        targets = []
        for camera, target, hole in zip(views.cameras, views.rgb, views.mask, strict=True):
            targets.append(torch.where(hole[..., None], draw(camera), target) if bool(hole.any()) else target)
        return torch.stack(targets)
