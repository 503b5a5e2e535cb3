"""What compact formats store: Gaussians as NumPy columns in the units that files share."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.color import linear_to_srgb
from spackle.formats.ply import LARGEST_SCALE, SMALLEST_QUAT, SMALLEST_SCALE
from spackle.gaussians import Gaussians

Floats = NDArray[np.float32]

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
            ValueError: where a Gaussian is not finite.
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
        log_scales = np.log(np.clip(scales.numpy(), SMALLEST_SCALE, LARGEST_SCALE))
        return Columns(
            means.numpy(), unit.numpy(), log_scales, opacities.clamp(0, 1).numpy(), linear_to_srgb(colors).numpy()
        )

    def select(self, rows: NDArray[np.int64] | slice) -> Columns:
        """The Gaussians that an index or a slice picks."""
        return Columns(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))


def smallest_three(quats: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Which component [N] of unit quaternions wxyz is largest, and the others [N, 3] as shares 0..1, in their order.

    Of a quaternion and its opposite, which turn alike, the one is taken whose largest component is positive: the others
    say how large it is.
    """
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, np.float32(-1), np.float32(1))
    shares = np.clip(quats * sign * np.float32(0.5**0.5) + np.float32(0.5), 0, 1)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, np.take_along_axis(shares, others, axis=1)
