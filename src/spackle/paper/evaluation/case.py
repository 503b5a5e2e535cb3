"""Evaluation cases: photos with their known depth, cameras and second photos, at the working size."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.photo import MAX_WORKING_SIDE_PX, Photo, load_photo, resize_photo, working_size
from spackle.depth.depth_map import DepthMap
from spackle.paper.evaluation.measurements import NEAR
from spackle.runtime.errors import InputError

SHAPE_TOLERANCE = (
    0.01  # accepted relative difference of aspect ratio between a photo and its camera
)


@dataclasses.dataclass(frozen=True)
class SecondView:
    """A second photo of the same scene, from another viewpoint."""

    name: str
    photo: Path
    camera: Camera  # of the photo's aspect ratio; in the input photo's frame and the dataset's unit
    near: bool = True  # whether --second-views nearest takes this view


@dataclasses.dataclass(frozen=True)
class Points:
    """Points of the input photo with known depth."""

    uv: Tensor  # [n, 2] in pixels of the case's camera, pixel centres at half-integers
    z: Tensor  # [n] depth along the optical axis, in the dataset's unit


@dataclasses.dataclass(frozen=True)
class Case:
    """An input photo with its known camera, depth and second photos. Files are read on demand."""

    name: str  # unique in the dataset; slashes separate scene and view
    photo: Path
    camera: Camera | None = (
        None  # of the photo's aspect ratio; None: the photo's metadata give the focal length
    )
    depth: Callable[[], DepthMap] | None = (
        None  # of the photo's aspect ratio, in the dataset's unit
    )
    points: Callable[[], Points] | None = None
    bounds: tuple[float, float] | None = (
        None  # nearest and farthest depth, for cases without depth and points
    )
    seconds: tuple[SecondView, ...] = ()


class Viewpoint(NamedTuple):
    """A view to evaluate."""

    setting: str
    name: str
    camera: Camera
    truth: Callable[[], Tensor] | None = (
        None  # reads the true view [H, W, 3] sRGB 0..1, of the camera's size
    )


@dataclasses.dataclass(frozen=True)
class LoadedCase:
    """A case whose photos have been read."""

    case: Case
    full: (
        Photo  # the input at its stored size, with the dataset's focal length; bases get this photo
    )
    photo: Photo  # the input at the working size
    camera: Camera  # of `photo`, at the world's origin: from the dataset, or else from the photo
    seconds: tuple[Viewpoint, ...]  # with cameras in the input photo's frame and the dataset's unit


def load_case(case: Case, max_side: int = MAX_WORKING_SIDE_PX) -> LoadedCase:
    """Read the photos of a case; resize photos and cameras to `working_size`.

    Views have even sides, so a second photo with an odd side loses its last row or column.

    Raises:
        InputError: a photo is missing or is no image, or its aspect ratio differs from its camera's.
    """
    full = load_photo(case.photo)
    if case.camera is not None:
        _check_shape(case.photo, full, case.camera)
        focal = case.camera.resized(full.width, full.height).focal[0]
        full = dataclasses.replace(full, focal_px=focal, focal_source=FocalSource.DATASET)
    photo = resize_photo(full, max_side)
    camera = photo.camera if case.camera is None else case.camera.resized(photo.width, photo.height)
    camera = dataclasses.replace(camera, world_to_camera=torch.eye(4))
    return LoadedCase(
        case, full, photo, camera, tuple(_load_view(view, max_side) for view in case.seconds)
    )


def _load_view(view: SecondView, max_side: int) -> Viewpoint:
    """Check a second photo; the photo is read again on demand, because a scene may have hundreds."""
    stored = load_photo(view.photo)
    _check_shape(view.photo, stored, view.camera)
    camera = view.camera.resized(*working_size(stored.width, stored.height, max_side))
    width, height = (max(1, side - side % 2) for side in (camera.width, camera.height))

    def truth() -> Tensor:
        return resize_photo(load_photo(view.photo), max_side).rgb[:height, :width].contiguous()

    return Viewpoint(
        NEAR, view.name, dataclasses.replace(camera, width=width, height=height), truth
    )


def _check_shape(path: Path, photo: Photo, camera: Camera) -> None:
    """InputError unless the photo has the aspect ratio for which its camera was calibrated."""
    if abs(photo.width * camera.height / (photo.height * camera.width) - 1) > SHAPE_TOLERANCE:
        raise InputError(
            f"{path}: {photo.width}×{photo.height} pixels upright, but the calibration is for "
            f"{camera.width}×{camera.height}: the photo was cropped or turned, unpack it again"
        )


def known_depth(case: Case) -> DepthMap:
    """A case's depth map, or a map of its points: each pixel of the case's camera gets its nearest point.

    Raises:
        InputError: the case has neither depth nor points, or a file cannot be used.
    """
    if case.depth is not None:
        return case.depth()
    if case.points is None or case.camera is None:
        raise InputError(
            f"{case.name}: has neither a depth map nor points: --base rgbd needs one of them"
        )
    points, camera = case.points(), case.camera
    column, row = points.uv.floor().long().unbind(-1)
    inside = (
        (column >= 0)
        & (row >= 0)
        & (column < camera.width)
        & (row < camera.height)
        & (points.z > 0)
    )
    order = points.z[inside].argsort(descending=True, stable=True)  # the nearest is written last
    depth = torch.zeros(camera.height, camera.width)
    depth[row[inside][order], column[inside][order]] = points.z[inside][order].float()
    if not bool((depth > 0).any()):
        raise InputError(f"{case.name}: not one of its {len(points.z)} points lies in the photo")
    return DepthMap(depth, depth > 0, camera.K, None, "depth", case.photo)
