"""WildRGB-D: phone videos around objects, with the depth of the phone's laser."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.bases.depth_map import load_depth
from spackle.camera import Camera
from spackle.errors import InputError, reason_in_a_line
from spackle.evaluation.case import Case
from spackle.evaluation.datasets.folders import by_name, scene_folders
from spackle.evaluation.datasets.multiview import Posed, check_two, make_cases, spread
from spackle.evaluation.datasets.stereo import HALF_PIXEL, read_text

MAX_POSES_BYTES = 1 << 24
MIDDLE_DEPTH_M = 0.8  # objects are held before the phone; so second views are 4 to 20 cm beside


class WildRgbd:
    """`CATEGORY/scenes/SCENE/` with `rgb/00000.png`, `depth/00000.png` (mm), `metadata` and `cam_poses.txt`.

    `metadata` is JSON: w, h, and K column by column, its pixel centres at whole numbers, as the dataset's own tool
    takes it. `cam_poses.txt` has a line for each frame: its number and 16 numbers, camera to world, OpenCV.

    512 frames are taken by `spread`, in turns over the categories: with 512 scenes or more, one of each. Second views
    come from all frames of the scene, see `near_views`, the middle depth taken as 0.8 m. At 640×480, upright or not,
    the photos stay as they are: the paper's 76,800 cells.
    """

    name = "wildrgbd"
    title = "WildRGBD"
    terms = "MIT"
    paper_images = 512

    def cases(self, root: Path) -> Sequence[Case]:
        """One case for each frame that is taken; see `EvalDataset`."""
        scenes = by_name(scene_folders(root, self.name), _scene_name)
        read: dict[str, list[Posed]] = {}

        def frames(name: str) -> range:
            read[name] = _views(name, scenes[name])
            return range(len(read[name]))

        picked = spread(sorted(scenes), frames, self.paper_images)
        return [_with_depth(case) for name in picked for case in make_cases(read[name], picked[name], metric=True)]


def _scene_name(folder: Path) -> str:
    """CATEGORY/SCENE, wherever the root is."""
    folder = folder.absolute()
    above = folder.parent.parent if folder.parent.name == "scenes" else folder.parent
    return f"{above.name}/{folder.name}"


def _with_depth(case: Case) -> Case:
    """With the depth map of the same number."""
    at = case.photo.parent.parent / "depth" / case.photo.name
    if not at.is_file():
        raise InputError(f"{at}: no such depth map, but {case.photo} is there: unpack the scene again")
    assert case.camera is not None
    K = case.camera.K
    return dataclasses.replace(case, depth=lambda: dataclasses.replace(load_depth(at), K=K))


def _views(name: str, scene: Path) -> list[Posed]:
    lens = _lens(next((at for n in ("metadata", "metadata.json") if (at := scene / n).is_file()), scene / "metadata"))
    there = {photo.stem: photo for photo in (scene / "rgb").glob("*.png")}
    views = []
    for number, pose in _poses(scene / "cam_poses.txt"):
        if photo := there.get(f"{number:05d}"):
            camera = dataclasses.replace(lens, world_to_camera=torch.linalg.inv(torch.from_numpy(pose)))
            views.append(Posed(f"{name}/{photo.stem}", photo, camera, MIDDLE_DEPTH_M))
    check_two(scene, len(views))
    return views


def _lens(path: Path) -> Camera:
    try:
        facts = json.loads(read_text(path, "description of the camera"))
        width, height = int(facts["w"]), int(facts["h"])
        K = torch.tensor(facts["K"], dtype=torch.float64).reshape(3, 3).T.clone()
        if not (torch.isfinite(K).all() and min(width, height, float(K[0, 0]), float(K[1, 1])) > 0):
            raise ValueError("a size or a focal length is not positive")
    except (ValueError, KeyError, TypeError, RuntimeError, RecursionError) as error:
        raise InputError(
            f"{path}: not the metadata of a scene ({reason_in_a_line(error)}): needs w, h and K of nine numbers"
        ) from error
    K[:2, 2] += HALF_PIXEL
    return Camera(K, torch.eye(4, dtype=torch.float64), width, height)


def _poses(path: Path) -> list[tuple[int, NDArray[Any]]]:
    try:
        rows = [line.split() for line in read_text(path, "list of poses", MAX_POSES_BYTES).splitlines() if line.strip()]
        found = [(int(row[0]), np.array(row[1:], np.float64).reshape(4, 4)) for row in rows]
        if not all(np.isfinite(pose).all() and abs(np.linalg.det(pose)) > 0.5 for _, pose in found):
            raise ValueError("a pose is no rotation")
    except ValueError as error:
        raise InputError(
            f"{path}: not a list of poses ({reason_in_a_line(error)}): needs a frame and 16 numbers a line"
        ) from error
    return sorted(found, key=lambda entry: entry[0])
