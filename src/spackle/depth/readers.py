"""Read depth maps from files: NumPy, PNG, TIFF, PFM, EXR, and relative depth from grey pictures.

`load_depth` is the entry. The content of a file decides its format (`read_array`); the numbers
become metres in `units`, or in `calibration` for the disparities of stereo pairs.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import zipfile
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from PIL import Image

from spackle.core.array_values import plain_array, without_unit_axes
from spackle.core.image_files import check_pixel_count, read_image
from spackle.core.image_formats import GIT_LFS, UNKNOWN, WEB_PAGE, kind_of_file
from spackle.depth.calibration import (
    LARGEST_NUMBER,
    Calibration,
    find_calibration,
    read_calibration,
)
from spackle.depth.depth_map import Array, DepthMap, StrPath
from spackle.depth.exr import EXR_MAGIC, read_exr_depth
from spackle.depth.units import (
    RELATIVE_FAR_M,
    RELATIVE_KINDS,
    RELATIVE_NEAR_M,
    DepthKind,
    StoredDepth,
    UnclearDepth,
    check_not_relative,
    metric_depth,
    parse_depth_unit,
    relative_depth,
)
from spackle.runtime.errors import InputError, as_input_error, short_repr
from spackle.runtime.files import check_file

DEPTH_SUFFIXES = (".npy", ".npz", ".png", ".pfm", ".exr", ".tif", ".tiff")
MAX_NPY_HEADER_BYTES = 1 << 16  # a damaged header may announce 4 GB of itself
MAX_CHANNEL_DIFFERENCE = 8  # of 255: channels of a grey picture differ by less, even from JPEG
MAX_LISTED_ARRAYS = 4  # of an archive, in a message
NOT_GREY = "a colour picture does not tell near from far: give a grey one"

NPY_MAGIC = b"\x93NUM"
ZIP_MAGIC = b"PK\x03\x04"
PNG_MAGIC = b"\x89PNG"
PFM_MAGIC = b"Pf"  # a portable float map with one channel
PFM_COLOUR_MAGIC = b"PF"  # one with three channels
TIFF_MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # both byte orders, and BigTIFF


def find_depth_file(depth: Path, photo: Path) -> Path:
    """The depth map of a photo: `depth` itself, or the file with the photo's name in that folder.

    InputError if the folder has no such file.
    """
    if not os.path.isdir(depth):
        return depth
    # a.jpg.npy comes before a.npy, because a.npy may belong to a.png.
    for name in (photo.name, photo.stem):
        for suffix in DEPTH_SUFFIXES:
            candidate = depth / f"{name}{suffix}"
            is_photo_itself = candidate.resolve() == photo.resolve()  # a PNG in the same folder
            if os.path.isfile(candidate) and not is_photo_itself:
                return candidate
    names = ", ".join(f"{photo.stem}{suffix}" for suffix in DEPTH_SUFFIXES)
    raise InputError(f"{photo}: no depth map in {depth}: looked for {names}")


@dataclasses.dataclass(frozen=True, eq=False)
class DepthValue:
    """A depth map that a program holds: a PIL picture, an array, a tensor, or nested lists."""

    value: Any  # see `plain_array`
    path: Path = Path("depth")  # what the map is called in messages


def load_depth(
    source: StrPath | DepthValue,
    *,
    focal_px: float | None = None,
    calib: StrPath | None = None,
    kind: DepthKind = "auto",
    unit: str | float | None = None,
    near: float = RELATIVE_NEAR_M,
    far: float = RELATIVE_FAR_M,
) -> DepthMap:
    """Read a depth map, a disparity map with its calibration, or a relative map.

    Depth is stored in metres in `.npy`, `.npz` (one array, or the key `depth`), `.pfm`, `.exr` (the
    channel depth, Z, V, Y or R) and `.tif` of floats: 0, NaN and inf mean unknown. A 16-bit `.png`
    or `.tif` stores millimetres: 0 and 65535 mean unknown. The content decides the format. A `unit`
    replaces metres and millimetres.

    Disparity d becomes depth = baseline · focal / (d + doffs); inf (in a PNG also 0) means unknown.
    A file holds disparity if `calib` is given, if a `scene.json` in the same folder names the file
    as its `disparity`, or if the file's name starts with "disp" and the same folder has a
    Middlebury `calib.txt`.

    Besides these formats, a relative map may be any grey picture: bright is near (near-white), or
    far (near-black), and the range of its numbers becomes `near` to `far`.

    Args:
        source: the file; or a value of a program, whose floats are metres, and which is read like a
            PNG if it is a PIL picture of integers.
        focal_px: replaces the calibration's focal length, in pixels of the map.
        calib: a Middlebury `calib.txt` or a `scene.json`.
        kind: meaning of the numbers; auto means disparity under the conditions above, else metric,
            never relative.
        unit: of metric depth, see `parse_depth_unit`; with it, auto means metric.
        near: nearest depth of a relative map, in metres.
        far: farthest depth of a relative map, in metres.

    Raises:
        UnclearDepth: `kind` is auto, and the map does not look like depth in metres.
        InputError: the map is missing, broken, too large, misshapen, negative or entirely unknown.
    """
    path = source.path if isinstance(source, DepthValue) else Path(source)
    if not isinstance(source, DepthValue):
        check_file(path, "depth map")
    if focal_px is not None and not 1 / LARGEST_NUMBER <= focal_px <= LARGEST_NUMBER:
        raise InputError(f"`focal_px` {focal_px:g}: give a focal length above 0, in pixels")
    depth_unit = None if unit is None else parse_depth_unit(unit)
    if depth_unit is not None and kind not in ("auto", "metric"):
        raise InputError(f"`depth_unit` {unit}: only for metric depth: leave `depth_kind` out")

    # What the user says about the numbers counts more than what the folder suggests.
    if kind in RELATIVE_KINDS:
        return relative_depth(read_stored_depth(source, grey=True), kind, near, far)
    calibration = None
    if kind != "metric" and depth_unit is None:
        calibration = _calibration_of(source, calib)
    if kind == "disparity" and calibration is None:
        raise InputError(
            f"{path}: its folder has no calibration: give `calib` FILE, or `depth_kind` near-white"
        )
    stored = read_stored_depth(source)
    if calibration is not None:
        if focal_px is not None:
            calibration = dataclasses.replace(calibration, focal_px=focal_px)
        numbers = np.where(stored.known, stored.numbers, np.inf)
        return calibration.depth_from_disparity(numbers, path, zero_is_unknown=stored.is_picture)

    if kind == "auto" and depth_unit is None:
        check_not_relative(stored)
    depth = metric_depth(stored, depth_unit)
    # The user has said that the depth is metric, and the format has a usual unit.
    return dataclasses.replace(depth, is_guess=False) if kind == "metric" else depth


def _calibration_of(source: StrPath | DepthValue, calib: StrPath | None) -> Calibration | None:
    """The calibration `calib`, else the one in the map's folder; None if the map holds depth."""
    if calib is not None:
        return read_calibration(calib)
    return None if isinstance(source, DepthValue) else find_calibration(Path(source))


def read_stored_depth(source: StrPath | DepthValue, *, grey: bool = False) -> StoredDepth:
    """The numbers [H, W] of a depth map, as a file or a value stores them.

    With `grey`, pictures of other formats are read, too, and three nearly equal channels count as
    one. InputError for an unknown format, a damaged file, or an array of another shape.
    """
    if isinstance(source, DepthValue):
        return _stored_depth_of_value(source, grey)
    path = Path(source)
    damaged = "cannot be decoded ({reason}): the file is damaged or cut off"
    with as_input_error(path, damaged), open(path, "rb") as file:
        # The first bytes, not the name: depth maps often have made-up suffixes.
        magic = file.read(4)
        file.seek(0)
        if magic == PNG_MAGIC:
            numbers = read_image(path, lambda image: _grey_values(image, path, grey))
            return StoredDepth(numbers, path, is_picture=True)
        if magic == NPY_MAGIC:
            return StoredDepth(_read_npy(file, path), path)
        if magic == ZIP_MAGIC:
            return StoredDepth(_read_npz(file, path), path)
        if magic == EXR_MAGIC:
            return StoredDepth(read_exr_depth(file, path), path)
        if magic.startswith(PFM_MAGIC):
            return StoredDepth(read_image(path, lambda image: np.array(image)), path)
        if magic in TIFF_MAGICS:
            numbers = read_image(path, lambda image: _grey_values(image, path, grey))
            return StoredDepth(numbers, path, is_picture=numbers.dtype.kind in "iu")
        if magic.startswith(PFM_COLOUR_MAGIC):
            raise InputError(
                f"{path}: a PFM with three channels is not a depth map: give one channel (Pf)"
            )

    # Relative maps also come as JPEG or WebP.
    if grey:
        numbers = read_image(path, lambda image: _grey_values(image, path, grey))
        return StoredDepth(numbers, path)
    kind = kind_of_file(path)
    if kind in (GIT_LFS, WEB_PAGE):
        raise InputError(f"{path}: a {kind.name} file, no depth map: {kind.advice}")
    what = "not a depth map" if kind is UNKNOWN else f"a {kind.name} file, no depth map"
    raise InputError(
        f"{path}: {what}: give .npy, .npz, .pfm, .exr or .tif of floats in metres, "
        "or a 16-bit .png or .tif in millimetres"
    )


def _stored_depth_of_value(source: DepthValue, grey: bool) -> StoredDepth:
    """The numbers [H, W] of a map that a program holds, and its mask; see `read_stored_depth`."""
    value = source.value
    path = source.path
    if isinstance(value, Image.Image) and value.mode != "F":  # floats are read as an array
        with as_input_error(path, "the picture cannot be used ({reason}): give another one"):
            return StoredDepth(_grey_values(value, path, grey), path, is_picture=True)

    plain = plain_array(value, path)
    numbers = without_unit_axes(plain.numbers, 2)
    # Relative depth as a picture with three or four channels, as OpenCV reads a grey file. The
    # channels may differ a little, as those of a JPEG do; the fourth is opacity.
    if grey and numbers.ndim == 3 and numbers.shape[-1] in (3, 4):
        channels = numbers[..., :3].astype(np.float64)
        largest = np.abs(channels).max(initial=0)
        largest_difference = np.ptp(channels, axis=-1).max(initial=0)
        if largest_difference > MAX_CHANNEL_DIFFERENCE / 255 * largest:
            raise InputError(f"{path}: {NOT_GREY}")
        numbers = numbers[..., 1]
    _check_shape(numbers.shape, path, file_bytes=None)
    mask = None if plain.known is None else without_unit_axes(plain.known, 2)
    if mask is not None and mask.shape != numbers.shape:  # of a picture with channels
        mask = np.asarray(mask.all(axis=-1))
    return StoredDepth(numbers, path, mask=mask)


def _check_shape(shape: tuple[int, ...], path: StrPath, file_bytes: int | None) -> None:
    """InputError unless an array's shape is [height, width], and of a size that memory holds.

    `file_bytes` is the size of its file; None for a value of a program.
    """
    # A third axis may be colours or several maps: there is no telling which one is meant.
    if len(shape) != 2 or min(shape) < 1:
        raise InputError(
            f"{path}: an array of shape {short_repr(shape)} is not a depth map: "
            "give [height, width]"
        )
    height, width = shape
    check_pixel_count(width, height, file_bytes, path)


def _grey_values(image: Image.Image, path: StrPath, grey: bool) -> Array:
    """The numbers [H, W] of a picture with one channel: uint8, uint16 from deeper ones, or floats.

    With `grey`, a picture with several channels is taken, too, if they are nearly equal. InputError
    for pictures with colours.
    """
    if min(image.size) < 1:
        raise InputError(f"{path}: a picture without pixels: give another one")
    check_pixel_count(image.width, image.height, None, path)
    if image.mode in ("L", "F"):  # 8 bits, or floats of 32 bits
        return np.asarray(image)
    # A PNG has at most 16 bits, for which Pillow uses integers of 16 or 32 bits. A picture that a
    # program made may hold larger ones.
    if image.mode.startswith("I"):
        numbers = np.asarray(image)
        fits_16_bits = numbers.min() >= 0 and numbers.max() <= np.iinfo(np.uint16).max
        if fits_16_bits:
            return numbers.astype(np.uint16)
        return numbers.astype(numbers.dtype.newbyteorder("="))  # the byte order of this machine

    # A colour map (such as viridis) has no order of brightness from near to far.
    channels = np.asarray(image.convert("RGB")).astype(np.int16)  # [H, W, 3]
    if np.ptp(channels, axis=-1).max() >= MAX_CHANNEL_DIFFERENCE:
        raise InputError(f"{path}: {NOT_GREY}")
    if not grey:
        raise UnclearDepth.of(f"{path}: a picture with mode {image.mode} holds no millimetres")
    return channels[..., 1].astype(np.uint8)  # JPEG keeps green best


def _read_npy(file: IO[bytes], path: StrPath) -> Array:
    """Read one array [H, W] of NumPy's format from an open file, which holds no pickled objects.

    InputError for objects, and if the shape that the header states is not that of a depth map.
    """
    # The header is read from a bounded copy, because NumPy trusts the length that it states.
    start = io.BytesIO(file.read(MAX_NPY_HEADER_BYTES))
    if np.lib.format.read_magic(start) == (1, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(start)
    else:
        shape, is_fortran, dtype = np.lib.format.read_array_header_2_0(start)
    if dtype.kind not in "fiu":
        raise InputError(f"{path}: an array of {dtype} is not a depth map: give float32 metres")
    # A network's output may have further axes of length 1. What remains without them is seen from
    # an array of this shape that takes no memory, because all its elements are the same 0.
    map_shape = without_unit_axes(np.broadcast_to(0, shape), 2).shape
    _check_shape(map_shape, path, os.path.getsize(path))

    # Only the bytes that the shape needs are read: `frombuffer` fails if the file has fewer.
    count = math.prod(shape)
    content = start.read() + file.read(count * dtype.itemsize)
    order: Literal["F", "C"] = "F" if is_fortran else "C"  # columns or rows come first
    values = np.frombuffer(content, dtype, count).reshape(shape, order=order)
    values = values.reshape(map_shape)
    # The byte order of this machine.
    return np.ascontiguousarray(values, dtype.newbyteorder("="))


def _read_npz(file: IO[bytes], path: StrPath) -> Array:
    """Read the only array of an .npz archive, or the one that is called depth; else InputError."""
    with zipfile.ZipFile(file) as archive:
        names = [name for name in archive.namelist() if name.endswith(".npy")]
        if not names:  # PyTorch's files and those of offices are ZIP archives, too
            raise InputError(
                f"{path}: a ZIP archive without arrays of NumPy: save the depth by numpy.save"
            )
        if "depth.npy" in names:
            name = "depth.npy"
        elif len(names) == 1:
            name = names[0]
        else:
            listed = ", ".join(name.removesuffix(".npy") for name in names[:MAX_LISTED_ARRAYS])
            raise InputError(
                f"{path}: holds {len(names)} arrays ({short_repr(listed)}) and none is called "
                "depth: name one of them depth"
            )
        with archive.open(name) as member:
            return _read_npy(member, path)
