"""Datasets of posed photos: ETH3D, Tanks and Temples, LLFF and WildRGB-D."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.photo import PHOTO_SUFFIXES
from spackle.depth.calibration import read_short_text
from spackle.depth.readers import load_depth
from spackle.formats.camera_files import checked_camera
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.colmap import model_folder, read_model
from spackle.paper.evaluation.datasets.multiview import Posed, make_cases, posed_by, spread
from spackle.paper.evaluation.datasets.stereo import HALF_PIXEL
from spackle.paper.evaluation.measurements import IMAGES
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import list_files

LLFF_PHOTOS = ("images_4", "images", "images_8")  # the first of these folders with photos is used
MAX_POSES_BYTES = 1 << 24
POSE_TOLERANCE = 0.05  # for the rotations of published poses, see `checked_camera`
MIDDLE_DEPTH_M = (
    0.8  # objects are held in front of the phone; second views are thus 4 to 20 cm away
)


def _camera(K: Tensor, pose: Tensor, width: int, height: int, where: str) -> Camera:
    """A float64 camera from `K` and a camera-to-world pose; InputError if K or the pose is impossible."""
    camera = checked_camera(
        K, pose, width, height, where, dtype=torch.float64, tolerance=POSE_TOLERANCE
    )
    return dataclasses.replace(camera, world_to_camera=torch.linalg.inv(pose))


# --- ETH3D


def eth3d_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Cases of ETH3D: the undistorted DSLR photos of the training scenes.

    `SCENE/dslr_calibration_undistorted/{cameras,images,points3D}.txt` and `SCENE/images/dslr_images_undistorted/*.JPG`.
    The model was aligned to laser scans, so its sparse points are metric. The dense ground truth
    belongs to the distorted photos and is not used. For second views see `make_cases`. The 13 training scenes have the
    paper's 454 images.
    """
    cases = []
    for scene in scenes.values():
        model = read_model(scene / "dslr_calibration_undistorted")
        cases += make_cases(
            posed_by(scene, model, [scene / "images" / view.name for view in model.views])
        )
    return cases


# --- Tanks and Temples


def tanks_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Cases of scenes with `SCENE/images` and `SCENE/sparse/0`, the usual layout for COLMAP and 3D Gaussian splatting.

    `SCENE/sparse` without the 0, and `SCENE/dense/{images,sparse}`, are read too. The camera must be close to a
    pinhole; `colmap image_undistorter` makes such cameras. The dataset's archives have no such models, only `.log`
    poses without intrinsics, which are not read. The unit of length is arbitrary.

    `spread` takes 512 photos from all scenes; second views come from all photos, see `make_cases`. The paper's 331,776
    cells correspond to 1920×1080, the size of most scenes' frames. Frames of 2048×1080 become 1536×810; the 980×545
    photos published with 3D Gaussian splatting keep their size.
    """
    read = {name: _tanks_views(scene) for name, scene in scenes.items()}
    picked = spread(list(scenes), lambda name: range(len(read[name])), IMAGES["Tanks"])
    return [case for name, chosen in picked.items() for case in make_cases(read[name], chosen)]


def _tanks_views(scene: Path) -> list[Posed]:
    folder = model_folder(scene)
    model = read_model(folder)
    top = scene / "dense" if "dense" in folder.relative_to(scene).parts else scene
    posed = posed_by(scene, model, [top / "images" / view.name for view in model.views])
    names = [
        Path(view.name).with_suffix("").as_posix() for view in model.views
    ]  # stems may repeat in subfolders
    return [
        dataclasses.replace(v, name=f"{scene.name}/{name}")
        for v, name in zip(posed, names, strict=True)
    ]


# --- LLFF


def llff_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Cases of scenes with `poses_bounds.npy`, `sparse/0`, or both, and photos in `images_4`, `images` or `images_8`.

    A COLMAP model, from which the dataset's poses were made, gives cameras and points. The near and far bounds are used
    only if there is no model, or the model has no points. Without a model, the middle depth is half way between the
    bounds in inverse depth. Photos of the model are matched to files by name, else by order. Rows of `poses_bounds.npy`
    are matched by order. The unit of length is arbitrary. For second views see `make_cases`.

    The paper's 190,512 cells correspond to `images_4` (1008×756); `images` (4032×3024) would give 1536×1152.
    """
    return [case for scene in scenes.values() for case in make_cases(_llff_views(scene))]


def _llff_views(scene: Path) -> list[Posed]:
    folders = (scene / name for name in LLFF_PHOTOS if (scene / name).is_dir())
    photos = next(
        (files for folder in folders if (files := list_files(folder, PHOTO_SUFFIXES))), []
    )
    path = scene / "poses_bounds.npy"
    rows = _read_bounds(path, len(photos)) if path.is_file() else ()
    bounds = {
        photo: (float(row[15]), float(row[16])) for photo, row in zip(photos, rows, strict=False)
    }
    if (scene / "sparse").is_dir():
        model = read_model(model_folder(scene))
        files = _match(scene, [view.name for view in model.views], photos)
        return [
            dataclasses.replace(v, bounds=bounds.get(v.photo))
            for v in posed_by(scene, model, files)
        ]
    views = []
    for photo, row in zip(photos, rows, strict=True):  # there are bounds, because there is no model
        near, far = bounds[photo]
        camera = _camera_of_row(row, f"{path}: {photo.name}")
        middle = 2 / (1 / near + 1 / far)
        views.append(
            Posed(f"{scene.name}/{photo.stem}", photo, camera, middle, bounds=bounds[photo])
        )
    return views


def _read_bounds(path: Path, count: int) -> NDArray[Any]:
    """Read a row of 17 numbers for each photo, sorted by name: a 3×5 matrix, the nearest and the farthest depth."""
    with as_input_error(path, "not LLFF's table ({reason}): expected finite floats, [photos, 17]"):
        table: NDArray[Any] = np.load(path, allow_pickle=False)
        if (
            table.ndim != 2
            or table.shape[1] != 17
            or table.dtype.kind != "f"
            or not np.isfinite(table).all()
        ):
            raise ValueError(f"{table.dtype} of shape {table.shape}")
        if not (table[:, [4, 9, 14, 15, 16]] > 0).all():
            raise ValueError("a size, a focal length or a bound is not positive")
    if len(table) != count:
        raise InputError(
            f"{path}: {len(table)} rows, but there are {count} photos: unpack the scene again"
        )
    return table


def _camera_of_row(row: NDArray[Any], where: str) -> Camera:
    """The camera of a `poses_bounds.npy` row: columns down, right, backwards, position, (height, width, focal)."""
    matrix = torch.from_numpy(np.asarray(row[:15], np.float64).reshape(3, 5))
    down, right, backwards, position, (height, width, focal) = matrix.unbind(1)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.stack([right, down, -backwards, position], dim=1)
    K = torch.tensor(
        [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    return _camera(K, pose, round(float(width)), round(float(height)), where)


def _match(scene: Path, names: Sequence[str], photos: Sequence[Path]) -> list[Path]:
    """The file of each photo of the model; suffixes may differ, as in a JPEG made from a PNG."""
    stems = {photo.stem: photo for photo in photos}
    if all(Path(name).stem in stems for name in names):
        return [stems[Path(name).stem] for name in names]
    if len(names) != len(photos):
        raise InputError(
            f"{scene}: {len(photos)} photos, but the COLMAP model has {len(names)} with other names: unpack it again"
        )
    return list(photos)


# --- WildRGB-D


def wildrgbd_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Cases of phone videos around objects, with depth from the phone's laser scanner.

    `CATEGORY/scenes/SCENE/` has `rgb/00000.png`, `depth/00000.png` (mm), `metadata` and `cam_poses.txt`.

    `metadata` is JSON with w, h and K. K is stored column by column, and pixel centres are at integers. `cam_poses.txt`
    has a line for each frame: its number, then camera-to-world as 16 numbers, in OpenCV's convention.

    `spread` takes 512 frames; if there are 512 scenes or more, 512 scenes give one frame each. Second views come from
    all frames of the scene, see `make_cases`, with 0.8 m as the middle depth. Photos of 640×480 or 480×640 keep their
    size and have the paper's 76,800 cells.
    """
    read: dict[str, list[Posed]] = {}

    def frames(name: str) -> range:
        read[name] = _wildrgbd_views(name, scenes[name])
        return range(len(read[name]))

    picked = spread(sorted(scenes), frames, IMAGES["WildRGBD"])
    return [_with_depth(case) for name in picked for case in make_cases(read[name], picked[name])]


def category_and_scene(folder: Path) -> str:
    """The name CATEGORY/SCENE of a scene's folder, wherever the root is."""
    folder = folder.absolute()
    above = folder.parent.parent if folder.parent.name == "scenes" else folder.parent
    return f"{above.name}/{folder.name}"


def _with_depth(case: Case) -> Case:
    assert case.camera is not None
    path, K = case.photo.parent.parent / "depth" / case.photo.name, case.camera.K
    return dataclasses.replace(case, depth=lambda: dataclasses.replace(load_depth(path), K=K))


def _wildrgbd_views(name: str, scene: Path) -> list[Posed]:
    metadata, poses = scene / "metadata", scene / "cam_poses.txt"
    with as_input_error(
        metadata, "not the metadata of a scene ({reason}): needs w, h and K of nine numbers"
    ):
        facts = json.loads(read_short_text(metadata, "description of the camera"))
        width, height = int(facts["w"]), int(facts["h"])
        K = torch.tensor(facts["K"], dtype=torch.float64).reshape(3, 3).T.clone()
        K[:2, 2] += HALF_PIXEL
    with as_input_error(
        poses, "not a list of poses ({reason}): needs a frame and 16 numbers a line"
    ):
        lines = [
            line.split()
            for line in read_short_text(poses, "list of poses", MAX_POSES_BYTES).splitlines()
        ]
        frames = [
            (int(line[0]), np.array(line[1:], np.float64).reshape(4, 4)) for line in lines if line
        ]
    photos = {photo.stem: photo for photo in (scene / "rgb").glob("*.png")}
    views = []
    for number, pose in sorted(frames, key=lambda frame: frame[0]):
        if photo := photos.get(f"{number:05d}"):
            camera = _camera(K, torch.from_numpy(pose), width, height, f"{poses}: {photo.name}")
            views.append(Posed(f"{name}/{photo.stem}", photo, camera, MIDDLE_DEPTH_M))
    return views
