"""What the numbers of each depth model mean, and how they become metres."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from spackle.bases.depth_maps import DepthMap
from spackle.bases.relative import NEAREST_M, nearest
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
CANONICAL_LIMITS = (1e-4, 1e4)  # in 1/m: Depth Pro's own
FLAT = 1e-5  # relative spread below which all pixels say the same


def meaning_of(settings: Mapping[str, Any], name: str) -> Meaning:
    """What a model's output is, by what its config.json says.

    Raises:
        InputError: a model whose output is no depth, or is not known here: a guess would turn scenes inside out.
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


def scale_note(meaning: Meaning) -> str:
    """What the report says of the depth's scale."""
    if meaning == "relative disparity":
        return f"relative, scaled to {NEAREST_M:g}–{FARTHEST_M:g} m"
    return "metric, by the model"


def to_depth_map(raw: Tensor, meaning: Meaning, focal: float, name: str, photo: Path) -> DepthMap:
    """A model's output in metres, at its own size; pixels without a positive finite depth are not valid.

    Args:
        raw: [h, w] float32.
        meaning: of its numbers.
        focal: of the photo, in its widths; canonical disparity depends on it.
        name: of the model, for messages.
        photo: for messages, and the map's `path`.

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
    quantity: Literal["depth", "disparity"] = "depth" if meaning == "metres" else "disparity"
    return DepthMap(depth.where(valid, 0.0), valid, None, None, quantity, photo)


def _scaled(disparity: Tensor, known: Tensor, high: float, who: str) -> Tensor:
    """Relative disparity in 1/m, [h, w]."""
    if high <= 0:
        raise InputError(f"{who} predicts no disparity above zero: its weights are broken, or not for photos")
    values = disparity[known]
    near = float(nearest(values))
    share = (disparity / (near if near > 0 else high)).clamp(0, 1)
    return (1 - share) / FARTHEST_M + share / NEAREST_M
