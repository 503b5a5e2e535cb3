"""A small network of SHARP's architecture with made weights, for trainings that need a SHARP.

SHARP's weights are 2.8 GB, and their licence allows research only. Where the paper trains SHARP
itself ("direct FT"), or starts from it (the residual network `sharp-decoder`),
`benchmarks/reproduce.py` uses this stand-in. It sees no depth: it gives all photos nearly the same
relief, a floor, a wall behind it and a bump in the middle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from random_weights import deterministic_weights
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import unfold

from spackle.bases.sharp.base import expected_shapes, load_network, resize_to_square
from spackle.bases.sharp.encoder import MICRO_SIZE, WINDOW_COUNT

Array = NDArray[Any]

DEPTHS = "monodepth_model.monodepth_predictor."  # prefix of the depth network's tensors
CELLS = 16  # cells a side of the coarsest features, which carry the relief
POSITION_WEIGHT = 30  # of the positions over the random features of what a photo shows
RIDGE = 1e-5  # of the fit, over the number of its equations
BEHIND = 0.97  # disparity of the second layer of Gaussians over the first's
OPACITY_LOGIT = 6.0  # before the sigmoid: Gaussians are nearly opaque
PLACES = (-0.25, 0.25)  # middles of a cell's two halves, in cells from the cell's middle

# The relief, in metres at a focal length as long as a photo is wide.
WALL_M, FLOOR_M, BUMP_M = 3.6, 1.9, 2.7
HORIZON = 0.62  # where wall and floor meet, as a fraction of the height
BUMP_MIDDLE = (0.5, 0.55)
BUMP_RADII = (0.27, 0.24)


def relief(x: Array, y: Array) -> Array:
    """Canonical disparity (focal length / width / depth) at places 0..1 of a photo."""
    along_floor = ((y - HORIZON) / (1 - HORIZON)).clip(0, 1)
    ground = 1 / WALL_M + along_floor * (1 / FLOOR_M - 1 / WALL_M)
    away = np.hypot((x - BUMP_MIDDLE[0]) / BUMP_RADII[0], (y - BUMP_MIDDLE[1]) / BUMP_RADII[1])
    bump = 1 / BUMP_M / (1 + away**6)  # flat inside, and steep around 1
    # The nearer surface is the visible one.
    return np.maximum(ground, bump)


@torch.no_grad()
def write_stand_in(path: Path, photos: Sequence[Tensor]) -> float:
    """Write the stand-in's weights; returns how far its relief is off, as a share of its variance.

    Args:
        path: a safetensors file with the names of SHARP's tensors.
        photos: [H, W, 3] sRGB 0..1; the relief is fitted so that it does not depend on them.
    """
    weights = deterministic_weights(expected_shapes(MICRO_SIZE))
    _add_positions(weights)
    _open_one_path(weights)
    save_file(weights, path)

    # Linear regression from the features around each cell to the cell's disparity and slopes.
    predictor: Any = load_network(path, torch.float32).monodepth_model.monodepth_predictor
    neighbourhoods = []
    for photo in photos:
        image = resize_to_square(photo, MICRO_SIZE.side)
        coarsest = predictor.encoder(2 * image - 1, WINDOW_COUNT)[-1]
        neighbourhoods.append(unfold(coarsest, 3, padding=1)[0].T.double())
    features = torch.cat(neighbourhoods)
    planes = _planes().repeat(len(photos), 1)
    mean = planes.mean(0)
    ridge = RIDGE * len(features) * torch.eye(features.shape[1]).double()
    squares = features.T @ features + ridge
    kernels = torch.linalg.solve(squares, features.T @ (planes - mean))  # [C · 9, 3]

    count = planes.shape[1]
    weights[f"{DEPTHS}decoder.convs.4.weight"][:count] = kernels.T.float().view(count, -1, 3, 3)
    # The means are added by the level's last layer, behind the one that halves the slopes.
    added = mean.float() * torch.tensor([1.0, 0.5, 0.5])
    weights[f"{DEPTHS}decoder.fusions.4.out_conv.bias"][:count] = added
    save_file(weights, path)
    residual = features @ kernels + mean - planes
    return float(residual[:, 0].var() / planes[:, 0].var())


def _planes() -> Tensor:
    """[CELLS², 3] for each cell the relief in its middle, and its slopes per cell along x and y."""
    fine = 8  # samples of a cell along each side
    steps = (np.arange(CELLS * fine) + 0.5) / (CELLS * fine)
    x, y = np.meshgrid(steps, steps)
    samples = relief(x, y).reshape(CELLS, fine, CELLS, fine)
    # Least squares: the slope along an axis is the covariance with the place in the cell.
    place = (np.arange(fine) + 0.5) / fine - 0.5
    variance = (place**2).mean()
    value = samples.mean((1, 3))
    slope_x = (samples * place).mean((1, 3)) / variance
    slope_y = (samples * place[:, None, None]).mean((1, 3)) / variance
    return torch.from_numpy(np.stack([value, slope_x, slope_y], axis=-1).reshape(-1, 3))


def _add_positions(weights: dict[str, Tensor]) -> None:
    """Let the tokens of the whole picture tell where they are, by waves of low frequency."""
    side = MICRO_SIZE.tokens_per_side
    across = (np.arange(side) + 0.5) * math.pi / side
    frequencies = sorted(((m, n) for m in range(side) for n in range(side)), key=sum)
    waves = [
        np.outer(np.cos(m * across), np.cos(n * across)).ravel()
        for m, n in frequencies[: MICRO_SIZE.embed_width]
    ]
    positions = torch.from_numpy(np.stack(waves, axis=-1))
    weights[f"{DEPTHS}encoder.image_encoder.pos_embed"][0, 1:] += POSITION_WEIGHT * positions


def _open_one_path(weights: dict[str, Tensor]) -> None:
    """Close the decoders but for a linear path from the coarsest features to the disparities.

    Three channels go along this path: a cell's disparity, and its slopes along x and y. A layer
    that doubles the size gives each of the four new cells its part of the plane.
    """
    parts = ("decoder", "head", "encoder.upsample_latent0", "encoder.upsample2")
    closed = ("prediction_head.", *(f"{DEPTHS}{part}." for part in parts))
    for name, weight in weights.items():
        if name.startswith(closed):
            weight.zero_()

    for name, weight in weights.items():
        if name.startswith(f"{DEPTHS}decoder.") and name.endswith(".out_conv.weight"):
            weight += torch.eye(MICRO_SIZE.depth_width)[..., None, None]
        if name.startswith(f"{DEPTHS}decoder.") and name.endswith(".deconv.weight"):
            _double_planes(weight)

    # The head: a 3×3 convolution, a doubling, a 3×3 convolution, and one number for each layer.
    head = f"{DEPTHS}head."
    for channel in range(3):
        weights[f"{head}0.weight"][channel, channel, 1, 1] = 1.0
    _double_planes(weights[f"{head}1.weight"])
    weights[f"{head}2.weight"][0, 0, 1, 1] = 1.0
    weights[f"{head}4.weight"][0, 0] = 1.0
    weights[f"{head}4.weight"][1, 0] = BEHIND
    weights["prediction_head.texture_prediction_head.bias"][-2:] = OPACITY_LOGIT


def _double_planes(weight: Tensor) -> None:
    """Set a layer [in, out, 2, 2] that doubles the size: value and slopes of each new cell."""
    across = torch.tensor([PLACES, PLACES])
    weight[0, 0] = 1.0
    weight[1, 0] = across
    weight[2, 0] = across.T
    # A new cell is half as wide, so a plane rises half as much in it.
    weight[1, 1] = 0.5
    weight[2, 2] = 0.5
