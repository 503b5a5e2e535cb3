"""Write images, in colour or grey, as PNG; arrange small images on a sheet."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate, pad

from spackle.core.color import to_uint8
from spackle.runtime.files import atomic_path

# zlib's level; level 6 takes twice the time for files 1 % smaller.
PNG_COMPRESS_LEVEL = 4


def thumbnail(picture: Tensor, max_side: int) -> Tensor:
    """Shrink an image [H, W, C] to at most `max_side` pixels a side, by averaging pixels.

    A smaller image stays as it is.
    """
    height, width = picture.shape[:2]
    scale = min(1.0, max_side / max(height, width))
    small_size = (max(1, round(height * scale)), max(1, round(width * scale)))
    batch = picture.movedim(-1, 0)[None]  # [1, C, H, W]
    return interpolate(batch, size=small_size, mode="area")[0].movedim(0, -1)


def contact_sheet(rows: Sequence[Sequence[Tensor]], max_side: int, fill: float = 0.0) -> Tensor:
    """Arrange rows of small images in one large image [H, W, 3].

    Args:
        rows: images [h, w, 3]; the images of a row must have one height.
        max_side: an image is shrunk to at most this many pixels a side.
        fill: the value right of rows that are shorter than the longest one.
    """
    strips = []
    for row in rows:
        thumbnails = [thumbnail(picture.cpu(), max_side) for picture in row]
        strips.append(torch.cat(thumbnails, dim=1))
    sheet_width = max(strip.shape[1] for strip in strips)

    padded_strips = []
    for strip in strips:
        # Before and after the last axis (colours), then before and after the columns.
        margins = (0, 0, 0, sheet_width - strip.shape[1])
        padded_strips.append(pad(strip, margins, value=fill))
    return torch.cat(padded_strips)


def save_png(rgb: Tensor, path: str | os.PathLike[str]) -> None:
    """Write a colour image as a PNG with 8 bits a channel.

    Args:
        rgb: [H, W, 3] sRGB in 0..1, or uint8.
        path: the file to write, whole or not at all.

    Raises:
        InputError: the file cannot be written.
        ValueError: `rgb` has another shape.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"a colour picture is [H, W, 3], got {tuple(rgb.shape)}")
    _write_png(Image.fromarray(to_uint8(rgb).numpy()), path)


def save_gray_png(gray: Tensor, path: str | os.PathLike[str]) -> None:
    """Write a grey image, a mask for example, as a PNG with 8 bits.

    Args:
        gray: [H, W] in 0..1.
        path: the file to write, whole or not at all.

    Raises:
        InputError: the file cannot be written.
        ValueError: `gray` has another shape.
    """
    if gray.ndim != 2:
        raise ValueError(f"a grey picture is [H, W], got {tuple(gray.shape)}")
    _write_png(Image.fromarray(to_uint8(gray).numpy()), path)


def _write_png(image: Image.Image, path: str | os.PathLike[str]) -> None:
    """Write an image as a PNG, whole or not at all; InputError if it cannot be written."""
    with atomic_path(path) as temporary:
        image.save(temporary, format="PNG", compress_level=PNG_COMPRESS_LEVEL)
