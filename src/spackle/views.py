"""Plan the views of a scene: the camera path, the frames of a video, and the views whose holes are filled."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import torch

from spackle.bases import DEFAULT_MAX_DISPARITY, BasePrediction
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import working_size
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    MAX_DISPARITY,
    TRAJECTORIES,
    DepthRange,
    KeyframePath,
    PathError,
    TrajectoryKind,
    leftmost_and_rightmost,
    trajectory_cameras,
)
from spackle.formats.camera_files import load_cameras, load_path
from spackle.render.protocol import Renderer
from spackle.residual.features import hole_area_ratio
from spackle.runtime.errors import InputError, as_input_error, check_name
from spackle.video.frames import FrameMaker, VideoOptions

PATH_FRAMES, MAX_FRAMES = 60, 10_000  # default and largest number of frames
SECONDS = 4.0  # default duration of a video along a trajectory
MAX_OVERSCAN = 0.5
MEASURED_KEYFRAMES = 16  # largest number of keyframes whose holes are reported


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathOptions:
    """Options of the camera path, and of the video along it."""

    trajectory: TrajectoryKind = "rotate-forward"
    disparity: float | None = None  # None: the base's
    cameras: Path | None = None  # a file of views that replace the trajectory
    path: Path | None = None  # a file of keyframes that replace the trajectory
    frames: int | None = None  # None: seconds times the frame rate
    seconds: float | None = None  # duration of the video; None: 4, or the keyframes'
    video: VideoOptions = dataclasses.field(default_factory=VideoOptions)
    overscan: float = DEFAULT_OVERSCAN  # relative gain in focal length along a trajectory

    def check(self) -> None:
        """Raise an InputError for an impossible path or video, or for options that contradict each other."""
        check_name("trajectory", self.trajectory.replace("_", "-"), TRAJECTORIES)
        if self.disparity is not None and not (
            math.isfinite(self.disparity) and 0 <= self.disparity <= MAX_DISPARITY
        ):
            raise InputError(
                f"--disparity must be between 0 and {MAX_DISPARITY:g}, got {self.disparity:g}"
            )
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise InputError(f"--frames must be between 1 and {MAX_FRAMES}, got {self.frames}")
        if self.seconds is not None:
            if self.frames is not None:
                raise InputError(
                    f"--seconds {self.seconds:g}: --frames {self.frames} sets the length: leave one out"
                )
            if not 1 <= self.seconds * self.video.frames_per_second <= MAX_FRAMES:
                raise InputError(
                    f"--seconds must give 1 to {MAX_FRAMES} frames, got {self.seconds:g}"
                )
        if self.cameras is not None and self.path is not None:
            raise InputError(
                f"--path {self.path}: --cameras gives the views already: leave one of them out"
            )
        if self.cameras is not None and self.video.size is not None:
            raise InputError(
                f"--size: the views of --cameras {self.cameras} have sizes already: leave --size out"
            )
        if not 0 <= self.overscan <= MAX_OVERSCAN:
            raise InputError(
                f"--overscan must be between 0 and {MAX_OVERSCAN:g}, got {self.overscan:g}"
            )
        self.video.check()

    def load(self) -> tuple[list[Camera] | None, KeyframePath | None]:
        """The views of --cameras and the keyframes of --path; InputError for a file that cannot be used."""
        views = None if self.cameras is None else load_cameras(self.cameras)
        return views, None if self.path is None else load_path(self.path)

    def disparity_or(self, default: float) -> float:
        """The path's disparity: that of the options, or the default."""
        return default if self.disparity is None else self.disparity

    def video_cameras(
        self,
        gaussians: Gaussians,
        camera: Camera,
        keyframes: KeyframePath | None,
        disparity: float | None,
    ) -> list[Camera]:
        """The cameras of a video through keyframes or along the trajectory; sides of odd size grow by a pixel.

        Args:
            gaussians: the scene, whose depths determine the path's length.
            camera: the photo's camera.
            keyframes: the keyframes of --path.
            disparity: used if the options give no disparity; None: the usual one.

        Raises:
            PathError: the keyframes give no usable path.
            ValueError: the scene allows no such path.
        """
        given = self.frames or (self.seconds and round(self.seconds * self.video.frames_per_second))
        if keyframes is None:
            count = given or max(1, round(SECONDS * self.video.frames_per_second))
            reach, depths = (
                self.disparity_or(DEFAULT_MAX_DISPARITY if disparity is None else disparity),
                DepthRange.of(gaussians),
            )
            path = trajectory_cameras(
                self.trajectory, camera.even(), reach, depths, count, looped=True
            )
            return [view.zoomed(1 + self.overscan) for view in path]
        count = given or keyframes.frame_count(self.video.frames_per_second)
        if count > MAX_FRAMES:
            raise PathError(
                f"{keyframes.seconds:g} s take {count} frames (at most {MAX_FRAMES}): give --frames"
            )
        return keyframes.cameras(camera.even(), count, DepthRange.of(gaussians))


@dataclasses.dataclass(frozen=True)
class PlannedViews:
    """The views whose holes are filled, and the video frames that consist of these views."""

    cameras: list[Camera]
    measured: dict[str, int]  # name → index: views whose holes are reported
    frames: list[
        tuple[int, ...]
    ]  # for each frame of the video the index of its view, or of its two eyes' views
    stills: int  # the number of views at the beginning that are also saved as pictures
    frame_maker: FrameMaker
    views_to_fill: list[
        int
    ]  # views for which a scene is completed; more frames of the same path uncover nothing more


COARSE_PX = 240  # long side of the renderings in which `choose_disparity` measures holes
MOVE_STEP = 0.01  # `choose_disparity` rounds the disparity down to a multiple of this step
LEAST_MOVE = 0.04  # the smallest disparity; a smaller one shows no parallax
LOOKS = 3  # largest number of disparities that `choose_disparity` tries besides the usual one


NO_PATH = "no camera path: {reason}: check the depth map and the focal length"


@torch.no_grad()
def choose_disparity(
    prediction: BasePrediction, renderer: Renderer, source: Path
) -> BasePrediction:
    """Replace the prediction's disparity by the largest one with a hole-area ratio of at most `prediction.max_hole_ratio`.

    The usual disparity is the upper limit. Coarse renderings measure the mean hole-area ratio (eq. 11) of the
    leftmost and the rightmost view. The ratio and the usual disparity are added to the notes.

    Raises:
        InputError: the depths and the focal length of the photo `source` allow no camera path.
    """
    gaussians, usual, allowed = (
        prediction.gaussians,
        prediction.max_disparity,
        prediction.max_hole_ratio,
    )
    with as_input_error(source, NO_PATH, ValueError):
        depths = DepthRange.of(gaussians)
    camera = prediction.camera.resized(
        *working_size(prediction.camera.width, prediction.camera.height, COARSE_PX)
    )

    def uncovered(disparity: float) -> float:
        ends = leftmost_and_rightmost(camera, disparity, depths)
        return sum(hole_area_ratio(renderer.render(gaussians, end).alpha) for end in ends) / len(
            ends
        )

    near, far = (
        (0.0, 0.0),
        (usual, uncovered(usual)),
    )  # (disparity, holes): within the limit, and beyond
    if far[1] <= allowed:
        near = far
    for _ in range(LOOKS if near[0] < usual else 0):
        between = near[0] + (allowed - near[1]) / (far[1] - near[1]) * (far[0] - near[0])
        disparity = round(MOVE_STEP * math.floor(between / MOVE_STEP + 1e-6), 4)
        if disparity <= max(near[0], LEAST_MOVE):
            break
        found = (disparity, uncovered(disparity))
        near, far = (found, far) if found[1] <= allowed else (near, found)
    if near[0] < LEAST_MOVE:
        near = (least := min(LEAST_MOVE, usual), uncovered(least))
    notes = prediction.notes | {"usual_disparity": usual, "uncovered": round(near[1], 4)}
    return dataclasses.replace(prediction, max_disparity=near[0], notes=notes)


def plan_views(
    prediction: BasePrediction,
    path: PathOptions,
    source: Path,
    given: list[Camera] | None = None,
    keyframes: KeyframePath | None = None,
) -> PlannedViews:
    """Plan the given views, or a path's; a path's holes are measured at its two extremes or at its keyframes.

    Raises:
        InputError: the depths and the focal length of the photo `source` allow no camera path.
    """
    gaussians, camera, even = prediction.gaussians, prediction.camera, prediction.camera.even()
    path_cameras, others, unseen, every = given or [], dict[str, Camera](), list[Camera](), 1
    if not given:
        with (
            as_input_error(source, NO_PATH, ValueError),
            as_input_error(path.path, "{reason}", PathError),
        ):
            path_cameras = path.video_cameras(
                gaussians, camera, keyframes, prediction.max_disparity
            )
            reach, depths = path.disparity_or(prediction.max_disparity), DepthRange.of(gaussians)
            if keyframes is None:
                others = dict(
                    zip(
                        (f"{-reach:g}", f"+{reach:g}"),
                        leftmost_and_rightmost(even, reach, depths),
                        strict=True,
                    )
                )
            else:
                keys = keyframes.at([key.time for key in keyframes.keys], even, depths)
                step = math.ceil(len(keys) / MEASURED_KEYFRAMES)
                others = {f"keyframe {k}": keys[k] for k in range(0, len(keys), step)}
            # Other programs render without overscan, so views with the photo's focal length are filled too.
            if keyframes is None and path.trajectory in ("shake", "rotate", "vertical"):
                unseen = trajectory_cameras("rotate", even, reach, depths, frames=5)[:4:2]
        every = 1 if keyframes else max(1, len(path_cameras) // PATH_FRAMES)
    maker = FrameMaker.of(path.video, gaussians, path_cameras, source)
    middles = given if given and maker.stereo else []  # pictures are taken midway between the eyes
    eyes = [maker.eyes(view) for view in path_cameras]
    first, each = len(middles), len(eyes[0])
    cameras = [*middles, *itertools.chain(*eyes), *unseen, *others.values()]
    frames = [tuple(range(k, k + each)) for k in range(first, first + each * len(eyes), each)]
    last = len(cameras) - len(others)
    measured = {name: last + k for k, name in enumerate(others)} or {
        str(k): k for k in range(len(eyes))
    }
    views_to_fill = [
        *range(first),
        *itertools.chain(*frames[::every]),
        *range(first + each * len(eyes), len(cameras)),
    ]
    return PlannedViews(cameras, measured, frames, len(given or []), maker, views_to_fill)
