"""Sets of 3D Gaussians, and quaternions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn.functional import normalize

ROTATION_TOLERANCE = 1e-5  # error of R Rᵀ at which a matrix is still a rotation


@dataclasses.dataclass(frozen=True)
class Gaussians:
    """A set of N anisotropic 3D Gaussians, without a batch axis.

    World axes are OpenCV's: x right, y down, z forward. Units are metres if the depth is metric.
    """

    means: Tensor  # [N, 3] centres
    quats: Tensor  # [N, 4] rotation as (w, x, y, z); need not be normalised
    scales: Tensor  # [N, 3] standard deviations along the rotated axes
    opacities: Tensor  # [N] in 0..1
    colors: Tensor  # [N, 3] linear RGB

    def __post_init__(self) -> None:
        """Raise a ValueError for tensors of a wrong shape."""
        count = len(self.means)
        expected_shapes = {
            "means": (count, 3),
            "quats": (count, 4),
            "scales": (count, 3),
            "opacities": (count,),
            "colors": (count, 3),
        }
        for name, expected_shape in expected_shapes.items():
            shape = tuple(getattr(self, name).shape)
            if shape != expected_shape:
                raise ValueError(f"Gaussians.{name} has shape {shape}, expected {expected_shape}")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,}, {self.means.device})"

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five tensors in the order of the fields."""
        return self.means, self.quats, self.scales, self.opacities, self.colors

    @staticmethod
    def empty(device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Gaussians:
        """A set without Gaussians."""
        return Gaussians(
            means=torch.empty((0, 3), device=device, dtype=dtype),
            quats=torch.empty((0, 4), device=device, dtype=dtype),
            scales=torch.empty((0, 3), device=device, dtype=dtype),
            opacities=torch.empty((0,), device=device, dtype=dtype),
            colors=torch.empty((0, 3), device=device, dtype=dtype),
        )

    @staticmethod
    def cat(parts: Iterable[Gaussians]) -> Gaussians:
        """Join sets in the given order, without changing a bit."""
        tensors_of_fields = zip(*(part.tensors for part in parts), strict=True)
        return Gaussians(*(torch.cat(tensors) for tensors in tensors_of_fields))

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Gaussians:
        """Move or convert every tensor, as `Tensor.to` does."""
        return Gaussians(*(tensor.to(device=device, dtype=dtype) for tensor in self.tensors))

    def detach(self) -> Gaussians:
        """The same values, detached from autograd."""
        return Gaussians(*(tensor.detach() for tensor in self.tensors))

    def select(self, index: Tensor | slice) -> Gaussians:
        """Select Gaussians by a boolean mask [N], an index tensor [M] or a slice."""
        return Gaussians(*(tensor[index] for tensor in self.tensors))

    def scaled(self, factor: float) -> Gaussians:
        """The scene in another unit of length: centres and scales times a factor."""
        return dataclasses.replace(self, means=self.means * factor, scales=self.scales * factor)

    def transform(self, matrix: Tensor) -> Gaussians:
        """Apply a similarity [4, 4]: rotation, uniform scale and translation.

        Raises:
            ValueError: the upper left 3×3 block is not a proper rotation times a scale.
        """
        matrix = matrix.to(device=self.means.device, dtype=torch.float64)
        linear = matrix[:3, :3]
        translation = matrix[:3, 3]
        # The determinant is the factor of volumes, which is the cube of the scale.
        scale = torch.linalg.det(linear).abs() ** (1 / 3)
        rotation = linear / scale
        identity = torch.eye(3).to(rotation)
        is_orthogonal = torch.allclose(rotation @ rotation.T, identity, atol=ROTATION_TOLERANCE)
        # A negative determinant would mirror the scene, and no quaternion can do that.
        if not is_orthogonal or torch.linalg.det(linear) <= 0:
            raise ValueError(
                "Gaussians.transform takes a rotation, a uniform scale and a translation only"
            )

        # Computed in float64, so that a scene far from the origin loses no precision.
        dtype = self.means.dtype
        means = (self.means.double() @ linear.T + translation).to(dtype)
        quats = quat_multiply(quat_from_matrix(rotation), self.quats.double()).to(dtype)
        return Gaussians(means, quats, self.scales * scale.to(dtype), self.opacities, self.colors)

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(torch.isfinite(tensor).all()) for tensor in self.tensors)

    def covariances(self) -> Tensor:
        """World-space covariances Σ = R S Sᵀ Rᵀ, [N, 3, 3]."""
        factor = quat_to_matrix(self.quats) * self.scales[:, None, :]  # R S
        return factor @ factor.transpose(1, 2)


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Convert quaternions [..., 4] (wxyz, of any length) to rotation matrices [..., 3, 3]."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    elements = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(elements, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def quat_from_matrix(rotation: Tensor) -> Tensor:
    """Convert rotation matrices [..., 3, 3] to unit quaternions [..., 4] (wxyz, w ≥ 0).

    Sums of the matrix's elements are products of two components of the quaternion, such as
    m21 − m12 = 4wx. The four products that have one component in common, such as 4w·(w, x, y, z),
    are a multiple of the quaternion. Of the four multiples, the largest one is the most accurate.
    """
    row0, row1, row2 = rotation.unbind(-2)
    m00, m01, m02 = row0.unbind(-1)
    m10, m11, m12 = row1.unbind(-1)
    m20, m21, m22 = row2.unbind(-1)

    # The quaternion times 4w, 4x, 4y and 4z.
    times_w = torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1)
    times_x = torch.stack([m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20], -1)
    times_y = torch.stack([m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21], -1)
    times_z = torch.stack([m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22], -1)
    candidates = torch.stack([times_w, times_x, times_y, times_z], dim=-2)  # [..., 4, 4]

    # Take the multiple by the largest component, which is never near zero.
    squares = [times_w[..., 0], times_x[..., 1], times_y[..., 2], times_z[..., 3]]  # 4w², 4x², …
    largest = torch.stack(squares, -1).argmax(-1)  # [...] 0 for w to 3 for z
    row_index = largest[..., None, None].expand(*largest.shape, 1, 4)
    best_rows = candidates.gather(-2, row_index).squeeze(-2)  # [..., 4]

    # A quaternion and its negative are the same rotation; the one with w ≥ 0 is returned.
    quats = normalize(best_rows, dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a·b of quaternions [..., 4] (wxyz), which rotates by b first, then by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )
