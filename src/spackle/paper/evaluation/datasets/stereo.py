"""Rectified pairs of photos with depth from disparities, and the Motorcycle in scikit-image.

A rectified pair has two cameras that look in the same direction, side by side. Its calibration
gives focal length, principal point, the distance of the cameras (baseline) and the offset of the
disparities.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.image_files import read_image
from spackle.depth.calibration import Calibration, read_calibration
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.paper.evaluation.case import Case, SecondView
from spackle.runtime.errors import InputError

# Calibrations of Middlebury and Booster have (0, 0) at the middle of the first pixel. Here (0, 0)
# is the pixel's corner, half a pixel away.
HALF_PIXEL = 0.5
# Names of the true disparity map in MiddEval3 and in the dataset of 2014.
DISPARITY_FILES = ("disp0GT.pfm", "disp0.pfm")

# Middlebury's calibration of the Motorcycle at a quarter of its size, as in scikit-image.
MOTORCYCLE_FOCAL_PX = 994.978
MOTORCYCLE_CX_PX = 311.193
MOTORCYCLE_CY_PX = 254.877
MOTORCYCLE_DOFFS_PX = 31.086
MOTORCYCLE_BASELINE_M = 0.193001


def rectified_pair(
    name: str,
    left: Path,
    right: Path,
    calibration: Calibration,
    size: tuple[int, int] | None,
    read_depth: Callable[[], DepthMap] | None,
) -> Case:
    """The case of a left photo, with the right photo as its second view.

    Args:
        name: the case's name.
        left: the file of the left photo.
        right: the file of the right photo.
        calibration: of the pair; (0, 0) is the corner of the first pixel.
        size: (width, height) of the photos in pixels; None: they cannot be read. Then the case has
            no second view, and its evaluation reports why the photo cannot be read.
        read_depth: reads the left photo's depth; None: it is unknown.
    """
    if size is None:
        return Case(name=name, photo=left, read_depth=read_depth)
    width, height = size
    left_camera, right_camera = calibration.cameras(width, height)
    return Case(
        name=name,
        photo=left,
        camera=left_camera,
        read_depth=read_depth,
        second_views=(SecondView(name="right", photo=right, camera=right_camera),),
    )


def size_of_photos(photos: Sequence[Path]) -> tuple[int, int] | None:
    """(width, height) from the header of the first readable photo; None if no photo is readable."""
    for photo in photos:
        with contextlib.suppress(InputError):
            return read_image(photo, lambda image: (image.width, image.height))
    return None


def with_origin_at_corner(calibration: Calibration) -> Calibration:
    """Move a calibration's origin from the middle of the first pixel to the pixel's corner."""
    return replace(calibration, cx=calibration.cx + HALF_PIXEL, cy=calibration.cy + HALF_PIXEL)


def pair_of_2014(folder: Path) -> Case:
    """The case of a folder with the files of Middlebury 2014.

    These are im0.png and im1.png (left and right photo), calib.txt, and the left photo's true
    disparities, disp0.pfm or disp0GT.pfm.

    Raises:
        InputError: calibration or disparity map are missing or damaged.
    """
    calibration_path = folder / "calib.txt"
    calibration = with_origin_at_corner(read_calibration(calibration_path))
    if calibration.size is None or min(calibration.size) < 1:
        raise InputError(
            f"{calibration_path}: needs a width and a height above 0: the file is damaged"
        )

    # Middlebury does not publish the true disparities of its test scenes.
    disparity_paths = [folder / name for name in DISPARITY_FILES if (folder / name).is_file()]
    if not disparity_paths:
        raise InputError(
            f"{folder}: no {' or '.join(DISPARITY_FILES)}: unpack the ground truth, or leave test "
            "scenes out"
        )

    def read_depth() -> DepthMap:
        """Depth of the left photo, with the intrinsics of the calibration."""
        # The file's principal point counts from the centre of the first pixel, and `load_depth`
        # keeps it so. `calibration` counts from this pixel's corner, as all cameras here do.
        depth_map = load_depth(disparity_paths[0], calib=calibration_path)
        return replace(depth_map, K=calibration.K)

    return rectified_pair(
        name=folder.name,
        left=folder / "im0.png",
        right=folder / "im1.png",
        calibration=calibration,
        size=calibration.size,
        read_depth=read_depth,
    )


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
    """Load Middlebury's Motorcycle, a rectified pair of photos, from the package scikit-image.

    Raises:
        InputError: scikit-image is not installed.
    """
    try:
        from skimage.data import stereo_motorcycle
    except ImportError as error:
        raise InputError(
            "the demo's photo is inside scikit-image: pip install 'spackle-nvs[demo]'"
        ) from error

    # Photos [H, W, 3] of bytes, and disparities [H, W] in pixels.
    left, right, disparity = stereo_motorcycle()  # type: ignore[no-untyped-call]
    height, width = disparity.shape

    calibration = Calibration(
        focal_px=MOTORCYCLE_FOCAL_PX,
        cx=MOTORCYCLE_CX_PX,
        cy=MOTORCYCLE_CY_PX,
        doffs_px=MOTORCYCLE_DOFFS_PX,
        baseline_m=MOTORCYCLE_BASELINE_M,
    )
    left_camera, right_camera = calibration.cameras(width, height)
    return StereoPair(
        left=torch.from_numpy(left.astype(np.float32) / 255),  # 255 is the largest byte
        right=torch.from_numpy(right.astype(np.float32) / 255),
        # There is no file, so messages name the scene.
        depth=calibration.depth_from_positive(disparity, path=Path("Motorcycle")),
        left_camera=left_camera,
        right_camera=right_camera,
    )
