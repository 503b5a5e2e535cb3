"""From a depth map as measured to a surface that can be seen from the side."""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.surface import EDGE, neighbours

SWEEPS = 200  # enough for steps about 30 pixels apart


def attach_flying_pixels(inverse_depth: Tensor, edge: float = EDGE) -> Tensor:
    """Move pixels that hang between foreground and background to the side they are closer to.

    A pixel hangs when it lies strictly between its left and right (or upper and lower) neighbours with
    a depth edge to both.

    Args:
        inverse_depth: [H, W], positive everywhere.
        edge: relative jump that makes a depth edge.
    """
    for axis in (1, 0):
        before, after = neighbours(inverse_depth, axis)
        to_before, to_after = (inverse_depth - before).abs(), (inverse_depth - after).abs()
        between = (inverse_depth - before) * (after - inverse_depth) > 0
        hangs = between & (torch.minimum(to_before, to_after) > edge * inverse_depth)
        inverse_depth = torch.where(hangs, torch.where(to_before < to_after, before, after), inverse_depth)
    return inverse_depth


def undo_quantisation(inverse_depth: Tensor, valid: Tensor, quantum: float, sweeps: int = SWEEPS) -> Tensor:
    """The smoothest surface that would round to the stored steps.

    Integer disparities turn a slanted plane into a staircase with a gap at every step. Each stored value
    is an interval, ±quantum/2; relaxing towards the mean of the neighbours within the interval removes
    the stairs. Neighbours more than 1.5 steps away belong to another surface.

    Args:
        inverse_depth: [H, W], multiples of `quantum` plus a constant.
        valid: [H, W] bool; other pixels neither move nor pull.
        quantum: step of the stored values in units of the inverse depth.
    """
    low, high = inverse_depth - quantum / 2, inverse_depth + quantum / 2
    weights = []
    for axis in (1, 0):
        for neighbour, present in zip(neighbours(inverse_depth, axis), neighbours(valid, axis), strict=True):
            weights.append((present & ((neighbour - inverse_depth).abs() < 1.5 * quantum)).float())
    mass = sum(weights, torch.full_like(inverse_depth, 1e-6))
    smooth = inverse_depth
    for _ in range(sweeps):
        around = [n for axis in (1, 0) for n in neighbours(smooth, axis)]
        total = sum((w * n for w, n in zip(weights, around, strict=True)), 1e-6 * smooth)
        smooth = torch.minimum(torch.maximum(total / mass, low), high)
    return torch.where(valid, smooth, inverse_depth)
