"""What scene files store: Gaussians as NumPy columns in the units that files share."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.color import linear_to_srgb
from spackle.gaussians import Gaussians

Floats = NDArray[np.float32]

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)
SMALLEST_SCALE, LARGEST_SCALE = 1e-37, 1e37  # keep the logarithm, and float32 after it, finite
SMALLEST_QUAT = 1e-12  # a shorter quaternion has no direction

# Half a turn about x: from x right, y down, z forward to x right, y up, z backward, as OpenGL and glTF have it.
FLIPPED_MEANS = np.array([1, -1, -1], np.float32)
FLIPPED_QUATS = np.array([1, 1, -1, -1], np.float32)


@dataclasses.dataclass(frozen=True)
class Columns:
    """N Gaussians, float32, in the axes of their scene."""

    means: Floats  # [N, 3]
    quats: Floats  # [N, 4] unit length, wxyz
    log_scales: Floats  # [N, 3] natural logarithms of standard deviations
    opacities: Floats  # [N] in 0..1
    srgb: Floats  # [N, 3] in 0..1

    @staticmethod
    @torch.no_grad()
    def of(gaussians: Gaussians) -> Columns:
        """Columns of a scene: colours clamped to what a screen shows, quaternions without direction made (1, 0, 0, 0).

        Raises:
            ValueError: a Gaussian is not finite.
        """
        means, quats, scales, opacities, colors = (t.detach().to("cpu", torch.float32) for t in gaussians.tensors)
        for name, tensor in (("means", means), ("quats", quats), ("opacities", opacities), ("colors", colors)):
            if not torch.isfinite(tensor).all():
                raise ValueError(f"{name} of these Gaussians are not all finite")
        if torch.isnan(scales).any():
            raise ValueError("scales of these Gaussians are not all finite")
        quats = quats / quats.abs().amax(-1, keepdim=True).clamp_min(1.0)  # their squares may be too large
        norm = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
        unit = torch.where(norm < SMALLEST_QUAT, torch.tensor([1.0, 0, 0, 0]), quats / norm.clamp_min(SMALLEST_QUAT))
        # NumPy's logarithm: torch's, split among threads, waits for them at every block of a PLY.
        log_scales = np.log(np.clip(scales.numpy(), SMALLEST_SCALE, LARGEST_SCALE))
        return Columns(
            means.numpy(), unit.numpy(), log_scales, opacities.clamp(0, 1).numpy(), linear_to_srgb(colors).numpy()
        )

    @property
    def harmonics(self) -> Floats:
        """[N, 3] coefficients of the constant spherical harmonic, which gives the sRGB colour."""
        return (self.srgb - np.float32(0.5)) / np.float32(SH_C0)

    def select(self, rows: NDArray[np.int64] | slice) -> Columns:
        """The Gaussians that an index or a slice picks."""
        return Columns(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))


def smallest_three(quats: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Which component [N] of unit quaternions [N, 4] is largest, and the others [N, 3], in their order.

    Of a quaternion and its opposite, which are one rotation, this takes the one whose largest component is positive:
    the others, of at most √½ each, tell that component.
    """
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, np.float32(-1), np.float32(1))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, np.take_along_axis(quats * sign, others, axis=1)


def as_shares(components: Floats) -> Floats:
    """Components of `smallest_three` as shares 0..1 of their range."""
    shares: Floats = np.clip(components * np.float32(0.5**0.5) + np.float32(0.5), 0, 1)
    return shares
