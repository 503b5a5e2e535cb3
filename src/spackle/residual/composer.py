"""Compose aux Gaussians from initial Gaussians and the network's deltas (paper, eqs. 5 and 7), as
SHARP does.

An aux Gaussian fills a hole. It starts as an initial Gaussian, a guess for a cell of 2×2 pixels;
the network changes the guess by 14 numbers, its deltas.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn.functional import softplus

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import SURFEL_OPACITY, make_surfels
from spackle.residual.initializer import InitialGaussians

# The channels of the deltas, in SHARP's order. SHARP predicts the first two groups (geometry) and
# the others (texture) by two heads.
GEOMETRY_DELTAS = {"pixel": 2, "inverse depth": 1}
TEXTURE_DELTAS = {"scale": 3, "quaternion": 4, "color": 3, "opacity": 1}
GEOMETRY_CHANNELS = sum(GEOMETRY_DELTAS.values())
TEXTURE_CHANNELS = sum(TEXTURE_DELTAS.values())
DELTA_CHANNELS = GEOMETRY_CHANNELS + TEXTURE_CHANNELS
DELTA_SIZES = [*GEOMETRY_DELTAS.values(), *TEXTURE_DELTAS.values()]
COLOR_DELTAS = slice(10, 13)  # the channels of the colour among the 14

# A delta of 1 moves a Gaussian by one pixel, and changes colour and opacity by 1 in the sigmoid's
# domain; but it turns the quaternion by only SMALL_STEP, and changes the inverse depth by
# SMALL_STEP times the view's median.
SMALL_STEP = 0.1
SPREAD_PX = 1.3  # standard deviation: Gaussians two pixels apart reach alpha 0.95 everywhere
MIN_RELATIVE_INVERSE_DEPTH = 1e-4  # least inverse depth, as a fraction of the view's median
MAX_SCALE_FACTOR = 4.0  # deltas change a scale by factors between 1/4 and 4
COLOR_MARGIN = 1.0 / 512  # keeps the inverse sigmoid finite; less than one step of 8-bit colour


def compose(
    initial: InitialGaussians, deltas: Tensor | None, camera: Camera, spread_px: float = SPREAD_PX
) -> Gaussians:
    """Gaussians [n] that fill holes, composed of n initial Gaussians and their deltas.

    An initial Gaussian is the first guess for a cell of 2×2 pixels; the deltas are changes that a
    network predicts. As in SHARP, position, inverse depth, scale, rotation, colour and opacity each
    change in a domain in which every number is valid. Gradients reach the deltas.

    Args:
        initial: the first guess, with flat fields [n, ...].
        deltas: [n, 14] changes that the network predicts; None: zero.
        camera: the view for which the Gaussians are made.
        spread_px: standard deviation of an initial Gaussian in pixels of the view.
    """
    initial_opacities = torch.full_like(initial.inverse_depth, float(SURFEL_OPACITY))
    if deltas is None:
        return make_surfels(
            camera,
            initial.uv,
            initial.inverse_depth,
            initial.slope,
            spread_px,
            srgb_to_linear(initial.rgb),
            initial_opacities,
        )

    # 14 channels: pixel 2, inverse depth 1, scale 3, quaternion 4, colour 3, opacity 1.
    shift_px, depth_delta, scale_delta, quat_delta, color_delta, opacity_delta = torch.split(
        deltas, DELTA_SIZES, dim=1
    )

    # Deltas are of order one. Inverse depth and rotation should change less, so theirs are reduced.
    inverse_depth = _add_to_positive(
        initial.inverse_depth, SMALL_STEP * depth_delta.squeeze(1), initial.unit
    )

    # Colours and opacities change in the sigmoid's domain, so that they stay within 0..1.
    colors = srgb_to_linear(torch.sigmoid(color_logit(initial.rgb) + color_delta))
    opacities = torch.sigmoid(color_logit(initial_opacities) + opacity_delta.squeeze(1))
    surfels = make_surfels(
        camera,
        initial.uv + shift_px,
        inverse_depth,
        initial.slope,
        spread_px,
        colors,
        opacities,
    )

    # A surfel is flat and lies in the surface; the network may turn it and change its size.
    return dataclasses.replace(
        surfels,
        quats=surfels.quats + SMALL_STEP * quat_delta,
        scales=surfels.scales * _scale_factor(scale_delta),
    )


def color_logit(value: Tensor) -> Tensor:
    """sigmoid⁻¹ of colours or opacities in 0..1, which are first moved a little away from 0 and
    1.
    """
    return torch.logit(value.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN / 2))


def _add_to_positive(value: Tensor, delta: Tensor, unit: float) -> Tensor:
    """Add `delta` to positive numbers in such a way that they stay positive.

    The result is unit · softplus(softplus⁻¹(value / unit) + delta). Large values change by
    delta · unit, small values by a factor exp(delta).
    """
    relative = (value / unit).clamp_min(MIN_RELATIVE_INVERSE_DEPTH)

    # softplus⁻¹(x) = log(exp(x) − 1) = x + log(1 − exp(−x)); the second form does not overflow.
    inverse_softplus = relative + torch.log(-torch.expm1(-relative))
    changed = softplus(inverse_softplus + delta)
    return unit * changed.clamp_min(MIN_RELATIVE_INVERSE_DEPTH)


def _scale_factor(delta: Tensor) -> Tensor:
    """low + (high − low) · sigmoid(a · delta + b): factors between low = 1/4 and high = 4.

    a and b are chosen so that a delta of 0 gives the factor 1, with slope 1.
    """
    low = 1 / MAX_SCALE_FACTOR
    high = MAX_SCALE_FACTOR
    b = math.log((1 - low) / (high - 1))
    a = (high - low) / ((1 - low) * (high - 1))
    return low + (high - low) * torch.sigmoid(a * delta + b)
