"""Rectified pairs: Middlebury and Booster, with disparities as depth."""

from __future__ import annotations

import dataclasses
import functools
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.bases.depth_map import Calibration, DepthMap, load_depth, read_array, read_calibration, read_text
from spackle.camera import Camera
from spackle.errors import InputError, reason_in_a_line
from spackle.evaluation.case import Case, SecondView
from spackle.evaluation.datasets.folders import by_name, photo_files, scene_folders
from spackle.files import check_file
from spackle.image import read_image

# Middlebury and Booster calibrate with tools that put (0, 0) into the middle of the first pixel; here it is that
# pixel's corner. (Middlebury's smaller sizes have the big one's principal point divided plainly, so there it is known
# to half a pixel only; the pair does not notice, because both cameras move alike.)
HALF_PIXEL = 0.5
TRUTHS_2014 = ("disp0GT.pfm", "disp0.pfm")  # MiddEval3 and ETH3D; the sets as they were published
# Published for the sets of 2005 and 2006 at full size, height 1110; nearly exact, the site says.
FOCAL_2006, BASELINE_2006, HEIGHT_2006 = 3740.0, 0.160, 1110
# Of the sets of 2001 and 2003 only the disparities are known. Any lens makes the pair exact, with its own depth; these
# numbers, for 450 pixels of width, give depths like those of the later sets.
FOCAL_OLD, BASELINE_OLD, DOFFS_OLD, WIDTH_OLD = 1000.0, 0.1, 30.0, 450
SCALE_2001 = 8  # grey levels a pixel of disparity
WIDTH_2003_FULL = 1800  # Cones and Teddy: 450, 900 or 1800 wide, 4, 2 or 1 grey levels a pixel
LIGHT_2006 = "Illum2/Exp1"  # in the archives with seven views and all lights


class BrokenPhoto(InputError):
    """A photo that is there and cannot be read: a matter of its own case, and not of the folder's layout."""


def _depth_map(
    lens: Calibration, disparity: NDArray[Any], known: NDArray[np.bool_], unit: float, path: Path
) -> DepthMap:
    """z = focal · baseline / (disparity + doffs), of a disparity [H, W] in steps of `unit` pixels."""
    reach = float(lens.K[0, 0]) * lens.baseline_m
    with np.errstate(all="ignore"):  # what is not known may be anything
        z = torch.from_numpy((reach / (disparity * unit + lens.doffs_px)).astype(np.float32))
    valid = torch.from_numpy(known) & torch.isfinite(z) & (z > 0)
    if not valid.any():
        raise InputError(f"{path}: not one pixel has a disparity: the file is damaged, or of another dataset")
    quantum = None
    if disparity.dtype.kind in "iu":  # whole numbers: the grid that they lie on, in 1/length
        steps = np.diff(np.unique(disparity[valid.numpy()].astype(np.int64)))
        quantum = float(np.gcd.reduce(steps) if len(steps) else 1) * unit / reach
    return DepthMap(z.where(valid, 0.0), valid, lens.K, quantum, "disparity", path)


def _pair(
    name: str,
    photos: tuple[Path, Path],
    lens: Calibration,
    size: tuple[int, int],
    depth: Callable[[], DepthMap],
    *,
    metric: bool = True,
) -> Case:
    """The left photo, with the right one as its second view; `lens` counts from the first pixel's corner."""
    for photo in photos:
        if not photo.exists():
            check_file(photo, "photo")  # raises; a photo that cannot be read is named in its turn
    left = Camera(lens.K, torch.eye(4), *size)
    K, pose = lens.K, torch.eye(4)
    K[0, 2] += lens.doffs_px
    pose[0, 3] = -lens.baseline_m
    right = SecondView("right", photos[1], Camera(K, pose, *size))
    return Case(name, photos[0], left, depth=depth, seconds=(right,), metric=metric)


def _from_corner(lens: Calibration) -> Calibration:
    return dataclasses.replace(lens, cx=lens.cx + HALF_PIXEL, cy=lens.cy + HALF_PIXEL)


def pair_of_2014(folder: Path, truth: Path | None = None) -> Case:
    """A folder in the format of Middlebury 2014: im0.png, im1.png, calib.txt, and disp0.pfm or disp0GT.pfm."""
    calib = folder / "calib.txt"
    lens = _from_corner(read_calibration(calib))
    if lens.size is None or min(lens.size) < 1:
        raise InputError(f"{calib}: needs a width and a height above 0: the file is damaged")
    found = [at for at in (truth, *(folder / name for name in TRUTHS_2014)) if at is not None and at.is_file()]
    if not found:
        raise InputError(f"{folder}: no {' or '.join(TRUTHS_2014)}: unpack the ground truth, or leave test scenes out")

    def depth() -> DepthMap:
        return dataclasses.replace(load_depth(found[0], calib=calib), K=lens.K)

    return _pair(folder.name, (folder / "im0.png", folder / "im1.png"), lens, lens.size, depth)


def _picture_size(path: Path) -> tuple[int, int]:
    """(width, height) from a picture's header; BrokenPhoto where it cannot be read, InputError where it is missing."""
    try:
        return read_image(path, lambda image: (image.width, image.height))
    except InputError as error:
        if path.exists():
            raise BrokenPhoto(str(error)) from error
        raise


class Middlebury:
    """Rectified pairs with dense truth; the second view is the true right photo.

    Scene folders, at any depth below the root: `im0.png` with `calib.txt` (2014 at full size, and MiddEval3 at full,
    half or quarter size); `view1.png` with `disp1.png` and `dmin.txt` (2005, 2006); `im2.ppm` with `disp2.pgm`, or
    the same as PNG (2001, 2003); or a `scene.json`. Of `Piano-perfect` and `Piano-imperfect` the first is taken.
    Test scenes, which have no truth, are passed over. The paper's 23 are those of 2014. MiddEval3's three sizes have
    the same names: give `trainingF`, `trainingH` or `trainingQ` alone.
    """

    name = "middlebury"
    title = "Middlebury"
    terms = "free to use, cite"

    def cases(self, root: Path) -> Sequence[Case]:
        """One case for each scene; see `EvalDataset`."""
        folders = scene_folders(root, self.name)
        perfect = {folder.name for folder in folders}
        kept = [f for f in folders if f.name.replace("-imperfect", "-perfect") not in perfect - {f.name}]
        return [_middlebury_case(folder) for folder in by_name(kept).values()]


def _middlebury_case(folder: Path) -> Case:
    def has(*names: str) -> bool:
        return any((folder / name).is_file() for name in names)

    try:
        if has("calib.txt", "im0.png"):
            return pair_of_2014(folder)
        if has("scene.json"):
            return _described(folder)
        return _of_2006(folder) if has("disp1.png", "view1.png") else _of_2003(folder)
    except BrokenPhoto as error:
        return Case(folder.name, folder, problem=str(error))


def _of_2006(folder: Path) -> Case:
    """Grey level 0 is unknown; levels and dmin are pixels of the full size."""
    photos = folder if (folder / "view1.png").is_file() else folder / LIGHT_2006
    left, right = photos / "view1.png", photos / "view5.png"
    width, height = _picture_size(left)
    shrink = round(HEIGHT_2006 / height)
    if abs(height * shrink - HEIGHT_2006) > shrink or not 1 <= shrink <= 3:
        raise InputError(f"{left}: {height} pixels high: expected 1110, 555 or 370, as the sets of 2005 and 2006 are")
    try:
        dmin = float(read_text(folder / "dmin.txt", "offset of the disparities"))
    except ValueError as error:
        raise InputError(f"{folder / 'dmin.txt'}: not a number: unpack the scene again") from error
    lens = Calibration(FOCAL_2006 / shrink, width / 2, height / 2, dmin / shrink, BASELINE_2006)
    return _pair(folder.name, (left, right), lens, (width, height), _levels(lens, folder / "disp1.png", 1 / shrink))


def _of_2003(folder: Path) -> Case:
    """Also 2001: grey level 0 is unknown; the width tells how many levels a pixel has."""
    suffix = ".ppm" if (folder / "im2.ppm").is_file() else ".png"
    left, right = folder / f"im2{suffix}", folder / f"im6{suffix}"
    truths = [folder / name for name in ("disp2.pgm", "disp2.png") if (folder / name).is_file()]
    if not truths:
        raise InputError(f"{folder}: no disp2.pgm or disp2.png: unpack the whole scene")
    width, height = _picture_size(left)
    scale = WIDTH_2003_FULL // width if width in (450, 900, 1800) else SCALE_2001
    size = width / WIDTH_OLD
    lens = Calibration(FOCAL_OLD * size, width / 2, height / 2, DOFFS_OLD * size, BASELINE_OLD)
    depth = _levels(lens, truths[0], 1 / scale)
    return _pair(folder.name, (left, right), lens, (width, height), depth, metric=False)


def _levels(lens: Calibration, path: Path, unit: float) -> Callable[[], DepthMap]:
    """Reads the whole numbers of a grey picture as disparities of `unit` pixels each."""

    def levels(image: Any) -> NDArray[Any]:
        if image.mode not in ("L", "I", "I;16", "I;16B", "RGB"):
            raise InputError(f"{path}: pixels of mode {image.mode} are no disparities: give the dataset's own file")
        values = np.asarray(image)
        return values if values.ndim == 2 else values[..., 0]  # grey that was saved as colour

    def depth() -> DepthMap:
        stored = read_image(path, levels)
        return _depth_map(lens, stored, stored > 0, unit, path)

    return depth


def _described(folder: Path) -> Case:
    """By a `scene.json`, whose principal point has pixel centres at half-integers; its lengths may be nominal."""
    path = folder / "scene.json"
    lens, facts = read_calibration(path), json.loads(read_text(path))
    try:
        left, right, truth = (folder / str(facts[key]) for key in ("left", "right", "disparity"))
    except KeyError as error:
        raise InputError(f"{path}: not a scene description: needs the photos and the disparity map") from error
    depth = functools.partial(load_depth, truth, calib=path)
    return _pair(folder.name, (left, right), lens, _picture_size(left), depth, metric=False)


class Booster:
    """Stereo at 12 megapixels of scenes with glass and mirrors: each photo of a left camera (one a light) is a case.

    `train/balanced/SCENE/camera_00/im*.png` at 4112×3008, the right photo of the same name in `camera_02`, one
    `disp_00.npy` and one `calib_00-02.xml` (OpenCV: proj_matL, proj_matR, baselineLR in millimetres) for all lights.
    The test scenes have no truth, and the unbalanced ones another right camera: both are passed over.
    At the working size the photos are 1536×1124: the paper's 431,616 cells.
    """

    name = "booster"
    title = "Booster"
    terms = "research, cite; see its page"

    def cases(self, root: Path) -> Sequence[Case]:
        """One case for each photo of a left camera; see `EvalDataset`."""
        return [case for scene in by_name(scene_folders(root, self.name)).values() for case in _booster_cases(scene)]


def _booster_cases(scene: Path) -> list[Case]:
    photos = photo_files(scene / "camera_00")
    if not photos:
        raise InputError(f"{scene / 'camera_00'}: no photos: expected im0.png and more; unpack the scene again")
    size, problems = None, []
    for photo in photos:  # all of a scene are of one size
        try:
            size = _picture_size(photo)
            break
        except BrokenPhoto as error:
            problems.append(str(error))
    if size is None:
        return [Case(f"{scene.name}/{p.stem}", p, problem=why) for p, why in zip(photos, problems, strict=True)]
    lens = _read_opencv(scene / "calib_00-02.xml")
    truth = scene / "disp_00.npy"
    if not truth.is_file():
        raise InputError(f"{truth}: no such disparity map: give train/balanced; Booster's test scenes have none")

    def depth() -> DepthMap:
        stored, _ = read_array(truth)
        return _depth_map(lens, stored, np.isfinite(stored) & (stored > 0), 1.0, truth)

    return [
        _pair(f"{scene.name}/{photo.stem}", (photo, scene / "camera_02" / photo.name), lens, size, depth)
        for photo in photos
    ]


def _read_opencv(path: Path) -> Calibration:
    text = read_text(path, "calibration")

    def matrix(entry: ElementTree.Element) -> NDArray[np.float64]:
        rows, columns = (int(entry.findtext(name, "")) for name in ("rows", "cols"))
        return np.array(entry.findtext("data", "").split(), np.float64).reshape(rows, columns)

    try:
        entries = {entry.tag: entry for entry in ElementTree.fromstring(text)}
        left, right = (matrix(entries[name]) for name in ("proj_matL", "proj_matR"))
        cx, baseline = float(left[0, 2]), float(entries["baselineLR"].text or "") / 1000
        lens = Calibration(float(left[0, 0]), cx, float(left[1, 2]), float(right[0, 2]) - cx, baseline)
    except (ElementTree.ParseError, KeyError, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            f"{path}: not a Booster calibration ({reason_in_a_line(error)}): needs proj_matL, proj_matR and baselineLR"
        ) from error
    return _from_corner(lens.check(path))
