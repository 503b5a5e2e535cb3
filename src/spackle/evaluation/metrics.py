"""Figures of a view that need no network: what is covered, and how far a picture is from the truth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spackle.training.distance import hole_psnr

WINDOW, SIGMA = 11, 1.5  # of SSIM, in pixels (Wang et al. 2004)
C1, C2 = 0.01**2, 0.03**2  # its constants K1 = 0.01, K2 = 0.03, for values in 0..1


def reduction(before: float, after: float) -> float:
    """Relative decrease of the HAR, 1 − after / before (paper, tab:controlled_disocclusion); NaN without any hole.

    The paper's own numbers are the reduction of a dataset's mean HAR, not the mean of its images' reductions; so are
    those of our tables.
    """
    return 1 - after / before if before > 0 else math.nan


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """-10 log10 of the mean squared difference over pixels and channels, in dB; higher is better.

    Args:
        image: [H, W, 3] sRGB 0..1.
        truth: [H, W, 3].
        mask: [H, W] bool, the pixels that count; all where None.

    Returns:
        Decibels; infinite where both are equal, NaN where no pixel counts.
    """
    if mask is None:
        mask = torch.ones(image.shape[:2], dtype=torch.bool)
    return hole_psnr(image.double(), truth.double(), mask)


def ssim(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of each sRGB channel, averaged; 1 is equal, higher is better.

    Without a mask the average runs over the pixels whose window lies within the picture, as published. A mask may reach
    the picture's border, where much of a hole is; there the picture is mirrored to fill the window.

    Args:
        image: [H, W, 3] sRGB 0..1.
        truth: [H, W, 3].
        mask: [H, W] bool, the pixels that count.

    Returns:
        The average; NaN where no pixel counts.
    """
    return ssim_average(ssim_map(image, truth), mask)


def ssim_average(similarity: Tensor, mask: Tensor | None = None) -> float:
    """`ssim` of a map that is at hand: [H, W, 3]."""
    if mask is None:
        edge = WINDOW // 2
        return float(similarity[edge:-edge, edge:-edge].mean())
    return float(similarity[mask].mean())


def ssim_map(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM at each pixel and channel, [H, W, 3] float64, under a Gaussian window of 11 pixels with σ 1.5."""
    x, y = (picture.double().permute(2, 0, 1).contiguous() for picture in (image, truth))
    mean_x, mean_y, square_x, square_y, product = (_blur(moment) for moment in (x, y, x * x, y * y, x * y))
    variance_x, variance_y = square_x - mean_x**2, square_y - mean_y**2
    covariance = product - mean_x * mean_y
    likeness = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    similarity = likeness / ((mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2))
    return similarity.permute(1, 2, 0)


def _blur(image: Tensor) -> Tensor:
    """[3, H, W] under the window; pixels beyond the border are mirrored, the border's own among them."""
    reach = WINDOW // 2
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=torch.float64) / SIGMA) ** 2)
    weights /= weights.sum()
    for axis in (1, 2):
        size = image.shape[axis]
        wide = image.index_select(axis, _mirrored(size, reach))
        image = torch.zeros_like(image)  # sums of slices: convolutions in float64 are slow
        for start, weight in enumerate(weights.tolist()):
            image.add_(wide.narrow(axis, start, size), alpha=weight)
    return image


def _mirrored(size: int, reach: int) -> Tensor:
    """Indices -reach..size+reach folded back into 0..size: d c b a | a b c d | d c b a."""
    folded = torch.arange(-reach, size + reach) % (2 * size)
    return torch.where(folded < size, folded, 2 * size - 1 - folded)
