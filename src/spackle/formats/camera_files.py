"""JSON files of cameras: views to render, or keyframes of a path."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import UNITS, Keyframe, KeyframePath, PathError
from spackle.errors import InputError, reading, shown
from spackle.files import check_file

MAX_BYTES = 64 << 20
MAX_FRAMES = 10_000  # cameras or keyframes
MAX_SIZE = 16_384
LARGEST = 1e9  # largest number in a camera: float32 can represent its square
MAX_NUMBER = 1e6  # largest number in a path: a thousand kilometres, or eleven days
RIGID_TOLERANCE = 1e-3
ZERO_TOLERANCE = 1e-6


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read `{"width": W, "height": H, "frames": [{"K": 3×3, "world_to_camera": 4×4}, …]}`.

    Matrices are lists of rows. The world is the photo's camera (OpenCV: x right, y down, z forward);
    K is in pixels. A frame may carry its own width and height.

    Raises:
        InputError: the file has another content, no frame or more than 10,000, or an impossible camera, see
            `checked_camera`.
    """
    content, frames = _read_json(path, "camera file", "frames", "K", "world_to_camera")
    size = {side: content.get(side) for side in ("width", "height")}
    return [camera_of(size | frame, f"{path}: frame {index}") for index, frame in enumerate(frames)]


def camera_of(facts: Mapping[str, Any], where: str) -> Camera:
    """A camera from its entry in a JSON file; InputError, beginning with `where`, if the camera is impossible."""
    K, pose = (_matrix(facts.get(name), n, f"{where}: {name}") for name, n in (("K", 3), ("world_to_camera", 4)))
    return checked_camera(K, pose, facts.get("width"), facts.get("height"), where)


def _matrix(rows: object, n: int, where: str) -> Tensor:
    """Convert a list of n lists of n numbers to float64 [n, n]; InputError for anything else."""
    lists = rows if isinstance(rows, list) else []
    numbers = [value for row in lists if isinstance(row, list) and len(row) == n for value in row]
    if len(lists) != n or len(numbers) != n * n or not all(type(value) in (int, float) for value in numbers):
        raise InputError(f"{where} must be a list of {n} rows of {n} numbers")
    try:
        return torch.tensor([float(value) for value in numbers], dtype=torch.float64).reshape(n, n)
    except OverflowError:  # a whole number with 400 digits
        raise InputError(f"{where} must be finite") from None


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
    """Check float64 matrices [3, 3] and [4, 4], and return a camera of them, in `dtype`.

    The rotation times its transpose must equal the identity within `tolerance`.

    Raises:
        InputError: beginning with `where`: K has no positive focal lengths, or has skew, or a last row other than
            0 0 1; world_to_camera is not a rotation and a translation; the size is outside 1..16384.
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

    A keyframe may also have "up" [x, y, z] and "fov" in degrees; the file may have "closed" and "unit", as in
    `KeyframePath`. The world is the photo's camera (OpenCV: x right, y down, z forward).

    Raises:
        InputError: the file has another content, or gives no path: fewer than two keyframes or more than 10,000, times
            that do not increase, a number that is not finite or beyond a million, an eye at its target, an up along
            the view, a fov outside 1..170 degrees, or a name that is unknown or given twice.
    """
    content, entries = _read_json(path, "path file", "keyframes", "time", "eye", "target")
    _check_names(content, ["keyframes", "closed", "unit"], str(path))
    closed, unit = content.get("closed", False), content.get("unit", "metres")
    if not isinstance(closed, bool):
        raise InputError(f'{path}: "closed" must be true or false')
    if unit not in UNITS:
        raise InputError(f'{path}: "unit" must be {" or ".join(UNITS)}')
    keys = tuple(_keyframe(entry, f"{path}: keyframe {index}") for index, entry in enumerate(entries))
    with reading(path, "{reason}", PathError):
        return KeyframePath(keys, closed, unit)


def _keyframe(entry: Mapping[str, Any], where: str) -> Keyframe:
    _check_names(entry, [field.name for field in dataclasses.fields(Keyframe)], where)
    given: dict[str, Any] = {}
    for name, value in entry.items():
        single = name in ("time", "fov")
        numbers = [value] if single else value
        if not isinstance(numbers, list) or len(numbers) != (1 if single else 3):
            raise InputError(f'{where}: "{name}" must be a list of three numbers')
        for number in numbers:
            if type(number) not in (int, float) or not -MAX_NUMBER <= number <= MAX_NUMBER:  # true for NaN too
                raise InputError(f'{where}: "{name}" must hold finite numbers, at most a million, not {shown(number)}')
        given[name] = float(value) if single else tuple(map(float, numbers))
    with reading(where, "{reason}", PathError):
        return Keyframe(**given)


def _read_json(
    path: str | os.PathLike[str], kind: str, name: str, *required: str
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Read a JSON file: returns its content, and its list `name`, whose objects have the required keys.

    InputError if the file has another content.
    """
    if check_file(path, kind) > MAX_BYTES:
        raise InputError(f"{path}: too long for a {kind} (at most {MAX_BYTES >> 20} MiB): is it the right file?")
    with reading(path, "not JSON: {reason}", ValueError, RecursionError), open(path, encoding="utf-8-sig") as file:
        content = json.load(file, object_pairs_hook=_names_once)
    entries = content.get(name) if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f'{path}: needs a list "{name}" with at least one object')
    if len(entries) > MAX_FRAMES:
        raise InputError(f"{path}: {len(entries)} {name} are too many (at most {MAX_FRAMES}): split the file")
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict) or not set(required) <= set(entry):
            names = ", ".join(f'"{each}"' for each in required)
            raise InputError(f"{path}: {name.removesuffix('s')} {index}: must be an object with {names}")
    return content, entries


def _check_names(entry: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    if unknown := sorted(set(entry) - set(known)):
        raise InputError(f"{where}: unknown name {shown(unknown[0])}: there are {', '.join(known)}")


def _names_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object as a dict; ValueError if a name is given twice."""
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"the name {shown(name)} is there twice in one object")
        found[name] = value
    return found
