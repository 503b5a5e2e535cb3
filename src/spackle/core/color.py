"""Convert between sRGB and linear RGB, and show depth as colours."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.runtime.kernels import kernel


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """Decode sRGB (IEC 61966-2-1) elementwise; values are clamped to 0..1 first."""
    srgb = srgb.clamp(0, 1)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: Tensor) -> Tensor:
    """Encode as sRGB (IEC 61966-2-1) elementwise; values are clamped to 0..1 first."""
    linear = linear.clamp(0, 1)
    # Without the clamp, the gradient of the unused branch would be infinite at zero.
    power = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, linear * 12.92, power)


MEASURED, LOOKS = 50_000, 60  # numbers of Gaussians and views that are sampled for the scale
FARTHEST, NEAREST = 0.002, 0.998  # quantiles of inverse depth at the ends of the scale
UNKNOWN_DEPTH_GREY = 0.5  # sRGB of unknown depth; the colour map contains no grey
# Seventeen evenly spaced colours of matplotlib's inferno (CC0).
INFERNO_COLORS = (
    *((0.001, 0.000, 0.014), (0.042, 0.028, 0.141), (0.129, 0.047, 0.291), (0.238, 0.037, 0.396)),
    *((0.342, 0.062, 0.429), (0.441, 0.099, 0.432), (0.541, 0.135, 0.415), (0.640, 0.171, 0.381)),
    *((0.736, 0.216, 0.330), (0.817, 0.271, 0.270), (0.890, 0.348, 0.198), (0.944, 0.443, 0.120)),
    *((0.977, 0.551, 0.039), (0.988, 0.668, 0.058), (0.976, 0.790, 0.196), (0.949, 0.910, 0.395)),
    (0.988, 0.998, 0.645),
)


@dataclasses.dataclass(frozen=True)
class DepthColorScale:
    """A scale of colours between two depths; a depth outside of the scale gets the colour of the closest end."""

    near: float  # depth of the brightest colour
    far: float  # depth of the darkest colour

    @staticmethod
    def over(gaussians: Gaussians, cameras: Sequence[Camera]) -> DepthColorScale:
        """The scale for the depths in a set of views, without the nearest and the farthest 0.2 %.

        Raises:
            ValueError: no Gaussian is in a view.
        """
        step = max(1, len(gaussians) // MEASURED)
        means = gaussians.means.detach()[::step].cpu()
        looks = cameras[:: max(1, len(cameras) // LOOKS)]
        inverse = torch.cat([_inverse_in_frame(means, camera) for camera in looks]).double()
        if len(inverse) == 0:
            raise ValueError("no Gaussian is in view")
        low, high = torch.quantile(
            inverse, torch.tensor([FARTHEST, NEAREST], dtype=torch.float64)
        ).tolist()
        return DepthColorScale(1 / high, 1 / low)

    def __call__(self, depth: Tensor, known: Tensor) -> Tensor:
        """Depth [H, W] as sRGB [H, W, 3], linear in inverse depth; grey where `known` [H, W] is false."""
        span = max(1 / self.near - 1 / self.far, 1e-12)
        share = ((1 / depth.clamp_min(1e-6) - 1 / self.far) / span).clamp(0, 1)
        table = depth.new_tensor(INFERNO_COLORS)
        place = share * (len(INFERNO_COLORS) - 1)
        below = place.floor().clamp_max(len(INFERNO_COLORS) - 2)
        colors = torch.lerp(
            table[below.long()], table[below.long() + 1], (place - below)[..., None]
        )
        return colors.where(known[..., None], colors.new_tensor(UNKNOWN_DEPTH_GREY))


def _inverse_in_frame(means: Tensor, camera: Camera) -> Tensor:
    uv, z = camera.to("cpu").project(means)
    inside = (
        (z > 0.01)
        & (uv >= 0).all(dim=-1)
        & (uv < uv.new_tensor([camera.width, camera.height])).all(dim=-1)
    )
    return 1 / z[inside]


def to_uint8(image: Tensor) -> Tensor:
    """Round values in 0..1 to uint8 on the CPU; values outside are clamped, NaN becomes 0, and uint8 is kept."""
    if image.dtype == torch.uint8:
        return image.detach().cpu()
    values = image.detach().float().contiguous()
    if values.device.type != "cpu":
        return values.mul(255).nan_to_num_(0.0).clamp_(0, 255).round_().to("cpu", torch.uint8)
    result = torch.empty(values.shape, dtype=torch.uint8)
    _round(values.numpy().reshape(-1), result.numpy().reshape(-1))
    return result


@kernel
def _round(values: Any, result: Any) -> None:
    """Write 255 times the values, rounded, in one pass; both arrays are flat."""
    for i in range(len(values)):
        scaled = values[i] * np.float32(255)
        scaled = (
            min(scaled, np.float32(255)) if scaled > 0 else np.float32(0)
        )  # a comparison with NaN is false
        result[i] = np.uint8(np.rint(scaled))
