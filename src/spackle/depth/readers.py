"""Read depth maps from files: NumPy, PNG, PFM and EXR, and relative depth from any grey picture.

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
from typing import IO

import numpy as np
from PIL import Image

from spackle.core.image_files import check_pixel_count, read_image
from spackle.depth.calibration import (
    LARGEST_NUMBER,
    Calibration,
    find_calibration,
    read_calibration,
)
from spackle.depth.depth_map import Array, DepthMap, StrPath
from spackle.depth.exr import EXR_MAGIC, read_exr_depth
from spackle.depth.units import (
    KIND_ADVICE,
    RELATIVE_FAR_M,
    RELATIVE_KINDS,
    RELATIVE_NEAR_M,
    DepthKind,
    fills_16_bits,
    metric_depth,
    millimetre_depth,
    relative_depth,
)
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

DEPTH_SUFFIXES = (".npy", ".npz", ".png", ".pfm", ".exr")
MAX_NPY_HEADER_BYTES = 1 << 16  # a damaged header may announce 4 GB of itself
MAX_CHANNEL_DIFFERENCE = 8  # of 255: channels of a grey picture differ by less, even from JPEG

NPY_MAGIC = b"\x93NUM"
ZIP_MAGIC = b"PK\x03\x04"
PNG_MAGIC = b"\x89PNG"
PFM_MAGIC = b"Pf"  # a portable float map with one channel
PFM_COLOUR_MAGIC = b"PF"  # one with three channels


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


def load_depth(
    path: StrPath,
    *,
    focal_px: float | None = None,
    calib: StrPath | None = None,
    kind: DepthKind = "auto",
    near: float = RELATIVE_NEAR_M,
    far: float = RELATIVE_FAR_M,
) -> DepthMap:
    """Read a depth map, a disparity map with its calibration, or a relative map.

    Depth is stored in metres in `.npy`, `.npz` (one array, or the key `depth`), `.pfm` and `.exr`
    (the channel depth, Z, V, Y or R): 0, NaN and inf mean unknown. A 16-bit `.png` stores
    millimetres: 0 and 65535 mean unknown. The content decides the format.

    Disparity d becomes depth = baseline · focal / (d + doffs); inf (in a PNG also 0) means unknown.
    A file holds disparity if `calib` is given, if a `scene.json` in the same folder names the file
    as its `disparity`, or if the file's name starts with "disp" and the same folder has a
    Middlebury `calib.txt`.

    Besides these formats, a relative map may be any grey picture: bright is near (near-white), or
    far (near-black), and the range of its numbers becomes `near` to `far`.

    Args:
        path: the file.
        focal_px: replaces the calibration's focal length, in pixels of the map.
        calib: a Middlebury `calib.txt` or a `scene.json`.
        kind: meaning of the numbers; auto means disparity under the conditions above, else metric,
            never relative.
        near: nearest depth of a relative map, in metres.
        far: farthest depth of a relative map, in metres.

    Raises:
        InputError: the map is missing, broken, too large, misshapen, negative or entirely unknown;
            or `kind` is auto and the map looks relative.
    """
    check_file(path, "depth map")
    if focal_px is not None and not 1 / LARGEST_NUMBER <= focal_px <= LARGEST_NUMBER:
        raise InputError(f"`focal_px` {focal_px:g}: give a focal length above 0, in pixels")
    # What the user says about the numbers counts more than what the folder suggests.
    if kind in RELATIVE_KINDS:
        stored, _ = read_array(path, grey=True)
        return relative_depth(stored, kind, path, near, far)

    calibration = None if kind == "metric" else _calibration_of(Path(path), calib)
    if kind == "disparity" and calibration is None:
        raise InputError(
            f"{path}: its folder has no calibration: give `calib` FILE, or `depth_kind` near-white"
        )
    stored, is_png = read_array(path)
    if calibration is not None:
        if focal_px is not None:
            calibration = dataclasses.replace(calibration, focal_px=focal_px)
        return calibration.depth_from_disparity(stored, path, zero_is_unknown=is_png)

    if not is_png:
        return metric_depth(stored, path)
    # Relative depth in 16 bits looks like millimetres up to 65 m: better ask than be wrong.
    if kind == "auto" and fills_16_bits(stored):
        raise InputError(
            f"{path}: its values fill the range of 16 bits, as relative depth does: {KIND_ADVICE}"
        )
    return millimetre_depth(stored, path)


def _calibration_of(path: Path, calib: StrPath | None) -> Calibration | None:
    """The calibration `calib`, else the one in the map's folder; None if the map holds depth."""
    return find_calibration(path) if calib is None else read_calibration(calib)


def read_array(path: StrPath, *, grey: bool = False) -> tuple[Array, bool]:
    """The stored numbers [H, W] of a depth map, and whether the file is a PNG.

    With `grey`, pictures of other formats are read, too, and three nearly equal channels count as
    one. InputError for an unknown format or a damaged file.
    """
    damaged = "cannot be decoded ({reason}): the file is damaged or cut off"
    with as_input_error(path, damaged), open(path, "rb") as file:
        # The first bytes, not the name: depth maps often have made-up suffixes.
        magic = file.read(4)
        file.seek(0)
        if magic == PNG_MAGIC:
            return read_image(path, lambda image: _grey_values(image, path, grey)), True
        if magic == NPY_MAGIC:
            return _read_npy(file, path), False
        if magic == ZIP_MAGIC:
            return _read_npz(file, path), False
        if magic == EXR_MAGIC:
            return read_exr_depth(file, path), False
        if magic.startswith(PFM_MAGIC):
            return read_image(path, lambda image: np.array(image)), False
        if magic.startswith(PFM_COLOUR_MAGIC):
            raise InputError(
                f"{path}: a PFM with three channels is not a depth map: give one channel (Pf)"
            )

    # Relative maps also come as JPEG or WebP.
    if grey:
        return read_image(path, lambda image: _grey_values(image, path, grey)), False
    raise InputError(
        f"{path}: not a depth map: give .npy, .npz, .pfm or .exr in metres, "
        "or a 16-bit .png in millimetres"
    )


def _check_shape(shape: tuple[int, ...], path: StrPath) -> None:
    """InputError unless an array's shape is [height, width], and of a size that memory holds."""
    # A third axis may be colours or several maps: there is no telling which one is meant.
    if len(shape) != 2 or min(shape) < 1:
        raise InputError(
            f"{path}: an array of shape {shape} is not a depth map: give [height, width]"
        )
    height, width = shape
    check_pixel_count(width, height, os.path.getsize(path), path)


def _grey_values(image: Image.Image, path: StrPath, grey: bool) -> Array:
    """The numbers [H, W] of a picture with one channel: uint8, or uint16 from deeper ones.

    With `grey`, a picture with several channels is taken, too, if they are nearly equal. InputError
    for pictures with colours.
    """
    _check_shape((image.height, image.width), path)
    if image.mode == "L":
        return np.asarray(image)
    # A PNG has at most 16 bits, for which Pillow uses integers of 16 or 32 bits.
    if image.mode.startswith("I"):
        return np.asarray(image).astype(np.uint16)
    if not grey:
        raise InputError(
            f"{path}: a PNG with mode {image.mode} holds no millimetres: {KIND_ADVICE}"
        )

    # A colour map (such as viridis) has no order of brightness from near to far.
    channels = np.asarray(image.convert("RGB")).astype(np.int16)  # [H, W, 3]
    if np.ptp(channels, axis=-1).max() >= MAX_CHANNEL_DIFFERENCE:
        raise InputError(f"{path}: a colour picture does not tell near from far: give a grey one")
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
    _check_shape(shape, path)

    # Only the bytes that the shape needs are read: `frombuffer` fails if the file has fewer.
    count = math.prod(shape)
    content = start.read() + file.read(count * dtype.itemsize)
    values = np.frombuffer(content, dtype, count).reshape(shape, order="F" if is_fortran else "C")
    return np.ascontiguousarray(values, dtype.newbyteorder("="))


def _read_npz(file: IO[bytes], path: StrPath) -> Array:
    """Read the only array of an .npz archive, or the one that is called depth; else InputError."""
    with zipfile.ZipFile(file) as archive:
        names = archive.namelist()
        if "depth.npy" in names:
            name = "depth.npy"
        elif len(names) == 1:
            name = names[0]
        else:
            raise InputError(
                f"{path}: holds {len(names)} arrays and none is called depth: "
                "name one of them depth"
            )
        with archive.open(name) as member:
            return _read_npy(member, path)
