"""A photo as each depth model wants to see it, and where the photo lies in what it saw."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

# The image processors of these exist for torchvision alone. They only resize and normalise, the first of them
# without smoothing, as Depth Pro was trained.
SQUARE_ANTIALIAS = {"depth_pro": False, "tipsv2_dpt": True}
MAX_SQUARE_SIDE = 4096
_BILINEAR = 2  # Pillow's number


@dataclasses.dataclass(frozen=True)
class Window:
    """The part of a padded picture that is the photo, in shares of the picture's sides."""

    left: float = 0.0
    top: float = 0.0
    width: float = 1.0
    height: float = 1.0


# [H, W, 3] sRGB in 0..1 to pixel values [1, 3, h, w].
Prepare = Callable[[Tensor], tuple[Tensor, Window]]


def by_processor(processor: Any, model_type: str) -> Prepare:
    """The input that an image processor of transformers makes."""

    def prepare(rgb: Tensor) -> tuple[Tensor, Window]:
        image = Image.fromarray((rgb * 255).round().to(torch.uint8).numpy())
        pixels = torch.as_tensor(processor(images=image, return_tensors="pt")["pixel_values"])
        if not getattr(processor, "do_pad", False):
            return pixels, Window()
        if model_type == "zoedepth":  # reflects the photo beyond its borders, and resizes both together
            margins = [int(math.sqrt(side / 2) * 3) for side in image.size]
            shares = [margin / (side + 2 * margin) for side, margin in zip(image.size, margins, strict=True)]
            return pixels, Window(*shares, *(1 - 2 * share for share in shares))
        bare = processor(images=image, return_tensors="pt", do_pad=False)["pixel_values"].shape  # centred in the padded
        tall, wide = pixels.shape[2:]
        left, top = (wide - bare[3]) // 2, (tall - bare[2]) // 2
        return pixels, Window(left / wide, top / tall, bare[3] / wide, bare[2] / tall)

    return prepare


def by_settings(settings: Mapping[str, Any], antialias: bool) -> Prepare:
    """The input that preprocessor_config.json asks for: the photo stretched to one size, bilinear, and normalised.

    Raises:
        ValueError: settings that ask for something else.
    """
    size = settings["size"]
    height, width = int(size["height"]), int(size["width"])
    if not (1 <= height <= MAX_SQUARE_SIDE and 1 <= width <= MAX_SQUARE_SIDE):
        raise ValueError(f"a size of {width}×{height}")
    if settings.get("resample", _BILINEAR) != _BILINEAR or not settings.get("do_resize", True):
        raise ValueError("another way to resize than bilinear")
    factor = 255 * float(settings.get("rescale_factor", 1 / 255)) if settings.get("do_rescale", True) else 255.0
    normalize = settings.get("do_normalize", "image_mean" in settings)
    mean = torch.tensor(settings["image_mean"] if normalize else [0.0] * 3).float().reshape(3, 1, 1)
    std = torch.tensor(settings["image_std"] if normalize else [1.0] * 3).float().reshape(3, 1, 1)

    def prepare(rgb: Tensor) -> tuple[Tensor, Window]:
        pixels = (rgb.permute(2, 0, 1) * factor - mean) / std
        return interpolate(pixels[None], size=(height, width), mode="bilinear", antialias=antialias), Window()

    return prepare


def crop(output: Tensor, window: Window) -> Tensor:
    """The photo's part of an output [h, w], at about the same pixel size; bilinear, since it begins within a pixel."""
    if window == Window():
        return output
    tall, wide = output.shape
    ys, xs = (
        2 * (start + share * (np.arange(count) + 0.5) / count) - 1
        for start, share, count in (
            (window.top, window.height, max(1, round(tall * window.height))),
            (window.left, window.width, max(1, round(wide * window.width))),
        )
    )
    grid = torch.from_numpy(np.stack(np.meshgrid(xs, ys), axis=-1)).to(output)
    return grid_sample(output[None, None], grid[None], padding_mode="border", align_corners=False)[0, 0]
