"""Rectified pairs: Middlebury, Booster and the Motorcycle inside scikit-image, with disparities as depth."""

from __future__ import annotations

import dataclasses
import functools
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.bases.depth_map import Calibration, DepthMap, load_depth, read_array, read_calibration, read_text
from spackle.camera import Camera
from spackle.errors import InputError, reading
from spackle.evaluation.case import Case, SecondView, has_any, photo_files
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
LEVELS = {450: 4, 900: 2, 1800: 1}  # grey levels a pixel of disparity, by the width of Cones and Teddy
LEVELS_2001 = 8
LIGHT_2006 = "Illum2/Exp1"  # in the archives with seven views and all lights
# Middlebury's calibration of the Motorcycle at a quarter of its size, as scikit-image ships it.
MOTORCYCLE_FOCAL, MOTORCYCLE_CX, MOTORCYCLE_CY = 994.978, 311.193, 254.877
MOTORCYCLE_DOFFS, MOTORCYCLE_BASELINE = 31.086, 0.193001


class BrokenPhoto(InputError):
    """A photo that is there and cannot be read: a matter of its own case, and not of the folder's layout."""


def _pair(
    name: str, left: Path, right: Path, lens: Calibration, size: tuple[int, int], depth: Callable[[], DepthMap]
) -> Case:
    """The left photo, with the right one as its second view; `lens` counts from the first pixel's corner."""
    for photo in (left, right):
        if not photo.exists():
            check_file(photo, "photo")  # raises; a photo that cannot be read is named in its turn
    K, pose = lens.K, torch.eye(4)
    K[0, 2] += lens.doffs_px
    pose[0, 3] = -lens.baseline_m
    seconds = (SecondView("right", right, Camera(K, pose, *size)),)
    return Case(name, left, Camera(lens.K, torch.eye(4), *size), depth=depth, seconds=seconds)


def _picture_size(path: Path) -> tuple[int, int]:
    """(width, height) from a picture's header; BrokenPhoto where it cannot be read, InputError where it is missing."""
    try:
        return read_image(path, lambda image: (image.width, image.height))
    except InputError as error:
        if path.exists():
            raise BrokenPhoto(str(error)) from error
        raise


def _from_corner(lens: Calibration) -> Calibration:
    return dataclasses.replace(lens, cx=lens.cx + HALF_PIXEL, cy=lens.cy + HALF_PIXEL)


def _levels(path: Path) -> NDArray[Any]:
    """The whole numbers of a grey picture."""

    def levels(image: Any) -> NDArray[Any]:
        if image.mode not in ("L", "I", "I;16", "I;16B", "RGB"):
            raise InputError(f"{path}: pixels of mode {image.mode} are no disparities: give the dataset's own file")
        values = np.asarray(image)
        return values if values.ndim == 2 else values[..., 0]  # grey that was saved as colour

    return read_image(path, levels)


def _depth_by(
    lens: Calibration, path: Path, unit: float, read: Callable[[Path], NDArray[Any]] = _levels
) -> Callable[[], DepthMap]:
    """Reads z = focal · baseline / (disparity + doffs) of disparities in steps of `unit` pixels; 0 is unknown."""

    def depth() -> DepthMap:
        stored = read(path)
        reach = float(lens.K[0, 0]) * lens.baseline_m
        with np.errstate(all="ignore"):  # what is not known may be anything
            z = torch.from_numpy((reach / (stored * unit + lens.doffs_px)).astype(np.float32))
        valid = torch.from_numpy(np.isfinite(stored) & (stored > 0)) & torch.isfinite(z) & (z > 0)
        if not valid.any():
            raise InputError(f"{path}: not one pixel has a disparity: the file is damaged, or of another dataset")
        quantum = None
        if stored.dtype.kind in "iu":  # whole numbers: the grid that they lie on, in 1/length
            steps = np.diff(np.unique(stored[valid.numpy()].astype(np.int64)))
            quantum = float(np.gcd.reduce(steps) if len(steps) else 1) * unit / reach
        return DepthMap(z.where(valid, 0.0), valid, lens.K, quantum, "disparity", path)

    return depth


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

    return _pair(folder.name, folder / "im0.png", folder / "im1.png", lens, lens.size, depth)


# --- Middlebury


def is_middlebury(folder: Path) -> bool:
    old = has_any(folder, "view1.png", "im2.ppm", "im2.png", "scene.json")
    old |= has_any(folder, "disp1.png") and has_any(folder, "dmin.txt")
    new = has_any(folder, "im0.png") and not folder.name.startswith("camera_")  # as Booster's photos of a camera lie
    return old or (new and not is_two_view(folder))


def is_two_view(folder: Path) -> bool:
    """A rectified pair of ETH3D's, in Middlebury's format: by its name, or because COLMAP's files are beside it."""
    named = bool(re.search(r"_\d[ls]$", folder.name))  # playground_1l, electro_2s
    return has_any(folder, "im0.png") and (named or has_any(folder, "cameras.txt"))


def middlebury_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """One case for each scene; the second view is the true right photo.

    Scene folders: `im0.png` with `calib.txt` (2014 at full size, and MiddEval3 at full, half or quarter size);
    `view1.png` with `disp1.png` and `dmin.txt` (2005, 2006); `im2.ppm` with `disp2.pgm`, or the same as PNG (2001,
    2003); or a `scene.json`. Of `Piano-perfect` and `Piano-imperfect` the first is taken. Test scenes, which have no
    truth, are skipped. The paper's 23 are those of 2014. MiddEval3's three sizes have the same names: give
    `trainingF`, `trainingH` or `trainingQ` alone.
    """
    return [
        _middlebury_case(folder)
        for name, folder in scenes.items()
        if name.replace("-imperfect", "-perfect") not in scenes.keys() - {name}
    ]


def _middlebury_case(folder: Path) -> Case:
    try:
        if has_any(folder, "calib.txt", "im0.png"):
            return pair_of_2014(folder)
        if has_any(folder, "scene.json"):
            return _described(folder)
        return _of_2006(folder) if has_any(folder, "disp1.png", "view1.png") else _of_2003(folder)
    except BrokenPhoto as error:
        return Case(folder.name, folder, problem=str(error))


def _of_2006(folder: Path) -> Case:
    """Grey levels and dmin are pixels of the full size."""
    photos = folder if (folder / "view1.png").is_file() else folder / LIGHT_2006
    left = photos / "view1.png"
    width, height = _picture_size(left)
    shrink = round(HEIGHT_2006 / height)
    if abs(height * shrink - HEIGHT_2006) > shrink or not 1 <= shrink <= 3:
        raise InputError(f"{left}: {height} pixels high: expected 1110, 555 or 370, as the sets of 2005 and 2006 are")
    with reading(folder / "dmin.txt", "not a number: unpack the scene again"):
        dmin = float(read_text(folder / "dmin.txt", "offset of the disparities"))
    lens = Calibration(FOCAL_2006 / shrink, width / 2, height / 2, dmin / shrink, BASELINE_2006)
    depth = _depth_by(lens, folder / "disp1.png", 1 / shrink)
    return _pair(folder.name, left, photos / "view5.png", lens, (width, height), depth)


def _of_2003(folder: Path) -> Case:
    """Also 2001: the width tells how many levels a pixel has; lengths are nominal."""
    suffix = ".ppm" if (folder / "im2.ppm").is_file() else ".png"
    truths = [folder / name for name in ("disp2.pgm", "disp2.png") if (folder / name).is_file()]
    if not truths:
        raise InputError(f"{folder}: no disp2.pgm or disp2.png: unpack the whole scene")
    width, height = _picture_size(folder / f"im2{suffix}")
    size = width / WIDTH_OLD
    lens = Calibration(FOCAL_OLD * size, width / 2, height / 2, DOFFS_OLD * size, BASELINE_OLD)
    depth = _depth_by(lens, truths[0], 1 / LEVELS.get(width, LEVELS_2001))
    return _pair(folder.name, folder / f"im2{suffix}", folder / f"im6{suffix}", lens, (width, height), depth)


def _described(folder: Path) -> Case:
    """By a `scene.json`, whose principal point has pixel centres at half-integers; its lengths may be nominal."""
    path = folder / "scene.json"
    lens = read_calibration(path)
    with reading(path, "not a scene description: needs the photos and the disparity map"):
        facts = json.loads(read_text(path))
        left, right, truth = (folder / str(facts[key]) for key in ("left", "right", "disparity"))
    depth = functools.partial(load_depth, truth, calib=path)
    return _pair(folder.name, left, right, lens, _picture_size(left), depth)


# --- Booster


def booster_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Stereo at 12 megapixels of scenes with glass and mirrors: each photo of a left camera (one a light) is a case.

    `train/balanced/SCENE/camera_00/im*.png` at 4112×3008, the right photo of the same name in `camera_02`, one
    `disp_00.npy` and one `calib_00-02.xml` (OpenCV: proj_matL, proj_matR, baselineLR in millimetres) for all lights.
    The test scenes have no truth, and the unbalanced ones another right camera: both are skipped.
    At the working size the photos are 1536×1124: the paper's 431,616 cells.
    """
    return [case for scene in scenes.values() for case in _lights_of(scene)]


def _lights_of(scene: Path) -> list[Case]:
    photos = photo_files(scene / "camera_00")
    if not photos:
        raise InputError(f"{scene / 'camera_00'}: no photos: expected im0.png and more; unpack the scene again")
    names, problems = [f"{scene.name}/{photo.stem}" for photo in photos], []
    for photo in photos:  # all of a scene are of one size
        try:
            size = _picture_size(photo)
            break
        except BrokenPhoto as error:
            problems.append(str(error))
    else:
        return [Case(name, p, problem=why) for name, p, why in zip(names, photos, problems, strict=True)]
    lens, truth = _read_opencv(scene / "calib_00-02.xml"), scene / "disp_00.npy"
    if not truth.is_file():
        raise InputError(f"{truth}: no such disparity map: give train/balanced; Booster's test scenes have none")
    depth, rights = _depth_by(lens, truth, 1.0, lambda path: read_array(path)[0]), scene / "camera_02"
    return [_pair(name, p, rights / p.name, lens, size, depth) for name, p in zip(names, photos, strict=True)]


def _read_opencv(path: Path) -> Calibration:
    def matrix(entry: ElementTree.Element) -> NDArray[np.float64]:
        rows, columns = (int(entry.findtext(name, "")) for name in ("rows", "cols"))
        return np.array(entry.findtext("data", "").split(), np.float64).reshape(rows, columns)

    with reading(path, "not a Booster calibration ({reason}): needs proj_matL, proj_matR and baselineLR"):
        entries = {entry.tag: entry for entry in ElementTree.fromstring(read_text(path))}
        left, right = (matrix(entries[name]) for name in ("proj_matL", "proj_matR"))
        cx, baseline = float(left[0, 2]), float(entries["baselineLR"].text or "") / 1000
        lens = Calibration(float(left[0, 0]), cx, float(left[1, 2]), float(right[0, 2]) - cx, baseline)
    return _from_corner(lens.check(path))


# --- the Motorcycle


@dataclasses.dataclass(frozen=True)
class StereoPair:
    """A photo with its measured depth, and what a second camera truly saw."""

    left: Tensor  # [H, W, 3] sRGB
    right: Tensor  # [H, W, 3] sRGB
    depth: DepthMap
    left_camera: Camera
    right_camera: Camera


def load_motorcycle() -> StereoPair:
    """Middlebury's Motorcycle inside scikit-image; InputError where that is not installed."""
    try:
        from skimage.data import stereo_motorcycle
    except ImportError as error:
        raise InputError("the demo's photo is inside scikit-image: pip install 'spackle-nvs[demo]'") from error
    left, right, disparity = stereo_motorcycle()  # type: ignore[no-untyped-call]
    height, width = disparity.shape
    valid = np.isfinite(disparity)
    reach = MOTORCYCLE_FOCAL * MOTORCYCLE_BASELINE
    z = np.where(valid, reach / (np.where(valid, disparity, 0) + MOTORCYCLE_DOFFS), 0).astype(np.float32)
    K = torch.tensor([[MOTORCYCLE_FOCAL, 0, MOTORCYCLE_CX], [0, MOTORCYCLE_FOCAL, MOTORCYCLE_CY], [0, 0, 1]])
    beside, right_K = torch.eye(4), K.clone()
    beside[0, 3] = -MOTORCYCLE_BASELINE
    right_K[0, 2] += MOTORCYCLE_DOFFS
    known = torch.from_numpy(valid)
    depth = DepthMap(torch.from_numpy(z), known, K, None, "disparity", Path("Motorcycle"))
    first, second = (torch.from_numpy(photo.astype(np.float32) / 255) for photo in (left, right))
    cameras = Camera(K, torch.eye(4), width, height), Camera(right_K, beside, width, height)
    return StereoPair(first, second, depth, *cameras)
