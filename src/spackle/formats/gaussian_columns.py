"""Gaussians as NumPy columns, in the units that the file formats share."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.color import (
    extended_linear_to_srgb,
    extended_srgb_to_linear,
    linear_to_srgb,
    srgb_to_linear,
)
from spackle.core.gaussians import Gaussians, quat_from_matrix, quat_multiply
from spackle.core.spherical_harmonics import degree_of_count, rotate_harmonics

Floats = NDArray[np.float32]

# The value of the spherical harmonic of degree 0, which is constant: 1 / (2 √π).
SH_C0 = 0.28209479177387814

# Between these bounds, a scale and its logarithm are finite in float32.
MIN_SCALE = 1e-37
MAX_SCALE = 1e37

# Training leaves a few Gaussians that are NaN, which every viewer leaves out. A file with a larger
# share of them is broken.
MAX_BROKEN_RATIO = 0.01

# A shorter quaternion has no direction.
MIN_QUAT_LENGTH = 1e-12


@dataclasses.dataclass(frozen=True)
class GaussianColumns:
    """N Gaussians as float32 NumPy columns."""

    means: Floats  # [N, 3] centres
    quats: Floats  # [N, 4] rotations as unit quaternions (w, x, y, z)
    log_scales: Floats  # [N, 3] natural logarithms of the standard deviations
    opacities: Floats  # [N] in 0..1
    srgb: Floats  # [N, 3] colours in 0..1; with harmonics, they may lie outside
    # [N, 3 | 8 | 15, 3] coefficients of the spherical harmonics of the degrees 1 to 1, 2 or 3;
    # None: colours do not change with the view.
    harmonics: Floats | None = None

    @staticmethod
    @torch.no_grad()
    def from_gaussians(gaussians: Gaussians) -> GaussianColumns:
        """Convert Gaussians to columns with values that every format can store.

        Opacities are clamped to 0..1, scales to MIN_SCALE..MAX_SCALE, and colours to 0..1 unless
        they change with the view. A quaternion of length 0 becomes (1, 0, 0, 0), the rotation by
        0°.

        Raises:
            ValueError: a value is not finite; only scales may be infinite.
        """
        gaussians = gaussians.detach().to("cpu", torch.float32)
        names = ("means", "quats", "scales", "opacities", "colors", "harmonics")
        for name, tensor in zip(names, gaussians.tensors, strict=False):  # harmonics may be missing
            # An infinite scale is allowed, because it is clamped below; NaN is not.
            checked = tensor.clamp(-1, 1) if name == "scales" else tensor
            if not torch.isfinite(checked).all():
                raise ValueError(f"{name} of these Gaussians are not all finite")

        # NumPy's logarithm is used, because PyTorch's would start threads in each call, and a
        # writer may call this function for many small blocks of Gaussians.
        scales = np.clip(gaussians.scales.numpy(), MIN_SCALE, MAX_SCALE)
        harmonics = gaussians.harmonics
        # The colour that a camera sees is clamped only after the change by harmonics.
        encode = linear_to_srgb if harmonics is None else extended_linear_to_srgb
        return GaussianColumns(
            means=gaussians.means.numpy(),
            quats=_unit_quats(gaussians.quats).numpy(),
            log_scales=np.log(scales),
            opacities=gaussians.opacities.clamp(0, 1).numpy(),
            srgb=encode(gaussians.colors).numpy(),
            harmonics=None if harmonics is None else harmonics.numpy(),
        )

    def to_gaussians(self) -> Gaussians:
        """Convert the columns to Gaussians on the CPU, without those that are not finite.

        Raises:
            ValueError: more than MAX_BROKEN_RATIO of the Gaussians are not finite.
        """
        # A large logarithm gives an infinite scale, which is refused below.
        with np.errstate(over="ignore", invalid="ignore"):
            scales = np.exp(self.log_scales)
        columns = [self.means, self.quats, scales, self.opacities, self.srgb]
        if self.harmonics is not None:
            columns.append(self.harmonics)

        count = len(self.means)
        is_finite = np.ones(count, bool)
        for column in columns:
            is_finite &= np.isfinite(column.reshape(count, -1)).all(axis=1)
        broken_count = count - np.count_nonzero(is_finite)
        if broken_count > MAX_BROKEN_RATIO * count:
            raise ValueError(f"{broken_count} of {count} Gaussians are not finite")

        kept_rows = is_finite if broken_count else slice(None)
        means, quats, scale_tensor, opacities, srgb, *harmonics = (
            torch.from_numpy(np.array(column[kept_rows], np.float32)) for column in columns
        )
        decode = extended_srgb_to_linear if harmonics else srgb_to_linear
        return Gaussians(means, quats, scale_tensor, opacities, decode(srgb), *harmonics)

    @property
    def harmonics_degree(self) -> int:
        """The highest degree of the harmonics, 0 to 3."""
        return 0 if self.harmonics is None else degree_of_count(self.harmonics.shape[1])

    def without_harmonics(self) -> GaussianColumns:
        """The Gaussians with colours in 0..1 that do not change with the view."""
        if self.harmonics is None:
            return self
        return dataclasses.replace(self, srgb=np.clip(self.srgb, 0, 1), harmonics=None)

    @property
    def constant_harmonics(self) -> Floats:
        """[N, 3] coefficients of the constant spherical harmonic that give the sRGB colours."""
        return (self.srgb - np.float32(0.5)) / np.float32(SH_C0)

    def flip_y_and_z(self) -> GaussianColumns:
        """Rotate the scene by 180° about the x axis.

        This turns OpenCV's axes (y down, z forward) into those of OpenGL and glTF (y up, z
        backward), and back.
        """
        flipped_means = self.means * np.array([1, -1, -1], np.float32)
        # Conjugation with the rotation by 180° about x negates y and z of (w, x, y, z).
        flipped_quats = self.quats * np.array([1, 1, -1, -1], np.float32)
        return dataclasses.replace(
            self,
            means=flipped_means,
            quats=flipped_quats,
            harmonics=self._turned_harmonics(np.diag([1.0, -1.0, -1.0])),
        )

    def to_opencv_axes(self, letters: str) -> GaussianColumns:
        """Return the scene with x right, y down and z forward.

        Args:
            letters: where the axes point now, such as "RUB" for x right, y up, z back; they may
                also mirror the scene.
        """
        if letters == "RUB":
            return self.flip_y_and_z()
        new_axes = axes_to_opencv(letters)
        # A mirror cannot be a rotation, but with all three axes reversed it is one; and a Gaussian
        # is the same along reversed axes.
        is_mirrored = np.linalg.det(new_axes) < 0
        rotation = torch.from_numpy(-new_axes if is_mirrored else new_axes)
        turned = quat_multiply(quat_from_matrix(rotation), torch.from_numpy(self.quats))
        return dataclasses.replace(
            self,
            means=self.means @ new_axes.T,
            quats=turned.numpy(),
            harmonics=self._turned_harmonics(new_axes),
        )

    def _turned_harmonics(self, rotation: NDArray[Any]) -> Floats | None:
        """The coefficients after a rotation [3, 3] of the scene, which may also mirror it."""
        if self.harmonics is None:
            return None
        coefficients = torch.from_numpy(self.harmonics)
        return rotate_harmonics(coefficients, torch.from_numpy(rotation)).numpy()

    @staticmethod
    def cat(parts: Sequence[GaussianColumns]) -> GaussianColumns:
        """Join sets of Gaussians in the given order; harmonics that a set lacks are zeros."""
        names = ("means", "quats", "log_scales", "opacities", "srgb")
        columns = [np.concatenate([getattr(part, name) for part in parts]) for name in names]
        counts = [0 if part.harmonics is None else part.harmonics.shape[1] for part in parts]
        if not any(counts):
            return GaussianColumns(*columns)
        harmonics = np.zeros((len(columns[0]), max(counts), 3), np.float32)
        start = 0
        for part, count in zip(parts, counts, strict=True):
            if part.harmonics is not None:
                harmonics[start : start + len(part.means), :count] = part.harmonics
            start += len(part.means)
        return dataclasses.replace(GaussianColumns(*columns), harmonics=harmonics)

    def scaled(self, factor: float) -> GaussianColumns:
        """The scene in another unit of length: centres and scales times a factor."""
        if factor == 1:
            return self
        return dataclasses.replace(
            self,
            means=(self.means * np.float64(factor)).astype(np.float32),
            log_scales=(self.log_scales + np.log(factor)).astype(np.float32),
        )

    def select(self, rows: NDArray[np.int64] | slice) -> GaussianColumns:
        """Return the Gaussians that an index array [M] or a slice selects."""
        return GaussianColumns(
            means=self.means[rows],
            quats=self.quats[rows],
            log_scales=self.log_scales[rows],
            opacities=self.opacities[rows],
            srgb=self.srgb[rows],
            harmonics=None if self.harmonics is None else self.harmonics[rows],
        )


def axes_to_opencv(letters: str) -> NDArray[np.float32]:
    """Return the matrix [3, 3] that turns coordinates of a file into x right, y down, z forward.

    Args:
        letters: where the file's axes point, such as "RUB" for x right, y up, z back.
    """
    directions = {"R": (1, 0, 0), "D": (0, 1, 0), "F": (0, 0, 1)}
    opposites = {"L": "R", "U": "D", "B": "F"}
    matrix = np.zeros((3, 3), np.float32)
    for column, letter in enumerate(letters):
        if letter in opposites:
            matrix[:, column] = -np.array(directions[opposites[letter]])
        else:
            matrix[:, column] = directions[letter]
    return matrix


def colors_of_harmonics(srgb: Floats, degree: int) -> Floats:
    """Colours [N, 3] as read: in 0..1, unless harmonics of another degree than 0 add to them."""
    return srgb if degree > 0 else np.clip(srgb, 0, 1)


def harmonics_to_srgb(harmonics: Floats) -> Floats:
    """Return the colours of coefficients of the constant spherical harmonic, not clamped.

    The inverse of `GaussianColumns.constant_harmonics`: srgb = harmonics / (2 √π) + 0.5.
    """
    return harmonics * np.float32(SH_C0) + np.float32(0.5)


def _unit_quats(quats: Tensor) -> Tensor:
    """Normalise quaternions [N, 4] (w, x, y, z); one of length 0 becomes (1, 0, 0, 0)."""
    # The squares of large components would overflow, so these are scaled to at most 1 first.
    largest_component = quats.abs().amax(-1, keepdim=True)  # [N, 1]
    quats = quats / largest_component.clamp_min(1.0)
    length = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)  # [N, 1]
    return torch.where(
        length < MIN_QUAT_LENGTH,
        torch.tensor([1.0, 0, 0, 0]),
        quats / length.clamp_min(MIN_QUAT_LENGTH),
    )
