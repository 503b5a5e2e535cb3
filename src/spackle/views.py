"""Plan a photo's views: the camera path, the frames of its video, and the views to fill.

Read `PathOptions` first (what a user may ask for), then `choose_disparity` (how far the camera
goes) and `plan_views` (which views follow from both).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from spackle.bases import DEFAULT_MAX_DISPARITY, BasePrediction
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.keyframes import KeyframePath, PathError
from spackle.core.photo import working_size
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    MAX_DISPARITY,
    TRAJECTORIES,
    DepthRange,
    TrajectoryKind,
    leftmost_and_rightmost,
    trajectory_cameras,
)
from spackle.formats.camera_files import load_cameras, load_path
from spackle.render.protocol import Renderer
from spackle.residual.features import hole_area_ratio
from spackle.runtime.errors import InputError, as_input_error, check_name
from spackle.video.frames import FrameMaker
from spackle.video.options import VideoOptions

DEFAULT_FRAME_COUNT = 60  # cameras of `Scene.path`; of a longer path, 60 to 119 frames are filled
MAX_FRAME_COUNT = 10_000
DEFAULT_VIDEO_SECONDS = 4.0  # duration of a video along a trajectory
MAX_OVERSCAN = 0.5
MAX_MEASURED_KEYFRAMES = 16  # the report measures the holes of at most so many keyframes

COARSE_SIDE_PX = 240  # long side of the renderings in which `choose_disparity` measures holes
DISPARITY_STEP = 0.01  # `choose_disparity` rounds the disparity down to a multiple of this step
MIN_CHOSEN_DISPARITY = 0.04  # a smaller movement shows no parallax
MAX_TRIALS = 3  # disparities that `choose_disparity` tries besides the base's usual one

NO_PATH_MESSAGE = "no camera path: {reason}: check the depth map and the focal length"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathOptions:
    """Options of the camera path, and of the video along it."""

    trajectory: TrajectoryKind = "rotate-forward"
    disparity: float | None = None  # size of the camera's movement; None: chosen for the photo
    cameras: Path | None = None  # a file of views that replace the trajectory
    path: Path | None = None  # a file of keyframes that replace the trajectory
    frames: int | None = None  # number of video frames; None: `seconds` times the frame rate
    seconds: float | None = None  # duration of the video; None: 4, or the keyframes' duration
    video: VideoOptions = dataclasses.field(default_factory=VideoOptions)
    overscan: float = DEFAULT_OVERSCAN  # relative gain in focal length along a trajectory

    def check(self) -> None:
        """Raise an InputError for an impossible path or video, or for options that contradict."""
        check_name("trajectory", self.trajectory.replace("_", "-"), TRAJECTORIES)
        if self.disparity is not None:
            is_possible = math.isfinite(self.disparity) and 0 <= self.disparity <= MAX_DISPARITY
            if not is_possible:
                raise InputError(
                    f"`disparity` must be between 0 and {MAX_DISPARITY:g}, got {self.disparity:g}"
                )
        self._check_length()
        self._check_files()
        if not 0 <= self.overscan <= MAX_OVERSCAN:
            raise InputError(
                f"`overscan` must be between 0 and {MAX_OVERSCAN:g}, got {self.overscan:g}"
            )
        self.video.check()

    def _check_length(self) -> None:
        """Raise an InputError if the video would have no frame or too many, or two lengths."""
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
        """Raise an InputError if a file of views is given together with what it already sets."""
        if self.cameras is None:
            return
        if self.path is not None:
            raise InputError(
                f"`path` {self.path}: `cameras` gives the views already: leave one of them out"
            )
        if self.video.size is not None:
            raise InputError(
                f"`size`: the views of `cameras` {self.cameras} have sizes already: "
                "leave `size` out"
            )

    def load(self) -> tuple[list[Camera] | None, KeyframePath | None]:
        """Read the files of the options: the views of `cameras`, and the keyframes of `path`.

        Each is None if the option is not given. InputError for a file that cannot be used.
        """
        given_views = None if self.cameras is None else load_cameras(self.cameras)
        keyframes = None if self.path is None else load_path(self.path)
        return given_views, keyframes

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

    def video_cameras(
        self,
        gaussians: Gaussians,
        camera: Camera,
        keyframes: KeyframePath | None,
        disparity: float | None,
    ) -> list[Camera]:
        """The cameras of the video's frames, through keyframes or along the trajectory.

        Sides of odd size grow by one pixel, because video needs even sides.

        Args:
            gaussians: the scene, whose depths determine the length of a trajectory.
            camera: the photo's camera.
            keyframes: the keyframes of `path`; None: follow the trajectory.
            disparity: used if the options give no disparity; None: the usual one.

        Raises:
            PathError: the keyframes give no usable path.
            ValueError: the scene allows no such path.
        """
        if keyframes is not None:
            return self._keyframe_cameras(gaussians, camera, keyframes)

        frame_count = self.requested_frame_count()
        if frame_count is None:
            frame_count = max(1, round(DEFAULT_VIDEO_SECONDS * self.video.frames_per_second))
        default_disparity = DEFAULT_MAX_DISPARITY if disparity is None else disparity
        cameras = trajectory_cameras(
            self.trajectory,
            camera.even(),
            self.disparity_or(default_disparity),
            DepthRange.of(gaussians),
            frame_count,
            looped=True,  # most players repeat a video
        )
        # A little zoom hides most of what the fill has made up beyond the photo's border.
        return [view.zoomed(1 + self.overscan) for view in cameras]

    def _keyframe_cameras(
        self, gaussians: Gaussians, camera: Camera, keyframes: KeyframePath
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
        return keyframes.cameras(camera.even(), frame_count, DepthRange.of(gaussians))


class DisparityTrial(NamedTuple):
    """A size of the camera's movement, and the holes that it uncovers."""

    disparity: float
    hole_ratio: float  # mean share of the leftmost and rightmost view that the base leaves open


@torch.no_grad()
def choose_disparity(
    prediction: BasePrediction, renderer: Renderer, source: Path
) -> BasePrediction:
    """Choose how far the camera moves: as far as the photo allows without too many holes.

    The size of the movement is a "disparity": 0 stays, 0.3 is large. It replaces the prediction's
    disparity, which is the base's usual one, whatever the photo shows.

    The limit of the holes is `prediction.max_hole_ratio`. They are measured as the mean share of
    the leftmost and rightmost view (hole-area ratio, eq. 11 of the paper), in coarse renderings.
    This ratio and the usual disparity are added to the prediction's notes.

    Raises:
        InputError: the depths and the focal length of the photo `source` allow no camera path.
    """
    usual_disparity = prediction.max_disparity
    hole_limit = prediction.max_hole_ratio
    with as_input_error(source, NO_PATH_MESSAGE, ValueError):
        depth_range = DepthRange.of(prediction.gaussians)
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
    if best.disparity < MIN_CHOSEN_DISPARITY:
        best = measure(min(MIN_CHOSEN_DISPARITY, usual_disparity))

    notes = dict(prediction.notes)
    notes["usual_disparity"] = usual_disparity
    notes["uncovered"] = round(best.hole_ratio, 4)
    return dataclasses.replace(prediction, max_disparity=best.disparity, notes=notes)


def _largest_within(
    hole_limit: float, measure: Callable[[float], DisparityTrial], too_far: DisparityTrial
) -> DisparityTrial:
    """The largest disparity found whose holes stay within the limit; disparity 0 if none is found.

    A few steps of false position: holes grow nearly linearly with the disparity, so the straight
    line between a disparity within the limit and one beyond predicts where the limit is reached.

    Args:
        hole_limit: the largest allowed hole ratio.
        measure: measures the holes of a disparity.
        too_far: a disparity that uncovers more than the limit.
    """
    within = DisparityTrial(0.0, 0.0)
    for _ in range(MAX_TRIALS):
        share = (hole_limit - within.hole_ratio) / (too_far.hole_ratio - within.hole_ratio)
        disparity_at_limit = within.disparity + share * (too_far.disparity - within.disparity)

        # Round down, but not a multiple that is itself a rounding error above the limit.
        whole_steps = math.floor(disparity_at_limit / DISPARITY_STEP + 1e-6)
        disparity = round(DISPARITY_STEP * whole_steps, 4)
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
    measured: dict[str, int]  # the views whose holes are reported, by their names in the report
    views_to_fill: list[int]  # further frames of a path would uncover nothing more
    always_filled: frozenset[int]  # those that are filled even if views near them are filled
    still_count: int  # so many of the first views are also saved as pictures
    frame_maker: FrameMaker  # makes a frame of the video from the renderings of its views


@dataclasses.dataclass(frozen=True, kw_only=True)
class _PathViews:
    """The cameras of a path: what its video shows, and what is filled or reported besides."""

    frame_cameras: list[Camera]  # of the video's frames; of a stereo video, midway between the eyes
    filled_frame_step: int = 1  # every first, second, … of these frames is filled
    measured_cameras: dict[str, Camera] = dataclasses.field(default_factory=dict)  # by name
    cameras_without_overscan: Sequence[Camera] = ()  # filled besides the frames


def plan_views(
    prediction: BasePrediction,
    path: PathOptions,
    source: Path,
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
        given_views: the views of `path.cameras`, which replace a path.
        keyframes: the keyframes of `path.path`, which replace the trajectory.

    Raises:
        InputError: the depths and the focal length of the photo allow no camera path.
    """
    if given_views:
        path_views = _PathViews(frame_cameras=given_views)
    else:
        with (
            as_input_error(source, NO_PATH_MESSAGE, ValueError),
            as_input_error(path.path, "{reason}", PathError),
        ):
            if keyframes is None:
                path_views = _trajectory_views(prediction, path)
            else:
                path_views = _keyframe_views(prediction, path, keyframes)

    frame_maker = FrameMaker.of(path.video, prediction.gaussians, path_views.frame_cameras, source)
    return _index_views(path_views, frame_maker, given_views or [])


def _trajectory_views(prediction: BasePrediction, path: PathOptions) -> _PathViews:
    """The views along a trajectory; its leftmost and rightmost view are measured.

    ValueError if the scene allows no such path.
    """
    frame_cameras = path.video_cameras(
        prediction.gaussians, prediction.camera, None, prediction.max_disparity
    )
    camera = prediction.camera.even()
    disparity = path.disparity_or(prediction.max_disparity)
    depth_range = DepthRange.of(prediction.gaussians)
    leftmost, rightmost = leftmost_and_rightmost(camera, disparity, depth_range)

    # Other programs show the scene without overscan, that is, with the photo's own focal length,
    # and then show more beyond the photo's border. Left and right are measured, and therefore
    # filled anyway; these trajectories also go up and down.
    without_overscan: Sequence[Camera] = ()
    if path.trajectory in ("shake", "rotate", "vertical"):
        circle = trajectory_cameras("rotate", camera, disparity, depth_range, frames=5)
        # The five views are below, right, above, left and below again.
        without_overscan = [circle[0], circle[2]]

    return _PathViews(
        frame_cameras=frame_cameras,
        filled_frame_step=max(1, len(frame_cameras) // DEFAULT_FRAME_COUNT),
        measured_cameras={f"-{disparity:g}": leftmost, f"+{disparity:g}": rightmost},
        cameras_without_overscan=without_overscan,
    )


def _keyframe_views(
    prediction: BasePrediction, path: PathOptions, keyframes: KeyframePath
) -> _PathViews:
    """The views of a path through keyframes; the keyframes, or some of many, are measured.

    PathError if the keyframes give no path; ValueError if the scene allows none.
    """
    frame_cameras = path.video_cameras(
        prediction.gaussians, prediction.camera, keyframes, prediction.max_disparity
    )
    key_cameras = keyframes.at(
        [key.time for key in keyframes.keys],
        prediction.camera.even(),
        DepthRange.of(prediction.gaussians),
    )
    key_step = math.ceil(len(key_cameras) / MAX_MEASURED_KEYFRAMES)
    measured_keys = range(0, len(key_cameras), key_step)
    return _PathViews(
        frame_cameras=frame_cameras,
        measured_cameras={f"keyframe {key}": key_cameras[key] for key in measured_keys},
    )


def _index_views(
    path_views: _PathViews, frame_maker: FrameMaker, given_views: list[Camera]
) -> PlannedViews:
    """Put all views of a path into one list, and name each view's purpose by its index.

    Args:
        path_views: the cameras of the video's frames, and those that are filled besides.
        frame_maker: knows whether a frame is one view or the two views of a stereo video's eyes.
        given_views: the views that the user gave, or an empty list.
    """
    cameras: list[Camera] = []

    # The pictures of given views are taken midway between the eyes of a stereo video.
    if frame_maker.stereo:
        cameras.extend(given_views)
    middle_count = len(cameras)

    frames: list[tuple[int, ...]] = []
    for frame_camera in path_views.frame_cameras:
        eyes = frame_maker.eyes(frame_camera)
        frames.append(tuple(range(len(cameras), len(cameras) + len(eyes))))
        cameras.extend(eyes)
    frame_end = len(cameras)

    cameras.extend(path_views.cameras_without_overscan)
    measured = {
        name: len(cameras) + position for position, name in enumerate(path_views.measured_cameras)
    }
    cameras.extend(path_views.measured_cameras.values())
    if not measured:  # given views, which come first in the list
        measured = {str(index): index for index in range(len(path_views.frame_cameras))}

    views_to_fill = list(range(middle_count))
    for frame in frames[:: path_views.filled_frame_step]:
        views_to_fill.extend(frame)
    views_to_fill.extend(range(frame_end, len(cameras)))

    return PlannedViews(
        cameras=cameras,
        frames=frames,
        measured=measured,
        views_to_fill=views_to_fill,
        # A frame from the same place hides, by its overscan, what these views show at their border.
        always_filled=frozenset(range(frame_end, len(cameras))),
        still_count=len(given_views),
        frame_maker=frame_maker,
    )
