"""Spackle's JSON files of cameras: views to render, or keyframes of a path.

`load_cameras` and `load_path` read files; `checked_camera` makes a camera of matrices. Camera files
of other programs are read by `camera_readers.py`.
"""

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
from spackle.core.keyframes import WORLD_UP, Keyframe, KeyframePath, PathError, PathUnit
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

MAX_FILE_BYTES = 64 << 20
MAX_FRAMES = 10_000  # cameras or keyframes of a file
MAX_SIDE_PX = 16_384

# The largest absolute value in a camera's matrices: float32 can represent its square.
MAX_CAMERA_NUMBER = 1e9
# The largest absolute value in a path: a thousand kilometres, or eleven days.
MAX_PATH_NUMBER = 1e6

# How far a rotation times its transpose may be from the identity, in a file with few digits.
ROTATION_TOLERANCE = 1e-3
# How large a number that has to be 0 may be.
ZERO_TOLERANCE = 1e-6

# A number of JSON; a text or a bool is refused.
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
PathNumber = Annotated[Number, Field(ge=-MAX_PATH_NUMBER, le=MAX_PATH_NUMBER)]
PathVector = tuple[PathNumber, PathNumber, PathNumber]
Row3 = tuple[Number, Number, Number]
Row4 = tuple[Number, Number, Number, Number]
SidePx = Annotated[int, Strict(), Field(ge=1, le=MAX_SIDE_PX)]
Model = TypeVar("Model", bound=BaseModel)


class CameraEntry(BaseModel):
    """One camera in a file, or of a client of the server."""

    K: tuple[Row3, Row3, Row3]
    world_to_camera: tuple[Row4, Row4, Row4, Row4]
    width: SidePx | None = None
    height: SidePx | None = None


class _CameraFile(BaseModel):
    """A file of cameras; its width and height hold for cameras that have none."""

    frames: Annotated[list[CameraEntry], Field(min_length=1, max_length=MAX_FRAMES)]
    width: SidePx | None = None
    height: SidePx | None = None


class _KeyframeEntry(BaseModel, extra="forbid"):
    """One keyframe in a file; the names are those of `Keyframe`."""

    time: PathNumber
    eye: PathVector
    target: PathVector
    up: PathVector = WORLD_UP
    fov: PathNumber | None = None


class _PathFile(BaseModel, extra="forbid"):
    """A file of keyframes; the names are those of `KeyframePath`."""

    keyframes: Annotated[list[_KeyframeEntry], Field(max_length=MAX_FRAMES)]
    closed: Annotated[bool, Strict()] = False
    unit: PathUnit = "metres"


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read a file of cameras.

    The file holds {"width": W, "height": H, "frames": [{"K": 3×3, "world_to_camera": 4×4}, …]}.
    Matrices are lists of rows. The world is that of the photo's camera (OpenCV: x right, y
    down, z forward); K is in pixels. A frame may have its own width and height.

    Raises:
        InputError: the file has other content, no frame or more than 10,000, or an impossible
            camera: without a size, with skew, or with a pose that is no rotation and translation.
    """
    content = _read_json(_CameraFile, path, "camera file")
    cameras = []
    for index, entry in enumerate(content.frames):
        width = entry.width or content.width
        height = entry.height or content.height
        cameras.append(_camera_from_entry(entry, width, height, f"{path}: frame {index}"))
    return cameras


def camera_from_json(camera_entry: Mapping[str, Any], where: str) -> Camera:
    """Return a camera from its entry in a JSON file: K, world_to_camera, width and height.

    Args:
        camera_entry: the parsed entry.
        where: names the entry at the beginning of messages.

    Raises:
        InputError: the entry is incomplete, or the camera is impossible.
    """
    with as_input_error(where, "{reason}", ValidationError):
        entry = CameraEntry.model_validate(camera_entry)
    return _camera_from_entry(entry, entry.width, entry.height, where)


def _camera_from_entry(
    entry: CameraEntry, width: int | None, height: int | None, where: str
) -> Camera:
    """Return a camera from a file's entry; InputError if it is impossible or has no size."""
    K = torch.tensor(entry.K, dtype=torch.float64)
    world_to_camera = torch.tensor(entry.world_to_camera, dtype=torch.float64)
    # A missing size becomes 0, which `checked_camera` refuses.
    return checked_camera(K, world_to_camera, width or 0, height or 0, where)


def checked_camera(
    K: Tensor,
    world_to_camera: Tensor,
    width: int,
    height: int,
    where: str,
    *,
    dtype: torch.dtype = torch.float32,
    tolerance: float = ROTATION_TOLERANCE,
    pose_name: str = "world_to_camera",
) -> Camera:
    """Return a camera, after checking that its numbers make sense.

    Args:
        K: [3, 3] float64 intrinsics in pixels.
        world_to_camera: [4, 4] float64 pose.
        width, height: size of the image in pixels.
        where: names the camera at the beginning of messages.
        dtype: the type of the camera's matrices.
        tolerance: how far the rotation times its transpose may be from the identity.
        pose_name: what the pose is called in messages.

    Raises:
        InputError: a side is outside of 1..16384 pixels, a matrix is not finite, K has skew or
            no positive focal lengths, or the pose is not a rotation and a translation.
    """
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise InputError(f"{where}: width and height must be whole numbers from 1 to {MAX_SIDE_PX}")
    for matrix in (K, world_to_camera):
        # Also false for NaN.
        if not bool((matrix.abs() <= MAX_CAMERA_NUMBER).all()):
            limits = f"finite, at most {MAX_CAMERA_NUMBER:g}"
            raise InputError(f"{where}: numbers in K and {pose_name} must be {limits}")
    _check_intrinsics(K, where)
    _check_pose(world_to_camera, tolerance, f"{where}: {pose_name}")
    return Camera(K.to(dtype), world_to_camera.to(dtype), width, height)


def _check_intrinsics(K: Tensor, where: str) -> None:
    """Raise an InputError unless K [3, 3] has positive focal lengths and no skew."""
    fx = float(K[0, 0])
    fy = float(K[1, 1])
    # A smaller focal length would have an inverse beyond the largest allowed number.
    if min(fx, fy) < 1 / MAX_CAMERA_NUMBER:
        raise InputError(f"{where}: K needs positive focal lengths at [0][0] and [1][1]")
    largest_skew = max(abs(float(K[0, 1])), abs(float(K[1, 0])))
    if K[2].tolist() != [0, 0, 1] or largest_skew > ZERO_TOLERANCE * fx:
        form = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        raise InputError(f"{where}: K must be {form}: skew is not supported")


def _check_pose(world_to_camera: Tensor, tolerance: float, what: str) -> None:
    """Raise an InputError unless a matrix [4, 4] is a rotation and a translation.

    The rotation times its transpose must equal the identity within `tolerance`; `what` begins the
    message.
    """
    rotation = world_to_camera[:3, :3]
    identity = torch.eye(3, dtype=rotation.dtype)
    rotation_error = (rotation @ rotation.T - identity).abs().max()
    is_mirrored = torch.linalg.det(rotation) < 0

    expected_last_row = world_to_camera.new_tensor([0, 0, 0, 1])
    last_row_error = (world_to_camera[3] - expected_last_row).abs().max()
    if rotation_error > tolerance or is_mirrored or last_row_error > ZERO_TOLERANCE:
        form = "a rotation (no scale, no mirror) and a translation, above a row 0 0 0 1"
        raise InputError(f"{what} must be {form}")


def load_path(path: str | os.PathLike[str]) -> KeyframePath:
    """Read a file of keyframes.

    The file holds {"keyframes": [{"time": s, "eye": [x, y, z], "target": [x, y, z]}, …]}. A
    keyframe may also have "up" [x, y, z] and "fov" in degrees. The file may also have "closed",
    true if the path returns to its first keyframe; and "unit", the unit of all lengths: "metres",
    or "disparity" for the distance by which a disparity of 1 moves the camera. The world is that
    of the photo's camera (OpenCV: x right, y down, z forward).

    Raises:
        InputError: the file has other content, an unknown name, fewer than two keyframes or
            more than 10,000, times that do not increase, a number that is not finite or beyond
            a million, an eye at its target, an up along the view, or a fov outside of 1..170
            degrees.
    """
    content = _read_json(_PathFile, path, "path file")
    keyframes = []
    for index, entry in enumerate(content.keyframes):
        with as_input_error(f"{path}: keyframe {index}", "{reason}", PathError):
            keyframes.append(Keyframe(**entry.model_dump()))
    with as_input_error(path, "{reason}", PathError):
        return KeyframePath(tuple(keyframes), content.closed, content.unit)


def _read_json(model: type[Model], path: str | os.PathLike[str], kind: str) -> Model:
    """Read a JSON file, and check it against a pydantic model.

    Args:
        model: what the file must hold.
        path: the file.
        kind: what the file is called in messages, such as "camera file".

    Raises:
        InputError: the file cannot be read, is too long, or holds something else.
    """
    if check_file(path, kind) > MAX_FILE_BYTES:
        limit = f"at most {MAX_FILE_BYTES >> 20} MiB"
        raise InputError(f"{path}: too long for a {kind} ({limit}): is it the right file?")
    # Some editors of Windows begin a file with a byte order mark, which JSON does not allow.
    text = Path(path).read_bytes().removeprefix(codecs.BOM_UTF8)
    with as_input_error(path, "{reason}", ValidationError):
        return model.model_validate_json(text)
