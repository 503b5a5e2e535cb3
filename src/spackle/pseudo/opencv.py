"""Telea's inpainting of each view by itself, by OpenCV (optional: pip install 'spackle-nvs[opencv]')."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from spackle.errors import InputError
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
        try:
            import cv2
        except ImportError as error:
            raise InputError(
                "--inpainter opencv needs a package: pip install 'spackle-nvs[opencv]'; geometry needs none"
            ) from error
        self._cv2: Any = cv2
        self.version = f"telea {RADIUS:g}, cv2 {cv2.__version__}"

    def complete(self, views: ViewStack) -> Tensor:
        """Each view by itself, with 8 bits a channel in the holes."""
        targets = []
        for rgb, mask in zip(views.rgb, views.mask, strict=True):
            if not bool(mask.any()):
                targets.append(rgb)
                continue
            picture = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
            filled = self._cv2.inpaint(picture, mask.to(torch.uint8).numpy(), RADIUS, self._cv2.INPAINT_TELEA)
            targets.append(torch.where(mask[..., None], torch.from_numpy(filled).float() / 255, rgb))
        return torch.stack(targets)
