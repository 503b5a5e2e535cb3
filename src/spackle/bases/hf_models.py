"""Each kind of depth model: how it wants to see a photo, what its numbers mean, and how they become metres."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from spackle.bases.depth_map import DepthMap, Quantity
from spackle.bases.protocol import NEAREST_M, nearest
from spackle.errors import InputError

Meaning = Literal["metres", "relative disparity", "canonical disparity"]

# By `model_type` of config.json. Two kinds of model have both: see `meaning_of`.
MEANINGS: dict[str, Meaning] = {
    "depth_anything": "relative disparity",
    "depth_pro": "canonical disparity",  # 1/z in metres if the photo were as wide as its focal length is long
    "dpt": "relative disparity",
    "glpn": "metres",
    "tipsv2_dpt": "metres",
    "zoedepth": "metres",
}
UNFIT = {
    "chmv2": "measures how high trees stand, seen from above",
    "prompt_depth_anything": "needs a measured depth map beside the photo",
}

# Relative disparity knows neither its unit nor its zero. Its zero is taken for FARTHEST_M and its greatest values
# for NEAREST_M, an arm's length and a half to the far side of a street. Only their ratio matters, since
# trajectories move by the nearest depth: 20 gives a clear parallax, and what is far stays in the range where one
# step of the network's noise is not yet a depth edge. The smallest value is not stretched to FARTHEST_M: a wall
# photographed from the front would become a valley. Both ends are linear in disparity, so planes stay planes.
FARTHEST_M = 30.0
SCALE_NOTES: dict[Meaning, str] = {  # for the report
    "metres": "metric, by the model",
    "relative disparity": f"relative, scaled to {NEAREST_M:g}–{FARTHEST_M:g} m",
    "canonical disparity": "metric, by the model",
}
CANONICAL_LIMITS = (1e-4, 1e4)  # in 1/m: Depth Pro's own
FLAT = 1e-5  # relative spread below which all pixels say the same


def meaning_of(settings: Mapping[str, Any], name: str) -> Meaning:
    """What a model's output is, by its config.json.

    InputError for one whose output is no depth, or is not known here: a guess would turn scenes inside out.
    """
    kind = str(settings.get("model_type"))
    if kind in UNFIT:
        raise InputError(f"{name}: a {kind} model {UNFIT[kind]}: give another")
    if kind not in MEANINGS:
        known = ", ".join(MEANINGS)
        said = f"{kind[:40]!a} is" if "model_type" in settings else "its config.json names"
        raise InputError(f"{name}: {said} no kind of depth model that is known here: give one of {known}")
    if kind == "depth_anything":
        stated = str(settings.get("depth_estimation_type", "relative"))
        if stated not in ("relative", "metric"):
            raise InputError(f"{name}: its depth is {stated[:40]!a}, neither relative nor metric: give another model")
        return "metres" if stated == "metric" else "relative disparity"
    backbone = settings.get("backbone_config")
    if kind == "dpt" and isinstance(backbone, dict) and backbone.get("model_type") == "dinov2":
        return "metres"  # DINOv2's own depth heads, for NYU and KITTI; MiDaS has other backbones
    return MEANINGS[kind]


def to_depth_map(raw: Tensor, meaning: Meaning, focal: float, name: str, photo: Path) -> DepthMap:
    """A model's output [h, w] float32 in metres; pixels without a positive finite depth are not valid.

    Canonical disparity depends on `focal`, the photo's in its widths; `name` and `photo` are for messages.

    Raises:
        InputError: no finite numbers, or the same one everywhere.
    """
    who, known = f"{photo}: {name}", torch.isfinite(raw)
    if not known.any():
        raise InputError(f"{who} predicts no finite number: its weights are broken, or need --precision fp32")
    low, high = (float(extreme) for extreme in raw[known].aminmax())
    if high - low <= FLAT * max(abs(low), abs(high)):
        raise InputError(f"{who} predicts {high:g} for every pixel: its weights are broken, or the photo is empty")
    if meaning == "metres":
        depth = raw
    elif meaning == "relative disparity":
        depth = 1 / _scaled(raw, known, high, who)
    else:
        depth = 1 / (raw / focal).clamp(*CANONICAL_LIMITS)
    valid = known & (depth > 0) & torch.isfinite(1 / depth)
    if not valid.any():
        raise InputError(f"{who} predicts no depth above zero: its weights are broken, or not for photos")
    quantity: Quantity = "depth" if meaning == "metres" else "disparity"
    return DepthMap(depth.where(valid, 0.0), valid, None, None, quantity, photo)


def _scaled(disparity: Tensor, known: Tensor, high: float, who: str) -> Tensor:
    """Relative disparity in 1/m, [h, w]."""
    if high <= 0:
        raise InputError(f"{who} predicts no disparity above zero: its weights are broken, or not for photos")
    values = disparity[known]
    near = float(nearest(values))
    share = (disparity / (near if near > 0 else high)).clamp(0, 1)
    return (1 - share) / FARTHEST_M + share / NEAREST_M


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

    ValueError for settings that ask for something else.
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
