"""Weights that anyone can make, so that the whole path runs without Apple's checkpoint."""

from __future__ import annotations

import zlib

import numpy as np
import torch
from torch import Tensor

from spackle.bases.sharp.unused import Shapes


def deterministic_weights(shapes: Shapes) -> dict[str, Tensor]:
    """A state dict [name → float32 tensor] that depends on names and shapes alone.

    The numbers are random, the scale of each kind is such that signals neither die nor explode, and
    the Gaussians that come out fill the picture. They show no scene.
    """
    return {name: torch.from_numpy(_tensor(name, shape)) for name, shape in shapes.items()}


def _tensor(name: str, shape: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    generator = np.random.Generator(np.random.Philox(zlib.crc32(name.encode())))
    x = generator.standard_normal(shape, dtype=np.float32)
    if name.endswith(("pos_embed", "cls_token")):
        return np.float32(0.02) * x
    if name.endswith(".gamma"):
        return np.float32(0.1) * (1 + np.float32(0.1) * x)
    if name.endswith("monodepth_predictor.head.4.bias"):
        return 1 + np.float32(0.1) * x  # disparities around one
    if len(shape) > 1:
        return x / np.float32(np.sqrt(np.prod(shape[1:])))
    if name.endswith("weight"):
        return 1 + np.float32(0.1) * x
    return np.float32(0.02) * x
