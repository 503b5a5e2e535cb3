"""Sets of 3D Gaussians, and quaternions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from spackle.core.spherical_harmonics import HARMONICS_COUNTS, rotate_harmonics

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
    # [N, 3] linear RGB; with harmonics that of their constant part, which may be outside of 0..1
    colors: Tensor
    # [N, 3 | 8 | 15, 3] coefficients of the spherical harmonics of the degrees 1 to 1, 2 or 3, in
    # sRGB, as 3D Gaussian splatting orders them; None: colours do not change with the view.
    harmonics: Tensor | None = None

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
        if self.harmonics is None:
            return
        shape = tuple(self.harmonics.shape)
        possible_shapes = [(count, k, 3) for k in HARMONICS_COUNTS[1:]]
        if shape not in possible_shapes:
            raise ValueError(f"Gaussians.harmonics has shape {shape}, expected ({count}, 15, 3)")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,}, {self.means.device})"

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The five tensors in the order of the fields, and the harmonics if there are any."""
        always = (self.means, self.quats, self.scales, self.opacities, self.colors)
        return always if self.harmonics is None else (*always, self.harmonics)

    @property
    def harmonics_count(self) -> int:
        """The number of harmonics of a colour: 0, 3, 8 or 15 for the degrees 0 to 3."""
        return 0 if self.harmonics is None else self.harmonics.shape[1]

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
        """Join sets in the given order, without changing a bit.

        Where one set has harmonics of a higher degree than another, the other gets zeros.
        """
        parts = list(parts)
        count = max((part.harmonics_count for part in parts), default=0)
        parts = [part.with_harmonics_count(count) for part in parts]
        tensors_of_fields = zip(*(part.tensors for part in parts), strict=True)
        return Gaussians(*(torch.cat(tensors) for tensors in tensors_of_fields))

    def with_harmonics_count(self, count: int) -> Gaussians:
        """The same Gaussians with 0, 3, 8 or 15 harmonics: zeros are added, or the last dropped."""
        if count == self.harmonics_count:
            return self
        if count == 0:
            return dataclasses.replace(self, harmonics=None)
        harmonics = self.harmonics
        if harmonics is None:
            harmonics = self.colors.new_zeros(len(self), 0, 3)
        missing = max(0, count - harmonics.shape[1])
        # Pairs from the last axis on: no colour is added, but rows of harmonics at the end.
        padded = pad(harmonics[:, :count], (0, 0, 0, missing))
        return dataclasses.replace(self, harmonics=padded)

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

        Colours that change with the view turn together with the scene.

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
        harmonics = self.harmonics
        if harmonics is not None:
            harmonics = rotate_harmonics(harmonics, rotation)
        scales = self.scales * scale.to(dtype)
        return Gaussians(means, quats, scales, self.opacities, self.colors, harmonics)

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(torch.isfinite(tensor).all()) for tensor in self.tensors)

    @property
    def finite_rows(self) -> Tensor:
        """[N] bool: the Gaussians all of whose numbers are finite."""
        finite_by_field = []
        for tensor in self.tensors:
            is_finite = tensor.detach().isfinite()  # [N, ...], a Gaussian's numbers on all axes
            if is_finite.ndim > 1:
                is_finite = is_finite.flatten(1).all(1)  # [N]
            finite_by_field.append(is_finite)
        return torch.stack(finite_by_field).all(0)

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
