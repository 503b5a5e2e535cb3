"""Write images, in colour or grey, as PNG."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate, pad

from spackle.core.color import to_uint8
from spackle.runtime.files import atomic_path


def thumbnail(picture: Tensor, side: int) -> Tensor:
    """Shrink an image [H, W, C] to at most `side` pixels on its longer side, by averaging pixels."""
    height, width = picture.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = max(1, round(height * scale)), max(1, round(width * scale))
    return interpolate(picture.movedim(-1, 0)[None], size=size, mode="area")[0].movedim(0, -1)


def contact_sheet(rows: Sequence[Sequence[Tensor]], side: int, fill: float = 0.0) -> Tensor:
    """Arrange rows of images [h, w, 3], shrunk to `side` pixels at most, in one image [H, W, 3] padded with `fill`."""
    shown = [torch.cat([thumbnail(picture.cpu(), side) for picture in row], dim=1) for row in rows]
    widest = max(row.shape[1] for row in shown)
    return torch.cat([pad(row, (0, 0, 0, widest - row.shape[1]), value=fill) for row in shown])


def save_png(rgb: Tensor, path: str | os.PathLike[str]) -> None:
    """Write sRGB [H, W, 3] in 0..1, or uint8, with 8 bits a channel; InputError if the file cannot be written."""
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"a colour picture is [H, W, 3], got {tuple(rgb.shape)}")
    _save(Image.fromarray(to_uint8(rgb).numpy()), path)


def save_gray_png(gray: Tensor, path: str | os.PathLike[str]) -> None:
    """Write [H, W] in 0..1, a mask for example, with 8 bits; InputError if the file cannot be written."""
    if gray.ndim != 2:
        raise ValueError(f"a grey picture is [H, W], got {tuple(gray.shape)}")
    _save(Image.fromarray(to_uint8(gray).numpy()), path)


def _save(image: Image.Image, path: str | os.PathLike[str]) -> None:
    with atomic_path(path) as temporary:
        image.save(
            temporary, format="PNG", compress_level=4
        )  # level 6 takes twice the time for files 1 % smaller
