"""The views of a scene: the camera path, the video along it, the views whose holes are filled."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from spackle.bases import USUAL_DISPARITY, BasePrediction
from spackle.camera import Camera
from spackle.camera_path import (
    MAX_DISPARITY,
    OVERSCAN,
    DepthRange,
    KeyframePath,
    PathError,
    TrajectoryKind,
    extremes,
    trajectory,
    trajectory_kind,
)
from spackle.errors import InputError
from spackle.formats.camera_files import load_cameras, load_path
from spackle.gaussians import Gaussians
from spackle.image import working_size
from spackle.render.protocol import Renderer
from spackle.residual.view_features import hole_area_ratio
from spackle.video_frames import FrameMaker, VideoOptions

PATH_FRAMES, MAX_FRAMES = 60, 10_000  # of a path: the default, and the most
SECONDS = 4.0  # of a video along a trajectory
MAX_OVERSCAN = 0.5
MEASURED_KEYFRAMES = 16  # keyframes at most whose holes are reported


def scene_path(
    base: Gaussians,
    camera: Camera,
    kind: TrajectoryKind,
    disparity: float,
    frames: int = PATH_FRAMES,
    looped: bool = False,
) -> list[Camera]:
    """The cameras of a path around the photo's camera, of the photo's size with both sides made even.

    A path that is `looped`, as for videos, continues from its last camera to the first, see `trajectory`.
    """
    return trajectory(kind, camera.even(), disparity, DepthRange.of(base), frames, looped)


@dataclasses.dataclass(frozen=True)
class PathOptions:
    """Options of the camera path, and of the video along it."""

    trajectory: TrajectoryKind = "rotate-forward"
    disparity: float | None = None  # None: as the base has it
    cameras: Path | None = None  # exactly these views in place of a trajectory
    path: Path | None = None  # keyframes in place of a trajectory
    frames: int | None = None  # None: as many as the seconds take
    seconds: float | None = None  # of the video; None: 4, or the keyframes' own
    video: VideoOptions = dataclasses.field(default_factory=VideoOptions)
    overscan: float = OVERSCAN  # share by which a trajectory's focal length exceeds the photo's

    def check(self) -> None:
        """InputError for an impossible path or video, or views that are given twice."""
        try:
            trajectory_kind(self.trajectory)
        except ValueError as error:
            raise InputError(f"--trajectory: {error}") from error
        if self.disparity is not None and not (math.isfinite(self.disparity) and 0 <= self.disparity <= MAX_DISPARITY):
            raise InputError(f"--disparity must be between 0 and {MAX_DISPARITY:g}, got {self.disparity:g}")
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise InputError(f"--frames must be between 1 and {MAX_FRAMES}, got {self.frames}")
        if self.seconds is not None:
            if self.frames is not None:
                raise InputError(
                    f"--seconds {self.seconds:g}: --frames {self.frames} sets the length already: leave one out"
                )
            if not 1 <= self.seconds * self.video.rate <= MAX_FRAMES:
                raise InputError(f"--seconds must give 1 to {MAX_FRAMES} frames, got {self.seconds:g}")
        if self.cameras is not None and self.path is not None:
            raise InputError(f"--path {self.path}: --cameras gives the views already: leave one of them out")
        if self.cameras is not None and self.video.size is not None:
            raise InputError(f"--size: the views of --cameras {self.cameras} have a size of their own: leave it out")
        if not 0 <= self.overscan <= MAX_OVERSCAN:
            raise InputError(f"--overscan must be between 0 and {MAX_OVERSCAN:g}, got {self.overscan:g}")
        self.video.check()

    def load(self) -> tuple[list[Camera] | None, KeyframePath | None]:
        """The views of --cameras and the keyframes of --path; InputError for a file that cannot be used."""
        views = None if self.cameras is None else load_cameras(self.cameras)
        return views, None if self.path is None else load_path(self.path)

    def reach(self, default: float) -> float:
        """The disparity of the path: the one that is given, or the default."""
        return default if self.disparity is None else self.disparity

    def fly(
        self, gaussians: Gaussians, camera: Camera, keyframes: KeyframePath | None, disparity: float = USUAL_DISPARITY
    ) -> list[Camera]:
        """The cameras of a video: through keyframes or along the trajectory, at the photo's size made even.

        Args:
            gaussians: the scene, whose depths set how far the path goes.
            camera: the photo's.
            keyframes: those of --path.
            disparity: used if the options have none.

        Raises:
            PathError: the keyframes give no usable path.
            ValueError: this scene allows no such path.
        """
        given = self.frames or (self.seconds and round(self.seconds * self.video.rate))
        if keyframes is None:
            count = given or max(1, round(SECONDS * self.video.rate))
            path = scene_path(gaussians, camera, self.trajectory, self.reach(disparity), count, looped=True)
            return [view.zoomed(1 + self.overscan) for view in path]
        count = given or keyframes.frame_count(self.video.rate)
        if count > MAX_FRAMES:
            raise PathError(f"{keyframes.seconds:g} s take {count} frames (at most {MAX_FRAMES}): give --frames")
        return keyframes.cameras(camera.even(), count, DepthRange.of(gaussians))


@dataclasses.dataclass(frozen=True)
class PlannedViews:
    """The views whose holes are filled, and the video frames that they make up."""

    cameras: list[Camera]
    measured: dict[str, int]  # name → index: views whose holes are reported
    frames: list[tuple[int, ...]]  # of the video: each a view, or the left eye's and the right eye's
    stills: int  # this many views, the first ones, are also saved as pictures
    maker: FrameMaker
    looked_at: list[int]  # views that a scene is completed for: more frames of the same path uncover nothing more

    @staticmethod
    def of(
        path: list[Camera],
        others: dict[str, Camera],
        maker: FrameMaker,
        stills: bool,
        unseen: Sequence[Camera] = (),
        every: int = 1,
    ) -> PlannedViews:
        """Plan a path's frames, for one eye or two, with `unseen` further views to fill, and `others` to measure.

        A scene is completed for one frame in `every`.
        """
        middles = path if stills and maker.stereo else []  # pictures are taken midway between the eyes
        eyes = [maker.eyes(camera) for camera in path]
        cameras = [*middles, *(eye for pair in eyes for eye in pair), *unseen, *others.values()]
        first, each = len(middles), len(eyes[0])
        frames = [tuple(range(first + k * each, first + (k + 1) * each)) for k in range(len(path))]
        last = len(cameras) - len(others)
        measured = {name: last + k for k, name in enumerate(others)} or {str(k): k for k in range(len(path))}
        others_at = range(first + len(path) * each, len(cameras))
        looked_at = [*range(first), *itertools.chain(*frames[::every]), *others_at]
        return PlannedViews(cameras, measured, frames, len(path) if stills else 0, maker, looked_at)


COARSE_PX = 240  # long side of the pictures that show what a move uncovers
MOVE_STEP = 0.01  # step of the disparities that are chosen among
LEAST_MOVE = 0.04  # the smallest disparity; less shows no parallax
LOOKS = 3  # disparities tried, at most, between 0 and the base's usual one


@contextlib.contextmanager
def _possible_path(source: Path) -> Iterator[None]:
    """InputError, naming the photo, if its depths and focal length allow no camera path."""
    try:
        yield
    except PathError:
        raise
    except ValueError as error:
        raise InputError(f"{source}: no camera path: {error}: check the depth map and the focal length") from error


@torch.no_grad()
def choose_move(prediction: BasePrediction, renderer: Renderer, source: Path) -> BasePrediction:
    """The prediction with the farthest disparity, up to its usual one, at which holes in the widest views stay within
    its limit.

    Its notes get the base's usual disparity and the share of holes in the two widest views (eqs. 10, 11), measured in
    coarse renderings. InputError, naming `source`, the photo, if its depths and focal length allow no path.
    """
    gaussians, usual, allowed = prediction.gaussians, prediction.disparity, prediction.uncovered
    with _possible_path(source):
        depths = DepthRange.of(gaussians)
    camera = prediction.camera.resized(*working_size(prediction.camera.width, prediction.camera.height, COARSE_PX))

    def uncovered(disparity: float) -> float:
        ends = extremes(camera, disparity, depths)
        return sum(hole_area_ratio(renderer.render(gaussians, end).alpha) for end in ends) / len(ends)

    near, far = (0.0, 0.0), (usual, uncovered(usual))  # (disparity, holes): allowed, and too many
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
    return dataclasses.replace(prediction, disparity=near[0], notes=notes)


def plan_views(
    prediction: BasePrediction,
    path: PathOptions,
    source: Path,
    given: list[Camera] | None = None,
    keyframes: KeyframePath | None = None,
) -> PlannedViews:
    """Plan the given views, or else a path, whose holes are measured at its two extremes or at its keyframes.

    InputError, naming `source`, the photo, if its depths and focal length allow no such path.
    """
    gaussians, camera = prediction.gaussians, prediction.camera
    if given:
        return PlannedViews.of(given, {}, FrameMaker.of(path.video, gaussians, given, source), stills=True)
    try:
        with _possible_path(source):
            cameras = path.fly(gaussians, camera, keyframes, prediction.disparity)
            reach, depths = path.reach(prediction.disparity), DepthRange.of(gaussians)
            others = _measured(reach, camera.even(), depths, keyframes)
            # What the longer lens leaves out is filled too, because other programs render with the photo's lens.
            upright = keyframes is None and path.trajectory in ("shake", "rotate", "vertical")
            unseen = trajectory("rotate", camera.even(), reach, depths, frames=5)[:4:2] if upright else []
    except PathError as error:
        raise InputError(f"{path.path}: {error}") from error
    maker = FrameMaker.of(path.video, gaussians, cameras, source)
    every = 1 if keyframes else max(1, len(cameras) // PATH_FRAMES)
    return PlannedViews.of(cameras, others, maker, stills=False, unseen=unseen, every=every)


def _measured(
    disparity: float, camera: Camera, depths: DepthRange, keyframes: KeyframePath | None
) -> dict[str, Camera]:
    """The views whose holes are reported, by their names."""
    if keyframes is None:
        return dict(zip((f"{-disparity:g}", f"+{disparity:g}"), extremes(camera, disparity, depths), strict=True))
    keys = keyframes.key_cameras(camera, depths)
    step = math.ceil(len(keys) / MEASURED_KEYFRAMES)
    return {f"keyframe {index}": keys[index] for index in range(0, len(keys), step)}
