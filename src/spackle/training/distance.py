"""How far a filled hole is from the truth: the two numbers that are reported, neither of them trained on as it is."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spackle.training.features import FeatureNet
from spackle.training.losses import covered

NO_LENGTH = 1e-10  # of a feature vector, LPIPS' own: such a vector points nowhere


@torch.no_grad()
def hole_distance(features: FeatureNet, rgb: Tensor, target: Tensor, hole: Tensor) -> float:
    """Perceptual distance inside a hole, like LPIPS without its learned weights; 0 is equal, lower is better.

    Outside of the hole the prediction is replaced by the target, so that only the hole's content counts. For each layer
    the feature vectors of both images are scaled to unit length along the channels; the squared difference (0 to 2 a
    cell, for features that are not negative) is averaged over the cells by the share of each that is hole, not dilated,
    and the layers are summed. The layers are the network's own: `SqueezeNet` has conv1, fire4, fire8, fire9 (0 to 8 in
    all), `ResNet50` layer1 to layer4. Numbers of different networks do not compare, nor do they with published LPIPS.

    Args:
        features: the network to look with.
        rgb: [H, W, 3] the completed view, sRGB 0..1.
        target: [H, W, 3] the truth, finite everywhere.
        hole: [H, W] bool.

    Returns:
        The distance; NaN where there is no hole.
    """
    if not hole.any():
        return math.nan
    shown = torch.where(hole[..., None], rgb, target)
    total = 0.0
    for both in features(torch.stack([shown, target]).movedim(-1, 1)):  # [2, C, h, w]
        ours, theirs = both / both.norm(dim=1, keepdim=True).clamp_min(NO_LENGTH)
        weight = covered(hole[None], both)[0, 0]
        total += float(((ours - theirs).square().sum(0) * weight).sum() / weight.sum())
    return total


def hole_psnr(rgb: Tensor, target: Tensor, hole: Tensor) -> float:
    """-10 log10 of the mean squared difference over a hole's pixels and the channels, in dB; higher is better.

    Args:
        rgb: [H, W, 3] the completed view, sRGB 0..1.
        target: [H, W, 3] the truth.
        hole: [H, W] bool.

    Returns:
        Decibels; infinite where both are equal, NaN where there is no hole.
    """
    if not hole.any():
        return math.nan
    error = float((rgb - target)[hole].double().square().mean())
    return math.inf if error == 0 else -10 * math.log10(error)
