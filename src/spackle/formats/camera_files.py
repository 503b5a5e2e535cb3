"""JSON files of cameras: which views to render, or where the camera is at which time."""

from __future__ import annotations

import json
import os
from typing import Any

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import UNITS, Keyframe, KeyframePath, PathError
from spackle.errors import InputError, reason_in_a_line
from spackle.files import check_file

MAX_CAMERA_BYTES, MAX_PATH_BYTES = 64 << 20, 4 << 20
MAX_FRAMES = 10_000  # cameras or keyframes
MAX_SIZE = 16_384
LARGEST = 1e9  # in a camera: single precision holds its square
MAX_NUMBER = 1e6  # in a path: a thousand kilometres, eleven days
RIGID_TOLERANCE = 1e-3
ZERO_TOLERANCE = 1e-6

_REQUIRED = ("time", "eye", "target")
_KEYFRAME_NAMES = (*_REQUIRED, "up", "fov")
_PATH_NAMES = ("keyframes", "closed", "unit")


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read `{"width": W, "height": H, "frames": [{"K": 3×3, "world_to_camera": 4×4}, …]}`.

    Matrices are lists of rows. The world is the photo's camera (OpenCV: x right, y down, z forward);
    K is in pixels. A frame may carry its own width and height.

    Raises:
        InputError: not such a file, no frame or more than 10,000, or a camera that cannot be: K without
            positive focal lengths, with skew or a last row other than 0 0 1; world_to_camera that is
            not a rotation and a translation; a size outside 1..16384.
    """
    content = _read_json(path, "camera file", MAX_CAMERA_BYTES, dict)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f'{path}: needs a list "frames" with at least one camera')
    if len(frames) > MAX_FRAMES:
        raise InputError(f"{path}: {len(frames)} frames are too many (at most {MAX_FRAMES}): split the file")
    cameras = []
    for index, frame in enumerate(frames):
        where = f"{path}: frame {index}"
        if not isinstance(frame, dict):
            raise InputError(f'{where}: must be an object with "K" and "world_to_camera"')
        width, height = (frame.get(side, content.get(side)) for side in ("width", "height"))
        K = read_matrix(frame.get("K"), 3, "K", where)
        pose = read_matrix(frame.get("world_to_camera"), 4, "world_to_camera", where)
        cameras.append(checked_camera(K, pose, width, height, where))
    return cameras


def checked_camera(
    K: Tensor,
    world_to_camera: Tensor,
    width: object,
    height: object,
    where: str,
    *,
    dtype: torch.dtype = torch.float32,
    tolerance: float = RIGID_TOLERANCE,
) -> Camera:
    """A camera of float64 matrices [3, 3] and [4, 4]; InputError, beginning with `where`, if it cannot be.

    A rotation's product with its transpose is the identity to `tolerance`.
    """
    sizes = [n for n in (width, height) if isinstance(n, int) and not isinstance(n, bool) and 1 <= n <= MAX_SIZE]
    if len(sizes) != 2:
        raise InputError(f"{where}: width and height must be whole numbers from 1 to {MAX_SIZE}")
    if not (torch.isfinite(K).all() and torch.isfinite(world_to_camera).all()):
        raise InputError(f"{where}: K and world_to_camera must be finite")
    if max(float(K.abs().max()), float(world_to_camera.abs().max())) > LARGEST:
        raise InputError(f"{where}: K and world_to_camera must stay below {LARGEST:g}")
    if min(float(K[0, 0]), float(K[1, 1])) < 1 / LARGEST:
        raise InputError(f"{where}: K needs positive focal lengths at [0][0] and [1][1]")
    if K[2].tolist() != [0, 0, 1]:
        raise InputError(f"{where}: the last row of K must be 0 0 1")
    if max(abs(float(K[0, 1])), abs(float(K[1, 0]))) > ZERO_TOLERANCE * float(K[0, 0]):
        raise InputError(f"{where}: K has skew, which is not supported: [0][1] and [1][0] must be 0")
    rotation = world_to_camera[:3, :3]
    error = (rotation @ rotation.T - torch.eye(3, dtype=rotation.dtype)).abs().max()
    if error > tolerance or torch.linalg.det(rotation) < 0:
        raise InputError(f"{where}: world_to_camera must be a rotation (no scale, no mirror) and a translation")
    if (world_to_camera[3] - world_to_camera.new_tensor([0, 0, 0, 1])).abs().max() > ZERO_TOLERANCE:
        raise InputError(f"{where}: the last row of world_to_camera must be 0 0 0 1")
    return Camera(K.to(dtype), world_to_camera.to(dtype), *sizes)


def load_path(path: str | os.PathLike[str]) -> KeyframePath:
    """Read `{"keyframes": [{"time": s, "eye": [x, y, z], "target": [x, y, z]}, …]}`.

    A keyframe may carry "up" [x, y, z] and "fov" in degrees, the file "closed" and "unit", as in `KeyframePath`.
    The world is the photo's camera (OpenCV: x right, y down, z forward).

    Raises:
        InputError: not such a file, or not a path: fewer than two keyframes or more than 10,000, times that do not
            increase, a number that is not finite or beyond a million, an eye at its target, an up along the view,
            a fov outside 1..170 degrees, or a name that is unknown or there twice.
    """
    content = _read_json(path, "path file", MAX_PATH_BYTES, _without_doubles)
    if not isinstance(content, dict) or not isinstance(content.get("keyframes"), list):
        raise InputError(f'{path}: needs a list "keyframes" of objects with "time", "eye" and "target"')
    _check_names(content, _PATH_NAMES, str(path))
    entries, closed, unit = content["keyframes"], content.get("closed", False), content.get("unit", "metres")
    if len(entries) > MAX_FRAMES:
        raise InputError(f"{path}: {len(entries)} keyframes are too many (at most {MAX_FRAMES})")
    if not isinstance(closed, bool):
        raise InputError(f'{path}: "closed" must be true or false')
    if unit not in UNITS:
        raise InputError(f'{path}: "unit" must be {" or ".join(UNITS)}')
    keys = [_keyframe(entry, f"{path}: keyframe {index}") for index, entry in enumerate(entries)]
    try:
        return KeyframePath(tuple(keys), closed, unit)
    except PathError as error:
        raise InputError(f"{path}: {error}") from error


def _read_json(path: str | os.PathLike[str], kind: str, limit: int, pairs: Any) -> Any:
    """The content of a file of at most `limit` bytes; InputError where it is not JSON."""
    if check_file(path, kind) > limit:
        raise InputError(f"{path}: too long for a {kind} (at most {limit >> 20} MiB): is it the right file?")
    try:
        with open(path, encoding="utf-8-sig") as file:
            return json.load(file, object_pairs_hook=pairs)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON: {reason_in_a_line(error)}") from error


def read_matrix(rows: object, n: int, name: str, where: str) -> Tensor:
    """A list of n lists of n numbers as float64 [n, n]."""
    problem = f"{where}: {name} must be a list of {n} rows of {n} numbers"
    if not (isinstance(rows, list) and len(rows) == n and all(isinstance(r, list) and len(r) == n for r in rows)):
        raise InputError(problem)
    if not all(type(value) in (int, float) for row in rows for value in row):
        raise InputError(problem)
    try:
        return torch.tensor([[float(value) for value in row] for row in rows], dtype=torch.float64)
    except OverflowError:  # a whole number with 400 digits
        raise InputError(f"{where}: {name} must be finite") from None


def _keyframe(entry: object, where: str) -> Keyframe:
    if not isinstance(entry, dict) or any(name not in entry for name in _REQUIRED):
        raise InputError(f'{where}: must be an object with "time", "eye" and "target"')
    _check_names(entry, _KEYFRAME_NAMES, where)
    given: dict[str, Any] = {}
    for name, value in entry.items():
        vector = name in ("eye", "target", "up")
        if vector and not (isinstance(value, list) and len(value) == 3):
            raise InputError(f'{where}: "{name}" must be a list of three numbers')
        given[name] = tuple(_number(part, name, where) for part in value) if vector else _number(value, name, where)
    try:
        return Keyframe(**given)
    except PathError as error:
        raise InputError(f"{where}: {error}") from error


def _number(value: Any, name: str, where: str) -> float:
    if type(value) not in (int, float):
        raise InputError(f'{where}: "{name}" must hold numbers, not {reason_in_a_line(json.dumps(value))}')
    if not -MAX_NUMBER <= value <= MAX_NUMBER:  # NaN is not, either
        raise InputError(f'{where}: "{name}" must be a finite number, at most a million, got {str(value)[:20]}')
    return float(value)


def _check_names(entry: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    if unknown := sorted(set(entry) - set(known)):
        raise InputError(f"{where}: unknown name {reason_in_a_line(unknown[0])!r}: there are {', '.join(known)}")


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; ValueError where a name is there twice."""
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"the name {name!r} is there twice in one object")
        found[name] = value
    return found
