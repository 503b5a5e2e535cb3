"""Read COLMAP models, text or binary: cameras, points, and the points that each photo sees."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.gaussians import quat_to_matrix
from spackle.formats.camera_files import MAX_CAMERA_NUMBER, checked_camera
from spackle.paper.evaluation.case import Points
from spackle.runtime.errors import InputError, as_input_error

Array = NDArray[Any]

# The greatest accepted distortion at a photo's corner, as a fraction of the long side. Smaller distortion is ignored,
# because photos from close viewpoints are distorted alike.
MAX_DISTORTION = 0.02
MAX_ERROR_PX = 2.0  # the greatest accepted reprojection error of a point, as mean over photos
# Name and number of parameters by COLMAP's model id; other models are too far from a pinhole.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
}
POINT_2D = np.dtype([("uv", "<f8", (2,)), ("id", "<i8")])  # id -1: no point


@dataclasses.dataclass(frozen=True)
class ColmapView:
    """A photo of a model."""

    name: str  # the name in the model, with folders
    camera: Camera  # in the model's world, float64; pixel centres at half-integers, as in COLMAP
    uv: Array  # [n, 2] pixel positions of points
    ids: Array  # [n] ids of these points


@dataclasses.dataclass(frozen=True)
class Model:
    """A sparse reconstruction."""

    views: tuple[ColmapView, ...]  # sorted by name
    ids: Array  # [m] ids of the reliable points, ascending
    xyz: Array  # [m, 3] positions in the world

    def points(self, view: ColmapView) -> Points:
        """The reliable points that a view sees, with their depth in the view."""
        _, seen, known = np.intersect1d(view.ids, self.ids, assume_unique=True, return_indices=True)
        z = view.camera.to_camera(torch.from_numpy(self.xyz[known]))[:, 2]
        front = z > 0
        return Points(torch.from_numpy(view.uv[seen]).float()[front], z.float()[front])


def model_folder(scene: Path) -> Path:
    """The folder of a scene's model: sparse/0 or sparse, in the scene or in dense/ (from COLMAP's undistorter)."""
    for place in (
        scene / name for name in ("sparse/0", "sparse", "dense/sparse/0", "dense/sparse")
    ):
        if any((place / f"cameras{end}").is_file() for end in (".bin", ".txt")):
            return place
    raise InputError(
        f"{scene / 'sparse/0'}: no COLMAP model: expected cameras, images, points3D as .bin or .txt"
    )


def read_model(folder: Path) -> Model:
    """Read cameras, images and points3D from binary files if there is a cameras.bin, else from text files.

    Raises:
        InputError: a file is missing or damaged, or a lens differs too much from a pinhole.
    """
    damaged = "not a COLMAP file ({reason}): the file is missing, damaged or cut off"
    binary = (folder / "cameras.bin").is_file()
    cameras, images, points = (
        folder / f"{name}.{'bin' if binary else 'txt'}"
        for name in ("cameras", "images", "points3D")
    )
    with as_input_error(points, damaged):
        records = _points_bin(points) if binary else _points_txt(points)
        table = np.array(
            [point for point in records if point[4] <= MAX_ERROR_PX], np.float64
        ).reshape(-1, 5)
    table = table[
        (
            np.abs(table[:, :4]) <= [2**53, MAX_CAMERA_NUMBER, MAX_CAMERA_NUMBER, MAX_CAMERA_NUMBER]
        ).all(axis=1)
    ]
    ids, first = np.unique(table[:, 0], return_index=True)
    with as_input_error(cameras, damaged):
        lenses = {
            key: _lens(cameras, *lens)
            for key, *lens in (_cameras_bin if binary else _cameras_txt)(cameras)
        }
    with as_input_error(images, damaged):
        photos = (_images_bin if binary else _images_txt)(images)
        views = [
            _view(images, lenses[camera], name, pose, seen) for pose, camera, name, seen in photos
        ]
    return Model(
        tuple(sorted(views, key=lambda view: view.name)), ids.astype(np.int64), table[first, 1:4]
    )


def _lens(path: Path, model: int | str, width: int, height: int, parameters: list[float]) -> Camera:
    name, count = next((m for key, m in MODELS.items() if model in (key, m[0])), ("", -1))
    if len(parameters) != count:
        raise InputError(
            f"{path}: camera model {model} is not a pinhole: undistort the photos with COLMAP first"
        )
    single = name.startswith(("SIMPLE", "RADIAL"))
    fx, fy, cx, cy, *bend = [parameters[0], *parameters] if single else parameters
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    lens = checked_camera(
        K, torch.eye(4, dtype=torch.float64), width, height, f"{path}: a lens", dtype=torch.float64
    )
    square = (max(cx, width - cx) / fx) ** 2 + (
        max(cy, height - cy) / fy
    ) ** 2  # radius r of the corner, squared
    # k1, k2 distort radially; p1, p2 shift a point at radius r by at most 3 (|p1| + |p2|) r².
    shift = (
        sum(abs(k) * square ** (n + 1.5) for n, k in enumerate(bend[:2]))
        + 3 * sum(map(abs, bend[2:])) * square
    )
    if not shift * max(fx, fy) <= MAX_DISTORTION * max(width, height):  # also refuses NaN
        raise InputError(
            f"{path}: the camera distorts the corners of photos: undistort the photos first"
        )
    return lens


def _view(path: Path, lens: Camera, name: str, pose: list[float], observed: Array) -> ColmapView:
    quaternion, shift = (
        torch.tensor(pose[:4], dtype=torch.float64),
        torch.tensor(pose[4:], dtype=torch.float64),
    )
    where = f"{path}: the pose of {name}"
    if len(shift) != 3 or not 1e-6 < float(quaternion.norm()) < MAX_CAMERA_NUMBER:
        raise InputError(f"{where} is not a rotation: the file is damaged")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = quat_to_matrix(quaternion), shift
    seen = observed[observed["id"] >= 0]
    _, first = np.unique(seen["id"], return_index=True)  # a photo may see a point twice
    seen = seen[first]
    camera = checked_camera(lens.K, matrix, lens.width, lens.height, where, dtype=torch.float64)
    return ColmapView(name, camera, seen["uv"].copy(), seen["id"].copy())


# --- the records of each file


def _cameras_bin(path: Path) -> Iterator[tuple[Any, ...]]:
    """Yield key, model, width, height, parameters."""
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        key, model, width, height = struct.unpack_from("<iiQQ", data, at)
        number = MODELS[model][1] if model in MODELS else 0  # the length of other models is unknown
        yield key, model, width, height, list(struct.unpack_from(f"<{number}d", data, at + 24))
        at += 24 + 8 * number


def _images_bin(path: Path) -> Iterator[tuple[list[float], int, str, Array]]:
    """Yield each photo's pose (quaternion wxyz, translation), camera, name and POINT_2D [n]."""
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "replace")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        yield pose, camera, name, np.frombuffer(data, POINT_2D, points, end + 9)
        at = end + 9 + points * POINT_2D.itemsize


def _points_bin(path: Path) -> Iterator[tuple[float, ...]]:
    """Yield key, x, y, z, error in pixels."""
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        *point, track = struct.unpack_from("<Q3d3xdQ", data, at)
        yield tuple(point)
        at += 51 + 8 * track


def _lines(path: Path) -> Iterator[str]:
    with open(path, encoding="utf-8", errors="replace") as file:
        yield from (line.rstrip("\n") for line in file if not line.startswith("#"))


def _cameras_txt(path: Path) -> Iterator[tuple[Any, ...]]:
    for key, model, width, height, *parameters in (
        line.split() for line in _lines(path) if line.strip()
    ):
        yield int(key), model, int(width), int(height), [float(p) for p in parameters]


def _images_txt(path: Path) -> Iterator[tuple[list[float], int, str, Array]]:
    """Like `_images_bin`: each photo has two lines, of which the second is empty if the photo sees no point."""
    lines = _lines(path)
    for line in lines:
        if not line.strip():
            continue
        _, *pose, camera, name = line.split(maxsplit=9)
        numbers = np.array(next(lines, "").split(), np.float64).reshape(-1, 3)
        observed = np.empty(len(numbers), POINT_2D)
        observed["uv"], observed["id"] = numbers[:, :2], numbers[:, 2]
        yield [float(p) for p in pose], int(camera), name.strip(), observed


def _points_txt(path: Path) -> Iterator[tuple[float, ...]]:
    for key, x, y, z, _, _, _, error, *_ in (
        line.split(maxsplit=8) for line in _lines(path) if line.strip()
    ):
        yield int(key), float(x), float(y), float(z), float(error)
