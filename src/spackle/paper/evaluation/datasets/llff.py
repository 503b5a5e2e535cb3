"""LLFF: forward-facing photos of scenes, with poses in poses_bounds.npy, COLMAP models, or both."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.image_formats import list_photos
from spackle.formats.colmap import model_folder
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.colmap import read_model
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.multiview import (
    PosedPhoto,
    camera_from_pose,
    make_cases,
    posed_photos_of_model,
)
from spackle.runtime.errors import InputError, as_input_error

PHOTO_FOLDERS = ("images_4", "images", "images_8")  # the first of these with photos is used

# A row of poses_bounds.npy has 17 numbers: a matrix [3, 5] row by row, the nearest and the
# farthest depth. The matrix's columns are down, right, backwards, position (camera to world), and
# (height, width, focal length).
NUMBERS_PER_ROW = 17
HEIGHT_COLUMN = 4
WIDTH_COLUMN = 9
FOCAL_COLUMN = 14
NEAREST_DEPTH_COLUMN = 15
FARTHEST_DEPTH_COLUMN = 16


def llff_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """A case (an input photo with what is known about it) for each photo of each scene.

    All other photos of the scene are second views of the case.

    A scene has photos in images_4, images or images_8, and poses in poses_bounds.npy, sparse/0,
    or both. A COLMAP model (sparse/0), from which the dataset's poses were made, gives cameras
    and points. The near and far bounds in poses_bounds.npy are used only if there is no model, or
    the model has no points. The unit of length is arbitrary.

    images_4 has photos of 1008×756, that is, 504 · 378 = 190,512 cells of 2×2 pixels, the paper's
    number; images (4032×3024) would be evaluated at 1536×1152.

    Args:
        scenes: the folder of each scene, by the scene's name.

    Raises:
        InputError: a file is missing or damaged, or photos and poses do not match.
    """
    return [case for folder in scenes.values() for case in make_cases(_photos_of_scene(folder))]


def _photos_of_scene(folder: Path) -> list[PosedPhoto]:
    """The photos of a scene with their poses; InputError for bad files."""
    files = _photo_files(folder)
    table_path = folder / "poses_bounds.npy"
    rows = _read_table(table_path, len(files)) if table_path.is_file() else None

    # The table has no names of photos: its rows are in the order of the photos' names.
    depth_bounds = {}
    if rows is not None:
        for file, row in zip(files, rows, strict=True):
            nearest = float(row[NEAREST_DEPTH_COLUMN])
            farthest = float(row[FARTHEST_DEPTH_COLUMN])
            depth_bounds[file] = (nearest, farthest)

    # A COLMAP model is better: it has points, too, and the table's poses were made from it.
    if (folder / "sparse").is_dir():
        model = read_model(model_folder(folder))
        model_files = _files_of_model(folder, [view.name for view in model.views], files)
        return [
            dataclasses.replace(photo, depth_bounds=depth_bounds.get(photo.photo))
            for photo in posed_photos_of_model(folder, model, model_files)
        ]

    if rows is None:
        raise InputError(f"{table_path}: no such file, and there is no COLMAP model in sparse/0")
    photos = []
    for file, row in zip(files, rows, strict=True):
        nearest, farthest = depth_bounds[file]
        photo = PosedPhoto(
            name=f"{folder.name}/{file.stem}",
            photo=file,
            camera=_camera_of_row(row, f"{table_path}: {file.name}"),
            # In inverse depth, which is what parallax depends on, half way between the bounds.
            middle_depth=2 / (1 / nearest + 1 / farthest),
            depth_bounds=depth_bounds[file],
        )
        photos.append(photo)
    return photos


def _photo_files(folder: Path) -> list[Path]:
    """The photos of a scene, sorted by name, from the first folder that has any."""
    for name in PHOTO_FOLDERS:
        if (folder / name).is_dir():
            files = list_photos(folder / name)
            if files:
                return files
    return []


def _read_table(path: Path, photo_count: int) -> NDArray[Any]:
    """Read poses_bounds.npy: [photos, 17], a row for each photo, sorted by name.

    Raises:
        InputError: the file is no such table, or has not a row for each of `photo_count` photos.
    """
    with as_input_error(path, "not LLFF's table ({reason}): expected finite floats, [photos, 17]"):
        table: NDArray[Any] = np.load(path, allow_pickle=False)
        has_shape = table.ndim == 2 and table.shape[1] == NUMBERS_PER_ROW
        has_floats = table.dtype.kind == "f"
        if not has_shape or not has_floats or not np.isfinite(table).all():
            # The text becomes the reason in the InputError's message.
            raise ValueError(f"{table.dtype} of shape {table.shape}")

        positive_columns = [
            HEIGHT_COLUMN,
            WIDTH_COLUMN,
            FOCAL_COLUMN,
            NEAREST_DEPTH_COLUMN,
            FARTHEST_DEPTH_COLUMN,
        ]
        if not (table[:, positive_columns] > 0).all():
            raise ValueError("a size, a focal length or a bound is not positive")

    if len(table) != photo_count:
        raise InputError(
            f"{path}: {len(table)} rows, but there are {photo_count} photos: unpack the scene again"
        )
    return table


def _camera_of_row(row: NDArray[Any], where: str) -> Camera:
    """The camera of a row of poses_bounds.npy.

    Args:
        row: [17], a matrix [3, 5] row by row, and two depths. The matrix's columns are down, right,
            backwards, position (camera to world), and (height, width, focal length).
        where: the file and photo, for messages.

    Raises:
        InputError: the camera is impossible.
    """
    # The last two numbers are depths.
    matrix = torch.from_numpy(np.asarray(row[:15], np.float64).reshape(3, 5))
    down, right, backwards, position, size_and_focal = matrix.unbind(1)
    height, width, focal = size_and_focal

    # The file's axes are down, right and backwards, those of OpenCV right, down and forward.
    camera_to_world = torch.eye(4, dtype=torch.float64)
    camera_to_world[:3] = torch.stack([right, down, -backwards, position], dim=1)
    # The principal point is the image's middle.
    K = torch.tensor(
        [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    return camera_from_pose(K, camera_to_world, round(float(width)), round(float(height)), where)


def _files_of_model(
    folder: Path, names_in_model: Sequence[str], files: Sequence[Path]
) -> list[Path]:
    """The file of each photo of a scene's COLMAP model.

    Suffixes may differ, as in a JPEG made from a PNG. If names differ, too, photos are matched by
    order.

    Raises:
        InputError: names differ, and the numbers of photos do, too.
    """
    files_by_stem = {file.stem: file for file in files}
    stems = [Path(name).stem for name in names_in_model]
    if all(stem in files_by_stem for stem in stems):
        return [files_by_stem[stem] for stem in stems]

    if len(names_in_model) != len(files):
        raise InputError(
            f"{folder}: {len(files)} photos, but the COLMAP model has {len(names_in_model)} with "
            "other names: unpack it again"
        )
    return list(files)


LLFF = EvalDataset(
    name="llff",
    title="LLFF",
    terms="research, cite",
    markers=("poses_bounds.npy", "sparse"),
    expected="SCENE/poses_bounds.npy or SCENE/sparse/0 beside SCENE/images_4 or SCENE/images",
    read_cases=llff_cases,
)
