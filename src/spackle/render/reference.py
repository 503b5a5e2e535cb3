"""A slow renderer in plain PyTorch: the formulas, with which tests compare the fast renderers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.core.view_colors import view_colors
from spackle.render.protocol import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_STOP,
    Renderer,
    Rendering,
    near_plane,
    paste,
)

BORDER_SLACK = 0.3  # as in gsplat: a centre this many half image sizes outside is moved no further


class ReferenceRenderer(Renderer):
    """A renderer for small scenes on the CPU: each pixel evaluates each Gaussian."""

    device = torch.device("cpu")

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        previous_rendering: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them, in the dtype of the Gaussians.

        Args:
            gaussians: one set, or several sets that are drawn together as if they were one.
            camera: the view.
            eps2d: added to the diagonal of each projected covariance, in pixels².
            tiles: [ceil(H/16), ceil(W/16)] bool: the tiles of 16×16 pixels to draw; None: all.
            previous_rendering: where all other tiles are copied from; None: they are black.
        """
        if isinstance(gaussians, Gaussians):
            joined = gaussians
        else:
            # The empty set makes a list without sets valid, too.
            joined = Gaussians.cat([Gaussians.empty(), *gaussians])

        rendering = blend(front_to_back(joined, camera), camera, eps2d)
        if tiles is None:
            return rendering
        return paste(rendering, tiles, previous_rendering)


def front_to_back(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The finite Gaussians at or beyond the near plane, sorted by their depth z."""
    z = camera.to_camera(gaussians.means.detach())[:, 2]
    drawable = gaussians.select(gaussians.finite_rows & (z >= near_plane([gaussians], camera)))

    # Stable: Gaussians of equal depth keep their order, as in the fast renderers.
    z = camera.to_camera(drawable.means.detach())[:, 2]
    return drawable.select(torch.argsort(z, stable=True))


def blend(gaussians: Gaussians, camera: Camera, eps2d: float) -> Rendering:
    """Blend Gaussians, sorted front to back, at every pixel.

    With aᵢ the alpha of Gaussian i in a pixel and Tᵢ = Πⱼ≤ᵢ (1 - aⱼ), its weight is aᵢ·Tᵢ₋₁. It is
    skipped if aᵢ is below 1/255; a pixel is full, and takes no more, once Tᵢ falls to 1e-4.
    `eps2d` is added to the diagonal of each projected covariance, in pixels².
    """
    alphas = falloff(gaussians, camera, eps2d)  # [N, H, W]
    alphas = torch.where(alphas > ALPHA_MAX, ALPHA_MAX, alphas)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0)

    # Transmittance behind and in front of each Gaussian, [N, H, W]. `cat` of nothing would fail.
    after = torch.cumprod(1 - alphas, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]]) if len(after) else after
    weights = torch.where(after > TRANSMITTANCE_STOP, alphas * before, 0)

    colors = gaussians.colors
    if gaussians.harmonics is not None:
        colors = view_colors(gaussians.means, colors, gaussians.harmonics, camera.position)

    alpha = weights.sum(dim=0)  # [H, W]
    color = torch.einsum("nhw,nc->hwc", weights, colors)
    z = camera.to_camera(gaussians.means)[:, 2]
    depth = torch.einsum("nhw,n->hw", weights, z) / torch.where(alpha > 0, alpha, 1)
    return Rendering(linear_to_srgb(color), depth, alpha)


def falloff(gaussians: Gaussians, camera: Camera, eps2d: float) -> Tensor:
    """Unclamped alpha of each Gaussian at each pixel, [N, H, W]: opacity · exp(-½ dᵀ Σ⁻¹ d).

    d is the pixel's offset from the projected centre, Σ the projected covariance, to whose diagonal
    `eps2d` pixels² are added. Alpha is 0 where Σ is singular.
    """
    centers, _ = camera.project(gaussians.means)  # [N, 2]
    covariances = project_covariances(gaussians, camera, eps2d)  # [N, 2, 2]
    covariances = covariances[:, :, :, None, None]  # [N, 2, 2, 1, 1]: the same at all pixels
    xx = covariances[:, 0, 0]  # [N, 1, 1]
    xy = covariances[:, 0, 1]
    yy = covariances[:, 1, 1]
    det = xx * yy - xy * xy
    has_area = det > 0

    offsets = camera.pixel_centers().to(centers) - centers[:, None, None, :]  # [N, H, W, 2]
    dx, dy = offsets.unbind(-1)
    # Of each pixel from the centre, in standard deviations: dᵀ Σ⁻¹ d.
    squared_distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / torch.where(
        has_area, det, 1
    )
    alphas = gaussians.opacities[:, None, None] * torch.exp(-0.5 * squared_distance)
    return torch.where(has_area, alphas, 0)


def project_covariances(gaussians: Gaussians, camera: Camera, eps2d: float) -> Tensor:
    """Image-space covariances J W Σ Wᵀ Jᵀ + eps2d·I of Gaussians, [N, 2, 2] in pixels².

    W is the camera's rotation and J the projection's Jacobian at the centre. As in gsplat, a centre
    far outside of the image is first moved to the border of a frame of 1.3 times the image's size.
    """
    x, y, z = camera.to_camera(gaussians.means).unbind(-1)  # [N] each
    fx, fy = camera.focal
    K = camera.K.to(x)
    cx, cy = K[0, 2], K[1, 2]

    # The slopes x/z and y/z, limited to that frame.
    slack_x = BORDER_SLACK * 0.5 * camera.width / fx
    slack_y = BORDER_SLACK * 0.5 * camera.height / fy
    tx = (x / z).clamp(-cx / fx - slack_x, (camera.width - cx) / fx + slack_x)
    ty = (y / z).clamp(-cy / fy - slack_y, (camera.height - cy) / fy + slack_y)

    zero = torch.zeros_like(z)
    row_u = torch.stack([fx / z, zero, -fx * tx / z], -1)  # derivatives of pixel x by the point
    row_v = torch.stack([zero, fy / z, -fy * ty / z], -1)
    jacobian = torch.stack([row_u, row_v], dim=-2)  # [N, 2, 3]

    # Σ = (R S)(R S)ᵀ, with the rotation R and the scales S.
    axes = quat_to_matrix(gaussians.quats) * gaussians.scales[:, None, :]  # [N, 3, 3]
    factor = jacobian @ camera.world_to_camera[:3, :3].to(x) @ axes  # [N, 2, 3]
    return factor @ factor.transpose(1, 2) + eps2d * torch.eye(2).to(x)
