"""MoGe-2 in a small size with deterministic weights, and the picture of the golden numbers."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from random_weights import deterministic_weights
from torch import Tensor

from spackle.bases.moge.network import MogeNetwork, MogeOutput


def settings(features: int, widths: list[int], blocks: tuple[list[int], list[int]], scale: list[int]) -> dict[str, Any]:
    """A `model_config` with a ViT-S; blocks of the neck, and of the heads."""
    shared: dict[str, Any] = {"dim_res_blocks": widths, "res_block_in_norm": "none", "res_block_hidden_norm": "none"}
    shared["resamplers"] = ["conv_transpose"] * 3 + ["bilinear"]
    neck = {"dim_in": [features + 2, 2, 2, 2, 2], "dim_out": None, "num_res_blocks": blocks[0]} | shared
    heads = {
        f"{name}_head": {"dim_in": widths, "dim_out": [None] * 4 + [out], "num_res_blocks": blocks[1]} | shared
        for name, out in (("points", 3), ("mask", 1))
    }
    encoder = {"backbone": "dinov2_vits14", "intermediate_layers": [5, 11], "dim_out": features}
    more = {"scale_head": {"dims": [384, *scale, 1]}, "remap_output": "exp", "num_tokens_range": [35, 120]}
    return copy.deepcopy({"encoder": encoder, "neck": neck, **heads, **more})


TINY = settings(32, [32, 24, 16, 12, 8], ([0, 2, 1, 1, 0], [0, 1, 1, 1, 0]), [16, 16])
FULL = settings(384, [384, 256, 128, 64, 32], ([0, 1, 1, 1, 0], [0, 1, 1, 1, 0]), [384, 384])


def shapes_of(config: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        return {name: tuple(t.shape) for name, t in MogeNetwork(config).state_dict().items()}


def write_tiny(path: Path) -> Path:
    """A checkpoint of the tiny network."""
    made = deterministic_weights(shapes_of(TINY))
    for name, x in made.items():
        if name.endswith(("pos_embed", "cls_token", ".gamma")):
            x *= 5 if name.endswith(".gamma") else 10
    plus = {"neck.input_blocks.4": 4, "points_head.input_blocks.4": 1, "points_head.output_blocks.4": 0.25}
    for name, value in plus.items():
        made[f"{name}.weight"] *= 0.2
        made[f"{name}.weight"][[0, 1], [0, 1]] += value  # x and y then follow the place in the photo
    for name, values in (("mean", (0.485, 0.456, 0.406)), ("std", (0.229, 0.224, 0.225))):
        made[f"encoder.image_{name}"] = torch.tensor(values).view(1, 3, 1, 1)
    torch.save({"model_config": TINY, "model": made}, path)
    return path


def waves(height: int, width: int) -> Tensor:
    """[H, W, 3] sRGB."""
    y, x = np.mgrid[:height, :width] / np.array([height, width]).reshape(2, 1, 1)
    red, green = np.sin(2 * np.pi * (3 * x + 2 * y)), np.cos(2 * np.pi * (5 * x * y + y))
    blue = np.sin(40 * x) * np.cos(30 * y) / 2 + x / 2
    return torch.from_numpy((0.5 + np.stack([red, green, blue], axis=-1) / 2).astype(np.float32))


HALF = math.hypot(160, 90) / 2  # half the diagonal of this scene


def scene(shift: float, bend: float = 0.0, hole: bool = True, scale: float = 1.0) -> MogeOutput:
    """A plausible output for waves at 90×160 and a focal length of 1.3 half diagonals; below is a hole of sky."""
    y, x = (np.mgrid[:90, :160] + 0.5 - np.array([45, 80]).reshape(2, 1, 1)) / HALF
    depth = 3 + np.sin(4 * x) * np.cos(3 * y)
    z = depth + shift + 2 * bend * y
    points = np.stack([x * depth / 1.3 + bend * np.sin(9 * y), y * depth / 1.3, z], axis=-1)
    sky = hole & (np.abs(x) < 0.3) & (y > 0)
    logits = torch.from_numpy(np.where(sky, -2.2, 2.2).astype(np.float32))
    return MogeOutput(torch.from_numpy(points.astype(np.float32)), logits, torch.tensor(scale))
