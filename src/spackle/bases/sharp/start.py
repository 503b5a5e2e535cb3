"""From SHARP's depth and deltas to Gaussians in its normalised space."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, softplus

from spackle.bases.sharp.config import STRIDE
from spackle.color import srgb_to_linear
from spackle.gaussians import Gaussians

NEAREST, FARTHEST = 1.0, 100.0  # depths are scaled so that the nearest is 1, and cut off at 100
FARTHEST_INVERSE = 1e-3  # added to inverse depth, which keeps depth finite
SMALLEST_INVERSE = 1e-6
COLOR_MARGIN = 0.01  # keeps the inverse sigmoid of a colour finite
MAX_SCALE = 10.0  # of a Gaussian, relative to where it starts

# How much a delta of one moves an attribute, before the sigmoid where there is one.
XY_GAIN = Z_GAIN = 0.001
COLOR_GAIN = 0.1


@dataclasses.dataclass(frozen=True)
class Start:
    """Gaussians on the predicted surfaces, one for each 2×2 pixels and layer, before any delta."""

    disparity_map: Tensor  # [1, 2, side, side] of the scaled depths, an input of the feature network
    disparity: Tensor  # [2, side/2, side/2] of the nearest pixel in each cell
    color: Tensor  # [3, side/2, side/2] sRGB, the cell's mean
    unscale: Tensor  # float64 without an axis: multiplies means and scales to undo the scaling of the depths


def make_start(image: Tensor, depth: Tensor) -> Start:
    """Where the Gaussians of a picture [1, 3, side, side] with depth layers [1, 2, side, side] begin."""
    factor = NEAREST / (depth.min().double() + SMALLEST_INVERSE)  # stays on its device: nobody waits for it
    disparity = 1.0 / (depth * factor).clamp_max(FARTHEST)
    return Start(disparity, max_pool2d(disparity, STRIDE)[0], avg_pool2d(image, STRIDE)[0], 1.0 / factor)


def compose(start: Start, deltas: Tensor) -> Gaussians:
    """Apply deltas [14, 2, H, W]; the Gaussians come layer by layer, each in row-major order.

    Means are (x·z, y·z, z), where x and y run from -1 to 1 over the picture.
    """
    height, width = deltas.shape[-2:]
    x, y = (_centers(n, deltas) for n in (width, height))
    inverse = softplus(_inverse_softplus(start.disparity) + Z_GAIN * deltas[2])
    z = 1.0 / (inverse + FARTHEST_INVERSE)
    means = torch.stack([z * (x + XY_GAIN * deltas[0]), z * (y[:, None] + XY_GAIN * deltas[1]), z])
    # A cell's width at that depth, times a factor between 0 and MAX_SCALE: 1 at zero, and so is its slope.
    slope, shift = MAX_SCALE / (MAX_SCALE - 1), -math.log(MAX_SCALE - 1)
    scales = (2.0 / width) * z * (MAX_SCALE * torch.sigmoid(slope * deltas[3:6] + shift))
    quats = torch.cat([deltas[6:7] + 1, deltas[7:10]])
    color = start.color.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)
    colors = srgb_to_linear(torch.sigmoid(torch.logit(color)[:, None] + COLOR_GAIN * deltas[10:13]))
    opacities = torch.sigmoid(deltas[13])
    return Gaussians(
        _rows(means * start.unscale), _rows(quats), _rows(scales * start.unscale), opacities.flatten(), _rows(colors)
    )


def _centers(count: int, like: Tensor) -> Tensor:
    """Cell centres in -1..1."""
    return ((2 * torch.arange(count, device=like.device) + 1) / count - 1).to(like.dtype)


def _inverse_softplus(y: Tensor) -> Tensor:
    """log(eʸ - 1) for y > 0 without overflow."""
    y = y.clamp_min(SMALLEST_INVERSE)
    return y + torch.log(-torch.expm1(-y))


def _rows(attribute: Tensor) -> Tensor:
    """[C, 2, H, W] to [2·H·W, C]."""
    return attribute.flatten(1).T.contiguous()
