"""Many posed photos of one scene: which are cases, and which others are second views of a case.

`make_cases` makes the cases of a scene; `spread_over_scenes` chooses photos where a dataset has
too many.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.formats.camera_files import checked_camera
from spackle.paper.evaluation.case import Case, Points, SecondView
from spackle.paper.evaluation.datasets.colmap import Model

# When a second photo counts as near: the distance of the cameras over the photo's middle depth
# lies in this range (Middlebury's pairs have 0.05 to 0.2), the optical axes differ by at most
# this angle, and the second photo sees at least this fraction of the photo's points.
MIN_BASELINE_OVER_DEPTH = 0.05
MAX_BASELINE_OVER_DEPTH = 0.25
MAX_TURN_DEGREES = 30.0
MIN_SHARED_POINTS_RATIO = 0.3
MAX_NEAR_VIEWS = 3  # of a photo

# How far a pose's rotation may differ from an exact rotation matrix; published poses are rounded.
ROTATION_TOLERANCE = 0.05

Item = TypeVar("Item")


@dataclasses.dataclass(frozen=True)
class PosedPhoto:
    """A photo with its pose in a scene."""

    name: str
    photo: Path
    camera: Camera  # in the scene's world, float64
    middle_depth: float  # of the photo's content; NaN if unknown
    point_ids: NDArray[Any] | None = None  # ids of the points that the photo sees
    read_points: Callable[[], Points] | None = None  # positions of these points in the photo
    depth_bounds: tuple[float, float] | None = None  # nearest and farthest depth


def camera_from_pose(
    K: Tensor, camera_to_world: Tensor, width: int, height: int, where: str
) -> Camera:
    """A float64 camera from intrinsics and a camera-to-world pose.

    Args:
        K: [3, 3] intrinsics in pixels.
        camera_to_world: [4, 4].
        width: of the photo in pixels.
        height: of the photo in pixels.
        where: the file and photo, for messages.

    Raises:
        InputError: intrinsics or pose are impossible.
    """
    # The pose is checked before it is inverted, so that messages show the numbers of the file.
    camera = checked_camera(
        K,
        camera_to_world,
        width,
        height,
        where,
        dtype=torch.float64,
        tolerance=ROTATION_TOLERANCE,  # published poses are rounded
        pose_name="camera_to_world",
    )
    return dataclasses.replace(camera, world_to_camera=torch.linalg.inv(camera_to_world))


def posed_photos_of_model(scene: Path, model: Model, photos: Sequence[Path]) -> list[PosedPhoto]:
    """The photos of a COLMAP model, each with its camera and the points that it sees.

    Args:
        scene: the scene's folder, which gives the first part of the photos' names.
        model: cameras and points.
        photos: the files of the model's photos, in the model's order.
    """
    posed_photos = []
    for view, photo in zip(model.views, photos, strict=True):
        # Without points the depth is unknown, and no other photo counts as near.
        depths = model.points(view).z
        middle_depth = float(depths.median()) if len(depths) else math.nan
        posed_photo = PosedPhoto(
            name=f"{scene.name}/{photo.stem}",
            photo=photo,
            camera=view.camera,
            middle_depth=middle_depth,
            point_ids=view.point_ids,
            read_points=partial(model.points, view) if len(view.point_ids) else None,
        )
        posed_photos.append(posed_photo)
    return posed_photos


def make_cases(
    photos: Sequence[PosedPhoto], case_indices: Iterable[int] | None = None
) -> list[Case]:
    """Make a case of each chosen photo, with all other photos of the scene as its second views.

    The cameras of second views are given in the frame of the case's photo, the nearest first.

    The nearest three views that meet these conditions are marked as near; there may be fewer, or
    none: the camera is 5 % to 25 % of the photo's middle depth away, is turned by at most 30°, and
    sees at least 30 % of the photo's points. If points are unknown, each camera must instead see
    the middle of the other's view. The photos before and after the case's are marked as adjacent.

    Args:
        photos: all photos of a scene, in their order, as in a video.
        case_indices: indices of the photos that become cases; None: all.
    """
    if not photos:
        return []
    if case_indices is None:
        case_indices = range(len(photos))

    # Computed once for all cases, because a scene may have hundreds of photos.
    poses = torch.stack([photo.camera.world_to_camera for photo in photos])
    scene = _PosedScene(
        photos=photos,
        poses=poses,
        positions=torch.stack([photo.camera.position for photo in photos]).numpy(),
        axes=poses[:, 2, :3].numpy(),  # the third row of a rotation is the viewing direction
        cameras=[photo.camera.to(dtype=torch.float32) for photo in photos],
    )
    return [_make_case(scene, index) for index in case_indices]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _PosedScene:
    """All photos of a scene, with what the cases need of their cameras."""

    photos: Sequence[PosedPhoto]
    poses: Tensor  # [N, 4, 4] world-to-camera, float64
    positions: NDArray[Any]  # [N, 3] of the cameras in the world
    axes: NDArray[Any]  # [N, 3] unit vectors along which the cameras look, in the world
    cameras: Sequence[Camera]  # float32


def _make_case(scene: _PosedScene, index: int) -> Case:
    """The case of one photo of a scene, with all others as second views, the nearest first."""
    photo = scene.photos[index]
    distances = np.linalg.norm(scene.positions - scene.positions[index], axis=1)  # [N]
    other_indices = [other for other in range(len(scene.photos)) if other != index]
    # Cameras at the same distance are in the order of names.
    other_indices.sort(key=lambda other: (float(distances[other]), scene.photos[other].name))
    near_indices = _near_indices(scene, index, distances, other_indices)

    # The case's camera becomes the world's origin.
    poses = (scene.poses @ torch.linalg.inv(scene.poses[index])).float()  # world-to-camera

    second_views = []
    for other in other_indices:
        camera = dataclasses.replace(scene.cameras[other], world_to_camera=poses[other])
        second_view = SecondView(
            name=scene.photos[other].name,
            photo=scene.photos[other].photo,
            camera=camera,
            is_among_nearest=other in near_indices,
            is_adjacent=abs(other - index) == 1,
        )
        second_views.append(second_view)

    return Case(
        name=photo.name,
        photo=photo.photo,
        camera=dataclasses.replace(scene.cameras[index], world_to_camera=torch.eye(4)),
        read_points=photo.read_points,
        depth_bounds=photo.depth_bounds,
        second_views=tuple(second_views),
    )


def _near_indices(
    scene: _PosedScene, index: int, distances: NDArray[Any], other_indices: Sequence[int]
) -> list[int]:
    """The photos that count as near second views of a photo: at most three, the nearest first.

    Args:
        scene: all photos.
        index: the photo.
        distances: [N] from the photo's camera to all cameras.
        other_indices: all other photos, the nearest camera first.
    """
    photo = scene.photos[index]
    min_distance = MIN_BASELINE_OVER_DEPTH * photo.middle_depth
    max_distance = MAX_BASELINE_OVER_DEPTH * photo.middle_depth
    # If the middle depth is unknown (NaN), no distance is good.
    has_good_distance = (distances >= min_distance) & (distances <= max_distance)

    # Axes are unit vectors, so their product is the cosine of the angle between them.
    cosines = scene.axes @ scene.axes[index]
    has_similar_direction = cosines >= math.cos(math.radians(MAX_TURN_DEGREES))

    near_indices: list[int] = []
    for other in other_indices:
        if len(near_indices) == MAX_NEAR_VIEWS:
            break
        is_placed_well = has_good_distance[other] and has_similar_direction[other]
        if is_placed_well and _sees_the_same(photo, scene.photos[other]):
            near_indices.append(other)
    return near_indices


def _sees_the_same(photo: PosedPhoto, other: PosedPhoto) -> bool:
    """Whether another photo sees at least 30 % of the points that a photo sees.

    If points are unknown: whether each camera sees the middle of the other's view.
    """
    if photo.point_ids is not None and other.point_ids is not None:
        shared_ids = np.intersect1d(photo.point_ids, other.point_ids, assume_unique=True)
        # At least one point must be shared, also if the photo sees none.
        point_count = max(1, len(photo.point_ids))
        return len(shared_ids) >= MIN_SHARED_POINTS_RATIO * point_count
    return _sees_middle(photo.camera, other) and _sees_middle(other.camera, photo)


def _sees_middle(camera: Camera, photo: PosedPhoto) -> bool:
    """Whether a camera sees the point in the middle of a photo, at the photo's middle depth."""
    size = torch.tensor([photo.camera.width, photo.camera.height], dtype=torch.float64)
    depth = torch.tensor(photo.middle_depth, dtype=torch.float64)
    middle_point = photo.camera.unproject(size / 2, depth)  # [3] in the world

    uv, z = camera.project(middle_point)
    is_in_image = (uv >= 0).all() & (uv <= torch.tensor([camera.width, camera.height])).all()
    return bool((z > 0) & is_in_image)


def spread_over_scenes(
    scenes: Sequence[str], photos_of_scene: Callable[[str], Sequence[int]], count: int
) -> dict[str, Sequence[int]]:
    """Choose photos of a dataset, spread evenly over its scenes and over the photos of each scene.

    Scenes take turns to give one photo each, until there are `count`; scenes without further
    photos are skipped.

    If there are more scenes than `count`, only some scenes are used, which give one photo each.
    Then categories take turns to give one scene each. A scene's category is the first part of its
    name, CATEGORY/SCENE.

    Args:
        scenes: names, in order; the scenes of a category are neighbours.
        photos_of_scene: returns the indices of a scene's photos; called only for scenes that are
            used.
        count: how many photos to choose; if there are fewer, all are chosen.

    Returns:
        The scenes that are used, in order, each with the indices of its chosen photos, in order.
    """
    # A name without a slash is a category by itself.
    by_category = itertools.groupby(scenes, key=lambda scene: scene.partition("/")[0])
    scenes_of_categories = [list(names) for _, names in by_category]
    used_scenes = _in_turn(scenes_of_categories)[:count]

    photos = {scene: photos_of_scene(scene) for scene in used_scenes}
    # A list for each scene has its name once for each of its photos. How often a name is among the
    # first `count` turns is how many photos the scene gives.
    turns = _in_turn([[scene] * len(photos[scene]) for scene in used_scenes])[:count]
    counts = collections.Counter(turns)
    return {
        scene: evenly_spaced_items(photos[scene], counts[scene])
        for scene in scenes
        if scene in counts
    }


def evenly_spaced_items(items: Sequence[Item], count: int) -> list[Item]:
    """Choose `count` evenly spaced items: the middle item of each of `count` equal parts."""
    # The middle of part k is at (k + 1/2) / count of the length, in whole numbers.
    return [items[(2 * k + 1) * len(items) // (2 * count)] for k in range(count)]


def _in_turn(lists: Iterable[Sequence[str]]) -> list[str]:
    """The first items of all lists, then the second items, and so on; lists may end early."""
    rounds = itertools.zip_longest(*lists)  # None for lists that have ended
    return [item for items in rounds for item in items if item is not None]
