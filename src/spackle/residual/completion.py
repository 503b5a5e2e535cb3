"""Complete one view as in the paper: eqs. 2 to 7 (eq. 8 is `Gaussians.cat([base, aux])`, eq. 9 its rendering)."""

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
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual.features import CELL, MASK_THRESHOLD, ViewFeatures, hole_mask
from spackle.residual.initializer import InitialGaussians, initialize
from spackle.residual.network import DELTAS, ResidualNet, color_logit, find_rim, predict_deltas
from spackle.runtime.device import Precision

SPREAD_PX = 1.3  # standard deviation: Gaussians two pixels apart reach alpha 0.95 everywhere
# A delta of 1 changes the position by a pixel, and colour and opacity by 1 in the sigmoid's domain, but the quaternion
# by GAIN, and the inverse depth by GAIN times the view's median.
GAIN = 0.1
LEAST_DEPTH = 1e-4  # least inverse depth, as part of the view's median
MAX_SCALE = (
    4.0  # scale factors lie between 1 / MAX_SCALE and MAX_SCALE; for delta 0, value and slope are 1
)


@torch.no_grad()
def complete_view(
    base: Gaussians,
    camera: Camera,
    photo_camera: Camera,
    renderer: Renderer,
    network: ResidualNet | None,
    *,
    threshold: float = MASK_THRESHOLD,
    least: int = 0,
    rendering: Rendering | None = None,
    photo: Tensor | None = None,
    precision: Precision = "auto",
) -> Gaussians:
    """𝒢̃_aug of a view (eq. 7): one Gaussian for each masked cell.

    A cell is masked if its first pixel is masked. So about HAR times all cells are masked, as in the paper's tables.

    Args:
        base: 𝒢_base, N Gaussians in the world's frame.
        camera: the view v.
        photo_camera: the camera of the photo from which the base was predicted.
        renderer: ℛ.
        network: f_res, on any device; None: all deltas are 0.
        threshold: τ_α.
        least: if fewer cells are masked, this number of the least opaque cells is used (paper, training details: 64).
        rendering: ℛ(𝒢_base, v), if already available.
        photo: I as [H, W, 3] sRGB, for a network that `sees_photo`; None: the rendering of the base.
        precision: of the network; auto is bfloat16 if the hardware multiplies it natively.
    """
    view = renderer.render(base, camera) if rendering is None else rendering  # eqs. 2 and 3
    features = ViewFeatures.of(view, threshold)
    mask = hole_mask(view.alpha, threshold)[::CELL, ::CELL].cpu()  # eq. 4
    if int(mask.count_nonzero()) < least:
        mask = torch.zeros_like(mask)
        mask.view(-1)[features.alpha.flatten().argsort(stable=True)[:least]] = True
    if not bool(mask.any()):
        return Gaussians.empty(base.means.device)
    seeds, deltas = initialize(features, camera, photo_camera), None
    if network is not None:
        if network.sees_photo and photo is None:
            photo = renderer.render(base, photo_camera).rgb
        rim, _ = find_rim(features, seeds, camera, photo_camera, photo)
        deltas = predict_deltas(network, features, seeds, rim, precision)[mask]  # eq. 5
    return compose(seeds.select(mask), deltas, camera).to(base.means.device)  # eq. 7


def compose(
    seeds: InitialGaussians, deltas: Tensor | None, camera: Camera, spread_px: float = SPREAD_PX
) -> Gaussians:
    """Aux Gaussians [n] from seeds and deltas (SHARP's composition); gradients reach the deltas.

    Args:
        seeds: flat fields [n, ...], see `InitialGaussians.select`.
        deltas: [n, 14]; None: zero.
        camera: the view of the seeds.
        spread_px: standard deviation of a Gaussian in pixels.
    """
    uv, inverse_depth, rgb = seeds.uv, seeds.inverse_depth, seeds.rgb
    opacities = torch.full_like(inverse_depth, float(SURFEL_OPACITY))
    if deltas is None:
        colors = srgb_to_linear(rgb)
        return make_surfels(camera, uv, inverse_depth, seeds.slope, spread_px, colors, opacities)
    shift, nearer, scale, turn, color, opacity = torch.split(deltas, DELTAS, dim=1)
    inverse_depth = _shift_positive(inverse_depth, GAIN * nearer.squeeze(1), seeds.unit)
    colors = srgb_to_linear(torch.sigmoid(color_logit(rgb) + color))
    opacities = torch.sigmoid(color_logit(opacities) + opacity.squeeze(1))
    surfels = make_surfels(
        camera, uv + shift, inverse_depth, seeds.slope, spread_px, colors, opacities
    )
    scales, quats = surfels.scales * _scale_factor(scale), surfels.quats + GAIN * turn
    return dataclasses.replace(surfels, quats=quats, scales=scales)


def _shift_positive(base: Tensor, delta: Tensor, unit: float) -> Tensor:
    """softplus(softplus⁻¹(base) + delta), with base and result in multiples of `unit`."""
    relative = (base / unit).clamp_min(LEAST_DEPTH)
    return unit * softplus(relative + torch.log(-torch.expm1(-relative)) + delta).clamp_min(
        LEAST_DEPTH
    )


def _scale_factor(delta: Tensor) -> Tensor:
    low, high = 1 / MAX_SCALE, MAX_SCALE
    center = math.log((1 - low) / (high - 1))
    steepness = (high - low) / ((1 - low) * (high - 1))
    return low + (high - low) * torch.sigmoid(steepness * delta + center)
