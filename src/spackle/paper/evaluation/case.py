"""Evaluation cases: photos with what is known about them (camera, depth, second photos).

`Case` names files and is cheap; `load_case` reads its photos and resizes them to the working
size, at which photos are evaluated. The functions in `datasets/` make the cases.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.photo import MAX_WORKING_SIDE_PX, Photo, load_photo, resize_photo, working_size
from spackle.depth.depth_map import DepthMap
from spackle.paper.evaluation.measurements import NEAR_SETTING
from spackle.runtime.errors import InputError

# Which second photos of a case near views use: those before and after it in the scene's order; the
# few nearest that show the same; a few, spread from the nearest to the farthest; or all.
SecondViews = Literal["adjacent", "nearest", "spread", "all"]
MAX_SPREAD_VIEWS = 8  # of a case, for "spread"; with "all", Tanks alone would have 150,000 views

# The accepted relative difference between the aspect ratios of a photo and of its calibration.
ASPECT_RATIO_TOLERANCE = 0.01


@dataclasses.dataclass(frozen=True)
class SecondView:
    """A second photo of the same scene, from another viewpoint."""

    name: str
    photo: Path
    # Of the photo's aspect ratio; in the frame of the case's photo and the dataset's unit of
    # length.
    camera: Camera
    # Whether it is one of the few close views that `second_views` "nearest" evaluates.
    is_among_nearest: bool = True
    # Whether it is the photo before or after the case's in the scene's order, as in a video.
    is_adjacent: bool = True


@dataclasses.dataclass(frozen=True)
class Points:
    """Points of a photo with known depth, for instance from a COLMAP model."""

    uv: Tensor  # [N, 2] in pixels of the case's camera, pixel centres at half-integers
    z: Tensor  # [N] depth along the optical axis, in the dataset's unit of length


@dataclasses.dataclass(frozen=True)
class Case:
    """An input photo with its known camera, depth and second photos; files are read on demand.

    Depth is known as a map, as points, as bounds, or not at all.
    """

    name: str  # unique in the dataset; slashes separate scene and view
    photo: Path
    # Of the photo's aspect ratio; None: the photo's metadata give the focal length.
    camera: Camera | None = None
    # Reads the depth map, of the photo's aspect ratio, in the dataset's unit of length.
    read_depth: Callable[[], DepthMap] | None = None
    read_points: Callable[[], Points] | None = None
    # Nearest and farthest depth, for cases without depth map and points.
    depth_bounds: tuple[float, float] | None = None
    second_views: tuple[SecondView, ...] = ()


class Viewpoint(NamedTuple):
    """A view to evaluate: all methods render it, and if its true picture is known, are compared."""

    setting: str  # a disparity as text, such as "0.3", or "near"
    name: str
    camera: Camera
    # Reads the true picture [H, W, 3], sRGB 0..1, of the camera's size; None: it is unknown.
    read_true_picture: Callable[[], Tensor] | None = None


@dataclasses.dataclass(frozen=True)
class LoadedCase:
    """A case whose photos have been read and checked."""

    case: Case
    # The input at its stored size, with the dataset's focal length; bases (the networks that turn a
    # photo into Gaussians) get this photo.
    full_photo: Photo
    photo: Photo  # the input at the working size
    camera: Camera  # of `photo`, at the world's origin: from the dataset, or else from the photo
    # With cameras in the input photo's frame and the dataset's unit of length.
    second_viewpoints: tuple[Viewpoint, ...]


def load_case(case: Case, max_side: int = MAX_WORKING_SIDE_PX) -> LoadedCase:
    """Read the photos of a case, and resize photos and cameras to the working size.

    Views have even sides, so a second photo with an odd side loses its last row or column.

    Args:
        case: the photo and its second photos, with their cameras.
        max_side: the long side of the working size, in pixels; smaller photos keep their size.

    Raises:
        InputError: a photo is missing or is no image, or its aspect ratio differs from its
            camera's.
    """
    full_photo = load_photo(case.photo)

    # The dataset's calibration is better than the focal length in the photo's metadata.
    if case.camera is not None:
        _check_aspect_ratio(case.photo, full_photo, case.camera)
        camera_at_full_size = case.camera.resized(full_photo.width, full_photo.height)
        focal_px, _ = camera_at_full_size.focal
        full_photo = dataclasses.replace(
            full_photo, focal_px=focal_px, focal_source=FocalSource.DATASET
        )

    photo = resize_photo(full_photo, max_side)
    known_camera = photo.camera if case.camera is None else case.camera
    camera = known_camera.resized(photo.width, photo.height)

    # The world's origin is the input camera, because second cameras are given in its frame.
    camera = dataclasses.replace(camera, world_to_camera=torch.eye(4))
    viewpoints = tuple(_load_second_view(view, max_side) for view in case.second_views)
    return LoadedCase(case, full_photo, photo, camera, viewpoints)


def _load_second_view(view: SecondView, max_side: int) -> Viewpoint:
    """Read a second photo to check it, and return its viewpoint at the working size.

    The viewpoint does not keep the photo's pixels but reads the file again on demand, because a
    scene may have hundreds of second photos. An odd side loses its last row or column of pixels.

    Args:
        view: the second photo and its camera.
        max_side: the long side of the working size, in pixels.

    Raises:
        InputError: the photo is missing or is no image, or its aspect ratio differs from its
            camera's.
    """
    # Read now, so that a damaged photo is found before long work.
    stored_photo = load_photo(view.photo)
    _check_aspect_ratio(view.photo, stored_photo, view.camera)
    working_width, working_height = working_size(stored_photo.width, stored_photo.height, max_side)
    camera = view.camera.resized(working_width, working_height)

    # Views are completed in cells of 2×2 pixels, so their sides are made even, but never 0.
    even_width = max(1, camera.width - camera.width % 2)
    even_height = max(1, camera.height - camera.height % 2)
    camera = dataclasses.replace(camera, width=even_width, height=even_height)

    def read_true_picture() -> Tensor:
        """The second photo, [even_height, even_width, 3], sRGB 0..1."""
        photo = resize_photo(load_photo(view.photo), max_side)
        return photo.rgb[:even_height, :even_width].contiguous()

    return Viewpoint(NEAR_SETTING, view.name, camera, read_true_picture)


def _check_aspect_ratio(path: Path, photo: Photo, camera: Camera) -> None:
    """Raise an InputError unless the photo has its camera's aspect ratio within 1 %.

    Another aspect ratio means that the photo is not the one for which the camera was calibrated.
    """
    photo_over_camera = photo.width * camera.height / (photo.height * camera.width)
    if abs(photo_over_camera - 1) > ASPECT_RATIO_TOLERANCE:
        raise InputError(
            f"{path}: {photo.width}×{photo.height} pixels upright, but the calibration is for "
            f"{camera.width}×{camera.height}: the photo was cropped or turned, unpack it again"
        )


def known_depth(case: Case) -> DepthMap:
    """The case's depth map; if it has only points, a depth map that is known at these points.

    Raises:
        InputError: the case has neither a depth map nor points, or a file cannot be used.
    """
    if case.read_depth is not None:
        return case.read_depth()
    if case.read_points is None or case.camera is None:
        raise InputError(
            f"{case.name}: has neither a depth map nor points: the base rgbd needs one of them"
        )
    depth = _depth_of_points(case.read_points(), case.camera, case.name)
    return DepthMap(
        depth=depth,
        valid=depth > 0,
        K=case.camera.K,
        quantum=None,  # the depths are not rounded
        quantity="depth",
        path=case.photo,
    )


def _depth_of_points(points: Points, camera: Camera, case_name: str) -> Tensor:
    """Depth of the nearest point in each pixel, [H, W] float32; 0 in pixels without a point.

    Raises:
        InputError: no point lies in the image and in front of the camera.
    """
    column, row = points.uv.floor().long().unbind(-1)
    is_in_image = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    is_usable = is_in_image & (points.z > 0)
    column, row, z = column[is_usable], row[is_usable], points.z[is_usable]

    # Points are written from far to near, so that a pixel with several points keeps its nearest.
    far_to_near = z.argsort(descending=True, stable=True)
    depth = torch.zeros(camera.height, camera.width)
    depth[row[far_to_near], column[far_to_near]] = z[far_to_near].float()

    if not bool((depth > 0).any()):
        raise InputError(f"{case_name}: not one of its {len(points.z)} points lies in the photo")
    return depth
