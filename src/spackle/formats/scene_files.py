"""The tables of scene formats, and the functions that pick the format of a file.

To add a format: write a file with its encoder and its reader, and add a line to the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from spackle.formats.compressed_ply import encode_compressed_ply
from spackle.formats.gltf import encode_glb
from spackle.formats.gltf_reader import read_gltf
from spackle.formats.ply import PlyFile, encode_ply
from spackle.formats.scene_content import (
    DecodedScene,
    SceneFile,
    UnsupportedSceneError,
    left_out_note,
)
from spackle.formats.scene_limits import check_gaussian_count
from spackle.formats.sog import META_NAME, encode_sog
from spackle.formats.sog_reader import is_sog_archive, read_sog, sog_byte_count
from spackle.formats.splat import decode_splat, encode_splat
from spackle.formats.spz import decode_spz, encode_spz, encode_spz_4
from spackle.runtime.errors import InputError, as_input_error, printable_line, unknown_suffix
from spackle.runtime.files import check_file

Encoder = Callable[[SceneFile], bytes]
SceneReader = Callable[[Path], DecodedScene]

# The first suffix that ends a file's name counts, so ".compressed.ply" stands before ".ply".
SCENE_ENCODERS: dict[str, Encoder] = {
    ".compressed.ply": encode_compressed_ply,
    ".ply": encode_ply,
    ".v4.spz": encode_spz_4,
    ".spz": encode_spz,
    ".splat": encode_splat,
    ".sog": encode_sog,
    ".glb": encode_glb,
}

# `PlyFile` reads .ply and .compressed.ply, because it also finds the camera of a scene.
SCENE_READERS: dict[str, SceneReader] = {
    ".spz": lambda path: decode_spz(path.read_bytes()),
    ".splat": lambda path: decode_splat(path.read_bytes()),
    ".sog": read_sog,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}

READABLE_SUFFIXES = (".ply", *SCENE_READERS)

# Formats that are known but not read, and what to do.
EXPORT_AGAIN = "give the scene.ply from which the page was made"
CONVERT = "convert it, for example with PlayCanvas's tool: `splat-transform {name} scene.ply`"
SAVE_AS_PLY = "save the scene as PLY in the program that wrote it"
NO_GAUSSIANS = (
    "a mesh or a cloud of points, which has no Gaussians: give a scene of Gaussians, such as a PLY "
    "of 3DGS"
)
UNREAD_SUFFIXES = {
    ".html": EXPORT_AGAIN,
    ".ksplat": CONVERT,  # of three.js
    ".lcc": CONVERT,  # of XGRIDS
    ".lcc2": CONVERT,
    ".splatv": SAVE_AS_PLY,
    ".spx": SAVE_AS_PLY,
    ".rad": SAVE_AS_PLY,
    ".usd": SAVE_AS_PLY,
    ".usda": SAVE_AS_PLY,
    ".usdc": SAVE_AS_PLY,
    ".usdz": SAVE_AS_PLY,
    ".ssproj": "export the scene from SuperSplat as PLY",
    ".ckpt": "export it first: `ns-export gaussian-splat` of nerfstudio writes a PLY",
    **dict.fromkeys(
        (".obj", ".fbx", ".stl", ".dae", ".las", ".laz", ".pcd", ".xyz", ".e57"), NO_GAUSSIANS
    ),
}

# The first bytes of a file of each format; a .splat file begins with its first Gaussian.
SIGNATURES = {
    b"ply": ".ply",
    b"\x1f\x8b": ".spz",
    b"NGSP": ".spz",
    b"glTF": ".glb",
}

# Many formats are zip archives; only the names of the files within tell a SOG scene from others.
ZIP_SIGNATURE = b"PK"
ARCHIVE_SUFFIXES = (".sogs", ".zip")

MAX_WRITER_LENGTH = 80  # characters of a program's name that are shown


def scene_suffix(path: Path) -> str | None:
    """Return the suffix of a scene file's format, such as ".spz"; None if it is no scene.

    The file's first bytes decide; for a format without a signature, the file's name. A folder
    counts as a SOG scene if it has the description of one, meta.json.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    if is_scene_folder(path):
        return ".sog"
    check_file(path, "scene")
    name = path.name.lower()
    if name.endswith(META_NAME):  # also lod-meta.json, which is refused with a message
        return ".sog"
    # Of the formats that are not read, some begin like others that are.
    for suffix in UNREAD_SUFFIXES:
        if name.endswith(suffix):
            return suffix

    with open(path, "rb") as file:
        first_bytes = file.read(4)  # the longest signature
    for signature, suffix in SIGNATURES.items():
        if first_bytes.startswith(signature):
            return suffix
    if first_bytes.startswith(ZIP_SIGNATURE) and is_sog_archive(path):
        return ".sog"
    for suffix in (*READABLE_SUFFIXES, *ARCHIVE_SUFFIXES):
        if name.endswith(suffix):
            return ".sog" if suffix in ARCHIVE_SUFFIXES else suffix
    return None


def is_scene_folder(path: Path) -> bool:
    """Return whether a path is a folder with an unbundled SOG scene.

    InputError for the folder of a training of 3DGS, which names the scene in it.
    """
    trained_scene = _trained_scene(path)
    if trained_scene is not None:
        raise InputError(f"{path}: the folder of a training: give its scene, {trained_scene}")
    return (path / META_NAME).is_file()


def _trained_scene(folder: Path) -> Path | None:
    """The newest scene in the folder of a training of 3DGS; None if it is no such folder."""
    scenes = [*folder.glob("point_cloud/iteration_*/point_cloud.ply")]
    scenes += folder.glob("iteration_*/point_cloud.ply")

    def iteration(scene: Path) -> int:
        """The number of training steps after which a scene was saved."""
        number = scene.parent.name.removeprefix("iteration_")
        return int(number) if number.isdecimal() else 0

    return max(scenes, key=iteration, default=None)


def load_scene(path: Path) -> SceneFile:
    """Read a scene in any format of READABLE_SUFFIXES.

    Raises:
        InputError: the file has another format, or is damaged.
    """
    suffix = scene_suffix(path)
    if suffix in UNREAD_SUFFIXES:
        advice = UNREAD_SUFFIXES[suffix].format(name=path.name)
        raise InputError(f"{path}: {suffix} files cannot be read: {advice}")

    # A file of an unknown format is read as a PLY, so that the message says what a PLY needs.
    if suffix not in SCENE_READERS:
        return PlyFile(path).scene()

    advice = "the file is damaged, or from another program"
    with as_input_error(path, f"cannot be read as {suffix}: {{reason}}: {advice}"):
        try:
            decoded = SCENE_READERS[suffix](path)
        except UnsupportedSceneError as error:  # a sound file, which must not be called damaged
            raise InputError(f"{path}: {error}") from error
        except InputError as error:  # the reader does not know the file's name
            raise InputError(f"{path}: {error}") from error
        count = len(decoded.columns.means)
        if count == 0:
            raise ValueError("it holds no Gaussians")
        # The readers of packed formats have asked before they unpacked; this holds for all.
        byte_count = decoded.byte_count or path.stat().st_size
        check_gaussian_count(count, decoded.columns.harmonics_degree, byte_count)
        gaussians = decoded.columns.to_gaussians()

    notes = decoded.notes
    broken_count = len(decoded.columns.means) - len(gaussians)
    if broken_count:
        notes = (*notes, left_out_note(broken_count))

    is_unbundled_sog = path.is_dir() or path.name.lower().endswith(META_NAME)
    writer = decoded.writer
    return SceneFile(
        path=path,
        gaussians=gaussians,
        camera=decoded.camera,
        base_count=decoded.base_count,
        format=decoded.format,
        writer=None if writer is None else printable_line(writer)[:MAX_WRITER_LENGTH],
        harmonics_degree=decoded.harmonics_degree,
        notes=notes,
        byte_count=sog_byte_count(path) if is_unbundled_sog else path.stat().st_size,
    )


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
    raise unknown_suffix(path, "which format", [*encoders])
