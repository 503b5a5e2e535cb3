"""Read COLMAP models, text or binary: cameras, points, and the points that each photo sees.

A model is a sparse reconstruction in three files: cameras (lenses), images (a pose for each
photo, and where the photo sees points) and points3D. `read_model` reads all three; a generator
below reads the records of each file.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.gaussians import quat_to_matrix
from spackle.formats.camera_files import MAX_CAMERA_NUMBER, checked_camera
from spackle.paper.evaluation.case import Points
from spackle.runtime.errors import InputError, as_input_error

Array = NDArray[Any]

# The greatest accepted distortion at a photo's corner, as a fraction of the long side. Smaller
# distortion is ignored, because photos from close viewpoints are distorted alike.
MAX_DISTORTION_RATIO = 0.02
MAX_REPROJECTION_ERROR_PX = 2.0  # of a point, as mean over photos
MAX_EXACT_INTEGER = 2**53  # the largest id that float64 holds exactly
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
}
# Lens models with one focal length; the others have fx and fy.
SINGLE_FOCAL_MODELS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

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


@dataclasses.dataclass(frozen=True)
class ColmapView:
    """A photo of a model."""

    name: str  # the name in the model, with folders
    camera: Camera  # in the model's world, float64; pixel centres at half-integers, as in COLMAP
    uv: Array  # [n, 2] pixel positions of points
    point_ids: Array  # [n] ids of these points, ascending


@dataclasses.dataclass(frozen=True)
class Model:
    """A sparse reconstruction of a scene."""

    views: tuple[ColmapView, ...]  # sorted by name
    point_ids: Array  # [m] ids of the reliable points, ascending
    xyz: Array  # [m, 3] positions in the world

    def points(self, view: ColmapView) -> Points:
        """The reliable points in front of a view that the view sees, with their depth."""
        # Where the ids that both have stand in the view's list of points, and in the model's.
        _, view_indices, model_indices = np.intersect1d(
            view.point_ids, self.point_ids, assume_unique=True, return_indices=True
        )
        positions = torch.from_numpy(self.xyz[model_indices])  # [n, 3]
        z = view.camera.to_camera(positions)[:, 2]
        uv = torch.from_numpy(view.uv[view_indices])

        is_in_front = z > 0
        return Points(uv.float()[is_in_front], z.float()[is_in_front])


def model_folder(scene: Path) -> Path:
    """The folder of a scene's model: sparse/0 or sparse, in the scene or in dense/.

    Raises:
        InputError: none of these has a file of cameras.
    """
    for name in MODEL_FOLDERS:
        folder = scene / name
        if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
            return folder
    raise InputError(
        f"{scene / 'sparse/0'}: no COLMAP model: expected cameras, images, points3D as .bin or .txt"
    )


def read_model(folder: Path) -> Model:
    """Read a model's cameras, images and points.

    Files are binary if there is a cameras.bin, else text.

    Raises:
        InputError: a file is missing or damaged, or a lens differs too much from a pinhole.
    """
    is_binary = (folder / "cameras.bin").is_file()
    suffix = ".bin" if is_binary else ".txt"

    # Each file has its own block, so that a message names the damaged file.
    points_path = folder / f"points3D{suffix}"
    with as_input_error(points_path, DAMAGED):
        point_records = _points_bin(points_path) if is_binary else _points_txt(points_path)
        point_ids, xyz = _reliable_points(point_records)

    cameras_path = folder / f"cameras{suffix}"
    with as_input_error(cameras_path, DAMAGED):
        camera_records = _cameras_bin(cameras_path) if is_binary else _cameras_txt(cameras_path)
        lenses = {record.key: _lens_of_record(cameras_path, record) for record in camera_records}

    images_path = folder / f"images{suffix}"
    with as_input_error(images_path, DAMAGED):
        image_records = _images_bin(images_path) if is_binary else _images_txt(images_path)
        views = [
            _view_of_record(images_path, lenses[record.camera_key], record)
            for record in image_records
        ]

    views.sort(key=lambda view: view.name)
    return Model(tuple(views), point_ids, xyz)


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


def _lens_of_record(path: Path, record: CameraRecord) -> Camera:
    """The lens of a record as a float64 camera at the world's origin.

    Args:
        path: the file, for messages.
        record: the lens.

    Raises:
        InputError: the lens model is no pinhole, or distorts the corners of photos too much.
    """
    model = _lens_model(record.model)
    if model is None or len(record.parameters) != model.parameter_count:
        raise InputError(
            f"{path}: camera model {record.model} is not a pinhole: undistort the photos with "
            "COLMAP first"
        )

    # Models with one focal length have f, cx, cy; the others fx, fy, cx, cy. Then comes distortion.
    parameters = record.parameters
    if model.name in SINGLE_FOCAL_MODELS:
        parameters = [parameters[0], *parameters]  # fx and fy are the same
    fx, fy, cx, cy, *distortion = parameters

    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    at_origin = torch.eye(4, dtype=torch.float64)
    lens = checked_camera(
        K, at_origin, record.width, record.height, f"{path}: a lens", dtype=torch.float64
    )

    # Distortion grows outwards, so the corner that is farthest from the principal point decides.
    # Divided by the focal lengths, its distance is in the units of the distortion's formulas.
    corner_x = max(cx, record.width - cx) / fx
    corner_y = max(cy, record.height - cy) / fy
    squared_radius = corner_x**2 + corner_y**2
    shift = _max_distortion_shift(distortion, squared_radius)
    max_shift_px = MAX_DISTORTION_RATIO * max(record.width, record.height)
    is_small = shift * max(fx, fy) <= max_shift_px  # false for NaN
    if not is_small:
        raise InputError(
            f"{path}: the camera distorts the corners of photos: undistort the photos first"
        )
    return lens


def _lens_model(number_or_name: int | str) -> LensModel | None:
    """The lens model with COLMAP's number or name; None if it is too far from a pinhole."""
    for number, model in LENS_MODELS.items():
        if number_or_name in (number, model.name):
            return model
    return None


def _max_distortion_shift(distortion: Sequence[float], squared_radius: float) -> float:
    """How far a lens may shift a point at most, at focal length 1.

    Radial distortion shifts a point at the radius r by k1 r³ + k2 r⁵; tangential distortion
    shifts it by at most 3 (|p1| + |p2|) r².

    Args:
        distortion: k1, k2, p1, p2. The list may end earlier; the numbers that are missing are 0.
        squared_radius: r², the point's squared distance from the optical axis.
    """
    radial = distortion[:2]
    tangential = distortion[2:]
    shift = 0.0
    for order, k in enumerate(radial):
        # (r²)^1.5 is r³, and (r²)^2.5 is r⁵.
        shift += abs(k) * squared_radius ** (order + 1.5)
    return shift + 3 * sum(abs(p) for p in tangential) * squared_radius


def _view_of_record(path: Path, lens: Camera, record: ImageRecord) -> ColmapView:
    """The view of a record: its camera, and the points that it sees, each once.

    Args:
        path: the file, for messages.
        lens: the camera at the world's origin.
        record: the photo.

    Raises:
        InputError: the pose is no rotation and translation.
    """
    quaternion = torch.tensor(record.pose[:4], dtype=torch.float64)
    translation = torch.tensor(record.pose[4:], dtype=torch.float64)
    where = f"{path}: the pose of {record.name}"
    # A quaternion of length 0, infinity or NaN has no direction, and so gives no rotation.
    has_length = MIN_QUATERNION_NORM < float(quaternion.norm()) < MAX_CAMERA_NUMBER
    if len(translation) != 3 or not has_length:
        raise InputError(f"{where} is not a rotation: the file is damaged")

    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = quat_to_matrix(quaternion)
    world_to_camera[:3, 3] = translation
    camera = checked_camera(
        lens.K, world_to_camera, lens.width, lens.height, where, dtype=torch.float64
    )

    # A feature of the photo that belongs to no point has the id -1.
    observations = record.observations[record.observations["id"] >= 0]
    # A photo may see a point twice; the first observation is kept.
    _, first_indices = np.unique(observations["id"], return_index=True)
    observations = observations[first_indices]
    return ColmapView(record.name, camera, observations["uv"].copy(), observations["id"].copy())


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


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file without comments."""
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            if not line.startswith("#"):
                yield line.rstrip("\n")


def _cameras_txt(path: Path) -> Iterator[CameraRecord]:
    """Yield the lenses of a cameras.txt: key, model's name, width, height, parameters."""
    for line in _lines(path):
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
    lines = _lines(path)
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
    for line in _lines(path):
        if not line.strip():
            continue
        key, x, y, z, _, _, _, error_px, *_ = line.split(maxsplit=8)
        yield PointRecord(int(key), float(x), float(y), float(z), float(error_px))
