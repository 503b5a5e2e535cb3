"""Sets of 3D Gaussians, and quaternions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Gaussians:
    """A set of N anisotropic 3D Gaussians, without a batch axis.

    World axes are OpenCV's: x right, y down, z forward; units are metres if the base is metric.
    """

    means: Tensor  # [N, 3] centres
    quats: Tensor  # [N, 4] rotation as (w, x, y, z); need not be normalised
    scales: Tensor  # [N, 3] standard deviations along the rotated axes
    opacities: Tensor  # [N] in 0..1
    colors: Tensor  # [N, 3] linear RGB

    def __post_init__(self) -> None:
        n = len(self.means)
        expected = {
            "means": (n, 3),
            "quats": (n, 4),
            "scales": (n, 3),
            "opacities": (n,),
            "colors": (n, 3),
        }
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"Gaussians.{name} has shape {found}, expected {shape}")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,}, {self.means.device})"

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five tensors in field order."""
        return self.means, self.quats, self.scales, self.opacities, self.colors

    @staticmethod
    def empty(device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Gaussians:
        """A set without Gaussians."""
        shapes: list[tuple[int, ...]] = [(0, 3), (0, 4), (0, 3), (0,), (0, 3)]
        return Gaussians(*(torch.empty(s, device=device, dtype=dtype) for s in shapes))

    @staticmethod
    def cat(parts: Iterable[Gaussians]) -> Gaussians:
        """Join sets in the given order, without changing a bit."""
        columns = zip(*(part.tensors for part in parts), strict=True)
        return Gaussians(*(torch.cat(column) for column in columns))

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Gaussians:
        """Move or convert every tensor, as `Tensor.to` does."""
        return Gaussians(*(t.to(device=device, dtype=dtype) for t in self.tensors))

    def detach(self) -> Gaussians:
        """The same values, detached from autograd."""
        return Gaussians(*(t.detach() for t in self.tensors))

    def select(self, index: Tensor | slice) -> Gaussians:
        """Select Gaussians by a boolean mask [N], an index tensor [M] or a slice."""
        return Gaussians(*(t[index] for t in self.tensors))

    def transform(self, matrix: Tensor) -> Gaussians:
        """Apply a similarity [4, 4]: rotation, uniform scale and translation.

        Raises:
            ValueError: the upper left 3×3 block is not a proper rotation times a scale.
        """
        matrix = matrix.to(device=self.means.device, dtype=torch.float64)
        linear = matrix[:3, :3]
        scale = torch.linalg.det(linear).abs() ** (1 / 3)
        rotation = linear / scale
        orthogonal = torch.allclose(rotation @ rotation.T, torch.eye(3).to(rotation), atol=1e-5)
        if not orthogonal or torch.linalg.det(linear) <= 0:
            raise ValueError(
                "Gaussians.transform takes a rotation, a uniform scale and a translation only"
            )
        dtype = self.means.dtype
        means = (self.means.double() @ linear.T + matrix[:3, 3]).to(dtype)
        quats = quat_multiply(quat_from_matrix(rotation), self.quats.double()).to(dtype)
        return Gaussians(means, quats, self.scales * scale.to(dtype), self.opacities, self.colors)

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(torch.isfinite(tensor).all()) for tensor in self.tensors)

    def covariances(self) -> Tensor:
        """World-space covariances Σ = R S Sᵀ Rᵀ, [N, 3, 3]."""
        factor = quat_to_matrix(self.quats) * self.scales[:, None, :]
        return factor @ factor.transpose(1, 2)


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Convert quaternions [..., 4] (wxyz, of any length) to rotation matrices [..., 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def quat_from_matrix(rotation: Tensor) -> Tensor:
    """Convert rotation matrices [..., 3, 3] to unit quaternions [..., 4] (wxyz, w ≥ 0).

    The divisor is the largest of the four components, so the result is well conditioned for every rotation.
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = (
        row.unbind(-1) for row in rotation.unbind(-2)
    )
    w = torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1)
    x = torch.stack([m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20], -1)
    y = torch.stack([m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21], -1)
    z = torch.stack([m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22], -1)
    candidates = torch.stack([w, x, y, z], dim=-2)  # row k is the quaternion times 4·component k
    best = torch.stack([w[..., 0], x[..., 1], y[..., 2], z[..., 3]], -1).argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    quats = torch.nn.functional.normalize(candidates.gather(-2, index).squeeze(-2), dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of quaternions [..., 4] (wxyz): rotate by b, then by a."""
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
