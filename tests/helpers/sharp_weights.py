"""SHARP in small sizes with deterministic weights, and the picture of the golden numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from random_weights import deterministic_weights
from safetensors.torch import save_file
from torch import Tensor

from spackle.bases.sharp.base import expected_shapes
from spackle.bases.sharp.encoder import CELL_STRIDE, LAYER_COUNT, MICRO_SIZE, SharpConfig
from spackle.bases.sharp.network import SharpNetwork


def tiny_weights(config: SharpConfig = MICRO_SIZE) -> dict[str, Tensor]:
    return deterministic_weights(expected_shapes(config))


def write_tiny(path: Path, config: SharpConfig = MICRO_SIZE) -> Path:
    """A checkpoint of a small network, .pt or .safetensors by the name."""
    if path.suffix == ".safetensors":
        save_file(tiny_weights(config), path)
    else:
        torch.save(tiny_weights(config), path)
    return path


def micro_network() -> SharpNetwork:
    """A network that predicts 131,072 Gaussians from 512² pixels, in float32."""
    network = SharpNetwork(MICRO_SIZE).eval().requires_grad_(False)
    weights = tiny_weights()
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
    return network


def gaussians_of(config: SharpConfig) -> int:
    """The number of Gaussians that the network predicts."""
    return LAYER_COUNT * (config.side // CELL_STRIDE) ** 2


def waves(height: int = 1536, width: int | None = None) -> Tensor:
    """The golden numbers' picture, [1, 3, height, width], square by default."""
    width = width or height
    y, x = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
    red = 0.5 + 0.5 * np.sin(2 * np.pi * (3 * x + 2 * y))
    green = 0.5 + 0.5 * np.cos(2 * np.pi * (5 * x * y + y))
    blue = 0.5 + 0.25 * np.sin(40 * x) * np.cos(30 * y) + 0.25 * x
    return torch.from_numpy(np.stack([red, green, blue]).astype(np.float32))[None]
