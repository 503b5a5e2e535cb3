"""Surfels: flat Gaussians that lie in a surface, which an image of inverse depth describes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from spackle.core.camera import Camera, to_like
from spackle.core.gaussians import Gaussians, quat_from_matrix
from spackle.runtime.kernels import kernel
from spackle.runtime.parallel_kernels import kernel_for_pixels

# Relative difference of inverse depth between neighbouring pixels above which there is an edge
# between two surfaces.
DEPTH_EDGE_RATIO = 0.03
# Difference of the slopes on both sides of a pixel, relative to the inverse depth, above which one
# surface has a crease.
CREASE_RATIO = 0.01
SURFEL_THICKNESS_RATIO = 0.05  # third axis of a surfel, in units of the smaller of the other two
# Opacity of a solid Gaussian. The renderer skips a Gaussian that would bring the transmittance
# below 1e-4, so one of opacity 0.999 behind another of alpha 0.9 would be skipped and leave a hole.
SURFEL_OPACITY = np.float32(0.99)
# Standard deviation, in pixels, of a Gaussian for one pixel in front of a wider Gaussian.
PIXEL_SIGMA_PX = 0.5
# Relative distance behind a surface at which a Gaussian does not show through the surface.
BEHIND_SURFACE_RATIO = 0.005


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
        spread: standard deviation in pixels of `camera`, as [N], as [N, 2] along pixel x and y, or
            as one number.
        colors: [N, 3] linear RGB.
        opacities: [N].
    """
    # A ray has the depth 1, so a sample's position is its depth times its ray.
    fx, fy = camera.focal
    K = to_like(camera.K, uv)
    principal_point = K[:2, 2]
    focal = K.diagonal()[:2]
    z = 1.0 / inverse_depth
    ray_xy = (uv - principal_point) / focal
    ray = torch.cat([ray_xy, torch.ones_like(uv[:, :1])], dim=-1)  # [N, 3] at depth 1

    # How far the point P = z·ray on the surface moves if the pixel moves by one:
    # dP/du = dz/du·ray + z·d(ray)/du, with dz/du = −z²·d(1/z)/du and d(ray)/du = (1/fx, 0, 0).
    dz = -(z**2)[:, None] * slope  # [N, 2] by pixel x and y
    sideways = pad(z[:, None] * (1 / fx), (0, 2))  # [N, 3]: (z/fx, 0, 0)
    downwards = pad(z[:, None] * (1 / fy), (1, 1))  # [N, 3]: (0, z/fy, 0)
    move_along_x = dz[:, :1] * ray + sideways  # [N, 3]
    move_along_y = dz[:, 1:] * ray + downwards  # [N, 3]

    # A circle of `spread` pixels in the image is an ellipse on the surface, which is the Gaussian.
    if isinstance(spread, Tensor):
        spreads = spread.to(uv)
        if spreads.ndim == 1:
            spreads = spreads[:, None]  # [N, 1]: the same along x and y
    else:
        spreads = uv.new_full((1, 1), spread)
    # The first column is for x, the last one for y. With a single column, both are the same.
    spread_x = spreads[:, :1]
    spread_y = spreads[:, -1:]
    rotation, scales = _ellipse_axes(move_along_x * spread_x, move_along_y * spread_y)
    thickness = SURFEL_THICKNESS_RATIO * scales.amin(dim=-1, keepdim=True)
    scales = torch.cat([scales, thickness], dim=-1)  # [N, 3]

    camera_to_world = to_like(camera.world_to_camera, uv)[:3, :3].T
    quats = quat_from_matrix(camera_to_world @ rotation)
    return Gaussians(camera.unproject(uv, z), quats, scales, opacities, colors)


def _ellipse_axes(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Axes of N ellipses in space, whose points are a·cos t + b·sin t from their centres.

    Args:
        a: [N, 3] the vector from the centre to the point of t = 0.
        b: [N, 3] the vector from the centre to the point of t = 90°.

    Returns:
        Rotations [N, 3, 3], whose columns are the directions of both axes and the normal, and the
        lengths [N, 2] of both half axes.
    """
    # At an axis, the distance from the centre is greatest or smallest, so its derivative by t is 0:
    # tan 2t = 2 a·b / (a·a − b·b).
    dot_ab = (a * b).sum(-1)
    length2_difference = (a * a).sum(-1) - (b * b).sum(-1)
    t = 0.5 * torch.atan2(2 * dot_ab, length2_difference)[:, None]  # [N, 1]
    first_axis = a * t.cos() + b * t.sin()
    second_axis = b * t.cos() - a * t.sin()
    lengths = torch.stack([first_axis.norm(dim=-1), second_axis.norm(dim=-1)], dim=-1)
    lengths = lengths.clamp_min(1e-12)  # no division by zero
    first_axis = first_axis / lengths[:, :1]
    second_axis = second_axis / lengths[:, 1:]
    normal = torch.linalg.cross(first_axis, second_axis)
    return torch.stack([first_axis, second_axis, normal], dim=-1), lengths


def inverse_depth_slope(inverse_depth: Tensor) -> Tensor:
    """Derivative of the inverse depth by pixel x and y, [H, W, 2], never across a depth edge.

    The inverse depth of a plane changes linearly across the image. So on a smooth surface the
    differences to the two neighbours along an axis agree, and the slope is their mean. If they do
    not agree, the smaller one is used, because the larger one may cross to another surface. If even
    the smaller one is large, the slope is 0.

    Args:
        inverse_depth: [H, W] float32 or float64, positive everywhere. The result is detached from
            autograd.
    """
    image = inverse_depth.detach().contiguous()
    slopes = image.new_empty(*image.shape, 2)
    # Limits of the image's dtype, because others would make the kernel compute in float64.
    number = np.float32 if image.dtype == torch.float32 else np.float64
    _write_slopes(image.shape, image, number(CREASE_RATIO), number(DEPTH_EDGE_RATIO), slopes)
    return slopes


@kernel_for_pixels
def _write_slopes(
    y: int, x: int, image: Any, crease_ratio: Any, edge_ratio: Any, slopes: Any
) -> None:
    """Write the slopes along x and y of one pixel of an image.

    Args:
        y, x: the pixel.
        image: [H, W] inverse depth.
        crease_ratio: if the differences to the previous and to the next pixel differ by more than
            this multiple of the inverse depth, the surface has a crease there.
        edge_ratio: if neighbouring pixels differ by more than this multiple of the inverse depth,
            there is an edge between two surfaces.
        slopes: output [H, W, 2].
    """
    height, width = image.shape
    above, below = max(y - 1, 0), min(y + 1, height - 1)
    left, right = max(x - 1, 0), min(x + 1, width - 1)
    here = image[y, x]

    # At the image's border, a pixel has one neighbour along an axis, and the difference to it
    # serves for both sides.
    to_right, to_left = image[y, right] - here, here - image[y, left]
    forward = to_right if right > x else to_left
    backward = to_left if left < x else to_right
    slopes[y, x, 0] = _slope(here, backward, forward, crease_ratio, edge_ratio)

    to_below, to_above = image[below, x] - here, here - image[above, x]
    forward = to_below if below > y else to_above
    backward = to_above if above < y else to_below
    slopes[y, x, 1] = _slope(here, backward, forward, crease_ratio, edge_ratio)


@kernel
def _slope(here: Any, backward: Any, forward: Any, crease_ratio: Any, edge_ratio: Any) -> Any:
    """The slope of inverse depth at a pixel along one axis, from the differences on its two sides.

    Args:
        here: inverse depth at the pixel.
        backward: the pixel's value minus the previous one.
        forward: the next value minus the pixel's.
        crease_ratio: the surface is smooth if `backward` and `forward` differ by at most this
            multiple of `here`; else it has a crease or an edge.
        edge_ratio: largest slope of a smooth surface, as a multiple of `here`.

    Returns:
        The mean on a smooth surface; at a crease or beside an edge the flatter difference, because
        the steeper one may cross to another surface; 0 if that is still too steep.
    """
    is_smooth = abs(forward - backward) <= crease_ratio * here
    flatter = backward if abs(backward) < abs(forward) else forward
    slope = (forward + backward) / 2 if is_smooth else flatter
    # Beside an edge even the flatter difference may cross it, so less is allowed there.
    max_slope = (edge_ratio if is_smooth else crease_ratio) * here
    return slope if abs(slope) <= max_slope else 0 * here  # a zero of the type of `here`
