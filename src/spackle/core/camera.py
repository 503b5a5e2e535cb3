"""Pinhole cameras in the OpenCV convention: x right, y down, z forward."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

# Below these limits a viewing direction is made of rounding errors.
MIN_EYE_TO_TARGET_RATIO = 1e-6  # distance of eye and target, relative to their largest coordinate
MIN_ANGLE_TO_UP_RAD = 1e-3  # angle between the viewing direction and up
MIN_UP_LENGTH = 1e-9


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera: x right, y down, z forward; pixel centres at half-integers."""

    K: Tensor  # [3, 3] intrinsics in pixels; the principal point of an untilted photo is (W/2, H/2)
    world_to_camera: Tensor  # [4, 4] extrinsics
    width: int
    height: int

    def __post_init__(self) -> None:
        """Raise a ValueError for matrices of a wrong shape or an image without pixels."""
        for name, expected_shape in {"K": (3, 3), "world_to_camera": (4, 4)}.items():
            shape = tuple(getattr(self, name).shape)
            if shape != expected_shape:
                raise ValueError(f"Camera.{name} has shape {shape}, expected {expected_shape}")
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
        """Focal lengths (fx, fy) in pixels."""
        return float(self.K[0, 0]), float(self.K[1, 1])

    @property
    def position(self) -> Tensor:
        """The camera's centre in world coordinates, [3]: −Rᵀ t.

        It is the point that R and t, the rotation and translation to the camera, move to 0.
        """
        rotation = self.world_to_camera[:3, :3]
        translation = self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Camera:
        """Move or convert the matrices, as `Tensor.to` does."""
        return dataclasses.replace(
            self,
            K=self.K.to(device=device, dtype=dtype),
            world_to_camera=self.world_to_camera.to(device=device, dtype=dtype),
        )

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another number of pixels; `K` is scaled along each axis."""
        factors = torch.tensor([width / self.width, height / self.height, 1.0]).to(self.K)
        return dataclasses.replace(self, K=self.K * factors[:, None], width=width, height=height)

    def cropped(self, left: float, top: float, width: int, height: int) -> Camera:
        """The width×height pixels of this view that begin at (left, top)."""
        # The rays of the pixels stay, but their positions now count from another corner.
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
        """This camera moved to `eye` [3] and turned to `target` [3], both in world coordinates.

        The world's y axis points downwards in the image. ValueError if eye and target coincide.
        """
        pose = look_at(eye, target).to(self.world_to_camera)
        return dataclasses.replace(self, world_to_camera=pose)

    def to_camera(self, points: Tensor) -> Tensor:
        """Convert world points [..., 3] to camera coordinates [..., 3]."""
        matrix = to_like(self.world_to_camera, points)
        return points @ matrix[:3, :3].T + matrix[:3, 3]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points [..., 3] to pixel coordinates [..., 2] and depth z [...]."""
        local_points = self.to_camera(points)
        z = local_points[..., 2]
        K = to_like(self.K, points)
        focal = torch.stack([K[0, 0], K[1, 1]])
        principal_point = K[:2, 2]
        uv = local_points[..., :2] / z[..., None] * focal + principal_point
        return uv, z

    def has_in_frame(self, uv: Tensor, z: Tensor) -> Tensor:
        """[...] bool: which pixel positions [..., 2] at depth z [...] lie in the picture."""
        size = uv.new_tensor([self.width, self.height])
        return (z > 0) & ((uv >= 0) & (uv < size)).all(dim=-1)

    def unproject(self, uv: Tensor, depth: Tensor) -> Tensor:
        """Unproject pixels [..., 2] at depth z [...] to world points [..., 3]."""
        K = to_like(self.K, uv)
        matrix = to_like(self.world_to_camera, uv)
        focal = torch.stack([K[0, 0], K[1, 1]])
        principal_point = K[:2, 2]
        xy = (uv - principal_point) / focal * depth[..., None]
        local_points = torch.cat([xy, depth[..., None]], dim=-1)  # [..., 3]
        # Row vectors times R apply the inverse rotation Rᵀ.
        return (local_points - matrix[:3, 3]) @ matrix[:3, :3]

    def pixel_centers(self, stride: int = 1) -> Tensor:
        """Centres (x, y) of blocks of stride×stride pixels, [H/stride, W/stride, 2]."""
        ys = (torch.arange(self.height // stride) + 0.5) * stride
        xs = (torch.arange(self.width // stride) + 0.5) * stride
        return torch.stack(torch.meshgrid(xs, ys, indexing="xy"), dim=-1)


def look_at(eye: Tensor, target: Tensor, up: Tensor | None = None) -> Tensor:
    """The matrix world_to_camera [4, 4], float64, of a camera at `eye` that looks at `target`.

    Args:
        eye: [3] the camera's centre in world coordinates.
        target: [3] a point in the middle of the view.
        up: [3] a direction that points upwards in the image; by default −y.

    Raises:
        ValueError: eye and target coincide, or `up` has no length or is parallel to the viewing
            direction.
    """
    eye = eye.double()
    target = target.double()
    forward = target - eye
    distance = float(forward.norm())
    largest_coordinate = float(torch.cat([eye, target]).abs().max())
    # Rounding errors grow with the coordinates. With all coordinates near 0, they would be zero, so
    # at least a millimetre is taken.
    if distance <= MIN_EYE_TO_TARGET_RATIO * max(1e-3, largest_coordinate):
        raise ValueError("eye and target coincide: move one of them")

    if up is None:
        down = eye.new_tensor([0.0, 1.0, 0.0])
    else:
        if float(up.norm()) < MIN_UP_LENGTH:
            raise ValueError("up has no length")
        down = -up.double() / up.double().norm()

    # The length of this cross product is `distance` times the sine of the angle between `up` and
    # the viewing direction.
    right = torch.linalg.cross(down, forward)
    if float(right.norm()) < MIN_ANGLE_TO_UP_RAD * distance:
        raise ValueError("up is parallel to the viewing direction: give another up")
    forward = forward / forward.norm()
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)  # now at a right angle to the viewing direction

    rotation = torch.stack([right, down, forward])  # rows are the camera's axes in the world
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ eye
    return matrix


def to_like(numbers: Tensor, other: Tensor) -> Tensor:
    """Convert a small tensor to the dtype and device of another, without waiting for a GPU."""
    return numbers.to(other, non_blocking=other.device.type != "cpu")
