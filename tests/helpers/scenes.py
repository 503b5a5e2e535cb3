"""Small scenes with exact depth, and one real stereo pair."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.photos import box
from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.depth.depth_map import DepthMap
from spackle.render.protocol import Rendering


@dataclasses.dataclass(frozen=True)
class Scene:
    """A photo, its exact depth and its camera at the world's origin."""

    rgb: Tensor  # [H, W, 3] sRGB
    depth: Tensor  # [H, W], 0 where unknown
    camera: Camera

    @property
    def depth_map(self) -> DepthMap:
        return DepthMap(self.depth, self.depth > 0, None, None, "depth", Path("synthetic.npy"))

    def lift(self, levels: int = 0) -> BasePrediction:
        return lift_rgbd(self.rgb, self.depth_map, self.camera, levels)

    def base(self) -> Gaussians:
        return self.lift().gaussians


def texture(height: int, width: int, hue: tuple[float, float, float] = (0.5, 0.45, 0.6)) -> Tensor:
    """A smooth pattern [H, W, 3] around a colour, ±0.1."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    waves = [
        torch.sin(0.5 * x + 0.2 * y),
        torch.sin(0.4 * y - 0.1 * x),
        torch.cos(0.3 * x + 0.3 * y),
    ]
    return torch.tensor(hue) + 0.1 * torch.stack(waves, dim=-1)


def random_gaussians(
    count: int = 400, seed: int = 3, dtype: torch.dtype = torch.float32
) -> Gaussians:
    """Random anisotropic Gaussians in front of a camera at the origin."""
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.rand(count, 3, generator=g) * torch.tensor([2.0, 1.5, 4.0])
        + torch.tensor([-1.0, -0.75, 2.0]),
        torch.randn(count, 4, generator=g),
        torch.rand(count, 3, generator=g) * 0.1 + 0.02,
        torch.rand(count, generator=g),
        torch.rand(count, 3, generator=g),
    ).to(dtype=dtype)


def slanted_plane(
    near: float, far: float, axis: int, width: int = 160, height: int = 120, focal: float = 150
) -> Scene:
    """A plane whose depth runs from `far` at the first row (axis 0) or column (axis 1) to `near` at
    the last.
    """
    ramp = torch.linspace(1 / far, 1 / near, (height, width)[axis])
    inverse = (ramp[:, None] if axis == 0 else ramp[None, :]).expand(height, width)
    return Scene(texture(height, width), 1 / inverse, Camera.from_focal(focal, width, height))


def wall(depth: float = 4.0, width: int = 64, height: int = 48, focal: float = 60) -> Scene:
    camera = Camera.from_focal(focal, width, height)
    return Scene(texture(height, width), torch.full((height, width), depth), camera)


def box_mask(width: int, height: int) -> Tensor:
    """The pixels [H, W] of the box in `box_before_wall`."""
    return torch.from_numpy(box(width, height))


def box_before_wall(
    near: float = 2.0, far: float = 6.0, width: int = 96, height: int = 72, focal: float = 80
) -> Scene:
    """A reddish box before a bluish wall, both facing the camera."""
    mask = box_mask(width, height)
    front, back = texture(height, width, (0.8, 0.3, 0.2)), texture(height, width, (0.2, 0.4, 0.7))
    depth = torch.where(mask, near, far)
    return Scene(
        torch.where(mask[..., None], front, back), depth, Camera.from_focal(focal, width, height)
    )


def cast(camera: Camera, z: float) -> Tensor:
    """The points [H, W, 3] at which rays through a view's pixels meet the world's plane at depth
    z.
    """
    centers = camera.pixel_centers()
    ray = camera.unproject(centers, torch.ones(centers.shape[:-1])) - camera.position
    return camera.position + ray * ((z - camera.position[2]) / ray[..., 2])[..., None]


def shifted(camera: Camera, right: float, focus: float = 4.0) -> Camera:
    """A camera moved to the right that looks at the point at depth `focus`."""
    return camera.looking(torch.tensor([right, 0.0, 0.0]), torch.tensor([0.0, 0.0, focus]))


def turned_camera(width: int, height: int, focal: float) -> Camera:
    """A tilted camera away from the origin, with an off-centre principal point."""
    camera = Camera.from_focal(focal, width, height)
    camera.K[0, 2] += 2.3
    camera.K[1, 2] -= 1.1
    return camera.looking(torch.tensor([0.5, -0.3, -0.8]), torch.tensor([0.2, 0.4, 5.0]))


def random_scene(
    seed: int,
    n: int,
    camera: Camera,
    solidity: float = 1.0,
    dtype: torch.dtype = torch.float32,
    sizes: tuple[float, float] = (0.6, 12.0),
) -> Gaussians:
    """Gaussians at different depths around the view; `sizes` bound their standard deviations in
    pixels.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    z = 0.6 + 4 * (torch.arange(n) + 0.5 * uniform(n)) / n
    z = torch.where(uniform(n) < 0.1, -z, z)
    uv = (uniform(n, 2) * 1.8 - 0.4) * torch.tensor([camera.width, camera.height])
    pixels = sizes[0] * (sizes[1] / sizes[0]) ** uniform(n, 3)
    return Gaussians(
        camera.unproject(uv, z),
        torch.randn(n, 4, generator=generator),
        pixels * z.abs()[:, None] / camera.focal[0],
        1.02 * uniform(n) ** (1 / solidity),
        uniform(n, 3),
    ).to(dtype=dtype)


def away(camera: Camera) -> Camera:
    """The camera turned by 180 degrees."""
    return camera.looking(torch.zeros(3), torch.tensor([0.0, 0.0, -1.0]))


def tensors_of(value: object) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from tensors_of(getattr(value, field.name))


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * float((a - b).double().square().mean().log10())


def same_bits(a: Rendering | Gaussians, b: Rendering | Gaussians) -> bool:
    return all(torch.equal(*pair) for pair in zip(tensors_of(a), tensors_of(b), strict=True))


@dataclasses.dataclass(frozen=True)
class Stereo:
    """The left photo with its depth, and the right photo."""

    left: Scene
    right: Camera
    right_rgb: Tensor  # [H, W, 3] sRGB


@functools.cache
def motorcycle() -> Stereo:
    """Middlebury's Motorcycle at quarter size, in metres; a real depth map, with gaps."""
    data = pytest.importorskip("skimage.data")
    left, right, disparity = data.stereo_motorcycle()
    focal, cx, cy, doffs, baseline = 994.978, 311.193, 254.877, 31.086, 0.193001
    depth = np.where(np.isfinite(disparity), focal * baseline / (disparity + doffs), 0).astype(
        np.float32
    )
    height, width = depth.shape
    K = torch.tensor([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    beside, pose = K.clone(), torch.eye(4)
    beside[0, 2] += doffs
    pose[0, 3] = -baseline
    photos = [torch.from_numpy(image).float() / 255 for image in (left, right)]
    scene = Scene(photos[0], torch.from_numpy(depth), Camera(K, torch.eye(4), width, height))
    return Stereo(scene, Camera(beside, pose, width, height), photos[1])


@functools.cache
def motorcycle_base() -> BasePrediction:
    return motorcycle().left.lift()


def random_harmonics(count: int, degree: int, seed: int = 5) -> Tensor:
    """Coefficients [count, 3 | 8 | 15, 3] of about ±0.3 for the degrees 1 to `degree`."""
    generator = torch.Generator().manual_seed(seed)
    return 0.3 * torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=generator)
