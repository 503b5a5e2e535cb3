"""WildRGB-D: phone videos around objects, with depth from the phone's laser scanner."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.depth.calibration import read_short_text
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.multiview import (
    PosedPhoto,
    camera_from_pose,
    make_cases,
    spread_over_scenes,
)
from spackle.paper.evaluation.datasets.stereo import HALF_PIXEL
from spackle.paper.evaluation.paper_numbers import PAPER_IMAGE_COUNTS
from spackle.runtime.errors import as_input_error

MAX_POSES_BYTES = 1 << 24  # of cam_poses.txt; the published ones are far smaller

# Objects are held this far in front of the phone, so second views are 4 to 20 cm away.
ASSUMED_MIDDLE_DEPTH_M = 0.8


def wildrgbd_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Cases (input photos with what is known about them) of chosen frames of each video.

    All other frames of the video are second views of a case.

    A scene, CATEGORY/scenes/SCENE/, has the frames rgb/00000.png, depth/00000.png (in
    millimetres), and the files metadata and cam_poses.txt.

    512 frames, the paper's number, are chosen evenly from all scenes; if there are 512 scenes or
    more, 512 scenes give one frame each. Frames have 640×480 or 480×640 pixels and keep their
    size: 320 · 240 = 76,800 cells of 2×2 pixels, the paper's number.

    Args:
        scenes: the folder of each scene, by the scene's name.

    Raises:
        InputError: a file is missing or damaged.
    """
    # For each scene its frames. Scenes are read when they are chosen (by `frame_indices`), because
    # the dataset has many more than are used.
    frames: dict[str, list[PosedPhoto]] = {}

    def frame_indices(name: str) -> range:
        """Read a scene, and return the indices of its frames."""
        frames[name] = _frames_of_scene(name, scenes[name])
        return range(len(frames[name]))

    chosen_indices = spread_over_scenes(
        sorted(scenes), frame_indices, PAPER_IMAGE_COUNTS["WildRGBD"]
    )
    cases = []
    for name, indices in chosen_indices.items():
        cases += [_with_depth(case) for case in make_cases(frames[name], indices)]
    return cases


def category_and_scene(folder: Path) -> str:
    """The name CATEGORY/SCENE of a scene's folder, CATEGORY/scenes/SCENE or CATEGORY/SCENE."""
    folder = folder.absolute()
    parent = folder.parent
    category = parent.parent if parent.name == "scenes" else parent
    return f"{category.name}/{folder.name}"


def _with_depth(case: Case) -> Case:
    """The case of a frame rgb/00000.png, with its depth map depth/00000.png."""
    assert case.camera is not None
    depth_path = case.photo.parent.parent / "depth" / case.photo.name
    return dataclasses.replace(case, read_depth=partial(_read_depth, depth_path, case.camera.K))


def _read_depth(path: Path, K: Tensor) -> DepthMap:
    """Read a depth map, with the intrinsics [3, 3] of its frame's camera."""
    return dataclasses.replace(load_depth(path, kind="metric"), K=K)


def _frames_of_scene(name: str, folder: Path) -> list[PosedPhoto]:
    """The frames of a scene that have a pose, in the order of their numbers.

    The file metadata is JSON with w, h and K. K is stored column by column, and pixel centres are
    at integers. cam_poses.txt has a line for each frame: its number, then camera-to-world as 16
    numbers, in OpenCV's convention.

    Args:
        name: the scene's name, CATEGORY/SCENE.
        folder: the scene's folder.

    Raises:
        InputError: a file is missing or damaged.
    """
    metadata_path = folder / "metadata"
    with as_input_error(
        metadata_path, "not the metadata of a scene ({reason}): needs w, h and K of nine numbers"
    ):
        metadata = json.loads(read_short_text(metadata_path, "description of the camera"))
        width = int(metadata["w"])
        height = int(metadata["h"])
        # Transposed, because K is stored column by column.
        K = torch.tensor(metadata["K"], dtype=torch.float64).reshape(3, 3).T.clone()
        K[:2, 2] += HALF_PIXEL  # from pixel centres at integers to those at half-integers

    poses_path = folder / "cam_poses.txt"
    poses = _read_poses(poses_path)

    # A pose without a frame, or a frame without a pose, is left out.
    files_by_stem = {file.stem: file for file in (folder / "rgb").glob("*.png")}
    frames = []
    for number, camera_to_world in poses:
        file = files_by_stem.get(f"{number:05d}")
        if file is None:
            continue
        where = f"{poses_path}: {file.name}"
        camera = camera_from_pose(K, camera_to_world, width, height, where)
        # The depth map is not read here: objects usually are at this distance from the phone.
        frame = PosedPhoto(
            name=f"{name}/{file.stem}",
            photo=file,
            camera=camera,
            middle_depth=ASSUMED_MIDDLE_DEPTH_M,
        )
        frames.append(frame)
    return frames


def _read_poses(path: Path) -> list[tuple[int, Tensor]]:
    """Read cam_poses.txt: (number, camera-to-world [4, 4] float64) of each frame, sorted by number.

    Raises:
        InputError: the file is missing or damaged.
    """
    poses = []
    with as_input_error(
        path, "not a list of poses ({reason}): needs a frame and 16 numbers a line"
    ):
        for line in read_short_text(path, "list of poses", MAX_POSES_BYTES).splitlines():
            words = line.split()
            if words:
                matrix = np.array(words[1:], np.float64).reshape(4, 4)
                poses.append((int(words[0]), torch.from_numpy(matrix)))
    return sorted(poses, key=lambda pose: pose[0])


WILDRGBD = EvalDataset(
    name="wildrgbd",
    title="WildRGBD",
    terms="MIT",
    markers=("cam_poses.txt",),
    expected="CATEGORY/scenes/SCENE/ with rgb/, depth/, metadata and cam_poses.txt",
    read_cases=wildrgbd_cases,
    scene_name=category_and_scene,
    # The paper adds only 91 Gaussians to a view here, hardly more than the 64 of a view without
    # holes: so its second photos lie very close, as neighbouring frames of a video do.
    second_views="adjacent",
)
