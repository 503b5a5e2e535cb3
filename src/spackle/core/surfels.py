"""Gaussians that lie in a surface given as an image of inverse depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from spackle.core.camera import Camera, to_like
from spackle.core.gaussians import Gaussians, quat_from_matrix
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

DEPTH_EDGE_RATIO = 0.03  # a larger relative difference of inverse depth between neighbouring pixels is a depth edge
CREASE_RATIO = (
    0.01  # a larger relative difference between the slopes on both sides of a pixel is a crease
)
SURFEL_THICKNESS_RATIO = 0.05  # third axis, in units of the smaller of the other two
# Opacity of a solid Gaussian. The renderer skips a Gaussian that would bring the transmittance below 1e-4, so a
# Gaussian of opacity 0.999 behind another of alpha 0.9 would be skipped and leave a hole.
SURFEL_OPACITY = np.float32(0.99)
PIXEL_SIGMA_PX = (
    0.5  # standard deviation, in pixels, of a Gaussian for one pixel in front of a wider Gaussian
)
BEHIND_SURFACE_RATIO = 0.005  # relative distance behind a surface at which a Gaussian does not show through the surface


def make_surfels(
    camera: Camera,
    uv: Tensor,
    inverse_depth: Tensor,
    slope: Tensor,
    spread: Tensor | float,
    colors: Tensor,
    opacities: Tensor,
) -> Gaussians:
    """Make a flat Gaussian in the tangent plane of each sample of a surface.

    Args:
        camera: the view in which the samples are given.
        uv: [N, 2] pixel positions.
        inverse_depth: [N] 1/z.
        slope: [N, 2] derivative of the inverse depth by pixel x and y.
        spread: standard deviation in pixels of `camera`, as [N], as [N, 2] along pixel x and y, or as one number.
        colors: [N, 3] linear RGB.
        opacities: [N].
    """
    (fx, fy), K = camera.focal, to_like(camera.K, uv)
    z = 1.0 / inverse_depth
    ray = torch.cat([(uv - K[:2, 2]) / K.diagonal()[:2], torch.ones_like(uv[:, :1])], dim=-1)
    # P = z·ray, so dP/du = z·d(ray)/du + dz/du·ray with dz/du = −z²·d(1/z)/du.
    dz = -(z**2)[:, None] * slope
    across = dz[:, :1] * ray + pad(z[:, None] * (1 / fx), (0, 2))
    down = dz[:, 1:] * ray + pad(z[:, None] * (1 / fy), (1, 1))
    widths = (
        spread.to(uv)[..., None].flatten(1)
        if isinstance(spread, Tensor)
        else uv.new_full((1, 1), spread)
    )
    rotation, scales = _principal_axes(across * widths[:, :1], down * widths[:, -1:])
    scales = torch.cat([scales, SURFEL_THICKNESS_RATIO * scales.amin(dim=-1, keepdim=True)], dim=-1)
    local_to_world = to_like(camera.world_to_camera, uv)[:3, :3].T
    means = camera.unproject(uv, z)
    return Gaussians(means, quat_from_matrix(local_to_world @ rotation), scales, opacities, colors)


def _principal_axes(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Axes and normals of the ellipses a·cos t + b·sin t, as columns [N, 3, 3], and the lengths of the axes [N, 2]."""
    theta = 0.5 * torch.atan2(2 * (a * b).sum(-1), (a * a).sum(-1) - (b * b).sum(-1))[:, None]
    p = a * theta.cos() + b * theta.sin()
    q = b * theta.cos() - a * theta.sin()
    lengths = torch.stack([p.norm(dim=-1), q.norm(dim=-1)], dim=-1).clamp_min(1e-12)
    p, q = p / lengths[:, :1], q / lengths[:, 1:]
    return torch.stack([p, q, torch.linalg.cross(p, q)], dim=-1), lengths


def inverse_depth_slope(inverse_depth: Tensor) -> Tensor:
    """Derivative of the inverse depth by pixel x and y, [H, W, 2], that never crosses a depth edge.

    The inverse depth of a plane changes linearly across the image, so the differences to both neighbours agree. If
    they differ, the smaller one is used; if even the smaller one is large, the slope is 0.

    Args:
        inverse_depth: [H, W] float32 or float64, positive everywhere; gradients do not pass.
    """
    image = inverse_depth.detach().cpu().contiguous().numpy()
    slopes = np.empty((*image.shape, 2), image.dtype)
    bounds = tuple(image.dtype.type(bound) for bound in (CREASE_RATIO, DEPTH_EDGE_RATIO))
    parallel_for_chunks(
        lambda start, stop: _slopes(start, stop, image, *bounds, slopes), len(image)
    )
    return torch.from_numpy(slopes).to(inverse_depth.device)


@kernel
def _slopes(start: int, stop: int, image: Any, crease: Any, edge: Any, slopes: Any) -> None:
    height, width = image.shape
    for y in range(start, stop):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            here, left, right = image[y, x], max(x - 1, 0), min(x + 1, width - 1)
            # At a border, one difference serves for both sides.
            ahead, behind = image[y, right] - here, here - image[y, left]
            forward, backward = ahead if right > x else behind, behind if left < x else ahead
            slopes[y, x, 0] = _slope(here, backward, forward, crease, edge)
            ahead, behind = image[below, x] - here, here - image[above, x]
            forward, backward = ahead if below > y else behind, behind if above < y else ahead
            slopes[y, x, 1] = _slope(here, backward, forward, crease, edge)


@kernel
def _slope(here: Any, backward: Any, forward: Any, crease: Any, edge: Any) -> Any:
    smooth = abs(forward - backward) <= crease * here
    flatter = backward if abs(backward) < abs(forward) else forward
    slope = (forward + backward) / 2 if smooth else flatter
    return slope if abs(slope) <= (edge if smooth else crease) * here else 0 * here
