"""From a depth map as measured to a surface that can be seen from the side."""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.surface import EDGE, neighbours

SWEEPS = 200  # enough for steps about 30 pixels apart


def attach_flying_pixels(inverse_depth: Tensor, edge: float = EDGE) -> Tensor:
    """Move pixels that hang between foreground and background to the side they are closer to.

    A pixel hangs when it lies strictly between its left and right (or upper and lower) neighbours with
    a depth edge to both, while the depth beyond those neighbours goes on much more smoothly: on a steep
    plane it does not.

    Args:
        inverse_depth: [H, W], positive everywhere.
        edge: relative jump that makes a depth edge.
    """
    for axis in (1, 0):
        before, after = _shifted(inverse_depth, axis, -1), _shifted(inverse_depth, axis, 1)
        to_before, to_after = (inverse_depth - before).abs(), (inverse_depth - after).abs()
        gap = torch.minimum(to_before, to_after)
        between = (inverse_depth - before) * (after - inverse_depth) > 0
        beyond = torch.maximum(
            (before - _shifted(inverse_depth, axis, -2)).abs(), (after - _shifted(inverse_depth, axis, 2)).abs()
        )
        hangs = between & (gap > edge * inverse_depth) & (beyond < 0.5 * gap)
        inverse_depth = torch.where(hangs, torch.where(to_before < to_after, before, after), inverse_depth)
    return inverse_depth


def _shifted(image: Tensor, axis: int, by: int) -> Tensor:
    """The pixel `by` steps along an axis of [H, W]; the border pixel beyond the border."""
    index = (torch.arange(image.shape[axis]) + by).clamp(0, image.shape[axis] - 1)
    return image.index_select(axis, index)


def attach_mixed_pixels(inverse_depth: Tensor, rgb: Tensor, edge: float = EDGE) -> Tensor:
    """Give a background pixel that a depth edge touches to the foreground, where its colour says so.

    A lens blurs a silhouette over a pixel or two, so the first background pixel often has the
    foreground's colour. Left where it is, it draws a ghost outline as soon as the camera moves.

    Args:
        inverse_depth: [H, W], positive everywhere.
        rgb: [H, W, 3] sRGB.
        edge: relative jump that makes a depth edge.
    """
    result = inverse_depth
    for axis in (1, 0):
        depths = neighbours(inverse_depth, axis)
        colors = [torch.stack(c, dim=-1) for c in zip(*(neighbours(c, axis) for c in rgb.unbind(-1)), strict=True)]
        for near, far in ((0, 1), (1, 0)):
            silhouette = depths[near] - inverse_depth > edge * inverse_depth
            silhouette &= (depths[far] - inverse_depth).abs() < edge * inverse_depth
            to_near, to_far = ((rgb - colors[side]).abs().sum(-1) for side in (near, far))
            result = torch.where(silhouette & (to_near < to_far), torch.maximum(result, depths[near]), result)
    return result


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
