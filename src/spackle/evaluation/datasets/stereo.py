"""Rectified pairs: Middlebury's calib.txt, and disparities as depth."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.bases.depth_maps import DepthMap, load_depth
from spackle.camera import Camera
from spackle.errors import InputError
from spackle.evaluation.case import Case, SecondView
from spackle.image import check_file, read_image

MAX_TEXT_BYTES = 1 << 16
# Middlebury and Booster calibrate with tools that put (0, 0) into the middle of the first pixel; here it is that
# pixel's corner. (Middlebury's smaller sizes have the big one's principal point divided plainly, so there it is known
# to half a pixel only; the pair does not notice, because both cameras move alike.)
HALF_PIXEL = 0.5
TRUTHS_2014 = ("disp0GT.pfm", "disp0.pfm")  # MiddEval3 and ETH3D; the sets as they were published


class BrokenPhoto(InputError):
    """A photo that is there and cannot be read: a matter of its own case, and not of the folder's layout."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two cameras side by side that look the same way."""

    left: Camera  # at the world's origin
    doffs: float  # the right principal point's x minus the left one's, pixels
    baseline: float  # the right eye stands this far to the right; the unit is the dataset's length

    @property
    def right(self) -> Camera:
        """The right camera in the left one's frame."""
        K, pose = self.left.K.clone(), torch.eye(4)
        K[0, 2] += self.doffs
        pose[0, 3] = -self.baseline
        return dataclasses.replace(self.left, K=K, world_to_camera=pose)

    def depth(self, disparity: NDArray[Any], known: NDArray[np.bool_], unit: float, path: Path) -> DepthMap:
        """z = focal · baseline / (disparity + doffs).

        Args:
            disparity: [H, W] as stored, `unit` pixels each.
            known: [H, W].
        """
        reach = self.left.focal[0] * self.baseline
        with np.errstate(all="ignore"):  # what is not known may be anything
            z = torch.from_numpy((reach / (disparity * unit + self.doffs)).astype(np.float32))
        valid = torch.from_numpy(known) & torch.isfinite(z) & (z > 0)
        if not valid.any():
            raise InputError(f"{path}: not one pixel has a disparity: the file is damaged, or of another dataset")
        quantum = None
        if disparity.dtype.kind in "iu":  # whole numbers: the grid that they lie on, in 1/length
            steps = np.diff(np.unique(disparity[valid.numpy()].astype(np.int64)))
            quantum = float(np.gcd.reduce(steps) if len(steps) else 1) * unit / reach
        return DepthMap(z.where(valid, 0.0), valid, self.left.K, quantum, "disparity", path)

    def case(self, name: str, photos: tuple[Path, Path], depth: Callable[[], DepthMap], *, metric: bool) -> Case:
        """The left photo, with the right one as its second view."""
        for photo in photos:
            if not photo.exists():
                check_file(photo, "photo")  # raises; what is there and cannot be read is named in its turn
        right = SecondView("right", photos[1], self.right)
        return Case(name, photos[0], self.left, depth=depth, seconds=(right,), metric=metric)


def make_pair(K: tuple[float, float, float], doffs: float, baseline: float, size: tuple[int, int]) -> Pair:
    """From (focal, cx, cy) in pixels with centres at half-integers, and (width, height)."""
    focal, cx, cy = K
    matrix = torch.tensor([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return Pair(Camera(matrix, torch.eye(4), *size), doffs, baseline)


def read_calib(path: Path) -> Pair:
    """Middlebury's `calib.txt`: cam0=[f 0 cx; 0 f cy; 0 0 1], doffs, baseline in mm, width, height.

    Returns:
        The pair in metres.

    Raises:
        InputError: a file that is missing or says something else.
    """
    number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
    facts = dict(re.findall(r"^\s*(\w+)\s*=\s*(.*?)\s*$", read_text(path, "calibration"), re.MULTILINE))
    try:
        focal, _, cx, _, _, cy, *_ = (float(n) for n in re.findall(number, facts["cam0"]))
        doffs, baseline = float(facts.get("doffs", 0)), float(facts["baseline"]) / 1000
        size = int(facts["width"]), int(facts["height"])
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path}: not a Middlebury calibration: needs cam0=[f 0 cx; 0 f cy; 0 0 1], doffs, baseline, width, height"
        ) from error
    if not (focal > 0 and baseline > 0 and min(size) > 0):
        raise InputError(f"{path}: focal length, baseline and size must be positive: the file is damaged")
    return make_pair((focal, cx + HALF_PIXEL, cy + HALF_PIXEL), doffs, baseline, size)


def pair_of_2014(folder: Path, truth: Path | None = None) -> Case:
    """A folder in the format of Middlebury 2014: im0.png, im1.png, calib.txt, and disp0.pfm or disp0GT.pfm."""
    calib = folder / "calib.txt"
    pair = read_calib(calib)
    if truth is None:
        truth = next((folder / name for name in TRUTHS_2014 if (folder / name).is_file()), None)
    if truth is None:
        raise InputError(f"{folder}: no {' or '.join(TRUTHS_2014)}: unpack the ground truth, or leave test scenes out")
    at = truth

    def depth() -> DepthMap:
        return dataclasses.replace(load_depth(at, calib=calib), K=pair.left.K)

    return pair.case(folder.name, (folder / "im0.png", folder / "im1.png"), depth, metric=True)


def read_text(path: Path, kind: str, at_most: int = MAX_TEXT_BYTES) -> str:
    """A short text; InputError where there is none."""
    if check_file(path, kind) > at_most:
        raise InputError(f"{path}: too long for a {kind}: give another file")
    return path.read_text(encoding="utf-8", errors="replace")


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) from a picture's header; BrokenPhoto where it cannot be read, InputError where it is missing."""
    try:
        return read_image(path, lambda image: (image.width, image.height))
    except InputError as error:
        if path.exists():
            raise BrokenPhoto(str(error)) from error
        raise


def read_levels(path: Path) -> NDArray[Any]:
    """The whole numbers [H, W] of a grey picture, as stored."""

    def levels(image: Any) -> NDArray[Any]:
        if image.mode not in ("L", "I", "I;16", "I;16B", "RGB"):
            raise InputError(f"{path}: pixels of mode {image.mode} are no disparities: give the dataset's own file")
        values = np.asarray(image)
        return values if values.ndim == 2 else values[..., 0]  # grey that was saved as colour

    return read_image(path, levels)
