"""Telea's inpainting of each view by itself, by OpenCV (optional: pip install 'spackle-nvs[opencv]')."""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.opencv import OpenCV
from spackle.pseudo.views import ViewStack

RADIUS = 5.0  # pixels around a hole's pixel that colour it


class OpencvInpainter:
    """A plain baseline: quick, blind to depth, and different from view to view."""

    name = "opencv"

    def __init__(self) -> None:
        """Find the package.

        Raises:
            InputError: it is not installed.
        """
        self._opencv = OpenCV("--inpainter opencv", "geometry needs none")
        self.version = f"telea {RADIUS:g}, cv2 {self._opencv.version}"

    def complete(self, views: ViewStack) -> Tensor:
        """Each view by itself, with 8 bits a channel in the holes."""
        targets = []
        for rgb, mask in zip(views.rgb, views.mask, strict=True):
            if not bool(mask.any()):
                targets.append(rgb)
                continue
            targets.append(torch.where(mask[..., None], self._opencv.inpaint(rgb, mask, RADIUS), rgb))
        return torch.stack(targets)
