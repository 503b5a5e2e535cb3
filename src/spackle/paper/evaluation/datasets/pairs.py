"""Photos of your own: rectified pairs and posed photos, which a scene.json describes.

docs/evaluation.md explains each key.
"""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.image_files import upright_size
from spackle.depth.calibration import Calibration, read_short_text
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth, read_stored_depth
from spackle.formats.camera_files import Number, Row3, Row4, SidePx, checked_camera
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.multiview import (
    MAX_NEAR_VIEWS,
    ROTATION_TOLERANCE,
    PosedPhoto,
    camera_from_pose,
    make_cases,
)
from spackle.paper.evaluation.datasets.stereo import rectified_pair
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.validation import validated

SCENE_FILE = "scene.json"
MAX_JSON_BYTES = 1 << 24  # enough for the poses of 10,000 photos
MAX_PHOTOS = 10_000  # of a scene

FileName = Annotated[str, Field(min_length=1, max_length=1000)]
Positive = Annotated[Number, Field(gt=0)]
Model = TypeVar("Model", bound=BaseModel)


class _Entry(BaseModel):
    """A part of a file; other keys than its own are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _RectifiedPair(_Entry):
    """A scene.json of two photos side by side. Numbers are in pixels of the left photo."""

    left: FileName
    right: FileName
    focal_px: Positive
    baseline_m: Positive
    cx: Number | None = None  # from the left edge of the photo; None: its middle
    cy: Number | None = None
    doffs_px: Number = 0.0  # the right principal point's x minus the left one's
    disparity: FileName | None = None  # the left photo's map
    disparity_scale: Positive = 1.0  # disparity in pixels = stored value · scale
    invalid: Number | None = None  # a stored value that means "unknown"
    depth_range: tuple[Positive, Positive] | None = None


class _Photo(_Entry):
    """A photo of a scene.json of posed photos. Lengths have one unit in the whole scene."""

    file: FileName
    K: tuple[Row3, Row3, Row3] | None = None
    world_to_camera: tuple[Row4, Row4, Row4, Row4] | None = None
    camera_to_world: tuple[Row4, Row4, Row4, Row4] | None = None
    depth: FileName | None = None
    depth_range: tuple[Positive, Positive] | None = None
    input: bool = True  # whether the photo is completed, not only compared with


class _PosedPhotos(_Entry):
    """A scene.json of photos with known cameras."""

    photos: Annotated[list[_Photo], Field(min_length=2, max_length=MAX_PHOTOS)]
    K: tuple[Row3, Row3, Row3] | None = None  # of photos without one
    # Width and height in pixels of the photos that K describes; None: the size of each photo.
    size: tuple[SidePx, SidePx] | None = None


def pairs_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """The cases (input photos with what is known about them) of each scene.

    Of a rectified pair the left photo is the input and the right photo its second view. Of posed
    photos each is an input, unless its entry says "input": false, and all others of the scene are
    its second views.

    Args:
        scenes: the folder of each scene, by the scene's name.

    Raises:
        InputError: a scene.json is damaged, or a file that it names is missing or damaged.
    """
    cases = []
    for folder in scenes.values():
        path = folder / SCENE_FILE
        content = _read_json(path)
        if "photos" in content:
            cases += _posed_cases(folder, _read(_PosedPhotos, path, content))
        elif "left" in content or "right" in content:
            cases.append(_rectified_case(folder, _read(_RectifiedPair, path, content)))
        else:
            raise InputError(
                f"{path}: describes no photos: give left and right for a rectified pair, or photos "
                "for photos with poses"
            )
    return cases


def _read_json(path: Path) -> dict[str, Any]:
    """The object that a JSON file holds; InputError if the file is damaged or holds another."""
    text = read_short_text(path, "description", MAX_JSON_BYTES)
    with as_input_error(path, "not JSON ({reason}): the file is damaged"):
        # Some editors of Windows begin a file with a byte order mark, which JSON does not allow.
        content = json.loads(text.removeprefix("\N{ZERO WIDTH NO-BREAK SPACE}"))
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no JSON object: put its content in braces, {{…}}")
    return content


def _read(model: type[Model], path: Path, content: dict[str, Any]) -> Model:
    """The content of a file as a model; InputError, which names file and key, if it is none."""
    return validated(model, content, path)


# --- a rectified pair


def _rectified_case(folder: Path, pair: _RectifiedPair) -> Case:
    """The case of a rectified pair; InputError if its files or numbers cannot be used."""
    path = folder / SCENE_FILE
    left = _existing(folder, pair.left, path, "left")
    right = _existing(folder, pair.right, path, "right")
    width, height = upright_size(left)
    if upright_size(right) != (width, height):
        raise InputError(
            f"{path}: {pair.left} and {pair.right} differ in size: rectified photos have one size; "
            "give other pairs as photos with poses"
        )
    calibration = Calibration(
        focal_px=pair.focal_px,
        cx=width / 2 if pair.cx is None else pair.cx,
        cy=height / 2 if pair.cy is None else pair.cy,
        doffs_px=pair.doffs_px,
        baseline_m=pair.baseline_m,
        scale=pair.disparity_scale,
        invalid=math.inf if pair.invalid is None else pair.invalid,
        size=(width, height),
    ).checked(path)

    case = rectified_pair(
        name=folder.name,
        left=left,
        right=right,
        calibration=calibration,
        size=(width, height),
        read_depth=None,
    )
    bounds = _ascending(pair.depth_range, path, "depth_range")
    if pair.disparity is None:
        return dataclasses.replace(case, depth_bounds=bounds)
    disparity = _existing(folder, pair.disparity, path, "disparity")
    read_depth = partial(_read_disparity, disparity, calibration)
    return dataclasses.replace(case, read_depth=read_depth, depth_bounds=bounds)


def _read_disparity(path: Path, calibration: Calibration) -> DepthMap:
    """The depth of the left photo, from its map of disparities."""
    stored = read_stored_depth(path)
    return calibration.depth_from_disparity(stored.numbers, path, zero_is_unknown=stored.is_picture)


# --- posed photos


def _posed_cases(folder: Path, scene: _PosedPhotos) -> list[Case]:
    """The cases of photos with poses; InputError if their files or numbers cannot be used."""
    path = folder / SCENE_FILE
    names = [Path(photo.file).with_suffix("").as_posix() for photo in scene.photos]
    repeated = [name for name in names if names.count(name) > 1]
    if repeated:
        raise InputError(f"{path}: several photos are called {repeated[0]}: rename them")
    posed_photos = [
        _posed_photo(folder, scene, photo, f"{folder.name}/{name}")
        for photo, name in zip(scene.photos, names, strict=True)
    ]
    input_indices = [index for index, photo in enumerate(scene.photos) if photo.input]
    if not input_indices:
        raise InputError(f"{path}: no photo is an input: leave input out at one of them")

    posed_photos = _with_usual_depth(posed_photos)
    cases = []
    for index, case in zip(input_indices, make_cases(posed_photos, input_indices), strict=True):
        depth_file = scene.photos[index].depth
        assert case.camera is not None
        if depth_file is not None:
            read_depth = partial(_read_depth, folder / depth_file, case.camera)
            case = dataclasses.replace(case, read_depth=read_depth)
        # `make_cases` compares a camera's distance with the scene's depth. Where no depth is known,
        # the nearest cameras count as near instead.
        if math.isnan(posed_photos[index].middle_depth):
            second_views = tuple(
                dataclasses.replace(view, is_among_nearest=rank < MAX_NEAR_VIEWS)
                for rank, view in enumerate(case.second_views)  # the nearest first
            )
            case = dataclasses.replace(case, second_views=second_views)
        cases.append(case)
    return cases


def _with_usual_depth(photos: Sequence[PosedPhoto]) -> list[PosedPhoto]:
    """The photos; those without a depth are taken to be as far from the scene as the others.

    If no depth is known at all, they stay as they are.
    """
    known_depths = [photo.middle_depth for photo in photos if not math.isnan(photo.middle_depth)]
    if not known_depths:
        return list(photos)
    usual_depth = statistics.median(known_depths)
    completed_photos = []
    for photo in photos:
        if math.isnan(photo.middle_depth):
            photo = dataclasses.replace(photo, middle_depth=usual_depth)
        completed_photos.append(photo)
    return completed_photos


def _posed_photo(folder: Path, scene: _PosedPhotos, photo: _Photo, name: str) -> PosedPhoto:
    """A photo with its camera, called `name`; InputError if file or numbers cannot be used."""
    path = folder / SCENE_FILE
    where = f"{path}: {photo.file}"
    file = _existing(folder, photo.file, path, "photos")
    camera = _camera(scene, photo, upright_size(file), where)

    bounds = _ascending(photo.depth_range, path, f"depth_range of {photo.file}")
    middle_depth = math.nan
    if photo.depth is not None:
        depth_file = _existing(folder, photo.depth, path, f"depth of {photo.file}")
        depth_map = _read_depth(depth_file, camera)
        depth_map.check_aspect_ratio(camera.height, camera.width, file)
        middle_depth = float(depth_map.depth[depth_map.valid].median())
    elif bounds is not None:
        # In inverse depth, which is what parallax depends on, half way between the bounds.
        nearest, farthest = bounds
        middle_depth = 2 / (1 / nearest + 1 / farthest)
    return PosedPhoto(
        name=name, photo=file, camera=camera, middle_depth=middle_depth, depth_bounds=bounds
    )


def _camera(scene: _PosedPhotos, photo: _Photo, size: tuple[int, int], where: str) -> Camera:
    """A photo's float64 camera.

    Args:
        scene: has the intrinsics of photos without their own.
        photo: its entry, with the pose.
        size: of the upright photo, (width, height) in pixels.
        where: names file and photo in messages.

    Raises:
        InputError: intrinsics or pose are missing or impossible.
    """
    K = photo.K or scene.K
    if K is None:
        raise InputError(f"{where}: has no K: give one for the photo, or one for the scene")
    # K may be for another size than that of the photos, such as that of the calibration.
    width, height = scene.size or size

    if photo.world_to_camera is not None and photo.camera_to_world is None:
        return checked_camera(
            _tensor(K),
            _tensor(photo.world_to_camera),
            width,
            height,
            where,
            dtype=torch.float64,
            tolerance=ROTATION_TOLERANCE,
        )
    if photo.camera_to_world is not None and photo.world_to_camera is None:
        return camera_from_pose(_tensor(K), _tensor(photo.camera_to_world), width, height, where)
    raise InputError(f"{where}: give one of world_to_camera and camera_to_world")


def _tensor(rows: Sequence[Sequence[float]]) -> Tensor:
    """A matrix of a file as float64."""
    return torch.tensor(rows, dtype=torch.float64)


def _read_depth(path: Path, camera: Camera) -> DepthMap:
    """The depth map of a photo, with the intrinsics of the photo's camera."""
    depth_map = load_depth(path)
    rows, columns = depth_map.depth.shape
    K = camera.resized(columns, rows).K.float()  # a map may be smaller than its photo
    return dataclasses.replace(depth_map, K=K)


# --- both


def _existing(folder: Path, name: str, scene_file: Path, key: str) -> Path:
    """The file with this name in a scene's folder; InputError if there is none.

    Args:
        folder: of the scene.
        name: of the file, with subfolders.
        scene_file: the scene.json, for the message.
        key: under which the scene.json names the file, for the message.
    """
    file = folder / name
    if not file.is_file():
        raise InputError(f"{scene_file}: {key}: no file {name} in the scene's folder")
    return file


def _ascending(
    depth_range: tuple[float, float] | None, path: Path, key: str
) -> tuple[float, float] | None:
    """The range itself; InputError, which names file and key, if the nearest is not below."""
    if depth_range is not None and depth_range[0] >= depth_range[1]:
        raise InputError(f"{path}: {key}: give the nearest depth, then the farthest")
    return depth_range


PAIRS = EvalDataset(
    name="pairs",
    title="",  # that of the folder, or of its about.json
    terms="",
    markers=(SCENE_FILE,),
    expected="SCENE/scene.json",
    read_cases=pairs_cases,
)
