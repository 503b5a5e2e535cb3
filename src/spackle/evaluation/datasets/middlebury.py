"""Middlebury stereo: the sets of 2014, and of 2001, 2003, 2005 and 2006."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from spackle.bases.depth_maps import DepthMap, load_depth
from spackle.errors import InputError
from spackle.evaluation.case import Case
from spackle.evaluation.datasets.folders import by_name, scene_folders
from spackle.evaluation.datasets.stereo import (
    BrokenPhoto,
    Pair,
    make_pair,
    pair_of_2014,
    picture_size,
    read_levels,
    read_text,
)

# Published for the sets of 2005 and 2006 at full size, height 1110; nearly exact, the site says.
FOCAL_2006, BASELINE_2006, HEIGHT_2006 = 3740.0, 0.160, 1110
# Of the sets of 2001 and 2003 only the disparities are known. Any lens makes the pair exact, with its own depth; these
# numbers, for 450 pixels of width, give depths like those of the later sets.
FOCAL_OLD, BASELINE_OLD, DOFFS_OLD, WIDTH_OLD = 1000.0, 0.1, 30.0, 450
SCALE_2001 = 8  # grey levels a pixel of disparity
WIDTH_2003_FULL = 1800  # Cones and Teddy: 450, 900 or 1800 wide, 4, 2 or 1 grey levels a pixel
LIGHT_2006 = "Illum2/Exp1"  # in the archives with seven views and all lights


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
    paper_images = 23

    def cases(self, root: Path) -> Sequence[Case]:
        """One case for each scene; see `EvalDataset`."""
        folders = scene_folders(root, self.name)
        perfect = {folder.name for folder in folders}
        kept = [f for f in folders if f.name.replace("-imperfect", "-perfect") not in perfect - {f.name}]
        return [_case(folder) for folder in by_name(kept).values()]


def _case(folder: Path) -> Case:
    try:
        return _readable(folder)
    except BrokenPhoto as error:
        return Case(folder.name, folder, problem=str(error))


def _readable(folder: Path) -> Case:
    if (folder / "calib.txt").is_file() or (folder / "im0.png").is_file():
        return pair_of_2014(folder)
    if (folder / "scene.json").is_file():
        return _described(folder)
    if (folder / "disp1.png").is_file() or (folder / "view1.png").is_file():
        return _of_2006(folder)
    return _of_2003(folder)


def _of_2006(folder: Path) -> Case:
    """Grey level 0 is unknown; levels and dmin are pixels of the full size."""
    photos = folder if (folder / "view1.png").is_file() else folder / LIGHT_2006
    left, right, truth = photos / "view1.png", photos / "view5.png", folder / "disp1.png"
    width, height = picture_size(left)
    shrink = round(HEIGHT_2006 / height)
    if abs(height * shrink - HEIGHT_2006) > shrink or not 1 <= shrink <= 3:
        raise InputError(f"{left}: {height} pixels high: expected 1110, 555 or 370, as the sets of 2005 and 2006 are")
    try:
        dmin = float(read_text(folder / "dmin.txt", "offset of the disparities"))
    except ValueError as error:
        raise InputError(f"{folder / 'dmin.txt'}: not a number: unpack the scene again") from error
    lens = FOCAL_2006 / shrink, width / 2, height / 2
    pair = make_pair(lens, dmin / shrink, BASELINE_2006, (width, height))
    return pair.case(folder.name, (left, right), lambda: _levels(pair, truth, 1 / shrink), metric=True)


def _of_2003(folder: Path) -> Case:
    """Also 2001: grey level 0 is unknown; the width tells how many levels a pixel has."""
    suffix = ".ppm" if (folder / "im2.ppm").is_file() else ".png"
    left, right = folder / f"im2{suffix}", folder / f"im6{suffix}"
    truth = next((folder / name for name in ("disp2.pgm", "disp2.png") if (folder / name).is_file()), None)
    if truth is None:
        raise InputError(f"{folder}: no disp2.pgm or disp2.png: unpack the whole scene")
    at = truth
    width, height = picture_size(left)
    scale = WIDTH_2003_FULL // width if width in (450, 900, 1800) else SCALE_2001
    size = width / WIDTH_OLD
    lens = FOCAL_OLD * size, width / 2, height / 2
    pair = make_pair(lens, DOFFS_OLD * size, BASELINE_OLD, (width, height))
    return pair.case(folder.name, (left, right), lambda: _levels(pair, at, 1 / scale), metric=False)


def _levels(pair: Pair, path: Path, unit: float) -> DepthMap:
    stored = read_levels(path)
    return pair.depth(stored, stored > 0, unit, path)


def _described(folder: Path) -> Case:
    """By a `scene.json`, whose principal point has pixel centres at half-integers; its lengths may be nominal."""
    path = folder / "scene.json"
    try:
        facts = json.loads(read_text(path, "scene description"))
        left, right, truth = (folder / str(facts[key]) for key in ("left", "right", "disparity"))
        focal, cx, cy, doffs, baseline = (float(facts[k]) for k in ("focal_px", "cx", "cy", "doffs_px", "baseline_m"))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{path}: not a scene description: needs the photos, the disparity map and the lens"
        ) from error
    pair = make_pair((focal, cx, cy), doffs, baseline, picture_size(left))
    return pair.case(folder.name, (left, right), lambda: load_depth(truth, calib=path), metric=False)
