"""Booster: rectified pairs of photos with glass and mirrors, each scene under several lightings."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spackle.core.image_formats import list_photos
from spackle.depth.calibration import Calibration, read_short_text
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import read_stored_depth
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.stereo import (
    rectified_pair,
    size_of_photos,
    with_origin_at_corner,
)
from spackle.runtime.errors import InputError, as_input_error

MM_PER_M = 1000


def booster_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """A case (an input photo with what is known about it) for each left photo of each scene.

    A scene has a left photo for each lighting, of 4112×3008 pixels:
    train/balanced/SCENE/camera_00/im*.png. The right photos have the same names in camera_02. All
    photos of a scene share one disparity map, disp_00.npy, and one calibration, calib_00-02.xml.

    Test scenes are not searched, because they have no ground truth; unbalanced scenes are not,
    because their right camera differs. Photos are evaluated at 1536×1124 pixels, that is, 768 ·
    562 = 431,616 cells of 2×2 pixels, the paper's number.

    Args:
        scenes: the folder of each scene, by the scene's name.

    Raises:
        InputError: a calibration or disparity map is missing or damaged.
    """
    return [case for folder in scenes.values() for case in _cases_of_scene(folder)]


def _cases_of_scene(folder: Path) -> list[Case]:
    """A case for each left photo of a scene; all photos have one calibration and one depth map.

    Raises:
        InputError: the calibration or the disparity map is missing or damaged.
    """
    # The left camera is number 00, the right one 02. All left photos have one size, which is read
    # from the first photo that is not damaged.
    left_photos = list_photos(folder / "camera_00")
    size = size_of_photos(left_photos)
    calibration = _read_opencv_calibration(folder / "calib_00-02.xml")
    disparity_path = folder / "disp_00.npy"
    if not disparity_path.is_file():
        raise InputError(
            f"{disparity_path}: no such disparity map: give train/balanced; Booster's test scenes "
            "have none"
        )

    def read_depth() -> DepthMap:
        """Depth of the left photos."""
        disparity = read_stored_depth(disparity_path).numbers
        return calibration.depth_from_positive(disparity, disparity_path)

    cases = []
    for left in left_photos:
        right = folder / "camera_02" / left.name
        name = f"{folder.name}/{left.stem}"
        cases.append(rectified_pair(name, left, right, calibration, size, read_depth))
    return cases


def _read_opencv_calibration(path: Path) -> Calibration:
    """Read a rectified pair's calibration from OpenCV's XML.

    The file has the projection matrices [3, 4] of both cameras, proj_matL and proj_matR, and
    baselineLR, the distance of the cameras in millimetres.

    Raises:
        InputError: the file is missing or damaged.
    """
    with as_input_error(
        path, "not a Booster calibration ({reason}): needs proj_matL, proj_matR and baselineLR"
    ):
        entries = {entry.tag: entry for entry in ElementTree.fromstring(read_short_text(path))}
        left = _matrix_of_entry(entries["proj_matL"])
        right = _matrix_of_entry(entries["proj_matR"])
        baseline_mm = float(entries["baselineLR"].text or "")

        # The principal points of the two cameras differ along x, which offsets the disparities.
        left_cx = float(left[0, 2])
        right_cx = float(right[0, 2])
        calibration = Calibration(
            focal_px=float(left[0, 0]),
            cx=left_cx,
            cy=float(left[1, 2]),
            doffs_px=right_cx - left_cx,
            baseline_m=baseline_mm / MM_PER_M,
        )
    return with_origin_at_corner(calibration.checked(path))


def _matrix_of_entry(entry: ElementTree.Element) -> NDArray[np.float64]:
    """A matrix of OpenCV's XML, which has the numbers of rows and columns and the values."""
    rows = int(entry.findtext("rows", ""))
    columns = int(entry.findtext("cols", ""))
    values = entry.findtext("data", "").split()
    return np.array(values, np.float64).reshape(rows, columns)


BOOSTER = EvalDataset(
    name="booster",
    title="Booster",
    terms="research, cite; see its page",
    markers=("camera_00",),
    expected="train/balanced/SCENE/camera_00/*.png",
    read_cases=booster_cases,
    skipped_folders=("test", "unbalanced"),
)
