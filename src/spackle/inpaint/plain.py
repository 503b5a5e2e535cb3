"""Inpainters without a network: patches of the image itself, and OpenCV (pip install 'spackle-nvs[opencv]')."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from spackle.core.hole_filling import fill_from_far_side
from spackle.core.patch_matching import match_patches
from spackle.inpaint.protocol import InpainterOptions
from spackle.runtime.errors import InputError

RADIUS = 5.0  # pixels: how far colours are propagated into a hole


class PlainInpainter:
    """Base class of inpainters without a network."""

    uses_network: ClassVar[bool] = False
    paints_views_together: ClassVar[bool] = False
    notice: ClassVar[str] = ""
    weight_files: Mapping[str, Path] = {}


class ExemplarInpainter(PlainInpainter):
    """Fills each view with patches of this view (PatchMatch); the search starts from the colours of the far rim."""

    name = "exemplar"
    version = "1"

    def __init__(self, options: InpainterOptions) -> None:
        """There are no options."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        return torch.stack([_painted(*view) for view in zip(rgb, hole, inverse_depth, strict=True)])


def _painted(rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
    if bool(hole.all()):
        return rgb
    if not bool(((inverse_depth > 0) & ~hole).any()):
        inverse_depth = torch.ones_like(inverse_depth)
    depth, colors = fill_from_far_side(
        inverse_depth, rgb.permute(2, 0, 1), (inverse_depth > 0) & ~hole
    )
    guess = torch.where(hole[..., None], colors.permute(1, 2, 0), rgb)
    return torch.where(hole[..., None], match_patches(guess, hole, depth).rgb.clamp(0, 1), rgb)


class OpenCV:
    """OpenCV's inpainting and optical flow."""

    def __init__(self, wanted_by: str) -> None:
        """Import OpenCV; InputError, naming `wanted_by`, if it is not installed."""
        try:
            import cv2
        except ImportError as error:
            raise InputError(
                f"{wanted_by} needs a package: pip install 'spackle-nvs[opencv]'"
            ) from error
        self._cv2: Any = cv2
        self.version: str = cv2.__version__
        self._flow = self._cv2.DISOpticalFlow_create(self._cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def inpaint(self, rgb: Tensor, mask: Tensor, radius: float) -> Tensor:
        """Fill a mask [H, W] bool in sRGB [H, W, 3] by Telea's method; returns [H, W, 3] with 8 bits per channel."""
        filled = self._cv2.inpaint(
            _bytes(rgb).numpy(), mask.to(torch.uint8).numpy(), radius, self._cv2.INPAINT_TELEA
        )
        return torch.from_numpy(filled).float() / 255

    def flow(self, picture: Tensor, other: Tensor) -> Tensor:
        """Optical flow from one sRGB image [H, W, 3] to another (Kroeger et al., 2016): [H, W, 2] (x, y) in pixels.

        The flow is zero if a side is too short for the search.
        """
        height, width = picture.shape[:2]
        if min(height, width) < 16:  # the search uses patches of 8 pixels at several scales
            return torch.zeros(height, width, 2, device=picture.device)
        grey = [
            self._cv2.cvtColor(_bytes(image).numpy(), self._cv2.COLOR_RGB2GRAY)
            for image in (picture, other)
        ]
        return torch.from_numpy(self._flow.calc(grey[0], grey[1], None)).to(picture.device)


def _bytes(rgb: Tensor) -> Tensor:
    return (rgb.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).contiguous()


class OpencvInpainter(PlainInpainter):
    """Paints each view separately with Telea's method, which is fast and ignores depth."""

    name = "opencv"

    def __init__(self, options: InpainterOptions) -> None:
        self._opencv = OpenCV("inpainter opencv:")
        self.version = f"telea {RADIUS:g}, cv2 {self._opencv.version}"

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        painted = []
        for view, mask in zip(rgb, hole, strict=True):
            filled = self._opencv.inpaint(view, mask, RADIUS) if bool(mask.any()) else view
            painted.append(torch.where(mask[..., None], filled, view))
        return torch.stack(painted)
