"""Path files: where the camera is at which time, as JSON."""

from __future__ import annotations

import json
import os
from typing import Any

from spackle.errors import InputError, reason_in_a_line
from spackle.image import check_file
from spackle.keyframes import UNITS, Keyframe, KeyframePath, PathError

MAX_FILE_BYTES = 4 << 20
MAX_KEYS = 10_000
LIMIT = 1e6  # of any number: a thousand kilometres, eleven days

_REQUIRED = ("time", "eye", "target")
_KEY = (*_REQUIRED, "up", "fov")
_FILE = ("keyframes", "closed", "unit")


def load_path(path: str | os.PathLike[str]) -> KeyframePath:
    """Read `{"keyframes": [{"time": s, "eye": [x, y, z], "target": [x, y, z]}, …]}`.

    A keyframe may carry "up" [x, y, z] and "fov" in degrees, the file "closed" and "unit", as in `KeyframePath`.
    The world is the photo's camera (OpenCV: x right, y down, z forward).

    Raises:
        InputError: not such a file, or not a path: fewer than two keyframes or more than 10,000, times that do not
            increase, a number that is not finite or beyond a million, an eye at its target, an up along the view,
            a fov outside 1..170 degrees, or a name that is unknown or there twice.
    """
    if check_file(path, "path file") > MAX_FILE_BYTES:
        raise InputError(f"{path}: too long for a path file (at most 4 MiB): is it the right file?")
    try:
        with open(path, encoding="utf-8-sig") as file:
            content = json.load(file, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON: {reason_in_a_line(error)}") from error
    if not isinstance(content, dict) or not isinstance(content.get("keyframes"), list):
        raise InputError(f'{path}: needs a list "keyframes" of objects with "time", "eye" and "target"')
    _check_names(content, _FILE, str(path))
    if len(content["keyframes"]) > MAX_KEYS:
        raise InputError(f"{path}: {len(content['keyframes'])} keyframes are too many (at most {MAX_KEYS})")
    closed, unit = content.get("closed", False), content.get("unit", "metres")
    if not isinstance(closed, bool):
        raise InputError(f'{path}: "closed" must be true or false')
    if unit not in UNITS:
        raise InputError(f'{path}: "unit" must be {" or ".join(UNITS)}')
    keys = [_keyframe(entry, f"{path}: keyframe {index}") for index, entry in enumerate(content["keyframes"])]
    try:
        return KeyframePath(tuple(keys), closed, unit)
    except PathError as error:
        raise InputError(f"{path}: {error}") from error


def _keyframe(entry: object, where: str) -> Keyframe:
    if not isinstance(entry, dict) or any(name not in entry for name in _REQUIRED):
        raise InputError(f'{where}: must be an object with "time", "eye" and "target"')
    _check_names(entry, _KEY, where)
    given: dict[str, Any] = {
        name: _vector(entry[name], name, where) for name in ("eye", "target", "up") if name in entry
    }
    given |= {name: _number(entry[name], f'"{name}"', where) for name in ("time", "fov") if name in entry}
    try:
        return Keyframe(**given)
    except PathError as error:
        raise InputError(f"{where}: {error}") from error


def _vector(value: object, name: str, where: str) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(f'{where}: "{name}" must be a list of three numbers')
    return tuple(_number(part, f'"{name}"', where) for part in value)


def _number(value: object, name: str, where: str) -> float:
    if type(value) not in (int, float):
        raise InputError(f"{where}: {name} must hold numbers, not {reason_in_a_line(json.dumps(value))}")
    if not -LIMIT <= value <= LIMIT:  # type: ignore[operator]  # NaN is not, either
        raise InputError(f"{where}: {name} must be a finite number, at most a million, got {str(value)[:20]}")
    return float(value)  # type: ignore[arg-type]


def _check_names(entry: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    if unknown := sorted(set(entry) - set(known)):
        raise InputError(f"{where}: unknown name {reason_in_a_line(unknown[0])!r}: there are {', '.join(known)}")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; ValueError where a name is there twice."""
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"the name {name!r} is there twice in one object")
        found[name] = value
    return found
