"""Camera files: which views to render, as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.errors import InputError, reason_in_a_line
from spackle.formats.atomic import atomic_path
from spackle.image import check_file

MAX_FILE_BYTES = 64 << 20
MAX_FRAMES = 10_000
MAX_SIZE = 16_384
RIGID_TOLERANCE = 1e-3
ZERO_TOLERANCE = 1e-6

_SHAPES = (("K", 3), ("world_to_camera", 4))


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read `{"width": W, "height": H, "frames": [{"K": 3×3, "world_to_camera": 4×4}, …]}`.

    Matrices are lists of rows. The world is the photo's camera (OpenCV: x right, y down, z forward);
    K is in pixels. A frame may carry its own width and height.

    Raises:
        InputError: not such a file, no frame or more than 10,000, or a camera that cannot be: K without
            positive focal lengths, with skew or a last row other than 0 0 1; world_to_camera that is
            not a rotation and a translation; a size outside 1..16384.
    """
    if check_file(path, "camera file") > MAX_FILE_BYTES:
        raise InputError(f"{path}: too long for a camera file (at most 64 MiB): split it")
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON: {reason_in_a_line(error)}") from error
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
        K, world_to_camera = (_matrix(frame.get(name), n, name, where) for name, n in _SHAPES)
        cameras.append(checked_camera(K, world_to_camera, width, height, where))
    return cameras


def save_cameras(cameras: Sequence[Camera], path: str | os.PathLike[str]) -> None:
    """Write a camera file; `load_cameras` returns the same numbers, bit for bit in float32."""
    if not cameras:
        raise ValueError("a camera file needs at least one camera")
    first, frames = cameras[0], []
    for camera in cameras:
        frame: dict[str, Any] = {"K": camera.K.tolist(), "world_to_camera": camera.world_to_camera.tolist()}
        if (camera.width, camera.height) != (first.width, first.height):
            frame |= {"width": camera.width, "height": camera.height}
        frames.append(frame)
    text = json.dumps({"width": first.width, "height": first.height, "frames": frames}, indent=1, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def checked_camera(K: Tensor, world_to_camera: Tensor, width: object, height: object, where: str) -> Camera:
    """A camera of float64 matrices [3, 3] and [4, 4]; InputError, beginning with `where`, if it cannot be."""
    sizes = [n for n in (width, height) if isinstance(n, int) and not isinstance(n, bool) and 1 <= n <= MAX_SIZE]
    if len(sizes) != 2:
        raise InputError(f"{where}: width and height must be whole numbers from 1 to {MAX_SIZE}")
    if not (torch.isfinite(K).all() and torch.isfinite(world_to_camera).all()):
        raise InputError(f"{where}: K and world_to_camera must be finite")
    if min(float(K[0, 0]), float(K[1, 1])) <= 0:
        raise InputError(f"{where}: K needs positive focal lengths at [0][0] and [1][1]")
    if K[2].tolist() != [0, 0, 1]:
        raise InputError(f"{where}: the last row of K must be 0 0 1")
    if max(abs(float(K[0, 1])), abs(float(K[1, 0]))) > ZERO_TOLERANCE * float(K[0, 0]):
        raise InputError(f"{where}: K has skew, which is not supported: [0][1] and [1][0] must be 0")
    rotation = world_to_camera[:3, :3]
    error = (rotation @ rotation.T - torch.eye(3, dtype=rotation.dtype)).abs().max()
    if error > RIGID_TOLERANCE or torch.linalg.det(rotation) < 0:
        raise InputError(f"{where}: world_to_camera must be a rotation (no scale, no mirror) and a translation")
    if (world_to_camera[3] - world_to_camera.new_tensor([0, 0, 0, 1])).abs().max() > ZERO_TOLERANCE:
        raise InputError(f"{where}: the last row of world_to_camera must be 0 0 0 1")
    return Camera(K.float(), world_to_camera.float(), *sizes)


def _matrix(rows: object, n: int, name: str, where: str) -> Tensor:
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
