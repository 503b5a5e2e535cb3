"""Scene files: what they store, and the formats that a scene is written in, by the end of a file's name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.camera import Camera
from spackle.color import linear_to_srgb
from spackle.errors import InputError
from spackle.gaussians import Gaussians

Floats = NDArray[np.float32]

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)
SMALLEST_SCALE, LARGEST_SCALE = 1e-37, 1e37  # keep the logarithm, and float32 after it, finite
_FLIP = np.array([1, 1, -1, -1], np.float32)
SMALLEST_QUAT = 1e-12  # a shorter quaternion has no direction


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """What a PLY holds."""

    path: Path
    gaussians: Gaussians
    camera: Camera | None = None  # the photo's
    base_count: int | None = None
    disparity: float | None = None  # how far it was completed

    @property
    def untilted_camera(self) -> Camera | None:
        """The camera where it stands at the world's origin, which is all that a comment of a PLY can say."""
        return self.camera if self.camera is not None and at_origin(self.camera) else None


def at_origin(camera: Camera) -> bool:
    """Whether a camera stands at the world's origin and looks along z."""
    return torch.equal(camera.world_to_camera, torch.eye(4).to(camera.world_to_camera))


@dataclasses.dataclass(frozen=True)
class Columns:
    """N Gaussians as NumPy columns, float32, in the units that files share and the axes of their scene."""

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
        for name, tensor in zip(vars(gaussians), (means, quats, scales.clamp(-1, 1), opacities, colors), strict=True):
            if not torch.isfinite(tensor).all():  # a scale may be infinite: it becomes the largest
                raise ValueError(f"{name} of these Gaussians are not all finite")
        quats = quats / quats.abs().amax(-1, keepdim=True).clamp_min(1.0)  # their squares may be too large
        norm = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
        unit = torch.where(norm < SMALLEST_QUAT, torch.tensor([1.0, 0, 0, 0]), quats / norm.clamp_min(SMALLEST_QUAT))
        # NumPy's logarithm: torch's, split among threads, waits for them at every block of a PLY.
        log_scales = np.log(np.clip(scales.numpy(), SMALLEST_SCALE, LARGEST_SCALE))
        srgb = linear_to_srgb(colors).numpy()
        return Columns(means.numpy(), unit.numpy(), log_scales, opacities.clamp(0, 1).numpy(), srgb)

    @property
    def harmonics(self) -> Floats:
        """[N, 3] coefficients of the constant spherical harmonic, which gives the sRGB colour."""
        return (self.srgb - np.float32(0.5)) / np.float32(SH_C0)

    def flipped(self) -> Columns:
        """Half a turn about x: y up, z backward, as OpenGL and glTF have it."""
        means, quats = self.means * _FLIP[1:], self.quats * _FLIP
        return dataclasses.replace(self, means=means, quats=quats)

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


SPLAT_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def encode_splat(scene: SceneFile) -> bytes:
    """Gaussians, in their order and axes, as a .splat file of antimatter15's viewer: 32 bytes each, and nothing else.

    Colours, opacities and rotations are rounded to bytes. ValueError where a Gaussian is not finite.
    """
    columns = Columns.of(scene.gaussians)
    rows = np.empty(len(scene.gaussians), SPLAT_ROW)
    rows["means"], rows["scales"] = columns.means, np.exp(columns.log_scales)
    rows["rgba"] = np.round(np.concatenate([columns.srgb, columns.opacities[:, None]], axis=1) * 255)
    rows["quats"] = np.clip(np.round(columns.quats * 128 + 128), 0, 255)
    return rows.tobytes()


Encoder = Callable[[SceneFile], bytes]
# The module and the function that encodes a format, imported when a file is first written in it. A new format is one
# file and one line here; the first end that fits a name counts.
SCENE_ENCODERS = {
    ".compressed.ply": "spackle.formats.compressed_ply:encode_compressed_ply",
    ".ply": "spackle.formats.ply:encode_ply",
    ".spz": "spackle.formats.spz:encode_spz",
    ".splat": "spackle.formats.scene_files:encode_splat",
    ".sog": "spackle.formats.sog:encode_sog",
    ".glb": "spackle.formats.gltf:encode_glb",
}


def encoder_of(path: Path, more: Mapping[str, Encoder] | None = None) -> Encoder:
    """What encodes a file of this name, of SCENE_ENCODERS and `more`; InputError for a name of no format."""
    encoders: dict[str, str | Encoder] = {**SCENE_ENCODERS, **(more or {})}
    for suffix, encoder in encoders.items():
        if path.name.lower().endswith(suffix):
            if not isinstance(encoder, str):
                return encoder
            module, _, function = encoder.partition(":")
            found: Encoder = getattr(import_module(module), function)
            return found
    raise InputError(f"{path}: which format? Give a name that ends in {', '.join(encoders)}")
