"""Plan a photo's views: the camera path, the frames of its video, and the views to fill.

Read `PathOptions` first (what a user may ask for), then `choose_disparity` (how far the camera
goes) and `plan_views` (which views follow from both).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.bases import DEFAULT_MAX_DISPARITY, BasePrediction
from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.gaussians import Gaussians
from spackle.core.keyframes import KeyframePath, PathError
from spackle.core.photo import Photo, working_size
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    MAX_DISPARITY,
    TRAJECTORIES,
    DepthRange,
    Framing,
    TrajectoryKind,
    leftmost_and_rightmost,
    trajectory_cameras,
)
from spackle.formats.camera_files import load_path
from spackle.formats.camera_readers import is_path_file, read_camera_set
from spackle.formats.camera_set import CameraSet
from spackle.formats.scene_content import SceneFile, is_at_origin
from spackle.render.protocol import Renderer
from spackle.residual.features import hole_area_ratio
from spackle.runtime.declared_options import MAX_FRAME_COUNT as MAX_FRAME_COUNT
from spackle.runtime.errors import InputError, as_input_error, check_name
from spackle.video.frames import SAME_ASPECT_TOLERANCE, FrameMaker
from spackle.video.framing import COARSE_SIDE_PX, SIDEWAYS, choose_framing
from spackle.video.options import VideoOptions

DEFAULT_FRAME_COUNT = 60  # cameras of `Scene.path`; of a longer path, 60 to 119 frames are filled
DEFAULT_VIDEO_SECONDS = 4.0  # duration of a video along a trajectory
MAX_OVERSCAN = 0.5  # focal length times 1.5, which leaves 44 % of the photo's area
MAX_REPORTED_KEYFRAMES = 16  # the report measures the holes of at most so many keyframes

NEARLY_NO_PX = 0.01  # two views that show the same may differ by this much, by rounding errors
DISPARITY_STEP = 0.01  # `choose_disparity` rounds the disparity down to a multiple of this step
MIN_CHOSEN_DISPARITY = 0.04  # a smaller movement shows no parallax
MAX_TRIALS = 3  # disparities that `choose_disparity` tries besides the base's usual one

NO_PATH_MESSAGE = "no camera path: {reason}: check the depth map and the focal length"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathOptions:
    """Options of the camera path, and of the video along it."""

    trajectory: TrajectoryKind = "rotate-forward"
    disparity: float | None = None  # size of the camera's movement; None: chosen for the photo
    # A file of views, or a folder of COLMAP's, that replace the trajectory.
    cameras: Path | None = None
    # A file of keyframes that replace the trajectory, or cameras of another program.
    path: Path | None = None
    frames: int | None = None  # number of video frames; None: `seconds` times the frame rate
    seconds: float | None = None  # duration of the video; None: 4, or the keyframes' duration
    video: VideoOptions = dataclasses.field(default_factory=VideoOptions)
    # Relative gain in focal length along a trajectory; None: chosen for the photo.
    overscan: float | None = None

    def check(self) -> None:
        """Raise an InputError for an impossible path or video, or for options that contradict."""
        # Trajectories may be written with underscores, too, as SHARP's programs write them.
        check_name("trajectory", self.trajectory.replace("_", "-"), TRAJECTORIES)
        if self.disparity is not None:
            is_possible = math.isfinite(self.disparity) and 0 <= self.disparity <= MAX_DISPARITY
            if not is_possible:
                raise InputError(
                    f"`disparity` must be between 0 and {MAX_DISPARITY:g}, got {self.disparity:g}"
                )
        self._check_length()
        self._check_files()
        if self.overscan is not None and not 0 <= self.overscan <= MAX_OVERSCAN:
            raise InputError(
                f"`overscan` must be between 0 and {MAX_OVERSCAN:g}, got {self.overscan:g}"
            )
        self.video.check()

    def _check_length(self) -> None:
        """Raise an InputError if the video would have no frame or too many.

        Likewise if `frames` and `seconds` both set its length.
        """
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAME_COUNT:
            raise InputError(f"`frames` must be between 1 and {MAX_FRAME_COUNT}, got {self.frames}")
        if self.seconds is None:
            return

        if self.frames is not None:
            raise InputError(
                f"`seconds` {self.seconds:g}: `frames` {self.frames} sets the length: leave one out"
            )
        if not 1 <= self.seconds * self.video.frames_per_second <= MAX_FRAME_COUNT:
            raise InputError(
                f"`seconds` must give 1 to {MAX_FRAME_COUNT} frames, got {self.seconds:g}"
            )

    def _check_files(self) -> None:
        """Raise an InputError if a file of views is given together with `path`."""
        if self.cameras is not None and self.path is not None:
            raise InputError(
                f"`path` {self.path}: `cameras` gives the views already: leave one of them out"
            )

    def load(self) -> GivenPath:
        """Read the files of `cameras` and `path`; InputError for one that cannot be used."""
        if self.cameras is not None:
            return GivenPath(cameras=read_camera_set(self.cameras))
        if self.path is None:
            return GivenPath()
        if is_path_file(self.path):
            return GivenPath(keyframes=load_path(self.path))
        return GivenPath(path_cameras=read_camera_set(self.path))

    def disparity_or(self, default: float) -> float:
        """The size of the camera's movement: the option's value, or else the default."""
        return default if self.disparity is None else self.disparity

    def requested_frame_count(self) -> int | None:
        """The number of video frames that `frames` or `seconds` asks for, or None."""
        if self.frames is not None:
            return self.frames
        if self.seconds is not None:
            return round(self.seconds * self.video.frames_per_second)
        return None

    def choose_framing(
        self,
        base: Gaussians,
        camera: Camera,
        depth_range: DepthRange,
        disparity: float | None,
        renderer: Renderer,
    ) -> Framing:
        """Where the cameras of the trajectory look, and how much they zoom in.

        The option `overscan` replaces both choices: then the target is the usual one.

        Args:
            base: the photo's Gaussians.
            camera: the photo's camera.
            depth_range: the scene's depths.
            disparity: size of the camera's movement if the option `disparity` is not given; None:
                DEFAULT_MAX_DISPARITY.
            renderer: renders the two widest views.
        """
        if self.overscan is not None:
            return Framing(depth_range.focus, self.overscan)
        if self.trajectory.replace("_", "-") not in SIDEWAYS:
            return Framing(depth_range.focus, DEFAULT_OVERSCAN)
        default_disparity = DEFAULT_MAX_DISPARITY if disparity is None else disparity
        return choose_framing(
            base,
            camera,
            depth_range,
            self.trajectory,
            self.disparity_or(default_disparity),
            renderer,
        )

    def video_cameras(
        self,
        depth_range: DepthRange,
        camera: Camera,
        keyframes: KeyframePath | None,
        disparity: float | None,
        framing: Framing | None,
    ) -> list[Camera]:
        """The cameras of the video's frames, through keyframes or along the trajectory.

        Views of odd width or height grow by one pixel, because video needs even sides.

        Args:
            depth_range: the scene's depths; the nearer the scene, the shorter the trajectory.
            camera: the photo's camera.
            keyframes: the keyframes of `path`; None: follow the trajectory.
            disparity: size of the camera's movement if the option `disparity` is not given; None:
                DEFAULT_MAX_DISPARITY.
            framing: from `choose_framing`; None: the usual target, and no zoom.

        Raises:
            PathError: the keyframes give no usable path.
            ValueError: the scene allows no such path.
        """
        # Keyframes say themselves where the camera goes.
        if keyframes is not None:
            return self._keyframe_cameras(depth_range, camera, keyframes)

        frame_count = self.requested_frame_count()
        if frame_count is None:
            frame_count = max(1, round(DEFAULT_VIDEO_SECONDS * self.video.frames_per_second))
        default_disparity = DEFAULT_MAX_DISPARITY if disparity is None else disparity
        cameras = trajectory_cameras(
            self.trajectory,
            camera.even(),
            self.disparity_or(default_disparity),
            depth_range if framing is None else framing.of(depth_range),
            frame_count,
            looped=True,  # most players repeat a video
        )
        if framing is None:
            return cameras
        # A little zoom hides most of what the fill has made up beyond the photo's border.
        return [view.zoomed(1 + framing.overscan) for view in cameras]

    def _keyframe_cameras(
        self, depth_range: DepthRange, camera: Camera, keyframes: KeyframePath
    ) -> list[Camera]:
        """The cameras of a video through keyframes; PathError if they would be too many."""
        frame_count = self.requested_frame_count()
        if frame_count is None:
            frame_count = keyframes.frame_count(self.video.frames_per_second)
        if frame_count > MAX_FRAME_COUNT:
            raise PathError(
                f"{keyframes.seconds:g} s take {frame_count} frames (at most {MAX_FRAME_COUNT}): "
                "give `frames`"
            )
        return keyframes.cameras(camera.even(), frame_count, depth_range)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathInWorld:
    """The views or keyframes of a user, in the world of a photo or scene."""

    views: list[Camera] | None = None
    keyframes: KeyframePath | None = None
    notes: list[str] = dataclasses.field(default_factory=list)  # lines for the user


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenPath:
    """What the files of the options `cameras` and `path` hold; nothing if none is given."""

    cameras: CameraSet | None = None  # the views
    keyframes: KeyframePath | None = None
    path_cameras: CameraSet | None = None  # another program's cameras, through which a path leads

    @property
    def replaces_trajectory(self) -> bool:
        """Whether a file says where the camera goes."""
        sources = (self.cameras, self.keyframes, self.path_cameras)
        return any(source is not None for source in sources)

    def with_lens(self, photo: Photo) -> Photo:
        """The photo with the focal length that the file of cameras gives, if it names the photo.

        A focal length that the user gives is kept. The file's focal length is not taken either for
        a photo that was cropped since: one whose uniform frame was cut off, or which has other
        proportions than the file says.
        """
        cameras = self.cameras or self.path_cameras
        lens = None if cameras is None else cameras.lens_of(photo.path.name)
        if lens is None or photo.focal_source.is_from_user or photo.frame is not None:
            return photo
        scale_across = photo.width / lens.width
        scale_down = photo.height / lens.height
        if abs(scale_across / scale_down - 1) > SAME_ASPECT_TOLERANCE:
            return photo
        focal_px = lens.focal[0] * scale_across
        return dataclasses.replace(photo, focal_px=focal_px, focal_source=FocalSource.CAMERAS)

    def around_photo(self, photo_name: str) -> PathInWorld:
        """The views or keyframes in the world of a photo's camera; the file may name the photo."""
        return self._in_world(lambda cameras: cameras.around_photo(photo_name))

    def in_scene(self, scene: SceneFile, photo_name: str) -> PathInWorld:
        """The views or keyframes in the world of a saved scene.

        A scene that was made of a photo has the photo's camera at its origin. Another program's
        scene, and one of several photos, has a world of its own, and cameras of other programs are
        taken to share it. The result is in the world of the scene's camera, if it has one.

        Args:
            scene: the scene.
            photo_name: what its photo was called.
        """
        if scene.camera is not None and is_at_origin(scene.camera):
            return self.around_photo(photo_name)
        camera_to_world = torch.eye(4, dtype=torch.float64)
        if scene.camera is not None:
            camera_to_world = torch.linalg.inv(scene.camera.world_to_camera.double())

        def from_shared_world(cameras: CameraSet) -> CameraSet:
            """Cameras in the scene's world, brought into the world of its camera; with a note.

            Cameras without an origin are in the world of a photo's camera already.
            """
            if cameras.origin is None:
                return cameras
            note = f"its world is taken as that of {scene.path.name}"
            moved = [
                dataclasses.replace(
                    camera, world_to_camera=camera.world_to_camera @ camera_to_world
                )
                for camera in cameras.cameras
            ]
            return dataclasses.replace(cameras, cameras=tuple(moved), notes=(*cameras.notes, note))

        return self._in_world(from_shared_world)

    def _in_world(self, change_world: Callable[[CameraSet], CameraSet]) -> PathInWorld:
        """The views or keyframes after a change of the cameras' world."""
        if self.cameras is not None:
            cameras = change_world(self.cameras)
            return PathInWorld(views=cameras.views(), notes=cameras.lines)
        if self.path_cameras is not None:
            cameras = change_world(self.path_cameras)
            with as_input_error(cameras.source, "{reason}", PathError):
                return PathInWorld(keyframes=cameras.path(), notes=cameras.lines)
        return PathInWorld(keyframes=self.keyframes)


class DisparityTrial(NamedTuple):
    """A size of the camera's movement, and the holes that it uncovers."""

    disparity: float
    hole_ratio: float  # mean share of the leftmost and rightmost view that the base leaves open


@torch.no_grad()
def choose_disparity(
    prediction: BasePrediction, renderer: Renderer, source: Path
) -> BasePrediction:
    """Choose how far the camera moves: as far as the photo allows without too many holes.

    The size of the movement is a "disparity": 0 is no movement, 0.3 a large one. A base predicts
    the same disparity for every photo, its usual one. If this disparity uncovers too many holes,
    a smaller one is chosen.

    The hole ratio of a disparity is the share of holes in its leftmost and rightmost view, on
    average (hole-area ratio, eq. 11 of the paper). It may be at most `prediction.max_hole_ratio`.
    The views are rendered coarsely, because only the shares count.

    Returns:
        The prediction with the chosen disparity. Its notes also say the usual disparity, and, as
        "uncovered", the hole ratio of the chosen one.

    Raises:
        InputError: the depths and the focal length of the photo `source` allow no camera path.
    """
    usual_disparity = prediction.max_disparity
    hole_limit = prediction.max_hole_ratio
    with as_input_error(source, NO_PATH_MESSAGE, ValueError):
        depth_range = prediction.depth_range
    coarse_camera = prediction.camera.resized(
        *working_size(prediction.camera.width, prediction.camera.height, COARSE_SIDE_PX)
    )

    def measure(disparity: float) -> DisparityTrial:
        """Render the two widest views of a disparity, and measure their holes."""
        widest_views = leftmost_and_rightmost(coarse_camera, disparity, depth_range)
        hole_ratios = [
            hole_area_ratio(renderer.render(prediction.gaussians, view).alpha)
            for view in widest_views
        ]
        return DisparityTrial(disparity, sum(hole_ratios) / len(hole_ratios))

    best = measure(usual_disparity)
    if best.hole_ratio > hole_limit:
        best = _largest_within(hole_limit, measure, too_far=best)
    # A movement without any parallax is worth nothing, so the least one may exceed the limit.
    if best.disparity < MIN_CHOSEN_DISPARITY:
        best = measure(min(MIN_CHOSEN_DISPARITY, usual_disparity))

    notes = dict(prediction.notes)
    notes["usual_disparity"] = usual_disparity
    notes["uncovered"] = round(best.hole_ratio, 4)
    return dataclasses.replace(prediction, max_disparity=best.disparity, notes=notes)


def _largest_within(
    hole_limit: float, measure: Callable[[float], DisparityTrial], too_far: DisparityTrial
) -> DisparityTrial:
    """Search for the largest disparity whose holes stay within the limit.

    The method is false position. Holes grow nearly linearly with the disparity. So take a disparity
    within the limit and one beyond it: the straight line between them predicts the disparity that
    reaches the limit. This one is measured, and replaces one of the two.

    Args:
        hole_limit: the largest allowed hole ratio.
        measure: measures the holes of a disparity.
        too_far: a disparity that uncovers more than the limit.

    Returns:
        The largest disparity within the limit after MAX_TRIALS measurements; 0 if none was within.
    """
    # Seen from the photo's own place, a base has no holes.
    within = DisparityTrial(disparity=0.0, hole_ratio=0.0)
    for _ in range(MAX_TRIALS):
        share = (hole_limit - within.hole_ratio) / (too_far.hole_ratio - within.hole_ratio)
        disparity_at_limit = within.disparity + share * (too_far.disparity - within.disparity)

        # Round down to whole steps. The 1e-6 keeps a step that a rounding error has made smaller:
        # 28.999999999 steps are 29.
        whole_steps = math.floor(disparity_at_limit / DISPARITY_STEP + 1e-6)
        disparity = round(DISPARITY_STEP * whole_steps, 4)  # 0.29, not 0.29000000000000004
        if disparity <= max(within.disparity, MIN_CHOSEN_DISPARITY):
            break

        trial = measure(disparity)
        if trial.hole_ratio <= hole_limit:
            within = trial
        else:
            too_far = trial
    return within


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannedViews:
    """A photo's views: all their cameras, and which of them are filled, reported or video frames.

    All other fields name views by their index in `cameras`.
    """

    cameras: list[Camera]
    frames: list[tuple[int, ...]]  # each video frame's view, or the two views of its eyes
    # The views whose holes are measured for the report, by their names in the report.
    reported_views: dict[str, int]
    # Not every frame of a long video, because neighbours in a path show the same holes.
    views_to_fill: list[int]
    # Some views show a frame with a margin around it, and are filled in the frame's place. For each
    # of them, the frame's view.
    frame_within: dict[int, int]
    # The first `shown_view_count` views of `cameras` are shown in the video, reported or given;
    # those after them are only filled.
    shown_view_count: int
    # The first `given_view_count` views of `cameras` were given by the user. They are also saved as
    # pictures.
    given_view_count: int
    frame_maker: FrameMaker  # makes a frame of the video from the renderings of its views


class Margin(NamedTuple):
    """Pixels that are added to a view at its four sides."""

    left: int
    top: int
    right: int
    bottom: int

    @staticmethod
    def to_show(view: Camera, other: Camera) -> Margin:
        """The margin with which a view shows all that another view from the same place shows."""
        other_corners = torch.tensor(
            [[0, 0], [other.width, 0], [0, other.height], [other.width, other.height]],
            dtype=torch.float64,
        )
        points = other.unproject(other_corners, torch.ones(4, dtype=torch.float64))
        corners, _ = view.project(points)  # [4, 2] where this view shows the other's corners
        size = corners.new_tensor([view.width, view.height])

        def whole_pixels(lengths: Tensor) -> list[int]:
            """Lengths rounded up; 0.01 pixels more than a whole number are a rounding error."""
            return (lengths - NEARLY_NO_PX).ceil().clamp_min(0).int().tolist()

        left, top = whole_pixels(-corners.amin(0))
        right, bottom = whole_pixels(corners.amax(0) - size)
        return Margin(left, top, right, bottom)

    def around(self, view: Camera) -> Camera:
        """The view with this margin."""
        return view.cropped(
            -self.left,
            -self.top,
            view.width + self.left + self.right,
            view.height + self.top + self.bottom,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _PathViews:
    """The cameras of a path: what its video shows, and what is filled or reported besides."""

    frame_cameras: list[Camera]  # of the video's frames; of a stereo video, midway between the eyes
    filled_frame_step: int = 1  # every first, second, … of these frames is filled
    # For each frame, by how much the view that is filled in its place is larger; empty: by nothing.
    filled_margins: list[Margin] = dataclasses.field(default_factory=list)
    reported_cameras: dict[str, Camera] = dataclasses.field(default_factory=dict)  # by name


def plan_views(
    prediction: BasePrediction,
    path: PathOptions,
    source: Path,
    renderer: Renderer,
    given_views: list[Camera] | None = None,
    keyframes: KeyframePath | None = None,
) -> PlannedViews:
    """Plan which views of a photo are filled, reported and shown in the video.

    They are the given views, or those of a camera path. The report measures the holes of all given
    views, of a trajectory's leftmost and rightmost view, or of a path's keyframes. What it measures
    is always filled.

    Args:
        prediction: the photo's Gaussians and camera.
        path: the options of path and video.
        source: the photo's file, for messages.
        renderer: renders coarse views, in which the photo's border is found.
        given_views: the views of `path.cameras`, which replace a path.
        keyframes: the keyframes of `path.path`, which replace the trajectory.

    Raises:
        InputError: the depths and the focal length of the photo allow no camera path.
    """
    if given_views:
        path_views = _PathViews(frame_cameras=given_views)
    else:
        # A ValueError comes from the photo's depths; a PathError from the file of keyframes, and
        # its own text ("{reason}") is the message.
        with (
            as_input_error(source, NO_PATH_MESSAGE, ValueError),
            as_input_error(path.path, "{reason}", PathError),
        ):
            if keyframes is None:
                path_views = _trajectory_views(prediction, path, renderer)
            else:
                path_views = _keyframe_views(prediction, path, keyframes)

    frame_maker = FrameMaker.of(
        path.video,
        prediction.gaussians,
        path_views.frame_cameras,
        source,
        is_metric=prediction.is_metric,
    )
    return _index_views(path_views, frame_maker, given_views or [])


def _trajectory_views(
    prediction: BasePrediction, path: PathOptions, renderer: Renderer
) -> _PathViews:
    """The views along a trajectory; the report measures its leftmost and rightmost view.

    ValueError if the scene allows no such path.
    """
    depth_range = prediction.depth_range
    usual_disparity = prediction.max_disparity
    framing = path.choose_framing(
        prediction.gaussians, prediction.camera, depth_range, usual_disparity, renderer
    )
    frame_cameras = path.video_cameras(
        depth_range,
        prediction.camera,
        keyframes=None,
        disparity=usual_disparity,
        framing=framing,
    )
    camera = prediction.camera.even()  # of even width and height, as videos need
    disparity = path.disparity_or(usual_disparity)
    leftmost, rightmost = leftmost_and_rightmost(camera, disparity, depth_range)

    # The framing of the video hides what lies beyond the photo's border. Other programs show the
    # scene without it: through the photo's own lens, and with the usual target. So frames are
    # filled with margins around them, with which they also show this.
    usual_cameras = path.video_cameras(
        depth_range,
        prediction.camera,
        keyframes=None,
        disparity=usual_disparity,
        framing=None,
    )
    filled_margins = [
        Margin.to_show(frame, usual)
        for frame, usual in zip(frame_cameras, usual_cameras, strict=True)
    ]

    return _PathViews(
        frame_cameras=frame_cameras,
        # Of a long path every second, third, … frame is filled, so that 60 to 119 frames are.
        filled_frame_step=max(1, len(frame_cameras) // DEFAULT_FRAME_COUNT),
        filled_margins=filled_margins,
        reported_cameras={f"-{disparity:g}": leftmost, f"+{disparity:g}": rightmost},
    )


def _keyframe_views(
    prediction: BasePrediction, path: PathOptions, keyframes: KeyframePath
) -> _PathViews:
    """The views of a path through keyframes; the report measures the views at the keyframes.

    If there are more than MAX_REPORTED_KEYFRAMES, it measures every second, third, … of them.
    PathError if the keyframes give no path; ValueError if the scene allows none.
    """
    frame_cameras = path.video_cameras(
        prediction.depth_range,
        prediction.camera,
        keyframes,
        prediction.max_disparity,
        framing=None,  # keyframes say themselves where the camera looks and how much it zooms
    )
    key_cameras = keyframes.at(
        [key.time for key in keyframes.keys],
        prediction.camera.even(),  # of even width and height, as videos need
        prediction.depth_range,
    )
    key_step = math.ceil(len(key_cameras) / MAX_REPORTED_KEYFRAMES)
    reported_keys = range(0, len(key_cameras), key_step)
    return _PathViews(
        frame_cameras=frame_cameras,
        reported_cameras={f"keyframe {key}": key_cameras[key] for key in reported_keys},
    )


def _index_views(
    path_views: _PathViews, frame_maker: FrameMaker, given_views: list[Camera]
) -> PlannedViews:
    """Put all views of a path into one list, and say by indices which view serves what.

    The order is: given views that are no frames, the frames' views, reported views, and views that
    are only filled.

    Args:
        path_views: the cameras of the video's frames, and those that are filled besides.
        frame_maker: knows whether a frame is one view or the two views of a stereo video's eyes.
        given_views: the views that the user gave, or an empty list.
    """
    cameras: list[Camera] = []

    # Without stereo, the given views are themselves the views of the frames. The frames of a stereo
    # video show what the left and the right eye see; the given view lies midway between them, and
    # is a view of its own, because it is saved as a picture.
    if frame_maker.stereo:
        cameras.extend(given_views)
    middle_view_count = len(cameras)

    frames: list[tuple[int, ...]] = []
    for frame_camera in path_views.frame_cameras:
        eyes = frame_maker.eyes(frame_camera)  # one camera, or two for stereo
        frames.append(tuple(range(len(cameras), len(cameras) + len(eyes))))
        cameras.extend(eyes)
    frame_view_end = len(cameras)  # index after the last frame's views

    reported_views = {
        name: len(cameras) + position for position, name in enumerate(path_views.reported_cameras)
    }
    cameras.extend(path_views.reported_cameras.values())
    shown_view_count = len(cameras)
    # Given views bring no cameras just for the report, because it measures all of them. They are
    # the first views of the list.
    if not reported_views:
        reported_views = {str(index): index for index in range(len(path_views.frame_cameras))}

    views_to_fill = list(range(middle_view_count))
    # A frame that is filled with a margin around it is filled as a larger view of its own.
    frame_within: dict[int, int] = {}
    for frame_index in range(0, len(frames), path_views.filled_frame_step):
        margin = Margin(0, 0, 0, 0)
        if path_views.filled_margins:
            margin = path_views.filled_margins[frame_index]
        for index in frames[frame_index]:
            if not any(margin):
                views_to_fill.append(index)
            else:
                views_to_fill.append(len(cameras))
                frame_within[len(cameras)] = index
                cameras.append(margin.around(cameras[index]))
    views_to_fill.extend(range(frame_view_end, shown_view_count))  # what the report measures

    return PlannedViews(
        cameras=cameras,
        frames=frames,
        reported_views=reported_views,
        views_to_fill=views_to_fill,
        frame_within=frame_within,
        shown_view_count=shown_view_count,
        given_view_count=len(given_views),
        frame_maker=frame_maker,
    )
