"""The image metrics of the tables: their descriptions, and those that are computed here.

`METRICS` describes all of them. PSNR, SSIM and sharpness are below; the perceptual distance is
`spackle.paper.training.losses.hole_distance`; the others are published networks
(published_metrics.py).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.filters import gaussian_blur, maximum_filter
from spackle.paper.training.losses import hole_psnr

# SSIM as published (Wang et al. 2004), for values in 0..1.
SSIM_WINDOW_PX = 11  # side of the window
SSIM_SIGMA_PX = 1.5  # of the Gaussian weights in the window
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2

GREY_WEIGHTS = torch.tensor([0.299, 0.587, 0.114])  # of red, green and blue in grey (Rec. 601)

# Sharpness counts a pixel if the square of this side around it lies in the mask.
SHARPNESS_SQUARE_PX = 7


@dataclasses.dataclass(frozen=True, kw_only=True)
class MetricDescription:
    """What a metric of images is called, what it measures exactly, and what it needs."""

    title: str  # its name, a space, and an arrow for the better direction
    definition: str  # the exact definition, for the notes below tables
    lower_is_better: bool
    decimals: int = 4  # in tables
    needs_true_picture: bool = False  # whether it compares with the true photo of the same view
    # For pyiqa, all explicit, because its defaults may change; None: not one of pyiqa's metrics.
    pyiqa_options: dict[str, Any] | None = None

    @property
    def name(self) -> str:
        """The title without its arrow."""
        return self.title[: -len(" ↑")]

    def format(self, value: float) -> str:
        """A value as tables show it."""
        return f"{value:.{self.decimals}f}"


METRICS = {
    "clipiqa": MetricDescription(
        title="CLIPIQA ↑",
        definition=(
            "CLIP RN50 without positional embedding at the picture's own size; mean over the "
            "prompt pairs Good/bad image, Sharp/blurry image, sharp/blurry edges, High/low "
            "resolution image, Noise-free/noisy image"
        ),
        lower_is_better=False,
        pyiqa_options={"model_type": "clipiqa", "backbone": "RN50", "pos_embedding": False},
    ),
    "niqe": MetricDescription(
        title="NIQE ↓",
        definition=(
            "on the float render, of which pyiqa rounds the luma (YIQ) to 0..255; blocks of 96×96, "
            "the pristine model of the authors' release"
        ),
        lower_is_better=True,
        pyiqa_options={"test_y_channel": True},
    ),
    "musiq": MetricDescription(
        title="MUSIQ ↑",
        definition="trained on KonIQ-10k; scales 224, 384 and the picture's own",
        lower_is_better=False,
        pyiqa_options={"pretrained": "koniq10k"},
    ),
    "psnr": MetricDescription(
        title="PSNR ↑",
        definition="in dB over sRGB pixels and channels in 0..1",
        lower_is_better=False,
        decimals=2,
        needs_true_picture=True,
    ),
    "ssim": MetricDescription(
        title="SSIM ↑",
        definition=(
            "Gaussian window of 11 pixels, σ 1.5, K 0.01 and 0.03, mean of the sRGB channels"
        ),
        lower_is_better=False,
        needs_true_picture=True,
    ),
    "distance": MetricDescription(
        title="distance ↓",
        definition=(
            "masked perceptual distance in the hole: SqueezeNet 1.0 at conv1, fire4, fire8 and "
            "fire9, unit feature vectors, 0 to 8 (spackle.paper.training.losses.hole_distance); "
            "not LPIPS"
        ),
        lower_is_better=True,
        needs_true_picture=True,
    ),
    "dists": MetricDescription(
        title="DISTS ↓",
        definition="VGG16 with the authors' weights, at the picture's own size",
        lower_is_better=True,
        needs_true_picture=True,
        pyiqa_options={},
    ),
    "lpips": MetricDescription(
        title="LPIPS ↓",
        definition=(
            "AlexNet, version 0.1, at the picture's own size (the paper does not say which network "
            "it took)"
        ),
        lower_is_better=True,
        needs_true_picture=True,
        pyiqa_options={"net": "alex", "version": "0.1"},
    ),
}

# The metrics that are measured unless others are chosen, by protocol.
DEFAULT_METRICS = {
    "large-view": [name for name, metric in METRICS.items() if not metric.needs_true_picture],
    "near-view": [name for name, metric in METRICS.items() if metric.needs_true_picture],
}


def metric_of_column(column: str) -> str | None:
    """The metric that a table's column shows: "psnr" for "psnr", "psnr_hole" and "psnr_outside".

    Returns None for columns of counts and shares, which are no image metrics.
    """
    name, _, _ = column.partition("_")
    return name if name in METRICS else None


def psnr(image: Tensor, true_picture: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB, computed in float64: -10 · log10(mean squared error).

    The peak, which is the largest possible value, is 1.

    Args:
        image: [H, W, 3] sRGB 0..1.
        true_picture: [H, W, 3] sRGB 0..1, what the image should be.
        mask: [H, W] bool, the pixels that count; None: all.

    Returns:
        The ratio, higher is better; infinite for equal images, NaN if no pixel counts.
    """
    if mask is None:
        mask = torch.ones(image.shape[:2], dtype=torch.bool)
    return hole_psnr(image.double(), true_picture.double(), mask)


def sharpness(image: Tensor, true_picture: Tensor, mask: Tensor) -> float:
    """The mean gradient magnitude of the image as grey, divided by that of the true picture.

    1 is as sharp as the true picture, 0 has no detail. Only pixels at least 3 pixels inside the
    mask count, because the mask's border is an edge of its own.

    Args:
        image: [H, W, 3] sRGB 0..1.
        true_picture: [H, W, 3] sRGB 0..1, what the image should be.
        mask: [H, W] bool.

    Returns:
        The ratio; NaN if no pixel counts.
    """
    # A pixel counts if the square around it (of 7 pixels, so 3 to each side) lies in the mask.
    is_inside = ~maximum_filter(~mask, SHARPNESS_SQUARE_PX // 2)
    return float(_mean_gradient(image, is_inside) / _mean_gradient(true_picture, is_inside))


def _mean_gradient(picture: Tensor, mask: Tensor) -> Tensor:
    """The mean gradient magnitude of a picture [H, W, 3] in grey, in a mask [H, W]."""
    grey = picture @ GREY_WEIGHTS  # [H, W]
    down, right = torch.gradient(grey)
    return torch.hypot(down, right)[mask].mean()


def ssim_average(similarity: Tensor, mask: Tensor | None = None) -> float:
    """The mean structural similarity of two images (Wang et al. 2004).

    Without a mask, pixels count if their window lies within the image, as published. With a mask,
    all its pixels count, also at the image's border, because much of a hole is at the border.

    Args:
        similarity: [H, W, 3] similarity at each pixel, from `ssim_map`.
        mask: [H, W] bool, the pixels that count; None: as published.

    Returns:
        The average: 1 for equal images, higher is better, NaN if no pixel counts.
    """
    if mask is None:
        margin = SSIM_WINDOW_PX // 2
        counted = similarity[margin:-margin, margin:-margin]
    else:
        counted = similarity[mask]
    return float(counted.mean())


def ssim_map(image: Tensor, true_picture: Tensor) -> Tensor:
    """Structural similarity of two images x and y at each pixel and channel (Wang et al. 2004).

    SSIM = (2 μx μy + C1) (2 σxy + C2) / ((μx² + μy² + C1) (σx² + σy² + C2)), with means μ,
    variances σ² and covariance σxy under a Gaussian window of 11 pixels with σ 1.5. At the border
    the images are mirrored to fill the window.

    Args:
        image: [H, W, 3] sRGB 0..1.
        true_picture: [H, W, 3] sRGB 0..1.

    Returns:
        [H, W, 3] float64, 1 where the images are equal.
    """
    # Float64, because variances are small differences of large numbers.
    x = image.double()
    y = true_picture.double()

    mean_x = _windowed_mean(x)
    mean_y = _windowed_mean(y)
    variance_x = _windowed_mean(x * x) - mean_x**2
    variance_y = _windowed_mean(y * y) - mean_y**2
    covariance = _windowed_mean(x * y) - mean_x * mean_y

    numerator = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    denominator = (mean_x**2 + mean_y**2 + SSIM_C1) * (variance_x + variance_y + SSIM_C2)
    return numerator / denominator


def _windowed_mean(image: Tensor) -> Tensor:
    """The mean of [H, W, C] around each pixel under a Gaussian window; borders are mirrored."""
    margin = SSIM_WINDOW_PX // 2
    widths = ((margin, margin), (margin, margin), (0, 0))
    # By NumPy, because torch's mirror would leave the outermost pixel out.
    mirrored = torch.from_numpy(np.pad(image.numpy(), widths, "symmetric"))
    return gaussian_blur(mirrored, SSIM_SIGMA_PX)[margin:-margin, margin:-margin]
