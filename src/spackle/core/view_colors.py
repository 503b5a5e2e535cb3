"""The colours of Gaussians as a camera sees them, which change with the view by their harmonics."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from spackle.core.color import extended_linear_to_srgb, extended_srgb_to_linear
from spackle.core.spherical_harmonics import degree_of_count, harmonics_of


def view_colors(means: Tensor, colors: Tensor, harmonics: Tensor, position: Tensor) -> Tensor:
    """The linear RGB [N, 3] of Gaussians seen from a position, at least 0.

    As in 3D Gaussian splatting, in sRGB: max(0, srgb(colour) + Σ cₖ Yₖ(d)), where d is the
    direction from the camera to the Gaussian's centre in the scene's frame. Gradients reach means,
    colours and harmonics.

    Args:
        means: [N, 3] centres.
        colors: [N, 3] linear RGB, which may lie outside of 0..1.
        harmonics: [N, K, 3] coefficients cₖ of K = 3, 8 or 15 harmonics.
        position: [3] of the camera.
    """
    return changed_colors(colors, color_change(means, harmonics, position))


def color_change(means: Tensor, harmonics: Tensor, position: Tensor) -> Tensor:
    """The sums Σ cₖ Yₖ(d) [N, 3], by which the view changes the sRGB of Gaussians.

    The arguments are those of `view_colors`.
    """
    directions = normalize(means - position.to(means), dim=-1)
    values = harmonics_of(directions, degree_of_count(harmonics.shape[1]))  # [N, K]
    # One harmonic after the other, because all products at once would take much memory.
    change = torch.zeros_like(means)
    for index in range(harmonics.shape[1]):
        change = change + values[:, index, None] * harmonics[:, index]
    return change


def changed_colors(colors: Tensor, change: Tensor) -> Tensor:
    """Linear RGB [N, 3] of colours [N, 3] whose sRGB is changed, at least 0."""
    return extended_srgb_to_linear((extended_linear_to_srgb(colors) + change).clamp_min(0))
