"""Carrying values from the rim of a hole into it, with a bias to what lies behind."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle._numba import kernel

FAR_BIAS = 80.0  # how sharply the far side of a rim wins: a sample 5 % nearer than the fill counts 1/50
SWEEPS = 12  # relaxation sweeps at each resolution; more gain nothing

MIN_TRUST = 1e-6  # a hole whose whole rim is near still gets its colour from there
MAX_EXPONENT = 30.0  # keeps weights within single precision

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


def far_fill(
    inverse_depth: Tensor,
    values: Tensor,
    known: Tensor,
    *,
    far_bias: Tensor | float = FAR_BIAS,
    sweeps: int = SWEEPS,
) -> tuple[Tensor, Tensor]:
    """Fill the unknown part of an inverse depth image and of the values that go with it.

    What a moving camera uncovers lies behind what covered it, so a hole between a near and a far
    surface continues the far one. A fill from coarse to fine gives the first guess; at every resolution
    a relaxation turns it into a membrane over the rim, in which a rim sample counts the less the nearer
    it is than the fill: min(1, fill / sample)^far_bias. The work grows with the hole, not the image.

    Args:
        inverse_depth: [H, W], positive where known.
        values: [C, H, W], anything that is to be carried along, colour for instance.
        known: [H, W] bool. Elsewhere the input is ignored.
        far_bias: one number, or one for each pixel [H, W]; 0 treats both sides of the rim alike.
        sweeps: relaxation sweeps at each resolution.

    Returns:
        Inverse depth [H, W] and values [C, H, W], float32; known pixels as they were.

    Raises:
        ValueError: where nothing is known.
    """
    if not bool(known.any()):
        raise ValueError("nothing to fill from: no pixel is known")
    field = torch.cat([inverse_depth[None], values]).detach().to("cpu", torch.float32).numpy()
    mask = known.cpu().numpy()
    bias = torch.as_tensor(far_bias, dtype=torch.float32).cpu().expand(inverse_depth.shape).contiguous().numpy()
    filled = torch.from_numpy(_fill_level(np.where(mask, field, np.float32(0)), mask, bias, sweeps))
    return filled[0].to(inverse_depth.device), filled[1:].to(values.device)


def _fill_level(field: Floats, known: Bools, bias: Floats, sweeps: int) -> Floats:
    """Fill one level [1 + C, H, W] from the next coarser one, then relax it."""
    if known.all():
        return field
    reference = np.float32(np.quantile(field[0][known], 0.5, method="lower"))
    coarse, coarse_known, coarse_bias = _coarsen(field, known, bias, reference)
    coarse = _fill_level(coarse, coarse_known, coarse_bias, sweeps)
    holes = np.argwhere(~known).astype(np.int32)
    field = field.copy()
    _guess(field, coarse, holes)
    _relax(field, known, bias, holes, sweeps)
    return field


@kernel
def _coarsen(field: Any, known: Any, bias: Any, reference: Any) -> Any:
    """Means of 2×2 pixels over the known ones, the far ones counting most; known flags; mean bias."""
    channels, height, width = field.shape
    rows, columns = (height + 1) // 2, (width + 1) // 2
    coarse = np.zeros((channels, rows, columns), np.float32)
    coarse_known = np.zeros((rows, columns), np.bool_)
    coarse_bias = np.zeros((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            mass = np.float32(0)
            for k in range(4):
                y, x = 2 * row + k // 2, 2 * column + k % 2
                coarse_bias[row, column] += bias[min(y, height - 1), min(x, width - 1)] / 4
                if y >= height or x >= width or not known[y, x]:
                    continue
                ratio = max(field[0, y, x] / reference, np.float32(1e-6))
                exponent = min(max(-bias[y, x] * np.log(ratio), -MAX_EXPONENT), MAX_EXPONENT)
                weight = np.float32(np.exp(exponent))
                mass += weight
                for channel in range(channels):
                    coarse[channel, row, column] += weight * field[channel, y, x]
            if mass > 0:
                coarse_known[row, column] = True
                for channel in range(channels):
                    coarse[channel, row, column] /= mass
    return coarse, coarse_known, coarse_bias


@kernel
def _guess(field: Any, coarse: Any, holes: Any) -> None:
    """Bilinear interpolation of the coarser level, at the holes alone."""
    channels, rows, columns = coarse.shape
    for n in range(len(holes)):
        y, x = holes[n, 0], holes[n, 1]
        # A fine pixel lies a quarter of a coarse one beside its parent's centre.
        y0, x0 = (y - 1) // 2, (x - 1) // 2
        fy = np.float32(0.75) if y % 2 == 0 else np.float32(0.25)
        fx = np.float32(0.75) if x % 2 == 0 else np.float32(0.25)
        top, bottom = max(y0, 0), min(y0 + 1, rows - 1)
        left, right = max(x0, 0), min(x0 + 1, columns - 1)
        for channel in range(channels):
            upper = coarse[channel, top, left] * (1 - fx) + coarse[channel, top, right] * fx
            lower = coarse[channel, bottom, left] * (1 - fx) + coarse[channel, bottom, right] * fx
            field[channel, y, x] = upper * (1 - fy) + lower * fy


@kernel
def _relax(field: Any, known: Any, bias: Any, holes: Any, sweeps: int) -> None:
    """Jacobi sweeps on the holes; nothing flows across the image's border."""
    channels, height, width = field.shape
    update = np.empty((len(holes), channels), np.float32)
    for _ in range(sweeps):
        for n in range(len(holes)):
            y, x = holes[n, 0], holes[n, 1]
            update[n] = 0
            mass = np.float32(0)
            for k in range(4):
                v = min(max(y + (k == 1) - (k == 0), 0), height - 1)
                u = min(max(x + (k == 3) - (k == 2), 0), width - 1)
                conductance = np.float32(1)
                if known[v, u]:
                    ratio = min(max(field[0, y, x] / max(field[0, v, u], np.float32(1e-12)), np.float32(1e-6)), 1)
                    conductance = np.float32(max(np.exp(bias[y, x] * np.log(ratio)), MIN_TRUST))
                mass += conductance
                for channel in range(channels):
                    update[n, channel] += conductance * field[channel, v, u]
            update[n] /= mass
        for n in range(len(holes)):
            for channel in range(channels):
                field[channel, holes[n, 0], holes[n, 1]] = update[n, channel]
