"""A slow renderer in plain PyTorch, of any dtype, with which tests compare the fast renderers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.render.protocol import (
    ALPHA_MAX,
    ALPHA_MIN,
    NEAR_PLANE,
    TRANSMITTANCE_STOP,
    Rendering,
    paste,
)


class ReferenceRenderer:
    """A `Renderer` for small scenes: each pixel evaluates each Gaussian."""

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        """See `Renderer.render`; the result has the dtype of the input."""
        joined = (
            gaussians
            if isinstance(gaussians, Gaussians)
            else Gaussians.cat([Gaussians.empty(), *gaussians])
        )
        visible = front_to_back(joined, camera)
        rendering = blend(visible, camera, eps2d)
        return rendering if tiles is None else paste(rendering, tiles, onto)


def front_to_back(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The finite Gaussians at or beyond the near plane, sorted by depth."""
    finite = [t.detach().isfinite().unsqueeze(-1).flatten(1).all(dim=1) for t in gaussians.tensors]
    z = camera.to_camera(gaussians.means.detach())[:, 2]
    gaussians = gaussians.select(torch.stack(finite).all(dim=0) & (z >= NEAR_PLANE))
    return gaussians.select(
        torch.argsort(camera.to_camera(gaussians.means.detach())[:, 2], stable=True)
    )


def blend(gaussians: Gaussians, camera: Camera, eps2d: float) -> Rendering:
    """Blend Gaussians, sorted front to back, at every pixel."""
    alphas = falloff(gaussians, camera, eps2d)
    alphas = torch.where(alphas > ALPHA_MAX, ALPHA_MAX, alphas)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0)
    after = torch.cumprod(1 - alphas, dim=0)  # [N, H, W] transmittance after each Gaussian
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]]) if len(after) else after
    weights = torch.where(after > TRANSMITTANCE_STOP, alphas * before, 0)
    z = camera.to_camera(gaussians.means)[:, 2]
    alpha = weights.sum(dim=0)
    color = torch.einsum("nhw,nc->hwc", weights, gaussians.colors)
    depth = torch.einsum("nhw,n->hw", weights, z) / torch.where(alpha > 0, alpha, 1)
    return Rendering(linear_to_srgb(color), depth, alpha)


def project_covariances(gaussians: Gaussians, camera: Camera, eps2d: float) -> Tensor:
    """Image-space covariances J W Σ Wᵀ Jᵀ + eps2d·I, [N, 2, 2].

    J is the projection's Jacobian at the centre. As in gsplat, a centre far outside of the image is first moved to the
    border of a frame of 1.3 times the image's size.
    """
    x, y, z = camera.to_camera(gaussians.means).unbind(-1)
    (fx, fy), K = camera.focal, camera.K.to(x)
    slack_x, slack_y = 0.3 * 0.5 * camera.width / fx, 0.3 * 0.5 * camera.height / fy
    tx = (x / z).clamp(-K[0, 2] / fx - slack_x, (camera.width - K[0, 2]) / fx + slack_x)
    ty = (y / z).clamp(-K[1, 2] / fy - slack_y, (camera.height - K[1, 2]) / fy + slack_y)
    zero = torch.zeros_like(z)
    rows = [
        torch.stack([fx / z, zero, -fx * tx / z], -1),
        torch.stack([zero, fy / z, -fy * ty / z], -1),
    ]
    jacobian = torch.stack(rows, dim=-2)  # [N, 2, 3]
    axes = quat_to_matrix(gaussians.quats) * gaussians.scales[:, None, :]  # R S, [N, 3, 3]
    factor = jacobian @ camera.world_to_camera[:3, :3].to(x) @ axes
    return factor @ factor.transpose(1, 2) + eps2d * torch.eye(2).to(x)


def falloff(gaussians: Gaussians, camera: Camera, eps2d: float) -> Tensor:
    """Unclamped alpha of each Gaussian at each pixel, [N, H, W]."""
    uv, _ = camera.project(gaussians.means)  # [N, 2]
    covariances = project_covariances(gaussians, camera, eps2d)[
        :, :, :, None, None
    ]  # [N, 2, 2, 1, 1]
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    det = xx * yy - xy * xy
    proper = det > 0  # a Gaussian without extent is invisible
    dx, dy = (camera.pixel_centers().to(uv) - uv[:, None, None, :]).unbind(-1)  # [N, H, W]
    distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / torch.where(proper, det, 1)
    return torch.where(proper, gaussians.opacities[:, None, None] * torch.exp(-0.5 * distance), 0)
