"""Rectified pairs with depth from disparities: Middlebury, Booster, and the Motorcycle in scikit-image."""

from __future__ import annotations

import contextlib
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.image_files import read_image
from spackle.core.photo import PHOTO_SUFFIXES
from spackle.depth.calibration import Calibration, read_calibration, read_short_text
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth, read_array
from spackle.paper.evaluation.case import Case, SecondView
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import list_files

HALF_PIXEL = 0.5  # Middlebury's and Booster's (0, 0) is the middle of the first pixel; here (0, 0) is its corner
TRUTHS = ("disp0GT.pfm", "disp0.pfm")  # the names in MiddEval3, and in the 2014 dataset
# Middlebury's calibration of the Motorcycle at a quarter of its size, as in scikit-image.
MOTORCYCLE_FOCAL_PX = 994.978
MOTORCYCLE_CX_PX = 311.193
MOTORCYCLE_CY_PX = 254.877
MOTORCYCLE_DOFFS_PX = 31.086
MOTORCYCLE_BASELINE_M = 0.193001


def _pair(
    name: str,
    left: Path,
    right: Path,
    lens: Calibration,
    size: tuple[int, int] | None,
    depth: Callable[[], DepthMap],
) -> Case:
    """A case of the left photo, with the right photo as second view; in `lens`, (0, 0) is the first pixel's corner."""
    if size is None:  # the photo cannot be read: its evaluation reports why
        return Case(name, left, depth=depth)
    cameras = lens.cameras(*size)
    return Case(
        name, left, cameras[0], depth=depth, seconds=(SecondView("right", right, cameras[1]),)
    )


def _size_of(*photos: Path) -> tuple[int, int] | None:
    """(width, height) from the header of the first readable photo; None if no photo is readable."""
    for photo in photos:
        with contextlib.suppress(InputError):
            return read_image(photo, lambda image: (image.width, image.height))
    return None


def _from_corner(lens: Calibration) -> Calibration:
    return replace(lens, cx=lens.cx + HALF_PIXEL, cy=lens.cy + HALF_PIXEL)


def pair_of_2014(folder: Path) -> Case:
    """A case from a folder as in Middlebury 2014: im0.png, im1.png, calib.txt, and disp0.pfm or disp0GT.pfm."""
    calib = folder / "calib.txt"
    lens = _from_corner(read_calibration(calib))
    if lens.size is None or min(lens.size) < 1:
        raise InputError(f"{calib}: needs a width and a height above 0: the file is damaged")
    truth = next((folder / name for name in TRUTHS if (folder / name).is_file()), None)
    if truth is None:
        raise InputError(
            f"{folder}: no {' or '.join(TRUTHS)}: unpack the ground truth, or leave test scenes out"
        )
    read = partial(load_depth, truth, calib=calib)
    return _pair(
        folder.name,
        folder / "im0.png",
        folder / "im1.png",
        lens,
        lens.size,
        lambda: replace(read(), K=lens.K),
    )


# --- Middlebury


def middlebury_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """A case for each scene; the second view is the right photo.

    A scene's folder has either `im0.png` and `calib.txt` (2014 at full size; MiddEval3 at full, half or quarter size),
    or a `scene.json`, which can describe any rectified pair. `X-imperfect` is skipped if there is `X-perfect`; test
    scenes are skipped, because they have no ground truth. The paper's 23 scenes are those of 2014.
    """
    names = [
        name
        for name in scenes
        if name.replace("-imperfect", "-perfect") not in scenes.keys() - {name}
    ]
    return [_middlebury_case(scenes[name]) for name in names]


def _middlebury_case(folder: Path) -> Case:
    """A case from `scene.json` (pixel centres at half-integers; lengths may be nominal), or from the files of 2014."""
    path = folder / "scene.json"
    if not path.exists():
        return pair_of_2014(folder)
    lens = read_calibration(path)
    with as_input_error(path, "not a scene description: needs the photos and the disparity map"):
        facts = json.loads(read_short_text(path))
        left, right, truth = (folder / str(facts[key]) for key in ("left", "right", "disparity"))
    return _pair(
        folder.name, left, right, lens, _size_of(left), partial(load_depth, truth, calib=path)
    )


# --- Booster


def booster_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Cases of 12-megapixel stereo scenes with glass and mirrors: one for each left photo, that is, each lighting.

    Left photos are `train/balanced/SCENE/camera_00/im*.png` of 4112×3008 pixels; right photos have the same names in
    `camera_02`. All photos of a scene share one `disp_00.npy` and one `calib_00-02.xml` (OpenCV: proj_matL, proj_matR,
    baselineLR in millimetres). Test scenes are skipped because they have no ground truth, unbalanced scenes because
    their right camera differs. At the working size the photos have 1536×1124 pixels and the paper's 431,616 cells.
    """
    return [case for scene in scenes.values() for case in _lights_of(scene)]


def _lights_of(scene: Path) -> list[Case]:
    photos, rights = list_files(scene / "camera_00", PHOTO_SUFFIXES), scene / "camera_02"
    lens, truth = _read_opencv(scene / "calib_00-02.xml"), scene / "disp_00.npy"
    if not truth.is_file():
        raise InputError(
            f"{truth}: no such disparity map: give train/balanced; Booster's test scenes have none"
        )
    size, read = _size_of(*photos), lambda: lens.depth_from_positive(read_array(truth)[0], truth)
    return [_pair(f"{scene.name}/{p.stem}", p, rights / p.name, lens, size, read) for p in photos]


def _read_opencv(path: Path) -> Calibration:
    def matrix(entry: ElementTree.Element) -> NDArray[np.float64]:
        rows, columns = (int(entry.findtext(name, "")) for name in ("rows", "cols"))
        return np.array(entry.findtext("data", "").split(), np.float64).reshape(rows, columns)

    with as_input_error(
        path, "not a Booster calibration ({reason}): needs proj_matL, proj_matR and baselineLR"
    ):
        entries = {entry.tag: entry for entry in ElementTree.fromstring(read_short_text(path))}
        left, right = (matrix(entries[name]) for name in ("proj_matL", "proj_matR"))
        cx, baseline = float(left[0, 2]), float(entries["baselineLR"].text or "") / 1000
        lens = Calibration(
            float(left[0, 0]), cx, float(left[1, 2]), float(right[0, 2]) - cx, baseline
        )
    return _from_corner(lens.checked(path))


# --- the Motorcycle


@dataclass(frozen=True)
class StereoPair:
    """A photo with measured depth, and the photo of a second camera."""

    left: Tensor  # [H, W, 3] sRGB
    right: Tensor  # [H, W, 3] sRGB
    depth: DepthMap
    left_camera: Camera
    right_camera: Camera


def load_motorcycle() -> StereoPair:
    """Load Middlebury's Motorcycle from scikit-image; InputError if scikit-image is not installed."""
    try:
        from skimage.data import stereo_motorcycle
    except ImportError as error:
        raise InputError(
            "the demo's photo is inside scikit-image: pip install 'spackle-nvs[demo]'"
        ) from error
    left, right, disparity = stereo_motorcycle()  # type: ignore[no-untyped-call]
    cx, cy = MOTORCYCLE_CX_PX, MOTORCYCLE_CY_PX
    lens = Calibration(MOTORCYCLE_FOCAL_PX, cx, cy, MOTORCYCLE_DOFFS_PX, MOTORCYCLE_BASELINE_M)
    first, second = (torch.from_numpy(photo.astype(np.float32) / 255) for photo in (left, right))
    return StereoPair(
        first,
        second,
        lens.depth_from_positive(disparity, Path("Motorcycle")),
        *lens.cameras(*disparity.shape[::-1]),
    )
