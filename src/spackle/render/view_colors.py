"""The colours that a camera sees, fast: Gaussians with harmonics become Gaussians without.

`core/view_colors.py` has the formula; here is a kernel for the CPU, and one rule more: where a sum
of harmonics is 0, not a bit of the colour changes. So a scene looks the same with and without
coefficients of 0, which Gaussians get that are joined to others.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from spackle.core.camera import Camera
from spackle.core.color import SRGB_EXPONENT, SRGB_OFFSET
from spackle.core.gaussians import Gaussians
from spackle.core.spherical_harmonics import (
    C1,
    C2_AXIAL,
    C2_MIXED,
    C2_SQUARES,
    C3_AXIAL,
    C3_INNER,
    C3_MIXED,
    C3_OUTER,
    C3_SQUARES,
)
from spackle.core.view_colors import changed_colors, color_change, view_colors
from spackle.render.fast_math import (
    ENCODED_KNEE,
    SRGB_KNEE,
    SRGB_LINE,
    decode_srgb,
    encode_srgb,
)
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import ONE, ZERO, inlined_kernel, kernel

GAUSSIANS_PER_CHUNK = 1 << 14  # that a thread colours at a time
BLOCK_GAUSSIANS = 256  # their changes of colour fit into the first-level cache
MAX_CHANGE = 1e30  # a larger sum of harmonics is treated like NaN

# Numbers of the formulas in float32, for the kernel.
K_OFFSET = np.float32(SRGB_OFFSET)
K_POWER = np.float32(SRGB_EXPONENT)
K_ROOT = np.float32(1 / SRGB_EXPONENT)
K_MAX = np.float32(MAX_CHANGE)
K_1 = np.float32(C1)
K_2_MIXED = np.float32(C2_MIXED)
K_2_AXIAL = np.float32(C2_AXIAL)
K_2_SQUARES = np.float32(C2_SQUARES)
K_3_OUTER = np.float32(C3_OUTER)
K_3_MIXED = np.float32(C3_MIXED)
K_3_INNER = np.float32(C3_INNER)
K_3_AXIAL = np.float32(C3_AXIAL)
K_3_SQUARES = np.float32(C3_SQUARES)
TWO = np.float32(2)
THREE = np.float32(3)
FOUR = np.float32(4)


def as_seen(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The Gaussians with the colours that a camera sees, and without harmonics.

    Gaussians without harmonics are returned as they are. Gradients reach all tensors.
    """
    if gaussians.harmonics is None:
        return gaussians
    colors = seen_colors(gaussians.means, gaussians.colors, gaussians.harmonics, camera)
    return dataclasses.replace(gaussians, colors=colors, harmonics=None)


def seen_colors(means: Tensor, colors: Tensor, harmonics: Tensor, camera: Camera) -> Tensor:
    """The linear RGB [N, 3] of Gaussians seen by a camera, as `view_colors` defines it.

    Where the sum of harmonics is 0, the colour is not changed by a bit; where it is not finite, the
    colour is NaN. Gradients reach means, colours and harmonics.

    Args:
        means: [N, 3] centres.
        colors: [N, 3] linear RGB, which may lie outside of 0..1.
        harmonics: [N, K, 3] coefficients of K = 3, 8 or 15 harmonics.
        camera: the view.
    """
    position = camera.position.detach().to(means.device)
    seen: Tensor = SeenColors.apply(  # type: ignore[no-untyped-call]
        means, colors, harmonics, position
    )
    return seen


class SeenColors(torch.autograd.Function):
    """`seen_colors` with its gradients; on the CPU, a kernel computes the values in one pass."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, colors: Tensor, harmonics: Tensor, position: Tensor
    ) -> Tensor:
        """The colours [N, 3]; the arguments are those of `view_colors`."""
        ctx.save_for_backward(means, colors, harmonics, position)
        if means.device.type == "cpu" and means.dtype == torch.float32:
            return _colors_by_kernel(means, colors, harmonics, position)
        change = color_change(means, harmonics, position)
        seen = torch.where(change == 0, colors.clamp_min(0), changed_colors(colors, change))
        return torch.where(change.abs() < MAX_CHANGE, seen, torch.nan)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """The gradients of means, colours and harmonics, from the formula in PyTorch.

        `gradient` is that of the colours [N, 3]. The position has none.
        """
        *fields, position = ctx.saved_tensors
        needed_indices = [index for index in range(3) if ctx.needs_input_grad[index]]
        with torch.enable_grad():
            inputs = [
                field.detach().requires_grad_(index in needed_indices)
                for index, field in enumerate(fields)
            ]
            means, colors, harmonics = inputs
            seen = view_colors(means, colors, harmonics, position)
            needed_inputs = [inputs[index] for index in needed_indices]
            needed_gradients = torch.autograd.grad(seen, needed_inputs, gradient)

        # One for each argument of `forward`; None for those that need none.
        gradients: list[Tensor | None] = [None, None, None, None]
        for index, needed_gradient in zip(needed_indices, needed_gradients, strict=True):
            gradients[index] = needed_gradient
        return tuple(gradients)


def _colors_by_kernel(means: Tensor, colors: Tensor, harmonics: Tensor, position: Tensor) -> Tensor:
    """The colours of `seen_colors` in float32 on the CPU, on several threads."""
    arrays = [tensor.detach().float().contiguous().numpy() for tensor in (means, colors, harmonics)]
    place = position.double().numpy()
    result = np.empty((len(means), 3), np.float32)
    parallel_for_chunks(
        lambda start, stop: color_gaussians(start, stop, *arrays, place, result),
        len(means),
        GAUSSIANS_PER_CHUNK,
    )
    return torch.from_numpy(result)


@kernel
def color_gaussians(
    start: int, stop: int, means: Any, colors: Any, harmonics: Any, place: Any, result: Any
) -> None:
    """Write the colours of the Gaussians start..stop, as `seen_colors` defines them.

    Args:
        start, stop: indices of Gaussians.
        means, colors: [N, 3] float32.
        harmonics: [N, K, 3] float32, with K = 3, 8 or 15.
        place: [3] float64, the camera's position.
        result: [N, 3] float32; the rows start..stop are written.
    """
    changes = np.empty(3 * BLOCK_GAUSSIANS, np.float32)
    for begin in range(start, stop, BLOCK_GAUSSIANS):
        end = min(begin + BLOCK_GAUSSIANS, stop)
        write_changes(means[begin:end], harmonics[begin:end], place, changes)
        # Nearly all blocks have ordinary colours alone, for which there is a faster loop.
        flat_colors = colors[begin:end].reshape(-1)
        flat_result = result[begin:end].reshape(-1)
        if not write_ordinary_colors(flat_colors, changes, flat_result):
            write_other_colors(flat_colors, changes, flat_result)


@kernel
def write_changes(means: Any, harmonics: Any, place: Any, changes: Any) -> None:
    """Write the changes of sRGB, flat [3·n], of n ≤ 256 Gaussians seen from a place [3].

    `means` is [n, 3], `harmonics` [n, K, 3].
    """
    count = harmonics.shape[1]
    values = np.empty(15, np.float32)  # of the harmonics at a Gaussian's direction
    for i in range(len(means)):
        # The direction, from differences in float64: a scene may be far from the origin.
        dx = np.float64(means[i, 0]) - place[0]
        dy = np.float64(means[i, 1]) - place[1]
        dz = np.float64(means[i, 2]) - place[2]
        length = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-30)  # at the camera there is none
        inverse_length = 1.0 / length
        x = np.float32(dx * inverse_length)
        y = np.float32(dy * inverse_length)
        z = np.float32(dz * inverse_length)
        write_harmonics(x, y, z, count, values)

        red = ZERO
        green = ZERO
        blue = ZERO
        for k in range(count):
            red += values[k] * harmonics[i, k, 0]
            green += values[k] * harmonics[i, k, 1]
            blue += values[k] * harmonics[i, k, 2]
        changes[3 * i] = red
        changes[3 * i + 1] = green
        changes[3 * i + 2] = blue


@inlined_kernel
def write_harmonics(x: np.float32, y: np.float32, z: np.float32, count: int, values: Any) -> None:
    """Write the first 3, 8 or 15 harmonics of a unit direction into `values` [15]."""
    xx = x * x
    yy = y * y
    zz = z * z
    values[0] = -K_1 * y
    values[1] = K_1 * z
    values[2] = -K_1 * x
    if count > 3:
        values[3] = K_2_MIXED * x * y
        values[4] = -K_2_MIXED * y * z
        values[5] = K_2_AXIAL * (TWO * zz - xx - yy)
        values[6] = -K_2_MIXED * x * z
        values[7] = K_2_SQUARES * (xx - yy)
    if count > 8:
        values[8] = -K_3_OUTER * y * (THREE * xx - yy)
        values[9] = K_3_MIXED * x * y * z
        values[10] = -K_3_INNER * y * (FOUR * zz - xx - yy)
        values[11] = K_3_AXIAL * z * (TWO * zz - THREE * xx - THREE * yy)
        values[12] = -K_3_INNER * x * (FOUR * zz - xx - yy)
        values[13] = K_3_SQUARES * z * (xx - yy)
        values[14] = -K_3_OUTER * x * (xx - THREE * yy)


@kernel
def write_ordinary_colors(colors: Any, changes: Any, result: Any) -> bool:
    """Write changed colours, flat [3·n]; returns whether all are ordinary.

    A colour is ordinary if it is within 0..1 before the change, and at most 1 after it; below 0 it
    becomes 0. What is written of others is wrong. The loop runs in vector registers.
    """
    outside = 0
    for j in range(len(colors)):
        linear = colors[j]
        change = changes[j]
        changed = encode_srgb(linear) + change
        seen = decode_srgb(changed)
        result[j] = linear if change == ZERO else seen
        # All comparisons are false for NaN.
        is_ordinary = (linear >= ZERO) & (linear <= ONE) & (changed <= ONE) & (change > -K_MAX)
        outside += 0 if is_ordinary else 1
    return outside == 0


@kernel
def write_other_colors(colors: Any, changes: Any, result: Any) -> None:
    """Write those changed colours, flat [3·n], that `write_ordinary_colors` could not."""
    for j in range(len(colors)):
        linear = colors[j]
        change = changes[j]
        if not abs(change) < K_MAX:
            result[j] = np.nan
        elif change == ZERO:
            result[j] = max(linear, ZERO)
        elif linear < ZERO or linear > ONE or encode_srgb(linear) + change > ONE:
            result[j] = extended_change(linear, change)


@inlined_kernel
def extended_change(linear: np.float32, change: np.float32) -> np.float32:
    """A linear colour of any size whose sRGB is changed, at least 0."""
    size = abs(linear)
    srgb = size * SRGB_LINE
    if size > SRGB_KNEE:
        srgb = (ONE + K_OFFSET) * size**K_ROOT - K_OFFSET
    if linear < ZERO:
        srgb = -srgb
    changed = srgb + change
    if changed <= ZERO:
        return ZERO
    if changed <= ENCODED_KNEE:
        return changed / SRGB_LINE
    return ((changed + K_OFFSET) / (ONE + K_OFFSET)) ** K_POWER
