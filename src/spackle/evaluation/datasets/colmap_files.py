"""The records in COLMAP's files, binary and text. A damaged file raises struct.error, ValueError or the like."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Name and number of parameters by COLMAP's model id; the others' lenses are too far from a pinhole's.
MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8)}
POINT_2D = np.dtype([("uv", "<f8", (2,)), ("id", "<i8")])  # id -1: matched with nothing

CameraRecord = tuple[int, int | str, int, int, list[float]]  # id, model, width, height, parameters
ImageRecord = tuple[list[float], int, str, NDArray[Any]]  # wxyz and translation, camera id, name, POINT_2D [n]
PointRecord = tuple[float, float, float, float, float]  # id, x, y, z, error in pixels


def cameras_bin(path: Path) -> Iterator[CameraRecord]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        key, model, width, height = struct.unpack_from("<iiQQ", data, at)
        number = MODELS[model][1] if model in MODELS else 0  # another's length is unknown, and it is refused
        yield key, model, width, height, list(struct.unpack_from(f"<{number}d", data, at + 24))
        if model not in MODELS:
            return
        at += 24 + 8 * number


def images_bin(path: Path) -> Iterator[ImageRecord]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "replace")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        yield pose, camera, name, np.frombuffer(data, POINT_2D, points, end + 9)
        at = end + 9 + points * POINT_2D.itemsize


def points_bin(path: Path) -> Iterator[PointRecord]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        key, x, y, z, error, track = struct.unpack_from("<Q3d3xdQ", data, at)
        yield key, x, y, z, error
        at += 51 + 8 * track


def _lines(path: Path) -> Iterator[str]:
    with open(path, encoding="utf-8", errors="replace") as file:
        yield from (line.rstrip("\n") for line in file if not line.startswith("#"))


def cameras_txt(path: Path) -> Iterator[CameraRecord]:
    for key, model, width, height, *parameters in (line.split() for line in _lines(path) if line.strip()):
        yield int(key), model, int(width), int(height), [float(p) for p in parameters]


def images_txt(path: Path) -> Iterator[ImageRecord]:
    """Two lines a photo; the second is empty where nothing was found in it."""
    lines = _lines(path)
    for line in lines:
        if not line.strip():
            continue
        _, *pose, camera, name = line.split(maxsplit=9)
        numbers = np.array(next(lines, "").split(), np.float64).reshape(-1, 3)
        observed = np.empty(len(numbers), POINT_2D)
        observed["uv"], observed["id"] = numbers[:, :2], numbers[:, 2]
        yield [float(p) for p in pose], int(camera), name.strip(), observed


def points_txt(path: Path) -> Iterator[PointRecord]:
    for line in _lines(path):
        if line.strip():
            key, x, y, z, _, _, _, error = line.split(maxsplit=8)[:8]
            yield int(key), float(x), float(y), float(z), float(error)
