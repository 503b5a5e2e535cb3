"""Read SOG scenes of PlayCanvas, bundled or not, of the versions 1 and 2; `sog.py` writes them."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.core.image_files import open_image
from spackle.core.spherical_harmonics import HARMONICS_COUNTS, degree_of_count
from spackle.formats.gaussian_columns import (
    Floats,
    GaussianColumns,
    colors_of_harmonics,
    harmonics_to_srgb,
)
from spackle.formats.quantization import (
    check_length_factor,
    codes_to_fractions,
    decode_smallest_three,
    fractions_to_components,
)
from spackle.formats.scene_content import DecodedScene, UnsupportedSceneError
from spackle.formats.scene_limits import check_gaussian_count, check_unpacked_bytes
from spackle.formats.sog import (
    CODEBOOK_SIZE,
    FIRST_LARGEST_COMPONENT_CODE,
    LENGTH_FACTOR_KEY,
    MAX_IMAGE_SIDE_PX,
    MAX_PALETTE_ENTRIES,
    MAX_POSITION_CODE,
    META_NAME,
    PALETTE_COLUMNS,
)
from spackle.runtime.errors import short_repr

MAX_META_BYTES = 1 << 22  # of the description, which has some thousands

# A description with so many harmonics has this degree.
DEGREE_OF_HARMONICS = {3: 1, 8: 2, 15: 3}


@dataclasses.dataclass(frozen=True)
class SogFiles:
    """The files of a scene, in a zip archive or in a folder."""

    read: Callable[[str], bytes]  # the content of the file of this name
    stored_bytes: Callable[[str], int]  # its size, compressed as it may be
    byte_count: int = 0  # of all files of the scene; 0 until the description is read

    def with_byte_count(self, meta: Mapping[str, Any]) -> SogFiles:
        """The same files, with the size of all that a description names."""
        names = {META_NAME}
        for part in ("means", "scales", "quats", "sh0", "shN"):
            if meta.get(part) is not None:
                names.update(meta[part]["files"])
        byte_count = sum(self.stored_bytes(name) for name in names)
        return dataclasses.replace(self, byte_count=byte_count)


def read_sog(path: Path) -> DecodedScene:
    """Read a SOG scene: a zip archive, a folder with meta.json and images, or its meta.json.

    Raises:
        UnsupportedSceneError: a zip archive of something else, or an unknown version.
        Exception: any exception, if the scene is damaged.
    """
    with _open_files(path) as files:
        meta = json.loads(files.read(META_NAME))
        _check_meta(meta)
        files = files.with_byte_count(meta)
        # The first version does not name itself, and its number of Gaussians is that of a table.
        version = meta.get("version", 1)
        count = int(meta["count"] if version == 2 else meta["means"]["shape"][0])
        check_gaussian_count(count, 0, files.byte_count)  # harmonics are checked on their own
        # Pixels [N, 4] of each image. A position is in two images: its lower and upper bytes.
        low_bytes, high_bytes = _read_images(files, meta["means"]["files"], count)
        (scale_codes,) = _read_images(files, meta["scales"]["files"], count)
        (rotation_codes,) = _read_images(files, meta["quats"]["files"], count)
        (color_codes,) = _read_images(files, meta["sh0"]["files"], count)
        view_harmonics = None
        if meta.get("shN") is not None:
            view_harmonics = _read_harmonics(files, meta["shN"], count)

    position_codes = high_bytes[:, :3] * np.uint32(256) + low_bytes[:, :3]
    opacities = codes_to_fractions(color_codes[:, 3], 255)
    if version == 2:
        log_scales = _look_up_codes(scale_codes[:, :3], meta["scales"]["codebook"])
        harmonics = _look_up_codes(color_codes[:, :3], meta["sh0"]["codebook"])
    else:
        log_scales = _between_bounds(scale_codes[:, :3], meta["scales"])
        harmonics_and_logit = _between_bounds(color_codes, meta["sh0"])  # [N, 4]
        harmonics = harmonics_and_logit[:, :3]
        with np.errstate(over="ignore"):  # a very negative logit is an opacity of 0
            odds_against = np.exp(-harmonics_and_logit[:, 3])
        opacities = (1 / (1 + odds_against)).astype(np.float32)
    columns = GaussianColumns(
        means=_dequantize_positions(position_codes, meta["means"]["mins"], meta["means"]["maxs"]),
        quats=_decode_rotations(rotation_codes),
        log_scales=log_scales,
        opacities=opacities,
        srgb=colors_of_harmonics(harmonics_to_srgb(harmonics), 0 if view_harmonics is None else 1),
        harmonics=view_harmonics,
    )
    return DecodedScene(
        columns=columns.scaled(1 / _length_factor(meta)),
        format=f"SOG {version}",
        writer=_generator(meta),
        harmonics_degree=_harmonics_degree(meta.get("shN")),
        byte_count=files.byte_count,
    )


def _read_harmonics(files: SogFiles, palette: Mapping[str, Any], count: int) -> Floats | None:
    """Read the coefficients [N, K, 3] of K harmonics; None if there are none.

    Gaussians have a number of a palette's entry, whose coefficients are pixels of an image: K in a
    row for each entry, 64 entries side by side.

    Args:
        files: of the scene.
        palette: the part of a description about harmonics above degree 0.
        count: N.

    Raises:
        ValueError: the image of the palette has another size, or the file is too small for so much.
    """
    centroids_name, labels_name = palette["files"]
    with open_image(io.BytesIO(files.read(centroids_name)), ("WEBP", "PNG")) as image:
        width, height = image.size
    harmonics_count = width // PALETTE_COLUMNS
    if harmonics_count == 0:
        return None
    if harmonics_count not in HARMONICS_COUNTS or width % PALETTE_COLUMNS:
        raise ValueError(f"{centroids_name} is {width} pixels wide: no palette of harmonics")

    check_gaussian_count(count, degree_of_count(harmonics_count), files.byte_count)
    entry_count = PALETTE_COLUMNS * height
    if entry_count > MAX_PALETTE_ENTRIES:
        raise ValueError(f"{centroids_name} has {entry_count:,} entries: too many for a palette")
    (codes,) = _read_images(files, [centroids_name], entry_count * harmonics_count)
    if "codebook" in palette:
        coefficients = _look_up_codes(codes[:, :3], palette["codebook"])
    else:  # version 1 has two bounds for all
        low = np.float32(palette["mins"])
        high = np.float32(palette["maxs"])
        coefficients = low + (high - low) * codes_to_fractions(codes[:, :3], 255)
    (label_codes,) = _read_images(files, [labels_name], count)
    labels = label_codes[:, 1] * np.uint32(256) + label_codes[:, 0]
    if labels.max() >= entry_count:
        raise ValueError(f"entry {labels.max()} of a palette of {entry_count}")
    entries = coefficients.reshape(entry_count, harmonics_count, 3)
    harmonics: Floats = entries[labels]
    return harmonics


def _check_meta(meta: Any) -> None:
    """Raise an UnsupportedSceneError unless a description is that of a SOG scene."""
    if isinstance(meta, dict) and "lodLevels" in meta:
        advice = "give the folder of one level, or the scene from which it was made"
        raise UnsupportedSceneError(f"a streamed SOG scene of several levels: {advice}")
    if not isinstance(meta, dict) or not {"means", "scales", "quats", "sh0"} <= set(meta):
        advice = "give the meta.json beside the images of a SOG scene"
        raise UnsupportedSceneError(f"not the description of a SOG scene: {advice}")
    version = meta.get("version", 1)
    if version not in (1, 2):
        problem = f"SOG version {short_repr(version)} (versions 1 and 2 are read)"
        raise UnsupportedSceneError(f"{problem}: save it as version 2, or as PLY")


def _generator(meta: Mapping[str, Any]) -> str | None:
    """Return the name of the program that wrote a description, if it names itself."""
    asset = meta.get("asset")
    generator = asset.get("generator") if isinstance(asset, dict) else None
    return generator if isinstance(generator, str) else None


def _length_factor(meta: Mapping[str, Any]) -> float:
    """Return by what Spackle multiplied all lengths; 1 for scenes in metres and other programs'.

    Raises:
        ValueError: the number is impossible.
    """
    asset = meta.get("asset")
    stored = asset.get(LENGTH_FACTOR_KEY, 1) if isinstance(asset, dict) else 1
    factor = float(stored)
    check_length_factor(factor)
    return factor


def _harmonics_degree(harmonics: Any) -> int:
    """Return the degree of the spherical harmonics of a scene; 0 if there are none.

    Args:
        harmonics: the part of a description about harmonics above degree 0. Version 2 has the
            degree as "bands", version 1 the shape of a table with 3 numbers for each harmonic.
    """
    if not isinstance(harmonics, dict):
        return 0
    if "bands" in harmonics:
        return int(harmonics["bands"])
    # The first version always has room for the 15 harmonics of degree 3.
    shape = harmonics.get("shape", [0, 45])
    return DEGREE_OF_HARMONICS.get(int(shape[1]) // 3, 3)


@contextlib.contextmanager
def _open_files(path: Path) -> Iterator[SogFiles]:
    """Yield the files of a scene.

    Args:
        path: a zip archive, a folder, or the description in a folder.

    Raises:
        UnsupportedSceneError: a zip archive without a description.
    """
    if path.is_dir() or not zipfile.is_zipfile(path):
        folder = path if path.is_dir() else path.parent
        description = META_NAME if path.is_dir() else path.name

        def sibling(name: str) -> Path:
            """The file of a name; the description may have another one."""
            return _sibling(folder, description if name == META_NAME else name)

        yield SogFiles(
            read=lambda name: _read_sibling(sibling(name)),
            stored_bytes=lambda name: sibling(name).stat().st_size,
        )
        return

    with zipfile.ZipFile(path) as archive:
        # Who zips a folder gets names that begin with the folder's name.
        names = [name for name in archive.namelist() if Path(name).name == META_NAME]
        if not names:
            advice = "unpack it, and give the scene inside"
            raise UnsupportedSceneError(f"a zip archive without the meta.json of a SOG: {advice}")
        prefix = min(names, key=len).removesuffix(META_NAME)
        yield SogFiles(
            read=lambda name: _read_member(archive, prefix + name),
            stored_bytes=lambda name: archive.getinfo(prefix + name).compress_size,
        )


def is_sog_archive(path: Path) -> bool:
    """Return whether a file is a zip archive with the description of a SOG scene."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(Path(name).name == META_NAME for name in archive.namelist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False  # the reader of another format reports the damage


def _sibling(folder: Path, name: str) -> Path:
    """The path of a file in a folder.

    Raises:
        ValueError: the name leads out of the folder, or there is no such file.
    """
    # A description names its images; a hostile one may not reach other files of this machine.
    if Path(name).name != name:
        raise ValueError(f"{short_repr(name)} is not a file beside {META_NAME}")
    path = folder / name
    if not path.is_file():
        raise ValueError(f"there is no {short_repr(name)} beside {META_NAME}")
    return path


def _read_sibling(path: Path) -> bytes:
    """Read a file in a folder; ValueError if it is too large for what it is."""
    _check_file_size(path.name, path.stat().st_size, path.stat().st_size)
    return path.read_bytes()


def _check_file_size(name: str, unpacked_bytes: int, stored_bytes: int) -> None:
    """Raise a ValueError if a file of a scene is too large, before it is decompressed and read."""
    if name.endswith(".json") and unpacked_bytes > MAX_META_BYTES:
        raise ValueError(f"{name} is too large")
    check_unpacked_bytes(name, unpacked_bytes, stored_bytes)


def sog_byte_count(path: Path) -> int:
    """Return the bytes of all files of a SOG scene that is a folder, or a description in one."""
    folder = path if path.is_dir() else path.parent
    files = [file for file in folder.iterdir() if file.suffix in (".json", ".webp")]
    return sum(file.stat().st_size for file in files)


def _read_member(archive: zipfile.ZipFile, name: str) -> bytes:
    """Read a file of an archive; ValueError if it is too large, before it is decompressed."""
    record = archive.getinfo(name)
    _check_file_size(name, record.file_size, record.compress_size)
    return archive.read(name)


def _read_images(files: SogFiles, names: list[str], count: int) -> list[NDArray[np.uint8]]:
    """Read images as pixels [count, 4], without the padding at their ends.

    Raises:
        ValueError: an image is too large, or has fewer than `count` pixels.
    """
    images = []
    for name in names:
        with open_image(io.BytesIO(files.read(name)), ("WEBP", "PNG")) as image:
            pixel_count = image.width * image.height
            check_unpacked_bytes(name, 4 * pixel_count, files.byte_count)  # a byte a channel
            if max(image.size) > MAX_IMAGE_SIDE_PX or not 0 < count <= pixel_count:
                size = f"{image.width}×{image.height}"
                raise ValueError(f"{name} has {size} pixels for {count:,} Gaussians")
            rgba = np.asarray(image.convert("RGBA"))
        images.append(rgba.reshape(-1, 4)[:count])
    return images


def _between_bounds(codes: NDArray[np.uint8], quantity: Mapping[str, Any]) -> Floats:
    """Return values [N, k] of codes [N, k], of which 0 and 255 stand for two bounds.

    Args:
        codes: one row for each Gaussian.
        quantity: has the k lower bounds as "mins", the k upper bounds as "maxs".
    """
    low = np.array(quantity["mins"], np.float32).reshape(codes.shape[1])
    high = np.array(quantity["maxs"], np.float32).reshape(codes.shape[1])
    values: Floats = low + (high - low) * codes_to_fractions(codes, 255)
    return values


def _dequantize_positions(codes: NDArray[np.uint32], low: object, high: object) -> Floats:
    """Return positions [N, 3] from codes; the inverse of `_quantize_positions`.

    Args:
        codes: [N, 3] in 0..65535.
        low, high: lists of the three logarithms to which the codes 0 and 65535 belong.
    """
    low_logs = np.array(low, np.float32).reshape(3)
    high_logs = np.array(high, np.float32).reshape(3)
    fractions = codes_to_fractions(codes, MAX_POSITION_CODE)
    log_positions = low_logs + (high_logs - low_logs) * fractions
    # Broken bounds may give infinite positions, which `GaussianColumns.to_gaussians` refuses.
    with np.errstate(over="ignore"):
        positions: Floats = np.copysign(np.expm1(np.abs(log_positions)), log_positions)
    return positions


def _look_up_codes(codes: NDArray[np.uint8], book: object) -> Floats:
    """Return the values [N, 3] of codes [N, 3] in a codebook, a list of 256 numbers."""
    values: Floats = np.array(book, np.float32).reshape(CODEBOOK_SIZE)
    return values[codes]


def _decode_rotations(rgba: NDArray[np.uint8]) -> Floats:
    """Return unit quaternions [N, 4] (w, x, y, z) from pixels [N, 4].

    Red, green and blue hold the three smaller components, with 0 for -√½ and 255 for √½. Alpha is
    252 plus the index of the largest component.

    Raises:
        ValueError: an alpha does not name a component.
    """
    largest = rgba[:, 3].astype(np.int64) - FIRST_LARGEST_COMPONENT_CODE
    if largest.min() < 0:
        raise ValueError("a rotation has no largest component")
    others = fractions_to_components(codes_to_fractions(rgba[:, :3], 255))
    return decode_smallest_three(largest, others)
