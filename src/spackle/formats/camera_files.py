"""JSON files of cameras: views to render, or keyframes of a path."""

from __future__ import annotations

import codecs
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
from pydantic import BaseModel, Field, Strict, ValidationError
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.trajectories import WORLD_UP, Keyframe, KeyframePath, PathError, PathUnit
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

MAX_BYTES = 64 << 20
MAX_FRAMES = 10_000  # cameras or keyframes
MAX_SIZE = 16_384
MAX_CAMERA_NUMBER = 1e9  # largest number in a camera: float32 can represent its square
MAX_NUMBER = 1e6  # largest number in a path: a thousand kilometres, or eleven days
RIGID_TOLERANCE = 1e-3
ZERO_TOLERANCE = 1e-6

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]  # not a bool or a text
Bounded = Annotated[Number, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Vector = tuple[Bounded, Bounded, Bounded]
Row3 = tuple[Number, Number, Number]
Row4 = tuple[Number, Number, Number, Number]
Side = Annotated[int, Strict(), Field(ge=1, le=MAX_SIZE)]
M = TypeVar("M", bound=BaseModel)


class _Frame(BaseModel):
    K: tuple[Row3, Row3, Row3]
    world_to_camera: tuple[Row4, Row4, Row4, Row4]
    width: Side | None = None
    height: Side | None = None


class _CameraFile(BaseModel):
    frames: Annotated[list[_Frame], Field(min_length=1, max_length=MAX_FRAMES)]
    width: Side | None = None
    height: Side | None = None


class _Key(BaseModel, extra="forbid"):
    time: Bounded
    eye: Vector
    target: Vector
    up: Vector = WORLD_UP
    fov: Bounded | None = None


class _PathFile(BaseModel, extra="forbid"):
    keyframes: Annotated[list[_Key], Field(max_length=MAX_FRAMES)]
    closed: Annotated[bool, Strict()] = False
    unit: PathUnit = "metres"


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read `{"width": W, "height": H, "frames": [{"K": 3×3, "world_to_camera": 4×4}, …]}`.

    Matrices are lists of rows. The world is the photo's camera (OpenCV: x right, y down, z forward);
    K is in pixels. A frame may have its own width and height.

    Raises:
        InputError: other content, no frame, more than 10,000 frames, or an impossible camera (see `checked_camera`).
    """
    content = _read(_CameraFile, path, "camera file")
    return [
        _camera(
            frame,
            frame.width or content.width,
            frame.height or content.height,
            f"{path}: frame {index}",
        )
        for index, frame in enumerate(content.frames)
    ]


def camera_from_json(facts: Mapping[str, Any], where: str) -> Camera:
    """A camera from its entry in a JSON file; InputError, beginning with `where`, if the camera is impossible."""
    with as_input_error(where, "{reason}", ValidationError):
        frame = _Frame.model_validate(facts)
    return _camera(frame, frame.width, frame.height, where)


def _camera(frame: _Frame, width: int | None, height: int | None, where: str) -> Camera:
    K, pose = (torch.tensor(rows, dtype=torch.float64) for rows in (frame.K, frame.world_to_camera))
    return checked_camera(K, pose, width or 0, height or 0, where)


def checked_camera(
    K: Tensor,
    world_to_camera: Tensor,
    width: int,
    height: int,
    where: str,
    *,
    dtype: torch.dtype = torch.float32,
    tolerance: float = RIGID_TOLERANCE,
) -> Camera:
    """Check float64 matrices [3, 3] and [4, 4], and return a camera of them, in `dtype`.

    The rotation times its transpose must equal the identity within `tolerance`.

    Raises:
        InputError: beginning with `where`, if a size is outside 1..16384, a matrix is not finite, K has skew or no
            positive focal lengths, or world_to_camera is not a rotation and a translation.
    """
    if not (1 <= width <= MAX_SIZE and 1 <= height <= MAX_SIZE):
        raise InputError(f"{where}: width and height must be whole numbers from 1 to {MAX_SIZE}")
    if not all(
        bool((matrix.abs() <= MAX_CAMERA_NUMBER).all()) for matrix in (K, world_to_camera)
    ):  # NaN fails, too
        raise InputError(
            f"{where}: numbers in K and world_to_camera must be finite, at most {MAX_CAMERA_NUMBER:g}"
        )
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if min(fx, fy) < 1 / MAX_CAMERA_NUMBER:
        raise InputError(f"{where}: K needs positive focal lengths at [0][0] and [1][1]")
    if (
        K[2].tolist() != [0, 0, 1]
        or max(abs(float(K[0, 1])), abs(float(K[1, 0]))) > ZERO_TOLERANCE * fx
    ):
        raise InputError(
            f"{where}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: skew is not supported"
        )
    rotation, last = world_to_camera[:3, :3], world_to_camera.new_tensor([0, 0, 0, 1])
    error = (rotation @ rotation.T - torch.eye(3, dtype=rotation.dtype)).abs().max()
    if (
        error > tolerance
        or torch.linalg.det(rotation) < 0
        or (world_to_camera[3] - last).abs().max() > ZERO_TOLERANCE
    ):
        raise InputError(
            f"{where}: world_to_camera must be a rotation (no scale, no mirror) and a translation, above a row 0 0 0 1"
        )
    return Camera(K.to(dtype), world_to_camera.to(dtype), width, height)


def load_path(path: str | os.PathLike[str]) -> KeyframePath:
    """Read `{"keyframes": [{"time": s, "eye": [x, y, z], "target": [x, y, z]}, …]}`.

    A keyframe may also have "up" [x, y, z] and "fov" in degrees; the file may have "closed" and "unit", as in
    `KeyframePath`. The world is the photo's camera (OpenCV: x right, y down, z forward).

    Raises:
        InputError: other content, an unknown name, fewer than two keyframes or more than 10,000, times that do not
            increase, a number that is not finite or beyond a million, an eye at its target, an up along the view, or a
            fov outside 1..170 degrees.
    """
    content = _read(_PathFile, path, "path file")
    keys = []
    for index, key in enumerate(content.keyframes):
        with as_input_error(f"{path}: keyframe {index}", "{reason}", PathError):
            keys.append(Keyframe(**key.model_dump()))
    with as_input_error(path, "{reason}", PathError):
        return KeyframePath(tuple(keys), content.closed, content.unit)


def _read(model: type[M], path: str | os.PathLike[str], kind: str) -> M:
    if check_file(path, kind) > MAX_BYTES:
        raise InputError(
            f"{path}: too long for a {kind} (at most {MAX_BYTES >> 20} MiB): is it the right file?"
        )
    with as_input_error(path, "{reason}", ValidationError):
        return model.model_validate_json(Path(path).read_bytes().removeprefix(codecs.BOM_UTF8))
