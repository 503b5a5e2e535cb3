"""COLMAP's models, text or binary: the lenses, the poses of the photos, and the points.

A model is a sparse reconstruction in three files: cameras (lenses), images (a pose for each
photo, and where the photo sees points) and points3D. A generator reads the records of each file.
Newer versions of COLMAP write rigs and frames besides, which are not needed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import quat_to_matrix
from spackle.formats.camera_files import MAX_CAMERA_NUMBER, checked_camera
from spackle.runtime.errors import InputError, as_input_error

Array = NDArray[Any]

MIN_QUATERNION_NORM = 1e-6

# Where the model of a scene lies; those in dense/ are from COLMAP's undistorter.
MODEL_FOLDERS = ("sparse/0", "sparse", "dense/sparse/0", "dense/sparse")
DAMAGED = "not a COLMAP file ({reason}): the file is missing, damaged or cut off"


class LensModel(NamedTuple):
    """A kind of lens in COLMAP."""

    name: str
    parameter_count: int


# By COLMAP's number of the lens model; others are too far from a pinhole.
LENS_MODELS = {
    0: LensModel("SIMPLE_PINHOLE", 3),
    1: LensModel("PINHOLE", 4),
    2: LensModel("SIMPLE_RADIAL", 4),
    3: LensModel("RADIAL", 5),
    4: LensModel("OPENCV", 8),
    6: LensModel("FULL_OPENCV", 12),
}
# Names of the models that are refused, by number: fisheyes, except for FOV.
OTHER_MODELS = {
    5: "OPENCV_FISHEYE",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
}
# Lens models with one focal length; the others have fx and fy.
SINGLE_FOCAL_MODELS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

MAX_REPROJECTION_ERROR_PX = 2.0  # of a point, as mean over photos
MAX_EXACT_INTEGER = 2**53  # the largest id that float64 holds exactly

# Where a photo sees a point; the id -1 means that the position belongs to no point.
OBSERVATION_DTYPE = np.dtype([("uv", "<f8", (2,)), ("id", "<i8")])


class CameraRecord(NamedTuple):
    """A lens in the file of cameras."""

    key: int
    model: int | str  # a key of `LENS_MODELS` in binary files, its name in text files
    width: int
    height: int
    parameters: list[float]


class ImageRecord(NamedTuple):
    """A photo in the file of images."""

    pose: list[float]  # world-to-camera: a quaternion wxyz, and a translation
    camera_key: int
    name: str
    observations: Array  # [n] of `OBSERVATION_DTYPE`


class PointRecord(NamedTuple):
    """A point in the file of points."""

    key: float
    x: float
    y: float
    z: float
    error_px: float  # mean reprojection error


def find_model(scene: Path, folders: tuple[str, ...] = MODEL_FOLDERS) -> Path | None:
    """Return the first of some folders within a scene's that has a model; None if none has."""
    for name in folders:
        folder = scene / name
        if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
            return folder
    return None


def model_folder(scene: Path) -> Path:
    """The folder of a scene's model: sparse/0 or sparse, in the scene or in dense/.

    Raises:
        InputError: none of these has a file of cameras.
    """
    folder = find_model(scene)
    if folder is not None:
        return folder
    raise InputError(
        f"{scene / 'sparse/0'}: no COLMAP model: expected cameras, images, points3D as .bin or .txt"
    )


class Lens(NamedTuple):
    """A lens of a model."""

    camera: Camera  # a float64 pinhole at the world's origin
    # k1, k2, p1, p2, k3, k4, k5, k6; the list may end earlier, the others are 0.
    distortion: list[float]


def read_lenses(folder: Path) -> dict[int, Lens]:
    """Read the lenses of a model's folder, by COLMAP's keys of them.

    Files are binary if there is a cameras.bin, else text.

    Raises:
        InputError: the file is missing or damaged, or a lens is no pinhole with some distortion.
    """
    is_binary = is_binary_model(folder)
    path = folder / f"cameras{'.bin' if is_binary else '.txt'}"
    with as_input_error(path, DAMAGED):
        records = _cameras_bin(path) if is_binary else _cameras_txt(path)
        return {record.key: _lens_of_record(path, record) for record in records}


def read_images(folder: Path) -> Iterator[ImageRecord]:
    """Yield the photos of a model's folder, in the file's order.

    Raises:
        Exception: any exception, if the file is missing or damaged.
    """
    path = images_path(folder)
    yield from _images_bin(path) if is_binary_model(folder) else _images_txt(path)


def is_binary_model(folder: Path) -> bool:
    """Return whether a model's files are binary, and not text."""
    return (folder / "cameras.bin").is_file()


def images_path(folder: Path) -> Path:
    """Return the file of a model's photos."""
    return folder / f"images{'.bin' if is_binary_model(folder) else '.txt'}"


def points_path(folder: Path) -> Path:
    """Return the file of a model's points."""
    return folder / f"points3D{'.bin' if is_binary_model(folder) else '.txt'}"


def read_points(folder: Path) -> tuple[Array, Array]:
    """Read the reliable points of a model's folder: those with a small reprojection error.

    Returns:
        ids: [m] int64, ascending and without repetitions.
        xyz: [m, 3] float64 positions in the world.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = points_path(folder)
    with as_input_error(path, DAMAGED):
        return _reliable_points(_points_bin(path) if is_binary_model(folder) else _points_txt(path))


def _reliable_points(records: Iterator[PointRecord]) -> tuple[Array, Array]:
    """The points of a model with a small reprojection error.

    Returns:
        ids: [m] int64, ascending and without repetitions.
        xyz: [m, 3] float64 positions in the world.
    """
    rows = [record for record in records if record.error_px <= MAX_REPROJECTION_ERROR_PX]
    table = np.array(rows, np.float64).reshape(-1, 5)  # key, x, y, z, error

    # Beyond these limits for id, x, y and z a file is damaged: float64 does not hold the id
    # exactly, or no camera is that far away.
    limits = [MAX_EXACT_INTEGER, MAX_CAMERA_NUMBER, MAX_CAMERA_NUMBER, MAX_CAMERA_NUMBER]
    table = table[(np.abs(table[:, :4]) <= limits).all(axis=1)]

    ids, first_rows = np.unique(table[:, 0], return_index=True)
    return ids.astype(np.int64), table[first_rows, 1:4]


def _lens_of_record(path: Path, record: CameraRecord) -> Lens:
    """Return the lens of a record; `path` is the file, for messages.

    Raises:
        InputError: the lens model is no pinhole with some distortion, or it is impossible.
    """
    model = _lens_model(record.model)
    if model is None or len(record.parameters) != model.parameter_count:
        name = record.model
        if isinstance(name, int):
            name = OTHER_MODELS.get(name, str(name))
        raise InputError(
            f"{path}: camera model {name} is not a pinhole: undistort the photos with COLMAP first"
        )

    # Models with one focal length have f, cx, cy; the others fx, fy, cx, cy. Then comes distortion.
    parameters = record.parameters
    if model.name in SINGLE_FOCAL_MODELS:
        parameters = [parameters[0], *parameters]  # fx and fy are the same
    fx, fy, cx, cy, *distortion = parameters

    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    at_origin = torch.eye(4, dtype=torch.float64)
    camera = checked_camera(
        K, at_origin, record.width, record.height, f"{path}: a lens", dtype=torch.float64
    )
    return Lens(camera, distortion)


def _lens_model(number_or_name: int | str) -> LensModel | None:
    """The lens model with COLMAP's number or name; None if it is too far from a pinhole."""
    for number, model in LENS_MODELS.items():
        if number_or_name in (number, model.name):
            return model
    return None


def pose_of_image(record: ImageRecord, where: str) -> Tensor:
    """Return the matrix world_to_camera [4, 4], float64, of a photo.

    Args:
        record: the photo.
        where: the file, for messages.

    Raises:
        InputError: the pose is no rotation and translation.
    """
    quaternion = torch.tensor(record.pose[:4], dtype=torch.float64)
    translation = torch.tensor(record.pose[4:], dtype=torch.float64)
    # A quaternion of length 0, infinity or NaN has no direction, and so gives no rotation.
    has_length = MIN_QUATERNION_NORM < float(quaternion.norm()) < MAX_CAMERA_NUMBER
    if len(translation) != 3 or not has_length:
        raise InputError(
            f"{where}: the pose of {record.name} is not a rotation: the file is damaged"
        )
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = quat_to_matrix(quaternion)
    world_to_camera[:3, 3] = translation
    return world_to_camera


# --- the records of binary files: little endian; a file begins with the number of its records


def _cameras_bin(path: Path) -> Iterator[CameraRecord]:
    """Yield the lenses of a cameras.bin.

    A record is key (int32), model (int32), width, height (uint64), parameters (float64).
    """
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    offset = 8  # bytes of the number of records
    for _ in range(count):
        key, model, width, height = struct.unpack_from("<iiQQ", data, offset)
        # The caller refuses other models, so their parameters, of unknown number, are not read.
        parameter_count = LENS_MODELS[model].parameter_count if model in LENS_MODELS else 0
        parameters_start = offset + 24  # 4 + 4 + 8 + 8 bytes
        parameters = struct.unpack_from(f"<{parameter_count}d", data, parameters_start)
        yield CameraRecord(key, model, width, height, list(parameters))
        offset = parameters_start + 8 * parameter_count  # a float64 has 8 bytes


def _images_bin(path: Path) -> Iterator[ImageRecord]:
    """Yield the photos of an images.bin.

    A record is key (int32), quaternion wxyz and translation (7 float64), camera's key (int32), the
    name with a zero byte, the number of observations (uint64), and these (x, y float64, id int64).
    """
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    offset = 8  # bytes of the number of records
    for _ in range(count):
        _, *pose, camera_key = struct.unpack_from("<i7di", data, offset)
        name_start = offset + 64  # 4 + 7 · 8 + 4 bytes
        name_end = data.index(b"\0", name_start)
        name = data[name_start:name_end].decode("utf-8", "replace")

        (observation_count,) = struct.unpack_from("<Q", data, name_end + 1)
        observations_start = name_end + 9  # the zero byte and the number of observations
        observations = np.frombuffer(data, OBSERVATION_DTYPE, observation_count, observations_start)
        yield ImageRecord(pose, camera_key, name, observations)
        offset = observations_start + observation_count * OBSERVATION_DTYPE.itemsize


def _points_bin(path: Path) -> Iterator[PointRecord]:
    """Yield the points of a points3D.bin.

    A record is key (uint64), x, y, z (float64), colour (3 bytes), error in pixels (float64), the
    number of photos that see the point (uint64), and for each of these two int32.
    """
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    offset = 8  # bytes of the number of records
    for _ in range(count):
        # "3x" skips the colour.
        key, x, y, z, error_px, photo_count = struct.unpack_from("<Q3d3xdQ", data, offset)
        yield PointRecord(key, x, y, z, error_px)
        offset += 51 + 8 * photo_count  # 8 + 3 · 8 + 3 + 8 + 8 bytes, and the photos


# --- the records of text files: lines of words; lines with # are comments


def text_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file without comments."""
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            if not line.startswith("#"):
                yield line.rstrip("\n")


def _cameras_txt(path: Path) -> Iterator[CameraRecord]:
    """Yield the lenses of a cameras.txt: key, model's name, width, height, parameters."""
    for line in text_lines(path):
        if not line.strip():
            continue
        key, model, width, height, *parameters = line.split()
        numbers = [float(parameter) for parameter in parameters]
        yield CameraRecord(int(key), model, int(width), int(height), numbers)


def _images_txt(path: Path) -> Iterator[ImageRecord]:
    """Yield the photos of an images.txt.

    Each photo has two lines. The first has key, quaternion wxyz, translation, the camera's key and
    the photo's name. The second has x, y and the point's id for each observation; it is empty if
    the photo sees no point.
    """
    lines = text_lines(path)
    for line in lines:
        if not line.strip():
            continue
        _, *pose, camera_key, name = line.split(maxsplit=9)  # 10 words; a name may have spaces

        # The second line; at the file's end it may be missing instead of empty.
        words = next(lines, "").split()
        numbers = np.array(words, np.float64).reshape(-1, 3)
        observations = np.empty(len(numbers), OBSERVATION_DTYPE)
        observations["uv"] = numbers[:, :2]
        observations["id"] = numbers[:, 2]
        yield ImageRecord(
            [float(word) for word in pose], int(camera_key), name.strip(), observations
        )


def _points_txt(path: Path) -> Iterator[PointRecord]:
    """Yield the points of a points3D.txt: key, x, y, z, 3 colours, error in pixels, photos."""
    for line in text_lines(path):
        if not line.strip():
            continue
        key, x, y, z, _, _, _, error_px, *_ = line.split(maxsplit=8)
        yield PointRecord(int(key), float(x), float(y), float(z), float(error_px))
