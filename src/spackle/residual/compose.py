"""Composition (paper, sections 3.3 and 3.4): seeds and the deltas of f_res make aux Gaussians (eq. 5), as in SHARP.

Of seeds that are selected by the mask it gives 𝒢̃_aug (eq. 7).
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn.functional import softplus

from spackle.camera import Camera
from spackle.color import srgb_to_linear
from spackle.gaussians import Gaussians
from spackle.residual.base_values import OPACITY, SPREAD_PX, Seeds
from spackle.surface import surface_gaussians

# Channels of a delta field: three of geometry, eleven of texture, as in SHARP.
XY, INVERSE_DEPTH, SCALE, QUAT, COLOR, ALPHA = (
    slice(0, 2), slice(2, 3), slice(3, 6), slice(6, 10), slice(10, 13), slice(13, 14),
)  # fmt: skip
GEOMETRY_CHANNELS = 3
TEXTURE_CHANNELS = 11
DELTA_CHANNELS = GEOMETRY_CHANNELS + TEXTURE_CHANNELS

# A delta of one moves the position by a pixel, and the colour and the opacity by one in the sigmoid's domain.
INVERSE_DEPTH_GAIN = 0.1  # in units of the view's median inverse depth
LEAST_DEPTH = 1e-4  # and least inverse depth, so that no delta makes a distance infinite
QUAT_GAIN = 0.1
MIN_SCALE, MAX_SCALE = 0.25, 4.0  # bounds of the scale factor, which is 1, with slope 1, at zero
COLOR_MARGIN = 1.0 / 512  # keeps the inverse sigmoid finite, below 8-bit resolution


def compose(seeds: Seeds, deltas: Tensor | None, camera: Camera, spread_px: float = SPREAD_PX) -> Gaussians:
    """Aux Gaussians [n] of flat seeds; deltas of None or zero give the seeds themselves.

    Args:
        seeds: flat, as `Seeds.select` gives them: fields [n, ...].
        deltas: [n, 14], or None. Gradients flow through them.
        camera: the view that the seeds belong to.
        spread_px: standard deviation of a blob.
    """
    uv, inverse_depth, rgb = seeds.uv, seeds.inverse_depth, seeds.rgb
    opacities = torch.full_like(inverse_depth, OPACITY)
    if deltas is not None:
        uv = uv + deltas[:, XY]
        shift = INVERSE_DEPTH_GAIN * deltas[:, INVERSE_DEPTH].squeeze(1)
        inverse_depth = _shift_positive(inverse_depth, shift, seeds.unit)
        rgb = torch.sigmoid(color_logit(rgb) + deltas[:, COLOR])
        opacities = torch.sigmoid(color_logit(opacities) + deltas[:, ALPHA].squeeze(1))
    surfels = surface_gaussians(camera, uv, inverse_depth, seeds.slope, spread_px, srgb_to_linear(rgb), opacities)
    if deltas is None:
        return surfels
    quats = surfels.quats + QUAT_GAIN * deltas[:, QUAT]
    return dataclasses.replace(surfels, quats=quats, scales=surfels.scales * _scale_factor(deltas[:, SCALE]))


def _shift_positive(base: Tensor, delta: Tensor, unit: float) -> Tensor:
    """softplus(softplus⁻¹(base) + delta), both in multiples of `unit`."""
    relative = (base / unit).clamp_min(LEAST_DEPTH)
    return unit * softplus(relative + torch.log(-torch.expm1(-relative)) + delta).clamp_min(LEAST_DEPTH)


def color_logit(value: Tensor) -> Tensor:
    """sigmoid⁻¹ of colours or opacities, kept off 0 and 1."""
    return torch.logit(value.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN / 2))


def _scale_factor(delta: Tensor) -> Tensor:
    """A sigmoid between the bounds."""
    low, high = MIN_SCALE, MAX_SCALE
    center = math.log((1 - low) / (high - 1))
    steepness = (high - low) / ((1 - low) * (high - 1))
    return low + (high - low) * torch.sigmoid(steepness * delta + center)
