"""Carrying values from the rim of a hole into it, with a bias to what lies behind."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle._numba import kernel
from spackle.device import run_chunks

FAR_BIAS = 80.0  # how sharply the far side of a rim wins: a sample 5 % nearer than the fill counts 1/50
SWEEPS = 12  # relaxation sweeps at each resolution; more gain nothing

MIN_TRUST = 1e-6  # a hole whose whole rim is near still gets its colour from there
MAX_EXPONENT = 30.0  # keeps weights within single precision
LIGHTEST, HEAVIEST = (np.float32(np.exp(sign * MAX_EXPONENT)) for sign in (-1, 1))
AROUND = 4  # neighbours of a pixel
GRAIN = 32  # coarse rows that a thread takes at a time

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
        Inverse depth [H, W] and values [C, H, W], float32, on the input's device; known pixels as they were.

    Raises:
        ValueError: nothing is known.
    """
    if not bool(known.any()):
        raise ValueError("nothing to fill from: no pixel is known")
    # Pixel by pixel what belongs together lies together: the hole's pixels are scattered through memory.
    depths = inverse_depth.detach().cpu().float().clone(memory_format=torch.contiguous_format)
    carried = values.detach().cpu().float().permute(1, 2, 0).clone(memory_format=torch.contiguous_format)
    bias = torch.as_tensor(far_bias, dtype=torch.float32).cpu().expand(inverse_depth.shape).contiguous()
    _fill_level(depths.numpy(), carried.numpy(), known.cpu().contiguous().numpy(), bias.numpy(), sweeps)
    return depths.to(inverse_depth.device), carried.permute(2, 0, 1).to(inverse_depth.device)


def _fill_level(depths: Floats, values: Floats, known: Bools, bias: Floats, sweeps: int) -> None:
    """Fill one level's inverse depths [H, W] and values [H, W, C] in place: from the next coarser one, then relaxed."""
    count = known.size - np.count_nonzero(known)
    if count == 0:
        return
    coarse = _coarser(depths, values, known, bias)
    _fill_level(*coarse, sweeps)
    holes, links, rim = _find_holes(known, count)
    samples = _guess(depths, values, coarse[0], coarse[1], holes, rim)
    _relax(samples, samples.copy(), links, bias.ravel()[holes], sweeps)
    _put(depths, values, holes, samples)


def _coarser(depths: Floats, values: Floats, known: Bools, bias: Floats) -> tuple[Floats, Floats, Bools, Floats]:
    """The next coarser level, in the same order."""
    reference = np.float32(1)
    if bias.any():
        reference = np.float32(torch.from_numpy(depths[known]).median())  # the lower one
    rows, columns = (-(-size // 2) for size in known.shape)
    means = np.empty((rows, columns), np.float32), np.empty((rows, columns, values.shape[-1]), np.float32)
    flags, biases = np.empty((rows, columns), np.bool_), np.empty((rows, columns), np.float32)
    run_chunks(
        lambda start, stop: _coarsen(start, stop, depths, values, known, bias, reference, *means, flags, biases),
        rows,
        GRAIN,
    )
    return *means, flags, biases


@kernel
def _coarsen(
    start: int, stop: int, depths: Any, values: Any, known: Any, bias: Any, reference: Any,
    coarse_depths: Any, coarse_values: Any, coarse_known: Any, coarse_bias: Any,
) -> None:  # fmt: skip
    """Rows start..stop of means of 2×2 pixels over the known ones, the far ones counting most; flags; mean bias."""
    height, width = depths.shape
    channels = values.shape[2]
    weights = np.empty(4, np.float32)
    for row in range(start, stop):
        for column in range(coarse_depths.shape[1]):
            top, left = 2 * row, 2 * column
            bottom, right = min(top + 1, height - 1), min(left + 1, width - 1)
            corners = (bias[top, left], bias[top, right], bias[bottom, left], bias[bottom, right])
            coarse_bias[row, column] = corners[0] / 4 + corners[1] / 4 + corners[2] / 4 + corners[3] / 4
            mass, depth = np.float32(0), np.float32(0)
            for k in range(4):
                y, x = top + k // 2, left + k % 2
                weights[k] = 0
                if y < height and x < width and known[y, x]:
                    weights[k] = _far_weight(depths[y, x] / reference, bias[y, x])
                    mass += weights[k]
                    depth += weights[k] * depths[y, x]
            coarse_known[row, column] = mass > 0
            if not mass > 0:
                continue
            coarse_depths[row, column] = depth / mass
            for channel in range(channels):
                total = np.float32(0)
                for k in range(4):
                    if weights[k] > 0:
                        total += weights[k] * values[top + k // 2, left + k % 2, channel]
                coarse_values[row, column, channel] = total / mass


@kernel
def _far_weight(relative: Any, bias: Any) -> Any:
    """relative^−bias, kept within single precision."""
    if bias == 0:
        return np.float32(1)
    exponent = -bias * np.log(max(relative, np.float32(1e-6)))
    if abs(exponent) < MAX_EXPONENT:
        return np.float32(np.exp(np.float64(exponent)))
    return HEAVIEST if exponent > 0 else LIGHTEST


@kernel
def _find_holes(known: Any, count: int) -> Any:
    """Flat positions of the holes [n], links [n, 4] to neighbours (holes, then the rim; itself outside), the rim."""
    height, width = known.shape
    holes, links = np.empty(count, np.int32), np.empty((count, AROUND), np.int32)
    rim = np.empty(min(AROUND * count, height * width - count), np.int32)
    numbers = np.empty((height, width), np.int32)
    n = 0
    for y in range(height):
        for x in range(width):
            if known[y, x]:
                numbers[y, x] = -1
            else:
                numbers[y, x] = n
                holes[n] = y * width + x
                n += 1
    met = 0
    for n in range(count):
        y, x = holes[n] // width, holes[n] % width
        for k in range(AROUND):
            v = min(max(y + (k == 1) - (k == 0), 0), height - 1)
            u = min(max(x + (k == 3) - (k == 2), 0), width - 1)
            if numbers[v, u] < 0:
                numbers[v, u] = count + met
                rim[met] = v * width + u
                met += 1
            links[n, k] = numbers[v, u]
    return holes, links, rim[:met]


@kernel
def _guess(depths: Any, values: Any, coarse_depths: Any, coarse_values: Any, holes: Any, rim: Any) -> Any:
    """Samples [holes + rim, 1 + C]: the coarser level interpolated bilinearly, and after that the rim as it is."""
    width, (rows, columns, channels) = depths.shape[1], coarse_values.shape
    samples = np.empty((len(holes) + len(rim), 1 + channels), np.float32)
    for n in range(len(holes)):
        y, x = holes[n] // width, holes[n] % width
        # A fine pixel lies a quarter of a coarse one beside its parent's centre.
        y0, x0 = (y - 1) // 2, (x - 1) // 2
        fy = np.float32(0.75) if y % 2 == 0 else np.float32(0.25)
        fx = np.float32(0.75) if x % 2 == 0 else np.float32(0.25)
        top, bottom = max(y0, 0), min(y0 + 1, rows - 1)
        left, right = max(x0, 0), min(x0 + 1, columns - 1)
        upper = coarse_depths[top, left] * (1 - fx) + coarse_depths[top, right] * fx
        lower = coarse_depths[bottom, left] * (1 - fx) + coarse_depths[bottom, right] * fx
        samples[n, 0] = upper * (1 - fy) + lower * fy
        for channel in range(channels):
            upper = coarse_values[top, left, channel] * (1 - fx) + coarse_values[top, right, channel] * fx
            lower = coarse_values[bottom, left, channel] * (1 - fx) + coarse_values[bottom, right, channel] * fx
            samples[n, 1 + channel] = upper * (1 - fy) + lower * fy
    for m in range(len(rim)):
        samples[len(holes) + m, 0] = depths[rim[m] // width, rim[m] % width]
        for channel in range(channels):
            samples[len(holes) + m, 1 + channel] = values[rim[m] // width, rim[m] % width, channel]
    return samples


@kernel
def _relax(samples: Any, copy: Any, links: Any, bias: Any, sweeps: int) -> None:
    """Jacobi sweeps on the holes, the first of the samples; nothing flows across the image's border."""
    count, channels = len(links), samples.shape[1]
    old, new = samples, copy
    for _ in range(sweeps):
        for n in range(count):
            up, down, left, right = links[n]
            if bias[n] == 0 or max(up, down, left, right) < count:
                for channel in range(channels):
                    both = old[up, channel] + old[down, channel] + old[left, channel] + old[right, channel]
                    new[n, channel] = both / AROUND
                continue
            here, mass = old[n, 0], np.float32(0)
            new[n] = 0
            for k in range(AROUND):
                link = links[n, k]
                conductance = np.float32(1) if link < count else _conductance(here, old[link, 0], bias[n])
                mass += conductance
                for channel in range(channels):
                    new[n, channel] += conductance * old[link, channel]
            for channel in range(channels):
                new[n, channel] /= mass
        old, new = new, old
    if sweeps % 2:
        for n in range(count):
            for channel in range(channels):
                samples[n, channel] = old[n, channel]


@kernel
def _conductance(here: Any, there: Any, bias: Any) -> Any:
    """How much a sample of the rim counts: the less the nearer it is."""
    if there <= here:
        return np.float32(1)
    ratio = max(here / max(there, np.float32(1e-12)), np.float32(1e-6))
    return np.float32(max(np.exp(bias * np.log(np.float64(ratio))), MIN_TRUST))


@kernel
def _put(depths: Any, values: Any, holes: Any, samples: Any) -> None:
    """Write what fills the holes to its place."""
    width = depths.shape[1]
    for n in range(len(holes)):
        y, x = holes[n] // width, holes[n] % width
        depths[y, x] = samples[n, 0]
        for channel in range(values.shape[2]):
            values[y, x, channel] = samples[n, 1 + channel]
