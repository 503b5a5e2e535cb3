"""Pinhole cameras in the OpenCV convention."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

SHORTEST_LOOK = 1e-6  # least distance of eye and target, relative to their largest coordinate
LEAST_TILT = 1e-3  # least angle in radians between the viewing direction and up


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera: x right, y down, z forward; pixel centres at half-integers."""

    K: Tensor  # [3, 3] intrinsics in pixels; the principal point of an untilted photo is (W/2, H/2)
    world_to_camera: Tensor  # [4, 4] extrinsics
    width: int
    height: int

    def __post_init__(self) -> None:
        for name, shape in {"K": (3, 3), "world_to_camera": (4, 4)}.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"Camera.{name} has shape {found}, expected {shape}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"Camera size {self.width}×{self.height} is empty")

    @staticmethod
    def from_focal(focal_px: float, width: int, height: int) -> Camera:
        """A camera at the world's origin, with the principal point in the image's middle."""
        if not (math.isfinite(focal_px) and focal_px > 0):
            raise ValueError(f"focal length must be positive, got {focal_px} px")
        K = torch.tensor([[focal_px, 0.0, width / 2], [0.0, focal_px, height / 2], [0.0, 0.0, 1.0]])
        return Camera(K, torch.eye(4), width, height)

    @property
    def focal(self) -> tuple[float, float]:
        """(fx, fy) in pixels."""
        return float(self.K[0, 0]), float(self.K[1, 1])

    @property
    def position(self) -> Tensor:
        """The camera's centre in world coordinates, [3]."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Camera:
        """Move or convert the matrices, as `Tensor.to` does."""
        K, pose = (
            matrix.to(device=device, dtype=dtype) for matrix in (self.K, self.world_to_camera)
        )
        return dataclasses.replace(self, K=K, world_to_camera=pose)

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another number of pixels; the intrinsics are scaled along each axis."""
        factors = torch.tensor([width / self.width, height / self.height, 1.0]).to(self.K)
        return dataclasses.replace(self, K=self.K * factors[:, None], width=width, height=height)

    def cropped(self, left: float, top: float, width: int, height: int) -> Camera:
        """The width×height pixels of this view that begin at (left, top)."""
        K = self.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        return dataclasses.replace(self, K=K, width=width, height=height)

    def even(self) -> Camera:
        """The same view with even width and height; an odd side grows by one pixel."""
        return self.resized(self.width + self.width % 2, self.height + self.height % 2)

    def zoomed(self, factor: float) -> Camera:
        """The view with the focal length multiplied by a factor."""
        K = self.K.clone()
        K[:2, :2] *= factor
        return dataclasses.replace(self, K=K)

    def looking(self, eye: Tensor, target: Tensor) -> Camera:
        """The camera at `eye` [3], turned to `target` [3], with the world's y axis downwards; see `look_at`."""
        return dataclasses.replace(
            self, world_to_camera=look_at(eye, target).to(self.world_to_camera)
        )

    def to_camera(self, points: Tensor) -> Tensor:
        """Convert world points [..., 3] to camera coordinates [..., 3]."""
        matrix = to_like(self.world_to_camera, points)
        return points @ matrix[:3, :3].T + matrix[:3, 3]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points [..., 3] to pixel coordinates [..., 2] and depth z [...]."""
        local = self.to_camera(points)
        z = local[..., 2]
        K = to_like(self.K, points)
        uv = local[..., :2] / z[..., None] * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
        return uv, z

    def unproject(self, uv: Tensor, depth: Tensor) -> Tensor:
        """Unproject pixels [..., 2] at depth z [...] to world points [..., 3]."""
        K, matrix = to_like(self.K, uv), to_like(self.world_to_camera, uv)
        xy = (uv - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]]) * depth[..., None]
        local = torch.cat([xy, depth[..., None]], dim=-1)
        return (local - matrix[:3, 3]) @ matrix[:3, :3]

    def pixel_centers(self, stride: int = 1) -> Tensor:
        """Centres (x, y) of cells of stride×stride pixels, [H/stride, W/stride, 2]."""
        ys = (torch.arange(self.height // stride) + 0.5) * stride
        xs = (torch.arange(self.width // stride) + 0.5) * stride
        return torch.stack(torch.meshgrid(xs, ys, indexing="xy"), dim=-1)


def look_at(eye: Tensor, target: Tensor, up: Tensor | None = None) -> Tensor:
    """The matrix world_to_camera [4, 4], float64, of a camera at `eye` [3] that looks at `target` [3].

    `up` [3], by default -y, points upwards in the image.

    Raises:
        ValueError: eye and target coincide, or `up` has no length or is parallel to the viewing direction.
    """
    eye, target = eye.double(), target.double()
    forward, down = target - eye, eye.new_tensor([0.0, 1.0, 0.0])
    distance = float(forward.norm())
    if distance <= SHORTEST_LOOK * max(1e-3, float(torch.cat([eye, target]).abs().max())):
        raise ValueError("eye and target coincide: move one of them")
    if up is not None:
        if float(up.norm()) < 1e-9:
            raise ValueError("up has no length")
        down = -up.double() / up.double().norm()
    right = torch.linalg.cross(down, forward)
    if float(right.norm()) < LEAST_TILT * distance:
        raise ValueError("up is parallel to the viewing direction: give another up")
    forward, right = forward / forward.norm(), right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
    return matrix


def to_like(numbers: Tensor, other: Tensor) -> Tensor:
    """Convert a small tensor to the dtype and device of another tensor, without waiting for a GPU."""
    return numbers.to(other, non_blocking=other.device.type != "cpu")
