"""Views with holes, and residual networks."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from helpers.scenes import box_before_wall
from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost
from spackle.render import CpuRenderer
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet
from spackle.residual.architectures import open_residual, shipped_network
from spackle.scene_fill import FillContext, SceneViewCompletion

CPU = CpuRenderer()


def random_view(seed: int, height: int, width: int) -> Rendering:
    """A random rendering with empty, translucent and opaque pixels."""
    generator = torch.Generator().manual_seed(seed)
    kind = torch.randint(0, 4, (height, width), generator=generator)
    veil = torch.rand(height, width, generator=generator)
    alpha = torch.where(kind == 0, 0.0, torch.where(kind == 1, veil, 0.96 + 0.039 * veil))
    rgb = linear_to_srgb(alpha[..., None] * torch.rand(height, width, 3, generator=generator))
    depth = torch.where(alpha > 0, 0.5 + 20 * torch.rand(height, width, generator=generator), 0.0)
    return Rendering(rgb, depth, alpha)


def box_view(
    disparity: float = 0.2, side: int = 1, width: int = 96, height: int = 72
) -> tuple[FillContext, Camera]:
    """A box before a wall, and a camera from which the wall behind the box is a hole."""
    scene = box_before_wall(width=width, height=height, focal=width * 80 // 96)
    context = FillContext(scene.base(), scene.camera, CPU)
    return context, leftmost_and_rightmost(
        scene.camera, disparity, DepthRange.of(context.base, is_metric=True)
    )[side]


def view_of(
    base: Gaussians | Rendering, camera: Camera, photo_camera: Camera, photo: Tensor | None = None
) -> SceneViewCompletion:
    """The completion of a view of Gaussians, or of a rendering."""
    rendering = base if isinstance(base, Rendering) else CPU.render(base, camera)
    get_photo = None if photo is None else lambda: photo
    return SceneViewCompletion(rendering, camera, photo_camera, get_photo)


def random_network(seed: int = 0, size: float = 0.02, name: str = "unet") -> ResidualNet:
    """A network whose last layers are not zero."""
    torch.manual_seed(seed)
    network = open_residual(name)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(size * torch.randn_like(parameter))
    return network


@functools.cache
def shipped() -> ResidualNet:
    network = shipped_network()
    assert network is not None
    return network
