"""The content of scene files, and the table of formats."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

Floats = NDArray[np.float32]

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)
SMALLEST_SCALE, LARGEST_SCALE = (
    1e-37,
    1e37,
)  # bounds that keep a scale and its logarithm finite in float32
_FLIP = np.array([1, 1, -1, -1], np.float32)
SMALLEST_QUAT = 1e-12  # a shorter quaternion has no direction


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """The content of a scene file; most formats store only Gaussians."""

    path: Path
    gaussians: Gaussians
    camera: Camera | None = None  # the photo's
    base_count: int | None = None
    disparity: float | None = None  # the disparity for which the scene was completed
    harmonics: int = 0  # number of coefficients above degree 0 of each Gaussian, which are not read

    @property
    def untilted_camera(self) -> Camera | None:
        """The camera if it is `is_at_origin`, else None, because a PLY's comment stores no pose."""
        return self.camera if self.camera is not None and is_at_origin(self.camera) else None


def is_at_origin(camera: Camera) -> bool:
    """Whether a camera is at the world's origin and looks along z."""
    return torch.equal(camera.world_to_camera, torch.eye(4).to(camera.world_to_camera))


@dataclasses.dataclass(frozen=True)
class GaussianColumns:
    """N Gaussians as float32 NumPy columns, in the units that file formats share."""

    means: Floats  # [N, 3]
    quats: Floats  # [N, 4] unit length, wxyz
    log_scales: Floats  # [N, 3] natural logarithms of standard deviations
    opacities: Floats  # [N] in 0..1
    srgb: Floats  # [N, 3] in 0..1

    @staticmethod
    @torch.no_grad()
    def of(gaussians: Gaussians) -> GaussianColumns:
        """Convert a scene; colours are clamped to 0..1, and quaternions of length 0 become (1, 0, 0, 0).

        ValueError if a Gaussian is not finite.
        """
        means, quats, scales, opacities, colors = (
            t.detach().to("cpu", torch.float32) for t in gaussians.tensors
        )
        for name, tensor in zip(
            vars(gaussians), (means, quats, scales.clamp(-1, 1), opacities, colors), strict=True
        ):
            if not torch.isfinite(tensor).all():  # infinite scales are clamped below
                raise ValueError(f"{name} of these Gaussians are not all finite")
        quats = quats / quats.abs().amax(-1, keepdim=True).clamp_min(
            1.0
        )  # their squares may overflow
        norm = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
        unit = torch.where(
            norm < SMALLEST_QUAT,
            torch.tensor([1.0, 0, 0, 0]),
            quats / norm.clamp_min(SMALLEST_QUAT),
        )
        # NumPy's logarithm, because torch would start threads for every block of a PLY.
        log_scales = np.log(np.clip(scales.numpy(), SMALLEST_SCALE, LARGEST_SCALE))
        srgb = linear_to_srgb(colors).numpy()
        return GaussianColumns(
            means.numpy(), unit.numpy(), log_scales, opacities.clamp(0, 1).numpy(), srgb
        )

    def gaussians(self) -> Gaussians:
        """Convert to Gaussians; ValueError if a Gaussian is not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            columns = self.means, self.quats, np.exp(self.log_scales), self.opacities, self.srgb
        count = len(self.means)
        finite = np.all(
            [np.isfinite(column.reshape(count, -1)).all(axis=1) for column in columns], axis=0
        )
        if broken := count - np.count_nonzero(finite):
            raise ValueError(f"{broken} of {count} Gaussians are not finite")
        means, quats, scales, opacities, srgb = (
            torch.from_numpy(np.array(column, np.float32)) for column in columns
        )
        return Gaussians(means, quats, scales, opacities, srgb_to_linear(srgb))

    @property
    def harmonics(self) -> Floats:
        """[N, 3] coefficients of the constant spherical harmonic that give the sRGB colours."""
        return (self.srgb - np.float32(0.5)) / np.float32(SH_C0)

    def flipped(self) -> GaussianColumns:
        """Rotate the scene by 180° about x, so that y points up and z backward, as in OpenGL and glTF."""
        means, quats = self.means * _FLIP[1:], self.quats * _FLIP
        return dataclasses.replace(self, means=means, quats=quats)

    def select(self, rows: NDArray[np.int64] | slice) -> GaussianColumns:
        """The Gaussians that an index array or a slice selects."""
        return GaussianColumns(
            *(getattr(self, field.name)[rows] for field in dataclasses.fields(self))
        )


OTHERS = np.array(
    [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]
)  # row k: a quaternion's components other than k


def encode_smallest_three(quats: Floats) -> tuple[NDArray[np.int64], Floats]:
    """The index [N] of the largest component of unit quaternions [N, 4], and the other components [N, 3], in order.

    Quaternions are negated if their largest component is negative, which does not change the rotation. The largest
    component then follows from the other three, which are at most √½.
    """
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(
        np.take_along_axis(quats, largest[:, None], axis=1) < 0, np.float32(-1), np.float32(1)
    )
    return largest, np.take_along_axis(quats * sign, OTHERS[largest], axis=1)


def decode_smallest_three(largest: NDArray[Any], others: Floats) -> Floats:
    """The inverse of `encode_smallest_three`: unit quaternions [N, 4]."""
    quats = np.empty((len(others), 4), np.float32)
    np.put_along_axis(quats, OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.maximum(0, 1 - np.square(others).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return quats


def components_to_fractions(components: Floats) -> Floats:
    """Components of `encode_smallest_three` as fractions 0..1 of their range."""
    shares: Floats = np.clip(components * np.float32(0.5**0.5) + np.float32(0.5), 0, 1)
    return shares


def fractions_to_components(shares: Floats) -> Floats:
    """The inverse of `components_to_fractions`."""
    return (shares - np.float32(0.5)) * np.float32(2**0.5)


def codes_to_fractions(codes: NDArray[Any], largest: int) -> Floats:
    """Integers from 0 to `largest` as floats in 0..1."""
    return codes.astype(np.float32) / np.float32(largest)


SPLAT_ROW = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
)


def encode_splat(scene: SceneFile) -> bytes:
    """Encode a scene as a .splat file of antimatter15's viewer, with 32 bytes per Gaussian; order and axes are kept.

    Colours, opacities and rotations are rounded to bytes. ValueError if a Gaussian is not finite.
    """
    columns = GaussianColumns.of(scene.gaussians)
    rows = np.empty(len(scene.gaussians), SPLAT_ROW)
    rows["means"], rows["scales"] = columns.means, np.exp(columns.log_scales)
    rows["rgba"] = np.round(
        np.concatenate([columns.srgb, columns.opacities[:, None]], axis=1) * 255
    )
    rows["quats"] = np.clip(np.round(columns.quats * 128 + 128), 0, 255)
    return rows.tobytes()


def decode_splat(data: bytes) -> GaussianColumns:
    """Decode a .splat file; ValueError if it ends within a Gaussian."""
    rows = np.frombuffer(data, SPLAT_ROW)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(np.clip(rows["scales"], SMALLEST_SCALE, LARGEST_SCALE))
    rgba = codes_to_fractions(rows["rgba"], 255)
    return GaussianColumns(
        rows["means"],
        codes_to_fractions(rows["quats"], 128) - 1,
        log_scales,
        rgba[:, 3],
        rgba[:, :3],
    )


Encoder = Callable[[SceneFile], bytes]
# Module and function that encode each format; the first suffix that matches a file name counts.
SCENE_ENCODERS = {
    ".compressed.ply": "spackle.formats.compressed_ply:encode_compressed_ply",
    ".ply": "spackle.formats.ply:encode_ply",
    ".spz": "spackle.formats.spz:encode_spz",
    ".splat": "spackle.formats.scene_files:encode_splat",
    ".sog": "spackle.formats.sog:encode_sog",
    ".glb": "spackle.formats.gltf:encode_glb",
}

# Module and function that decode each format; `PlyFile` reads .ply and .compressed.ply.
SCENE_DECODERS = {
    ".spz": "spackle.formats.spz:decode_spz",
    ".splat": "spackle.formats.scene_files:decode_splat",
    ".sog": "spackle.formats.sog:decode_sog",
}
SCENE_SUFFIXES = (".ply", *SCENE_DECODERS)
STARTS = {b"ply": ".ply", b"\x1f\x8b": ".spz", b"PK": ".sog"}  # a .splat has no signature
WRITTEN_ONLY = (".glb", ".html")  # formats that Spackle writes and does not read


def scene_suffix(path: Path) -> str | None:
    """The suffix of a scene's format, by the file's first bytes, else by its name; None if the file is no scene."""
    check_file(path, "scene")
    with open(path, "rb") as file:
        start = file.read(4)
    begun = next((suffix for magic, suffix in STARTS.items() if start.startswith(magic)), None)
    return begun or next(
        (end for end in (*SCENE_SUFFIXES, *WRITTEN_ONLY) if path.name.lower().endswith(end)), None
    )


def load_scene(path: Path) -> SceneFile:
    """Read a scene in any format of SCENE_SUFFIXES; InputError if the file has another format or is damaged."""
    kind = scene_suffix(path)
    if kind in WRITTEN_ONLY:
        raise InputError(
            f"{path}: {kind} files cannot be read: give the scene.ply from which the file was exported"
        )
    if kind not in SCENE_DECODERS:
        ply: SceneFile = import_module("spackle.formats.ply").PlyFile(path).scene()
        return ply
    with as_input_error(
        path, f"cannot be read as {kind}: {{reason}}: the file is damaged, or from another program"
    ):
        columns = function_named(SCENE_DECODERS[kind])(path.read_bytes())
        if not len(columns.means):
            raise ValueError("it holds no Gaussians")
        return SceneFile(path, columns.gaussians())


def function_named(name: str) -> Any:
    """Import the function "module:function"."""
    module, _, function = name.partition(":")
    return getattr(import_module(module), function)


def encoder_for(path: Path, more: Mapping[str, Encoder] | None = None) -> Encoder:
    """The encoder for a file name's suffix, from SCENE_ENCODERS and `more`; InputError for an unknown suffix."""
    encoders: dict[str, str | Encoder] = {**SCENE_ENCODERS, **(more or {})}
    for suffix, encoder in encoders.items():
        if path.name.lower().endswith(suffix):
            found: Encoder = function_named(encoder) if isinstance(encoder, str) else encoder
            return found
    raise InputError(f"{path}: which format? Give a name that ends in {', '.join(encoders)}")
