"""Calibrations of rectified stereo pairs, which turn disparity in pixels into depth in metres.

They are read from Middlebury's `calib.txt`, and from a `scene.json` of our own.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.depth.depth_map import (
    Array,
    DepthMap,
    StrPath,
    build_depth_map,
    check_not_negative,
)
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

LARGEST_NUMBER = 1e9  # largest number in a calibration: its square still fits float32
SIZE_TOLERANCE = 0.02  # a map's sides may differ from the calibrated ones by this share
MAX_TEXT_BYTES = 1 << 16  # a calibration is a few lines
MILLIMETRES_PER_METRE = 1000


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A rectified stereo pair: the left camera, and the conversion from disparity to depth."""

    focal_px: float
    cx: float  # principal point of the left camera, in pixels
    cy: float
    doffs_px: float  # the right principal point's x minus the left one's
    baseline_m: float
    scale: float = 1.0  # disparity in pixels = stored value · scale
    invalid: float = math.inf  # stored value for "unknown"
    size: tuple[int, int] | None = None  # (width, height) of the image that the numbers describe

    @property
    def K(self) -> Tensor:
        """[3, 3] intrinsics of the left camera, in pixels."""
        return torch.tensor(
            [[self.focal_px, 0.0, self.cx], [0.0, self.focal_px, self.cy], [0.0, 0.0, 1.0]]
        )

    def depth_from_disparity(
        self, stored: Array, path: StrPath, *, zero_is_unknown: bool = False
    ) -> DepthMap:
        """The depth map of stored disparities [H, W]: depth = baseline · focal / (d + doffs).

        d, in pixels, is the stored value times `scale`, and doffs is how much larger the principal
        point's x is in the right photo than in the left one. `invalid`, NaN and inf mean unknown;
        0 does only if `zero_is_unknown`. InputError, naming `path`, for negative numbers, for a map
        of another size than the calibrated one, and if no pixel is known.
        """
        # A wrong file is refused before its numbers are used.
        check_not_negative(stored, path)
        self._check_map_size(stored, path)

        # Datasets mark unknown pixels in different ways.
        valid = np.isfinite(stored) & (stored != self.invalid)
        if zero_is_unknown:
            valid &= stored > 0
        with np.errstate(all="ignore"):  # infinite results are unknown
            disparity_px = stored.astype(np.float64) * self.scale + self.doffs_px
            depth = self.baseline_m * self.focal_px / disparity_px
        return build_depth_map(
            stored,
            depth=depth,
            valid=valid & np.isfinite(depth),
            quantity="disparity",
            stored_unit=self.scale / (self.baseline_m * self.focal_px),
            K=self.K,
            path=path,
            meaning="disparity in pixels",
        )

    def depth_from_positive(self, disparity_px: Array, path: StrPath) -> DepthMap:
        """The depth map of disparities [H, W] in pixels, where 0 and negative ones are unknown."""
        return self.depth_from_disparity(np.where(disparity_px > 0, disparity_px, np.inf), path)

    def _check_map_size(self, stored: Array, path: StrPath) -> None:
        """InputError if a map [H, W] differs from the calibrated size by more than 2 %."""
        if self.size is None:
            return
        height, width = stored.shape
        calibrated_width, calibrated_height = self.size
        width_error = abs(calibrated_width / width - 1)
        height_error = abs(calibrated_height / height - 1)
        if max(width_error, height_error) > SIZE_TOLERANCE:
            calibrated = f"{calibrated_width}×{calibrated_height}"
            raise InputError(
                f"{path}: {width}×{height} pixels, its calibration is for {calibrated}: "
                "give matching files"
            )

    def cameras(self, width: int, height: int) -> tuple[Camera, Camera]:
        """The cameras of the left and the right photo, in the left camera's frame."""
        # The world's origin is the left camera.
        left = Camera(self.K, torch.eye(4), width, height)

        # Rectified photos differ in the principal point's x and in the position along x alone.
        right_K = self.K  # the property makes a new tensor, which may be changed
        right_K[0, 2] += self.doffs_px
        left_to_right = torch.eye(4)
        left_to_right[0, 3] = -self.baseline_m
        return left, Camera(right_K, left_to_right, width, height)

    def checked(self, path: StrPath) -> Calibration:
        """This calibration; InputError, naming the file, if its numbers are impossible."""
        # Larger numbers are damage; their squares would leave the range of float32.
        must_be_positive = (self.focal_px, self.baseline_m, self.scale)
        may_be_negative = (self.cx, self.cy, self.doffs_px)
        are_positive = all(1 / LARGEST_NUMBER <= n <= LARGEST_NUMBER for n in must_be_positive)
        are_small = all(abs(n) <= LARGEST_NUMBER for n in may_be_negative)
        if not (are_positive and are_small):
            raise InputError(f"{path}: a number is not positive, or is above {LARGEST_NUMBER:g}")
        return self


def calibration_candidates(depth_file: Path) -> tuple[Path, Path]:
    """Where a map's calibration is searched for, existing or not: scene.json, calib.txt."""
    return depth_file.with_name("scene.json"), depth_file.with_name("calib.txt")


def read_calibration(path: StrPath) -> Calibration:
    """A calibration from a `scene.json` or Middlebury's `calib.txt`; InputError for other files."""
    if Path(path).suffix.lower() == ".json":
        return _read_scene_json(path)
    return _read_middlebury(path)


def find_calibration(depth_file: Path) -> Calibration | None:
    """The calibration in the folder of a map that holds disparity; None if the map holds depth.

    A map holds disparity if a `scene.json` names it, or if its name starts with "disp" and there is
    a Middlebury `calib.txt`. InputError if its name announces disparity and there is neither.
    """
    scene_json, calib_txt = calibration_candidates(depth_file)
    if scene_json.is_file() and _is_disparity_of_scene(depth_file, scene_json):
        return _read_scene_json(scene_json)

    # Middlebury's own names are disp0.pfm and disp0GT.pfm.
    stem = depth_file.stem.lower()
    if stem.startswith("disp") and calib_txt.is_file():
        return _read_middlebury(calib_txt)
    # To take disparity for metres would give a scene turned inside out.
    if stem.startswith("disp") or stem.endswith(("disp", "disparity")):
        raise InputError(
            f"{depth_file}: the name announces a disparity map: give `calib`, or rename the map"
        )
    return None


def _read_middlebury(path: StrPath) -> Calibration:
    """Read Middlebury's text: cam0=[f 0 cx; 0 f cy; 0 0 1], doffs (px), baseline (mm).

    Optional width and height say to which image the numbers belong. InputError for another text.
    """
    # The lines are NAME=VALUE, in any order.
    entries: dict[str, str] = {}
    for line in read_short_text(path).splitlines():
        name, _, value = line.partition("=")
        entries[name.strip()] = value.strip()

    problem = "not a Middlebury calibration: needs cam0=[f 0 cx; 0 f cy; 0 0 1], doffs and baseline"
    with as_input_error(path, problem):
        number_pattern = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
        # The matrix in row-major order: f 0 cx, 0 f cy, 0 0 1.
        cam0 = [float(text) for text in re.findall(number_pattern, entries["cam0"])]
        size = None
        if "width" in entries and "height" in entries:
            size = (int(entries["width"]), int(entries["height"]))
        calibration = Calibration(
            focal_px=cam0[0],
            cx=cam0[2],
            cy=cam0[5],
            doffs_px=float(entries.get("doffs", 0)),
            baseline_m=float(entries["baseline"]) / MILLIMETRES_PER_METRE,
            size=size,
        )
    return calibration.checked(path)


SCENE_JSON_PROBLEM = (
    "not a scene description: needs focal_px, cx, cy, doffs_px and baseline_m as JSON numbers"
)


def _is_disparity_of_scene(depth_file: Path, scene_json: Path) -> bool:
    """Whether a `scene.json` names this file as its `disparity`; InputError if it is broken."""
    with as_input_error(scene_json, SCENE_JSON_PROBLEM):
        scene = json.loads(read_short_text(scene_json))
        return bool(scene.get("disparity") == depth_file.name)


def _read_scene_json(path: StrPath) -> Calibration:
    """Read a `scene.json`: an object with the fields of `Calibration`.

    Two fields are optional: `disparity_scale` (1 if it is missing), with which a stored value gives
    pixels, and `invalid` (infinite if it is missing), the stored value for "unknown".
    """
    with as_input_error(path, SCENE_JSON_PROBLEM):
        scene = json.loads(read_short_text(path))
        calibration = Calibration(
            focal_px=float(scene["focal_px"]),
            cx=float(scene["cx"]),
            cy=float(scene["cy"]),
            doffs_px=float(scene["doffs_px"]),
            baseline_m=float(scene["baseline_m"]),
            scale=float(scene.get("disparity_scale", 1)),
            invalid=float(scene.get("invalid", "inf")),
        )
        return calibration.checked(path)


def read_short_text(
    path: StrPath, kind: str = "calibration", max_bytes: int = MAX_TEXT_BYTES
) -> str:
    """The text of a short file; InputError, calling it a `kind`, if it is missing or too long."""
    # The size is checked before reading, because somebody may give a wrong file of gigabytes.
    if check_file(path, kind) > max_bytes:
        raise InputError(f"{path}: too long for a {kind}: give another file")
    return Path(path).read_text(encoding="utf-8", errors="replace")
