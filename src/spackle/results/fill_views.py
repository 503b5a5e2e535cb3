"""The views that `spackle fill` fills: those of a file, a path around one camera, or an orbit."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases import DEFAULT_MAX_DISPARITY
from spackle.core.camera import Camera, look_at
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import (
    MAX_DISPARITY,
    TRAJECTORIES,
    DepthRange,
    TrajectoryKind,
    leftmost_and_rightmost,
    trajectory_cameras,
)
from spackle.formats.camera_readers import read_camera_set
from spackle.formats.camera_set import CameraSet
from spackle.formats.scene_content import SceneFile
from spackle.results.saved_scene import page_name
from spackle.runtime.errors import InputError, as_input_error, check_name
from spackle.runtime.suggestions import closest_name
from spackle.scene import Scene
from spackle.views import NO_PATH_MESSAGE, GivenPath

PATH_VIEWS = 30  # of a path around one camera; neighbours show nearly the same
ORBIT_VIEWS = 12  # around a scene without cameras: one each 30 degrees
ORBIT_SIZE = (960, 720)  # pixels
ORBIT_FOV_DEGREES = 50.0
ORBIT_ELEVATION_DEGREES = 20.0  # the cameras look down a little, as people do on a thing
# The orbit has in its frame so large a part of the Gaussians; stray ones are far away.
ORBIT_QUANTILE = 0.95
MIN_ORBIT_OPACITY = 0.1  # fainter Gaussians say nothing about where the scene is
SIGNED_AXES = {
    "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0), "-y": (0.0, -1.0, 0.0), "-z": (0.0, 0.0, -1.0),
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class FillViewsOptions:
    """Which views of a scene are filled."""

    cameras: Path | None = None  # a file of views in the scene's world
    # A picture's name or an index in that file: a path around this camera is filled instead.
    from_camera: str | None = None
    trajectory: TrajectoryKind | None = None  # of a path; None: rotate-forward, as of a photo
    disparity: float | None = None  # of a path; None: the scene's own
    up: str | None = None  # the scene's upward direction, for an orbit: "-y", or "0,-1,0.2"

    def check(self) -> None:
        """InputError for an impossible option, or for two that contradict each other."""
        if self.trajectory is not None:
            check_name("trajectory", self.trajectory, TRAJECTORIES)
        if self.disparity is not None and not 0 < self.disparity <= MAX_DISPARITY:
            raise InputError(
                f"`disparity` must be above 0 and at most {MAX_DISPARITY:g}, got {self.disparity:g}"
            )
        has_path = self.trajectory is not None or self.disparity is not None
        gives_views = self.cameras is not None and self.from_camera is None
        if gives_views and has_path:
            option = "trajectory" if self.trajectory is not None else "disparity"
            raise InputError(
                f"`{option}`: `cameras` gives the views already: leave one out, or name the camera "
                "that the path goes around with `from_camera`"
            )
        if self.from_camera is not None and self.cameras is None:
            raise InputError(
                f"`from_camera` {self.from_camera}: give the file that has this camera as `cameras`"
            )
        if self.up is None:
            return
        direction_of(self.up)
        if self.cameras is not None or has_path:
            raise InputError(
                f"`up` {self.up} asks for cameras all around the scene: "
                "leave out `cameras`, `trajectory` and `disparity`"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FillViews:
    """The views to fill, in the world of the scene's file."""

    cameras: list[Camera]
    photo_camera: Camera | None  # of the photo of the scene, if it is known
    notes: list[str]  # lines for the user


def choose_fill_views(scene: SceneFile, options: FillViewsOptions) -> FillViews:
    """The views that the options ask for.

    InputError if the scene has no camera and none is given, or a file cannot be used.
    """
    if options.up is not None:
        return _orbit(scene, options.up)
    if options.cameras is None:
        if scene.camera is None:
            raise InputError(
                f"{scene.path}: has no camera of its own: give `cameras`, a file of views of its "
                "world; or `up`, its upward direction, for views all around it"
            )
        return _path_around(scene, scene.camera, options, "its own camera")

    # A wrong name is refused before anything else.
    camera_set = read_camera_set(options.cameras)
    index = None
    if options.from_camera is not None:
        index = _index_of(camera_set, options.from_camera)

    # `in_scene` gives the cameras as seen from the scene's own camera, if it has one.
    given = GivenPath(cameras=camera_set).in_scene(scene, page_name(scene.path))
    assert given.views is not None  # `cameras` gives them
    views = [_in_world_of_file(view, scene) for view in given.views]
    if index is None:
        return FillViews(cameras=views, photo_camera=scene.camera, notes=given.notes)

    # The path leads around one of the file's cameras, as around that of a photo.
    camera = views[index]
    name = f"camera {camera_set.names[index] or index} of {options.cameras.name}"
    path = _path_around(scene, camera, options, name)
    return dataclasses.replace(path, notes=[*given.notes, *path.notes])


def named_camera(scene: SceneFile, cameras_file: Path, name: str) -> Camera:
    """A camera of a file, by its picture's name or its number, in the world of a scene's file.

    InputError if the file cannot be read, or has no such camera.
    """
    camera_set = read_camera_set(cameras_file)
    index = _index_of(camera_set, name)
    given = GivenPath(cameras=camera_set).in_scene(scene, page_name(scene.path))
    assert given.views is not None  # `cameras` gives them
    return _in_world_of_file(given.views[index], scene)


def _index_of(cameras: CameraSet, name: str) -> int:
    """The index of a camera in its file, by the name of its picture or by a number from 0.

    InputError for a name or number that it does not have.
    """
    index = cameras.index_of(name)
    if index is not None:
        return index
    if name.isdecimal() and int(name) < len(cameras.cameras):
        return int(name)
    suggestion = closest_name(name, [known for known in cameras.names if known])
    question = "" if suggestion is None else f"did you mean {suggestion}? Else "
    last = len(cameras.cameras) - 1
    raise InputError(
        f"{cameras.source}: has no camera {name}: {question}give a picture's name, "
        f"or a number from 0 to {last}"
    )


def _in_world_of_file(view: Camera, scene: SceneFile) -> Camera:
    """A camera in the world of a scene's file.

    Views of a photo's scene are in the world of the photo's camera, which may stand elsewhere.
    """
    if scene.camera is None:
        return view
    to_photo = scene.camera.world_to_camera.double()
    return dataclasses.replace(view, world_to_camera=view.world_to_camera.double() @ to_photo)


def _path_around(
    scene: SceneFile, camera: Camera, options: FillViewsOptions, name: str
) -> FillViews:
    """Views along a trajectory around a camera, which stands for a photo's.

    Args:
        scene: the scene.
        camera: in the world of its file.
        options: the trajectory, and how far the camera moves.
        name: of the camera, for the user.
    """
    pose = camera.world_to_camera.double()
    with as_input_error(scene.path, NO_PATH_MESSAGE, ValueError):
        depth_range = _depth_range(scene, camera)
    disparity = options.disparity or scene.disparity or DEFAULT_MAX_DISPARITY
    trajectory = options.trajectory or "rotate-forward"

    # Trajectories begin at a camera at the origin; its pose then brings their views to the scene.
    # The two views that are farthest to the left and right see behind most edges.
    at_origin = dataclasses.replace(camera, world_to_camera=torch.eye(4))
    around = [
        *trajectory_cameras(trajectory, at_origin, disparity, depth_range, PATH_VIEWS, looped=True),
        *leftmost_and_rightmost(at_origin, disparity, depth_range),
    ]
    cameras = [
        dataclasses.replace(view, world_to_camera=(view.world_to_camera.double() @ pose).float())
        for view in around
    ]
    view_count = 1 + len(cameras)  # the camera's own view, too
    note = f"{view_count} views around {name}: {trajectory}, disparity {disparity:g}"
    return FillViews(
        cameras=[camera, *cameras], photo_camera=camera, notes=[f"{scene.path.name}: {note}"]
    )


def _depth_range(scene: SceneFile, camera: Camera) -> DepthRange:
    """The depths of what a camera sees of a scene; ValueError if it sees nothing."""
    # The camera of the scene's photo: it sees all Gaussians that came from the photo.
    if scene.camera is camera:
        return Scene.of_file(scene).depth_range
    # Any other camera has Gaussians beside and behind it, too.
    uv, z = camera.project(scene.gaussians.means)
    seen = scene.gaussians.select(camera.has_in_frame(uv, z)).transform(camera.world_to_camera)
    return DepthRange.of(seen, is_metric=scene.is_metric)


def direction_of(up: str) -> Tensor:
    """[3] float64: a direction from a word such as "-y", or from three numbers "0,-1,0.2".

    InputError for anything else.
    """
    if up in SIGNED_AXES:
        return torch.tensor(SIGNED_AXES[up], dtype=torch.float64)
    try:
        numbers = [float(number) for number in up.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or not any(numbers):
        raise InputError(f"`up` {up}: give an axis such as y or -y, or three numbers as 0,-1,0")
    return torch.tensor(numbers, dtype=torch.float64)


def _orbit(scene: SceneFile, up: str) -> FillViews:
    """Views all around a scene, which look at its middle from a little above.

    The middle is the median of the Gaussians' centres along each axis. The cameras stand so far
    away that 95 % of the centres are in the frame.
    """
    upward = direction_of(up)
    upward = upward / upward.norm()
    middle, radius = _middle_and_radius(scene.gaussians)
    # Any two directions at right angles to `up` and to each other. The axis that differs most from
    # `up` gives the first.
    axis = torch.zeros(3, dtype=torch.float64)
    axis[int(upward.abs().argmin())] = 1.0
    first = torch.linalg.cross(upward, axis)
    first = first / first.norm()
    second = torch.linalg.cross(upward, first)

    width, height = ORBIT_SIZE
    focal_px = width / 2 / math.tan(math.radians(ORBIT_FOV_DEGREES / 2))
    # The smaller side of the frame decides.
    half_angle = math.atan(min(width, height) / 2 / focal_px)
    distance = radius / math.sin(half_angle)
    elevation = math.radians(ORBIT_ELEVATION_DEGREES)
    lens = Camera.from_focal(focal_px, width, height)
    cameras = []
    for index in range(ORBIT_VIEWS):
        angle = 2 * math.pi * index / ORBIT_VIEWS
        sideways = math.cos(angle) * first + math.sin(angle) * second
        offset = math.cos(elevation) * sideways + math.sin(elevation) * upward
        pose = look_at(middle + distance * offset, middle, upward)
        cameras.append(dataclasses.replace(lens, world_to_camera=pose.float()))

    place = ", ".join(f"{number:.3g}" for number in middle.tolist())
    note = (
        f"{len(cameras)} views all around ({place}), {distance:.3g} units away, from "
        f"{ORBIT_ELEVATION_DEGREES:g} degrees above"
    )
    return FillViews(cameras=cameras, photo_camera=None, notes=[f"{scene.path.name}: {note}"])


def _middle_and_radius(gaussians: Gaussians) -> tuple[Tensor, float]:
    """The middle [3] of a scene, float64, and the radius around it with 95 % of its Gaussians.

    Both in the scene's unit.
    """
    # Faint Gaussians say nothing about where the scene is, unless all are faint.
    means = gaussians.means[gaussians.opacities >= MIN_ORBIT_OPACITY].double()
    if not len(means):
        means = gaussians.means.double()

    # The median and the quantile are not moved by stray Gaussians far away.
    middle = means.median(dim=0).values
    distances = (means - middle).norm(dim=1)
    rank = max(1, round(ORBIT_QUANTILE * len(distances)))
    radius = float(distances.kthvalue(rank).values)
    return middle, max(radius, 1e-6)  # above 0, even if all lie in one point
