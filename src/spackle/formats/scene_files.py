"""The table of scene formats, and the functions that pick the format of a file.

To add a format: write a file with its encoder and its decoder, and add a line to the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from spackle.formats.compressed_ply import encode_compressed_ply
from spackle.formats.gaussian_columns import GaussianColumns
from spackle.formats.gltf import encode_glb
from spackle.formats.ply import PlyFile, encode_ply
from spackle.formats.scene_content import SceneFile
from spackle.formats.sog import decode_sog, encode_sog
from spackle.formats.splat import decode_splat, encode_splat
from spackle.formats.spz import decode_spz, encode_spz
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

Encoder = Callable[[SceneFile], bytes]
Decoder = Callable[[bytes], GaussianColumns]

# The first suffix that ends a file's name counts, so ".compressed.ply" stands before ".ply".
SCENE_ENCODERS: dict[str, Encoder] = {
    ".compressed.ply": encode_compressed_ply,
    ".ply": encode_ply,
    ".spz": encode_spz,
    ".splat": encode_splat,
    ".sog": encode_sog,
    ".glb": encode_glb,
}

# `PlyFile` reads .ply and .compressed.ply, because it also finds the camera of a scene.
SCENE_DECODERS: dict[str, Decoder] = {
    ".spz": decode_spz,
    ".splat": decode_splat,
    ".sog": decode_sog,
}

READABLE_SUFFIXES = (".ply", *SCENE_DECODERS)
WRITE_ONLY_SUFFIXES = (".glb", ".html")

# The first bytes of a file of each format; a .splat file begins with its first Gaussian.
SIGNATURES = {b"ply": ".ply", b"\x1f\x8b": ".spz", b"PK": ".sog"}


def scene_suffix(path: Path) -> str | None:
    """Return the suffix of a scene file's format, such as ".spz"; None if it is no scene.

    The file's first bytes decide; for a format without a signature, the file's name.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    check_file(path, "scene")
    with open(path, "rb") as file:
        first_bytes = file.read(4)  # the longest signature has three bytes
    for signature, suffix in SIGNATURES.items():
        if first_bytes.startswith(signature):
            return suffix
    for suffix in (*READABLE_SUFFIXES, *WRITE_ONLY_SUFFIXES):
        if path.name.lower().endswith(suffix):
            return suffix
    return None


def load_scene(path: Path) -> SceneFile:
    """Read a scene in any format of READABLE_SUFFIXES.

    Raises:
        InputError: the file has another format, or is damaged.
    """
    suffix = scene_suffix(path)
    if suffix in WRITE_ONLY_SUFFIXES:
        advice = "give the scene.ply from which the file was exported"
        raise InputError(f"{path}: {suffix} files cannot be read: {advice}")

    # A file of an unknown format is read as a PLY, so that the message says what a PLY needs.
    if suffix not in SCENE_DECODERS:
        return PlyFile(path).scene()

    advice = "the file is damaged, or from another program"
    with as_input_error(path, f"cannot be read as {suffix}: {{reason}}: {advice}"):
        columns = SCENE_DECODERS[suffix](path.read_bytes())
        if len(columns.means) == 0:
            raise ValueError("it holds no Gaussians")
        return SceneFile(path, columns.to_gaussians())


def encoder_for(path: Path, more_encoders: Mapping[str, Encoder] | None = None) -> Encoder:
    """Return the encoder for the suffix of a file's name.

    Args:
        path: the name of the file to write; the file need not exist.
        more_encoders: encoders by suffix, beside those of SCENE_ENCODERS.

    Raises:
        InputError: no encoder has the suffix.
    """
    encoders = dict(SCENE_ENCODERS)
    if more_encoders is not None:
        encoders.update(more_encoders)
    for suffix, encoder in encoders.items():
        if path.name.lower().endswith(suffix):
            return encoder
    raise InputError(f"{path}: which format? Give a name that ends in {', '.join(encoders)}")
