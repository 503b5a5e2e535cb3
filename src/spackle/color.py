"""Transfer between sRGB, which photos and screens use, and linear RGB, in which light adds up."""

from __future__ import annotations

import torch
from torch import Tensor


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """IEC 61966-2-1 decoding, elementwise; values outside 0..1 are clamped to it."""
    srgb = srgb.clamp(0, 1)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: Tensor) -> Tensor:
    """IEC 61966-2-1 encoding, elementwise; values outside 0..1 are clamped to it."""
    linear = linear.clamp(0, 1)
    # The inner clamp keeps the gradient of the unused branch finite at zero.
    power = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, linear * 12.92, power)
