"""Booster: stereo at 12 megapixels of scenes with glass and mirrors."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.bases.depth_maps import DepthMap
from spackle.errors import InputError, reason_in_a_line
from spackle.evaluation.case import Case
from spackle.evaluation.datasets.folders import by_name, photo_files, scene_folders
from spackle.evaluation.datasets.stereo import HALF_PIXEL, BrokenPhoto, Pair, make_pair, picture_size, read_text

CALIBRATION = "calib_00-02.xml"


class Booster:
    """The balanced training scenes: each photo of the left camera (one a light) is a case.

    `train/balanced/SCENE/camera_00/im*.png` at 4112×3008, the right photo of the same name in `camera_02`, one
    `disp_00.npy` and one `calib_00-02.xml` (OpenCV: proj_matL, proj_matR, baselineLR in millimetres) for all lights.
    The test scenes have no truth, and the unbalanced ones another right camera: both are passed over.
    At the working size the photos are 1536×1124: the paper's 431,616 cells.
    """

    name = "booster"
    title = "Booster"
    terms = "research, cite; see its page"
    paper_images = 228

    def cases(self, root: Path) -> Sequence[Case]:
        """One case for each photo of a left camera; see `EvalDataset`."""
        return [case for scene in by_name(scene_folders(root, self.name)).values() for case in _cases(scene)]


def _cases(scene: Path) -> list[Case]:
    photos = photo_files(scene / "camera_00")
    if not photos:
        raise InputError(f"{scene / 'camera_00'}: no photos: expected im0.png and more; unpack the scene again")
    try:
        size = _first_size(photos)
    except BrokenPhoto as error:
        return [Case(f"{scene.name}/{photo.stem}", photo, problem=str(error)) for photo in photos]
    pair = _pair(scene / CALIBRATION, size)
    truth = scene / "disp_00.npy"
    if not truth.is_file():
        raise InputError(f"{truth}: no such disparity map: give train/balanced; Booster's test scenes have none")

    def depth() -> DepthMap:
        stored = _read(truth)
        return pair.depth(stored, np.isfinite(stored) & (stored > 0), 1.0, truth)

    def case(photo: Path) -> Case:
        right = scene / "camera_02" / photo.name
        return pair.case(f"{scene.name}/{photo.stem}", (photo, right), depth, metric=True)

    return [case(photo) for photo in photos]


def _first_size(photos: Sequence[Path]) -> tuple[int, int]:
    """Of the first photo that can be read: all of a scene are of one size."""
    for photo in photos[:-1]:
        with contextlib.suppress(BrokenPhoto):
            return picture_size(photo)
    return picture_size(photos[-1])


def _pair(path: Path, size: tuple[int, int]) -> Pair:
    text = read_text(path, "calibration")
    try:
        entries = {entry.tag: entry for entry in ElementTree.fromstring(text)}
        left, right = (_matrix(entries[name]) for name in ("proj_matL", "proj_matR"))
        baseline = float(entries["baselineLR"].text or "") / 1000
        focal, cx, cy = float(left[0, 0]), float(left[0, 2]), float(left[1, 2])
        if not (focal > 0 and baseline > 0):
            raise ValueError("focal length and baseline must be positive")
    except (ElementTree.ParseError, KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: not a Booster calibration ({reason_in_a_line(error)}): needs proj_matL, proj_matR and baselineLR"
        ) from error
    return make_pair((focal, cx + HALF_PIXEL, cy + HALF_PIXEL), float(right[0, 2]) - cx, baseline, size)


def _matrix(entry: ElementTree.Element) -> NDArray[np.float64]:
    """OpenCV's <rows>, <cols>, <data>."""
    rows, columns = (int(entry.findtext(name, "")) for name in ("rows", "cols"))
    return np.array(entry.findtext("data", "").split(), np.float64).reshape(rows, columns)


def _read(path: Path) -> NDArray[Any]:
    """Float disparities [H, W]; nothing is unpickled."""
    try:
        stored: NDArray[Any] = np.load(path, allow_pickle=False)
    except Exception as error:  # NumPy at work on a stranger's bytes raises anything
        raise InputError(f"{path}: cannot be decoded ({reason_in_a_line(error)}): the file is damaged") from error
    if stored.ndim != 2 or stored.dtype.kind != "f":
        raise InputError(f"{path}: {stored.dtype} of shape {stored.shape}: expected disparities as floats, [H, W]")
    return stored
