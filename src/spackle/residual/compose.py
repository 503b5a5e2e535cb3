"""Deltas applied to seeds: aux Gaussians, composed as SHARP composes its own."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn.functional import softplus

from spackle.camera import Camera
from spackle.color import srgb_to_linear
from spackle.gaussians import Gaussians
from spackle.residual.seeds import OPACITY, SPREAD_PX, Seeds
from spackle.surface import surface_gaussians

# Channels of a delta field: three of geometry, eleven of texture, as in SHARP.
XY, INVERSE_DEPTH, SCALE, QUAT, COLOR, ALPHA = (
    slice(0, 2), slice(2, 3), slice(3, 6), slice(6, 10), slice(10, 13), slice(13, 14),
)  # fmt: skip
GEOMETRY_CHANNELS = 3
TEXTURE_CHANNELS = 11
DELTA_CHANNELS = GEOMETRY_CHANNELS + TEXTURE_CHANNELS
COLOR_MARGIN = 1.0 / 512  # keeps the inverse sigmoid finite, below 8-bit resolution


@dataclasses.dataclass(frozen=True)
class DeltaGains:
    """How much a delta of one moves each attribute, at zero."""

    xy_px: float = 1.0
    inverse_depth: float = 0.1  # in units of the view's median inverse depth
    scale: float = 1.0
    quat: float = 0.1
    color: float = 1.0  # in the sigmoid's domain
    opacity: float = 1.0  # likewise
    min_scale: float = 0.25  # bounds of the scale factor, which is 1 at zero
    max_scale: float = 4.0


def compose(seeds: Seeds, deltas: Tensor | None, camera: Camera, gains: DeltaGains | None = None) -> Gaussians:
    """Aux Gaussians [n] of flat seeds; deltas of None or zero give the seeds themselves.

    Args:
        seeds: flat, as `Seeds.select` gives them: fields [n, ...].
        deltas: [n, 14], or None. Gradients flow through them.
        camera: the view that the seeds belong to.
        gains: weights of the deltas.
    """
    opacities = torch.full_like(seeds.inverse_depth, OPACITY)
    if deltas is None:
        return _lift(seeds.uv, seeds.inverse_depth, seeds, seeds.rgb, opacities, camera)
    gains = gains or DeltaGains()
    uv = seeds.uv + gains.xy_px * deltas[:, XY]
    inverse_depth = _shift_positive(
        seeds.inverse_depth, gains.inverse_depth * deltas[:, INVERSE_DEPTH].squeeze(1), seeds.unit
    )
    rgb = _shift_sigmoid(seeds.rgb, gains.color * deltas[:, COLOR])
    opacities = _shift_sigmoid(opacities, gains.opacity * deltas[:, ALPHA].squeeze(1))
    surfels = _lift(uv, inverse_depth, seeds, rgb, opacities, camera)
    return dataclasses.replace(
        surfels,
        quats=surfels.quats + gains.quat * deltas[:, QUAT],
        scales=surfels.scales * _scale_factor(gains.scale * deltas[:, SCALE], gains.min_scale, gains.max_scale),
    )


def _lift(uv: Tensor, inverse_depth: Tensor, seeds: Seeds, rgb: Tensor, opacities: Tensor, camera: Camera) -> Gaussians:
    return surface_gaussians(camera, uv, inverse_depth, seeds.slope, SPREAD_PX, srgb_to_linear(rgb), opacities)


def _shift_positive(base: Tensor, delta: Tensor, unit: float) -> Tensor:
    """softplus(softplus⁻¹(base) + delta), both in multiples of `unit`."""
    relative = (base / unit).clamp_min(1e-4)
    return unit * softplus(relative + torch.log(-torch.expm1(-relative)) + delta)


def _shift_sigmoid(base: Tensor, delta: Tensor) -> Tensor:
    """sigmoid(sigmoid⁻¹(base) + delta), the base kept off 0 and 1."""
    return torch.sigmoid(color_logit(base) + delta)


def color_logit(value: Tensor) -> Tensor:
    """sigmoid⁻¹ of colours or opacities, kept off 0 and 1."""
    return torch.logit(value.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN / 2))


def _scale_factor(delta: Tensor, low: float, high: float) -> Tensor:
    """A sigmoid between low and high that is 1, with slope 1, at zero."""
    center = math.log((1 - low) / (high - 1))
    steepness = (high - low) / ((1 - low) * (high - 1))
    return low + (high - low) * torch.sigmoid(steepness * delta + center)
