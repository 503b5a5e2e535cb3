"""Convert between sRGB and linear RGB, show depth as colours, and round colours to bytes."""

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

# sRGB (IEC 61966-2-1): a line below the knee, a power above it.
LINEAR_KNEE = 0.0031308
SRGB_KNEE = 0.04045
SRGB_SLOPE = 12.92
SRGB_OFFSET = 0.055
SRGB_EXPONENT = 2.4


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """Decode sRGB elementwise; values are clamped to 0..1 first."""
    return _decode_positive(srgb.clamp(0, 1))


def linear_to_srgb(linear: Tensor) -> Tensor:
    """Encode linear RGB as sRGB elementwise; values are clamped to 0..1 first."""
    return _encode_positive(linear.clamp(0, 1))


def extended_srgb_to_linear(srgb: Tensor) -> Tensor:
    """Decode sRGB elementwise, also outside of 0..1; odd around 0."""
    sign = torch.ones_like(srgb).copysign(srgb.detach())
    return sign * _decode_positive(sign * srgb)


def extended_linear_to_srgb(linear: Tensor) -> Tensor:
    """Encode linear RGB as sRGB elementwise, also outside of 0..1; odd around 0."""
    sign = torch.ones_like(linear).copysign(linear.detach())
    return sign * _encode_positive(sign * linear)


def _decode_positive(srgb: Tensor) -> Tensor:
    """Decode sRGB elementwise, of values that are at least 0."""
    power = ((srgb + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** SRGB_EXPONENT
    return torch.where(srgb <= SRGB_KNEE, srgb / SRGB_SLOPE, power)


def _encode_positive(linear: Tensor) -> Tensor:
    """Encode linear RGB as sRGB elementwise, of values that are at least 0."""
    # Without the clamp, the gradient of the unused branch would be infinite at zero.
    root = linear.clamp_min(LINEAR_KNEE) ** (1 / SRGB_EXPONENT)
    power = (1 + SRGB_OFFSET) * root - SRGB_OFFSET
    return torch.where(linear <= LINEAR_KNEE, linear * SRGB_SLOPE, power)


# The scale of depth is measured on a sample of the Gaussians and views, which is accurate enough.
MAX_SAMPLED_GAUSSIANS = 50_000
MAX_SAMPLED_VIEWS = 60
# Quantiles of inverse depth at the ends of the scale; beyond are a few stray Gaussians.
FAR_QUANTILE = 0.002
NEAR_QUANTILE = 0.998
MIN_RELATIVE_DEPTH_IN_VIEW = 1e-3  # of the median depth; a nearer Gaussian is in the lens

UNKNOWN_DEPTH_GREY = 0.5  # sRGB of unknown depth; the colour map contains no grey
# Seventeen evenly spaced colours of matplotlib's inferno (CC0), as sRGB, dark to bright.
INFERNO_COLORS = (
    *((0.001, 0.000, 0.014), (0.042, 0.028, 0.141), (0.129, 0.047, 0.291), (0.238, 0.037, 0.396)),
    *((0.342, 0.062, 0.429), (0.441, 0.099, 0.432), (0.541, 0.135, 0.415), (0.640, 0.171, 0.381)),
    *((0.736, 0.216, 0.330), (0.817, 0.271, 0.270), (0.890, 0.348, 0.198), (0.944, 0.443, 0.120)),
    *((0.977, 0.551, 0.039), (0.988, 0.668, 0.058), (0.976, 0.790, 0.196), (0.949, 0.910, 0.395)),
    (0.988, 0.998, 0.645),
)


@dataclasses.dataclass(frozen=True)
class DepthColorScale:
    """A scale of colours between two depths; beyond its ends, the colour stays the same."""

    near: float  # depth of the brightest colour
    far: float  # depth of the darkest colour

    @staticmethod
    def over(gaussians: Gaussians, cameras: Sequence[Camera]) -> DepthColorScale:
        """The scale for the depths in a set of views, without the nearest and the farthest 0.2 %.

        All frames of a video share one scale, because a scale of each frame's own would flicker.

        Raises:
            ValueError: no Gaussian is in a view.
        """
        # Every n-th Gaussian in every m-th view is accurate enough, and fast.
        gaussian_step = max(1, len(gaussians) // MAX_SAMPLED_GAUSSIANS)
        view_step = max(1, len(cameras) // MAX_SAMPLED_VIEWS)
        means = gaussians.means.detach()[::gaussian_step].cpu()
        inverse_depths = torch.cat(
            [_inverse_depths_in_view(means, camera) for camera in cameras[::view_step]]
        ).double()
        if len(inverse_depths) == 0:
            raise ValueError("no Gaussian is in view")
        # The smallest inverse depths are the farthest, so the far end is the low quantile.
        quantiles = torch.tensor([FAR_QUANTILE, NEAR_QUANTILE], dtype=torch.float64)
        far_inverse, near_inverse = torch.quantile(inverse_depths, quantiles).tolist()
        return DepthColorScale(near=1 / near_inverse, far=1 / far_inverse)

    def __call__(self, depth: Tensor, known: Tensor) -> Tensor:
        """Depth [H, W] as sRGB [H, W, 3], linear in inverse depth; grey where `known` is false.

        Args:
            depth: [H, W] in the unit of the scale.
            known: [H, W] bool.
        """
        # 0 at the far end of the scale, 1 at its near end. A scale of one single depth has no span,
        # and gets a tiny one, so that nothing is divided by zero.
        span = 1 / self.near - 1 / self.far
        span = max(span, 1e-12 / self.near)
        # What is nearer than the scale begins is as bright as its beginning. The clamp also avoids
        # a division by zero where the depth is unknown.
        brightness = ((1 / depth.clamp_min(self.near) - 1 / self.far) / span).clamp(0, 1)

        # Interpolate between the two closest colours of the table.
        table = depth.new_tensor(INFERNO_COLORS)
        last = len(INFERNO_COLORS) - 1
        position = brightness * last
        lower_index = position.floor().clamp_max(last - 1)  # there must be a colour above it
        lower_color = table[lower_index.long()]
        upper_color = table[lower_index.long() + 1]
        colors = torch.lerp(lower_color, upper_color, (position - lower_index)[..., None])
        return colors.where(known[..., None], colors.new_tensor(UNKNOWN_DEPTH_GREY))


def _inverse_depths_in_view(means: Tensor, camera: Camera) -> Tensor:
    """1/z of those of the points [N, 3] that are in front of the camera and inside its image."""
    uv, z = camera.to("cpu").project(means)
    is_in_view = camera.has_in_frame(uv, z)
    if not bool(is_in_view.any()):
        return z[is_in_view]
    # A much nearer Gaussian than the others is in the lens.
    nearest = MIN_RELATIVE_DEPTH_IN_VIEW * z[is_in_view].median()
    return 1 / z[is_in_view & (z > nearest)]


def to_uint8(image: Tensor) -> Tensor:
    """Round values in 0..1 to uint8, 0..255, on the CPU.

    Values outside are clamped, NaN becomes 0. An image of uint8 is returned as it is.
    """
    if image.dtype == torch.uint8:
        return image.detach().cpu()
    values = image.detach().float().contiguous()
    if values.device.type != "cpu":
        return values.mul(255).nan_to_num_(0.0).clamp_(0, 255).round_().to("cpu", torch.uint8)
    # On the CPU, one pass over the memory instead of five.
    result = torch.empty(values.shape, dtype=torch.uint8)
    _round_to_bytes(values.numpy().reshape(-1), result.numpy().reshape(-1))
    return result


@kernel
def _round_to_bytes(values: Any, result: Any) -> None:
    """Write 255 times the float32 values, rounded and clamped, to the uint8 `result`; both flat."""
    for i in range(len(values)):
        scaled = values[i] * np.float32(255)
        # No comparison with NaN is true, so NaN becomes 0.
        scaled = min(scaled, np.float32(255)) if scaled > 0 else np.float32(0)
        result[i] = np.uint8(np.rint(scaled))
