"""MoGe-2 in a small size with deterministic weights, and the picture of the golden numbers."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from random_weights import deterministic_weights
from torch import Tensor

from helpers import DATA
from helpers.sharp_weights import waves as planes
from spackle.bases.moge.network import MogeNetwork, MogeOutput

# each is a `model_config` with a ViT-S
CONFIGS = json.loads((DATA / "moge_configs.json").read_text())
TINY, FULL = CONFIGS["tiny"], CONFIGS["full"]


def shapes_of(config: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        return {name: tuple(t.shape) for name, t in MogeNetwork(config).state_dict().items()}


def write_tiny(path: Path) -> Path:
    """A checkpoint of the tiny network."""
    made = deterministic_weights(shapes_of(TINY))
    for name, x in made.items():
        if name.endswith(("pos_embed", "cls_token", ".gamma")):
            x *= 5 if name.endswith(".gamma") else 10
    plus = {
        "neck.input_blocks.4": 4,
        "points_head.input_blocks.4": 1,
        "points_head.output_blocks.4": 0.25,
    }
    for name, value in plus.items():
        made[f"{name}.weight"] *= 0.2
        made[f"{name}.weight"][[0, 1], [0, 1]] += (
            value  # x and y then follow the place in the photo
        )
    for name, values in (("mean", (0.485, 0.456, 0.406)), ("std", (0.229, 0.224, 0.225))):
        made[f"encoder.image_{name}"] = torch.tensor(values).view(1, 3, 1, 1)
    torch.save({"model_config": TINY, "model": made}, path)
    return path


def waves(height: int, width: int) -> Tensor:
    """[H, W, 3] sRGB."""
    return planes(height, width)[0].permute(1, 2, 0).contiguous()


HALF = math.hypot(160, 90) / 2  # half the diagonal of this scene


def scene(shift: float, bend: float = 0.0, hole: bool = True, scale: float = 1.0) -> MogeOutput:
    """A plausible output for waves at 90×160 and a focal length of 1.3 half diagonals; below is a
    hole of sky.
    """
    y, x = (np.mgrid[:90, :160] + 0.5 - np.array([45, 80]).reshape(2, 1, 1)) / HALF
    depth = 3 + np.sin(4 * x) * np.cos(3 * y)
    z = depth + shift + 2 * bend * y
    points = np.stack([x * depth / 1.3 + bend * np.sin(9 * y), y * depth / 1.3, z], axis=-1)
    sky = hole & (np.abs(x) < 0.3) & (y > 0)
    logits = torch.from_numpy(np.where(sky, -2.2, 2.2).astype(np.float32))
    return MogeOutput(torch.from_numpy(points.astype(np.float32)), logits, torch.tensor(scale))
