"""Image filters: blurs, the maximum in a window, a distance transform, and the fill of holes from their rims."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

FAR_SIDE_BIAS = 80.0  # preference for the far side of a rim: a sample 5 % nearer than the fill has the weight 1/50
RELAXATION_SWEEPS = 12  # relaxation sweeps at each resolution

MIN_TRUST = 1e-6  # least weight of a rim sample; a hole with only a near rim needs a weight above 0
MAX_EXPONENT = 30.0  # keeps weights within single precision
LIGHTEST, HEAVIEST = (np.float32(np.exp(sign * MAX_EXPONENT)) for sign in (-1, 1))
AROUND = 4  # neighbours of a pixel

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


def fill_from_far_side(
    inverse_depth: Tensor,
    values: Tensor,
    known: Tensor,
    *,
    far_bias: Tensor | float = FAR_SIDE_BIAS,
) -> tuple[Tensor, Tensor]:
    """Fill the unknown part of an inverse depth image and of further values, mostly from the far side of each hole.

    A moving camera uncovers the surface behind, so a hole between a near and a far surface belongs to the far surface.
    From coarse to fine, each level interpolates a guess, and relaxes it to a membrane that the rim holds. A rim sample
    has the weight min(1, fill / sample)^far_bias, with the inverse depths `fill` in the hole and `sample` at the rim.

    Args:
        inverse_depth: [H, W], positive at known pixels.
        values: [C, H, W] further values, such as colours.
        known: [H, W] bool. Values at unknown pixels are ignored.
        far_bias: one number, or one for each pixel [H, W]; 0 treats both sides of the rim alike.

    Returns:
        Inverse depth [H, W] and values [C, H, W], float32, on the input's device; known pixels are unchanged.

    Raises:
        ValueError: nothing is known.
    """
    if not bool(known.any()):
        raise ValueError("no pixel is known")
    # Channels last, because a hole's pixels are scattered in memory.
    depths = inverse_depth.detach().cpu().float().clone(memory_format=torch.contiguous_format)
    others = (
        values.detach().cpu().float().permute(1, 2, 0).clone(memory_format=torch.contiguous_format)
    )
    bias = (
        torch.as_tensor(far_bias, dtype=torch.float32)
        .cpu()
        .expand(inverse_depth.shape)
        .contiguous()
    )
    _fill_level(depths.numpy(), others.numpy(), known.cpu().contiguous().numpy(), bias.numpy())
    return depths.to(inverse_depth.device), others.permute(2, 0, 1).to(inverse_depth.device)


def _fill_level(depths: Floats, values: Floats, known: Bools, bias: Floats) -> None:
    """Fill inverse depths [H, W] and values [H, W, C] in place from the next coarser level, then relax them."""
    count, channels = known.size - np.count_nonzero(known), values.shape[-1]
    if count == 0:
        return
    reference = np.float32(
        torch.from_numpy(depths[known]).median() if bias.any() else 1
    )  # the lower of two medians
    size = [-(-side // 2) for side in known.shape]
    coarse = (np.empty(size, np.float32), np.empty((*size, channels), np.float32))
    masks = (np.empty(size, np.bool_), np.empty(size, np.float32))
    fine = (depths, values, known, bias, reference)
    parallel_for_chunks(lambda start, stop: _coarsen(start, stop, *fine, *coarse, *masks), size[0])
    _fill_level(*coarse, *masks)
    holes, links, rim = _find_holes(known, count)
    flat, pixels = depths.reshape(-1), values.reshape(known.size, channels)
    samples = np.empty(
        (count + len(rim), 1 + channels), np.float32
    )  # first of the holes, then of the rim
    _guess(known.shape[1], *coarse, holes, samples)
    samples[count:, 0], samples[count:, 1:] = flat[rim], pixels[rim]
    samples = _relax(samples, samples.copy(), links, bias.ravel()[holes], RELAXATION_SWEEPS)
    flat[holes], pixels[holes] = samples[:count, 0], samples[:count, 1:]


@kernel
def _coarsen(
    start: int, stop: int, depths: Any, values: Any, known: Any, bias: Any, reference: Any,
    coarse_depths: Any, coarse_values: Any, coarse_known: Any, coarse_bias: Any,
) -> None:  # fmt: skip
    """Reduce 2×2 pixels to one, in rows start..stop of the coarser level; far pixels have the largest weights."""
    height, width = depths.shape
    channels = values.shape[2]
    weights = np.empty(4, np.float32)
    for row in range(start, stop):
        for column in range(coarse_depths.shape[1]):
            top, left = 2 * row, 2 * column
            bottom, right = min(top + 1, height - 1), min(left + 1, width - 1)
            corners = (bias[top, left], bias[top, right], bias[bottom, left], bias[bottom, right])
            coarse_bias[row, column] = (
                corners[0] / 4 + corners[1] / 4 + corners[2] / 4 + corners[3] / 4
            )
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
    """relative^−bias, within single precision."""
    if bias == 0:
        return np.float32(1)
    exponent = -bias * np.log(max(relative, np.float32(1e-6)))
    if abs(exponent) < MAX_EXPONENT:
        return np.float32(np.exp(np.float64(exponent)))
    return HEAVIEST if exponent > 0 else LIGHTEST


@kernel
def _find_holes(known: Any, count: int) -> Any:
    """Flat positions of the n hole pixels, numbers [n, 4] of their neighbours, and flat positions of the rim's pixels.

    Pixels of the rim have higher numbers than those of the hole. At the image's border, a pixel is its own neighbour.
    """
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
def _guess(width: int, coarse_depths: Any, coarse_values: Any, holes: Any, samples: Any) -> None:
    """Interpolate the holes' samples [n, 1 + C] bilinearly from the coarser level."""
    rows, columns, channels = coarse_values.shape
    for n in range(len(holes)):
        y, x = holes[n] // width, holes[n] % width
        # A fine pixel's centre lies a quarter of a coarse pixel from its parent's centre.
        y0, x0 = (y - 1) // 2, (x - 1) // 2
        fy = np.float32(0.75) if y % 2 == 0 else np.float32(0.25)
        fx = np.float32(0.75) if x % 2 == 0 else np.float32(0.25)
        top, bottom = max(y0, 0), min(y0 + 1, rows - 1)
        left, right = max(x0, 0), min(x0 + 1, columns - 1)
        upper = coarse_depths[top, left] * (1 - fx) + coarse_depths[top, right] * fx
        lower = coarse_depths[bottom, left] * (1 - fx) + coarse_depths[bottom, right] * fx
        samples[n, 0] = upper * (1 - fy) + lower * fy
        for channel in range(channels):
            upper = (
                coarse_values[top, left, channel] * (1 - fx)
                + coarse_values[top, right, channel] * fx
            )
            lower = (
                coarse_values[bottom, left, channel] * (1 - fx)
                + coarse_values[bottom, right, channel] * fx
            )
            samples[n, 1 + channel] = upper * (1 - fy) + lower * fy


@kernel
def _relax(samples: Any, copy: Any, links: Any, bias: Any, sweeps: int) -> Any:
    """Jacobi sweeps over the samples of holes, which come before the samples of the rim."""
    count, channels = len(links), samples.shape[1]
    old, new = samples, copy
    for _ in range(sweeps):
        for n in range(count):
            up, down, left, right = links[n]
            if bias[n] == 0 or max(up, down, left, right) < count:
                for channel in range(channels):
                    both = (
                        old[up, channel]
                        + old[down, channel]
                        + old[left, channel]
                        + old[right, channel]
                    )
                    new[n, channel] = both / AROUND
                continue
            here, mass = old[n, 0], np.float32(0)
            new[n] = 0
            for k in range(AROUND):
                link = links[n, k]
                conductance = (
                    np.float32(1) if link < count else _conductance(here, old[link, 0], bias[n])
                )
                mass += conductance
                for channel in range(channels):
                    new[n, channel] += conductance * old[link, channel]
            for channel in range(channels):
                new[n, channel] /= mass
        old, new = new, old
    return old


@kernel
def _conductance(here: Any, there: Any, bias: Any) -> Any:
    """The weight min(1, here / there)^bias of a rim sample `there` for the fill `here`."""
    if there <= here:
        return np.float32(1)
    ratio = max(here / max(there, np.float32(1e-12)), np.float32(1e-6))
    return np.float32(max(np.exp(bias * np.log(np.float64(ratio))), MIN_TRUST))
