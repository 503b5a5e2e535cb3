"""Inpainters without a network: patches of the image itself, and OpenCV.

OpenCV is an optional package: pip install 'spackle-nvs[opencv]'.
"""

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

# How far Telea's method looks for known colours around a pixel.
TELEA_RADIUS_PX = 5.0

# OpenCV's flow compares patches of 8 pixels at several scales, which a smaller image lacks.
MIN_FLOW_SIDE_PX = 16


class PlainInpainter:
    """Base class of inpainters without a network."""

    uses_network: ClassVar[bool] = False
    paints_views_together: ClassVar[bool] = False
    notice: ClassVar[str] = ""
    weight_files: Mapping[str, Path] = {}

    def __init__(self, options: InpainterOptions | None = None) -> None:
        """Take the options that every inpainter takes; none of them is for these inpainters."""


class ExemplarInpainter(PlainInpainter):
    """Fills each view with patches of this view, found by PatchMatch."""

    name = "exemplar"
    version = "1"

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the holes of V views, each by itself.

        Args:
            rgb: [V, H, W, 3] sRGB in 0..1.
            hole: [V, H, W] bool, True where a colour has to be painted.
            inverse_depth: [V, H, W] 1 / depth; 0 where it is unknown.

        Returns:
            [V, H, W, 3] sRGB in 0..1, equal to `rgb` outside of the holes.
        """
        painted_views = [
            _paint_with_patches(view, view_hole, view_inverse_depth)
            for view, view_hole, view_inverse_depth in zip(rgb, hole, inverse_depth, strict=True)
        ]
        return torch.stack(painted_views)


def _paint_with_patches(rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
    """Fill the holes of one view with patches of the view.

    Args:
        rgb: [H, W, 3] sRGB in 0..1.
        hole: [H, W] bool.
        inverse_depth: [H, W] 1 / depth; 0 where it is unknown.

    Returns:
        [H, W, 3] sRGB; `rgb` itself if the whole view is a hole.
    """
    if bool(hole.all()):
        return rgb
    is_known = (inverse_depth > 0) & ~hole
    if not bool(is_known.any()):
        # Without any depth, all surfaces count as equally far.
        inverse_depth = torch.ones_like(inverse_depth)
        is_known = ~hole

    # A hole uncovers the surface behind, so the search for patches starts from the colours on
    # the far side of the hole's border.
    filled_depth, filled_colors = fill_from_far_side(inverse_depth, rgb.permute(2, 0, 1), is_known)
    first_guess = torch.where(hole[..., None], filled_colors.permute(1, 2, 0), rgb)
    patches = match_patches(first_guess, hole, filled_depth)
    return torch.where(hole[..., None], patches.rgb.clamp(0, 1), rgb)


class OpenCV:
    """OpenCV's inpainting and optical flow; the only place that imports OpenCV."""

    def __init__(self, needed_by: str) -> None:
        """Import OpenCV.

        Args:
            needed_by: what needs OpenCV, at the beginning of the message if it is missing.

        Raises:
            InputError: OpenCV is not installed.
        """
        try:
            import cv2
        except ImportError as error:
            advice = "needs a package: pip install 'spackle-nvs[opencv]'"
            raise InputError(f"{needed_by} {advice}") from error
        self._cv2: Any = cv2
        self.version: str = cv2.__version__
        # The optical flow between two images, by dense inverse search (DIS).
        self._flow = self._cv2.DISOpticalFlow_create(self._cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def inpaint(self, rgb: Tensor, mask: Tensor, radius_px: float) -> Tensor:
        """Fill a masked part of an image by Telea's method.

        Args:
            rgb: [H, W, 3] sRGB in 0..1.
            mask: [H, W] bool, True where a colour is missing.
            radius_px: how far the method looks for known colours.

        Returns:
            [H, W, 3] sRGB in 0..1, in steps of 1/255, because OpenCV takes and gives bytes.
        """
        pixels = _to_bytes_on_cpu(rgb).numpy()
        mask_pixels = mask.to(torch.uint8).numpy()
        method = self._cv2.INPAINT_TELEA
        filled = self._cv2.inpaint(pixels, mask_pixels, radius_px, method)
        return torch.from_numpy(filled).float() / 255

    def flow(self, picture: Tensor, other: Tensor) -> Tensor:
        """Find where each pixel of an image lies in another one (Kroeger et al., 2016).

        Args:
            picture, other: [H, W, 3] sRGB in 0..1.

        Returns:
            [H, W, 2] the optical flow (x, y) in pixels; zero if a side is shorter than 16 pixels.
        """
        height, width = picture.shape[:2]
        if min(height, width) < MIN_FLOW_SIDE_PX:
            return torch.zeros(height, width, 2, device=picture.device)
        grey_picture = self._to_grey(picture)
        grey_other = self._to_grey(other)
        no_first_guess = None
        flow = self._flow.calc(grey_picture, grey_other, no_first_guess)
        return torch.from_numpy(flow).to(picture.device)

    def _to_grey(self, rgb: Tensor) -> Any:
        """Return an image [H, W, 3] sRGB in 0..1 as an array [H, W] of grey bytes."""
        return self._cv2.cvtColor(_to_bytes_on_cpu(rgb).numpy(), self._cv2.COLOR_RGB2GRAY)


def _to_bytes_on_cpu(rgb: Tensor) -> Tensor:
    """Return an image in 0..1 as rounded bytes 0..255, contiguous, on the CPU."""
    return (rgb.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).contiguous()


class OpencvInpainter(PlainInpainter):
    """Paints each view by itself with Telea's method, which is fast and ignores depth."""

    name = "opencv"

    def __init__(self, options: InpainterOptions | None = None) -> None:
        """Import OpenCV; InputError if it is not installed."""
        self._opencv = OpenCV("inpainter opencv:")
        self.version = f"telea {TELEA_RADIUS_PX:g}, cv2 {self._opencv.version}"

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the holes of V views, each by itself.

        Args:
            rgb: [V, H, W, 3] sRGB in 0..1.
            hole: [V, H, W] bool, True where a colour has to be painted.
            inverse_depth: ignored.

        Returns:
            [V, H, W, 3] sRGB in 0..1, equal to `rgb` outside of the holes.
        """
        painted_views = []
        for view, view_hole in zip(rgb, hole, strict=True):
            filled = view
            if bool(view_hole.any()):
                filled = self._opencv.inpaint(view, view_hole, TELEA_RADIUS_PX)
            painted_views.append(torch.where(view_hole[..., None], filled, view))
        return torch.stack(painted_views)
