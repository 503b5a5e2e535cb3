"""Photos with measured depth: frames of depth cameras, and stereo pairs with disparities."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.image_formats import list_photos
from spackle.core.photo import load_photo
from spackle.depth.calibration import read_calibration
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import list_files


@dataclasses.dataclass(frozen=True)
class StereoPair:
    """Two photos of a scene, taken side by side, and the depth of the left one."""

    left: Tensor  # [H, W, 3] sRGB
    right: Tensor  # [H, W, 3] sRGB
    depth: DepthMap  # of the left photo
    left_camera: Camera
    right_camera: Camera


def find_files(folder: Path, key: str, endings: tuple[str, ...], description: str) -> list[Path]:
    """All files below a folder with one of these endings, sorted; InputError if there are none.

    Args:
        folder: where to look, its subfolders included.
        key: the recipe's key that names the folder, such as "data.photos", for messages.
        endings: how file names may end, such as ".jpg".
        description: what the files are, for messages.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder, but {key} names it: give {key}=FOLDER")
    files = list_files(folder, endings, below=True)
    if not files:
        raise InputError(f"{folder}: contains no {description}: set {key} to another folder")
    return files


def find_photo_files(folder: Path, key: str) -> list[Path]:
    """All photos below a folder, told by their content, sorted; InputError if there are none.

    Args:
        folder: where to look, its subfolders included.
        key: the recipe's key that names the folder, such as "data.photos", for messages.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder, but {key} names it: give {key}=FOLDER")
    photos = list_photos(folder, below=True)
    if not photos:
        raise InputError(f"{folder}: contains no photos: set {key} to another folder")
    return photos


def pick_random(rng: np.random.Generator, files: Sequence[Path]) -> Path:
    """One of the files, each with the same probability."""
    return files[int(rng.integers(len(files)))]


def draw_rgbd_frame(
    rng: np.random.Generator, frames: Sequence[Path], focal_px: float, unit_m: float
) -> tuple[Tensor, DepthMap, Camera]:
    """A random frame of a depth camera: photo [H, W, 3] sRGB, depth and camera.

    Args:
        rng: chooses the frame.
        frames: the photos NAME.color.jpg.
        focal_px: focal length of the depth camera in pixels.
        unit_m: one unit of the depth files in metres.
    """
    rgb, depth = load_frame(pick_random(rng, frames), unit_m)
    return rgb, depth, Camera.from_focal(focal_px, rgb.shape[1], rgb.shape[0])


def draw_left_photo(
    rng: np.random.Generator, folders: Sequence[Path]
) -> tuple[Tensor, DepthMap, Camera]:
    """The left photo [H, W, 3] sRGB of a random stereo pair, with its depth and camera."""
    pair = load_pair(pick_random(rng, folders))
    return pair.left, pair.depth, pair.left_camera


def load_frame(color_file: Path, unit_m: float) -> tuple[Tensor, DepthMap]:
    """Read a frame of a depth camera: the photo [H, W, 3] sRGB, and its depth in metres.

    Args:
        color_file: the photo NAME.color.jpg; its depth is in NAME.depth.png beside it.
        unit_m: one unit of the depth file in metres; 0 and 65535 mean unknown depth.

    Raises:
        InputError: a file is missing or broken, or the two differ in the ratio of their sides.
    """
    rgb = load_photo(color_file).rgb
    # The names of a frame's files differ by one word and the suffix.
    depth_name = color_file.name.replace(".color.", ".depth.")
    depth = load_depth(color_file.with_name(depth_name).with_suffix(".png"), unit=unit_m)
    depth.check_aspect_ratio(rgb.shape[0], rgb.shape[1], color_file)
    return rgb, depth


def load_pair(folder: Path) -> StereoPair:
    """Read a stereo pair from a folder.

    The folder's scene.json names the photos, the disparities and the calibration.

    InputError if a file is missing or broken, or the photos differ in size.
    """
    scene_file = folder / "scene.json"
    problem = "no stereo pair: needs a scene.json that names photos and calibration ({reason})"
    with as_input_error(folder, problem):
        facts = json.loads(scene_file.read_text(encoding="utf-8"))
        left_file = folder / facts["left"]
        right_file = folder / facts["right"]
        disparity_file = folder / facts["disparity"]
        calibration = read_calibration(scene_file)

    # A pair is rectified: both photos have the same rows, and so the same size.
    left = load_photo(left_file).rgb
    right = load_photo(right_file).rgb
    if left.shape != right.shape:
        raise InputError(f"{folder}: the two photos differ in size")
    height, width = left.shape[:2]
    depth = load_depth(disparity_file, calib=scene_file)
    depth.check_aspect_ratio(height, width, left_file)
    left_camera, right_camera = calibration.cameras(width, height)
    return StereoPair(left, right, depth, left_camera, right_camera)
