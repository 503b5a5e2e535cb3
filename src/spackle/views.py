"""The views of a scene: the camera path that is asked for, the video along it, the views whose holes are filled."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, cast

import torch
from torch import Tensor

from spackle.bases import USUAL_DISPARITY, BasePrediction
from spackle.camera import Camera
from spackle.camera_path import (
    MAX_DISPARITY,
    DepthRange,
    KeyframePath,
    PathError,
    TrajectoryKind,
    extremes,
    trajectory,
)
from spackle.color import DepthColors
from spackle.errors import InputError
from spackle.formats.camera_files import load_cameras, load_path
from spackle.formats.video import FORMATS, check_video
from spackle.gaussians import Gaussians
from spackle.image import working_size
from spackle.render.protocol import Renderer, Rendering
from spackle.residual.view_features import hole_area_ratio
from spackle.stereo import Stereo, StereoLayout, default_ipd

VideoFormat = Literal["mp4", "webm", "gif", "webp"]
Show = Literal["color", "depth"]
MAX_VIDEO_SIDE = 8192
PATH_FRAMES, MAX_FRAMES = 60, 10_000  # of a path: as usual, and at most
MEASURED_KEYFRAMES = 16  # keyframes at most whose holes are reported
MAX_IPD = 1e6
DEFAULT_FPS = 30
COVERED = 0.5  # less opaque pixels have no depth that a person would call one


def scene_path(
    base: Gaussians,
    camera: Camera,
    kind: TrajectoryKind,
    disparity: float,
    frames: int = PATH_FRAMES,
    looped: bool = False,
) -> list[Camera]:
    """Cameras around the photo's eye at the photo's size, both sides made even.

    Every path but `swipe` ends where it began. `looped` leaves out that last camera: a video that starts again would
    show the view twice in a row.
    """
    once = looped and kind != "swipe"
    path = trajectory(kind, camera.even(), disparity, DepthRange.of(base), frames + once)
    return path[:frames]


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """The choices that every video has."""

    format: VideoFormat | None = None  # mp4 where None
    fps: float | None = None  # 30 where None; a clip keeps its own, and takes none
    loop: int | None = None  # the format's where None: gif and webp for ever, the others once
    size: tuple[int, int] | None = None  # width and height of one eye's view; the photo's where None
    show: Show = "color"
    stereo: StereoLayout | None = None
    ipd: float | None = None  # as `default_ipd` has it where None
    convergence: float | None = None  # the focus depth where None

    @property
    def suffix(self) -> str:
        """What the file's name ends with."""
        return f".{self.format or 'mp4'}"

    @property
    def rate(self) -> float:
        """Frames a second."""
        return DEFAULT_FPS if self.fps is None else self.fps

    @property
    def plays(self) -> int:
        """How often the video is shown; 0: for ever."""
        return FORMATS[self.suffix].loop if self.loop is None else self.loop

    def check(self) -> None:
        """InputError for a choice that no video can have."""
        self._blame(f"--fps {self.rate:g}", None)
        self._blame(f"--loop {self.loop}", self.loop)
        for option, value in {"--ipd": self.ipd, "--convergence": self.convergence}.items():
            if value is None:
                continue
            if self.stereo is None:
                raise InputError(f"{option} {value:g}: is for two eyes: add --stereo, or leave it out")
            if not value > 0 or (option == "--ipd" and value > MAX_IPD):
                raise InputError(f"{option} must be a positive number, got {value:g}")
        if self.show == "depth" and self.stereo == "anaglyph":
            raise InputError(
                "--show depth: an anaglyph mixes the colours that stand for depth: give --stereo sbs or ou"
            )

    def _blame(self, option: str, loop: int | None) -> None:
        """InputError that names an option for what the format refuses."""
        try:
            check_video(name := f"video{self.suffix}", self.rate, loop)
        except InputError as error:
            raise InputError(f"{option}: {str(error).removeprefix(f'{name}: ')}") from error

    def for_file(self, file: Path) -> VideoOptions:
        """The options with the format that a file's name stands for; InputError where --format says something else."""
        suffix = file.suffix.lower()
        meant = "mp4" if suffix in (".m4v", ".mov") else cast(VideoFormat, suffix[1:])
        if self.format not in (None, meant):
            raise InputError(f"--format {self.format}: {file} is a name for {meant}: leave one of them out")
        return dataclasses.replace(self, format=meant)


@dataclasses.dataclass(frozen=True)
class PathOptions:
    """Which way the camera goes, and the video along it."""

    trajectory: TrajectoryKind = "rotate-forward"
    disparity: float | None = None  # as the base has it where None
    cameras: Path | None = None  # exactly these views in place of a trajectory
    path: Path | None = None  # keyframes in place of a trajectory
    frames: int | None = None  # 60, or as many as the keyframes take
    video: VideoOptions = dataclasses.field(default_factory=VideoOptions)

    def check(self) -> None:
        """InputError for a path that cannot be flown, views that are given twice, or a video that cannot be."""
        if self.disparity is not None and not (math.isfinite(self.disparity) and 0 <= self.disparity <= MAX_DISPARITY):
            raise InputError(f"--disparity must be between 0 and {MAX_DISPARITY:g}, got {self.disparity:g}")
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise InputError(f"--frames must be between 1 and {MAX_FRAMES}, got {self.frames}")
        if self.cameras is not None and self.path is not None:
            raise InputError(f"--path {self.path}: --cameras gives the views already: leave one of them out")
        if self.cameras is not None and self.video.size is not None:
            raise InputError(f"--size: the views of --cameras {self.cameras} have a size of their own: leave it out")
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
            disparity: for options without one.

        Raises:
            PathError: the keyframes lead nowhere.
            ValueError: this scene allows no such path.
        """
        if keyframes is None:
            looped, count = self.video.plays != 1, self.frames or PATH_FRAMES
            return scene_path(gaussians, camera, self.trajectory, self.reach(disparity), count, looped)
        count = self.frames or keyframes.frame_count(self.video.rate)
        if count > MAX_FRAMES:
            raise PathError(f"{keyframes.seconds:g} s take {count} frames (at most {MAX_FRAMES}): give --frames")
        return keyframes.cameras(camera.even(), count, DepthRange.of(gaussians))


@dataclasses.dataclass(frozen=True)
class FrameMaker:
    """Draws a frame of a video: one picture or two, in colours or as depth."""

    options: VideoOptions
    stereo: Stereo | None = None
    depth: DepthColors | None = None

    @staticmethod
    def of(options: VideoOptions, gaussians: Gaussians, cameras: Sequence[Camera], source: Path) -> FrameMaker:
        """For a scene along a path; measures on it what was not chosen; InputError (naming `source`) if it cannot."""
        try:
            stereo = _stereo(options, gaussians, cameras[0])
            depth = DepthColors.over(gaussians, cameras) if options.show == "depth" else None
        except ValueError as error:
            raise InputError(f"{source}: no such video: {error}") from error
        maker = FrameMaker(options, stereo, depth)
        width, height = maker.frame_size(maker.sized(cameras[0]))
        if max(width, height) > MAX_VIDEO_SIDE:
            hint = "give a smaller --size" if stereo is None else "give a smaller --size, or --stereo sbs-half"
            raise InputError(
                f"{source}: frames of {width}×{height} have more than {MAX_VIDEO_SIDE} pixels a side: {hint}"
            )
        return maker

    @property
    def plain(self) -> bool:
        """Whether a frame is what one view shows, at its own size."""
        return self.stereo is None and self.depth is None and self.options.size is None

    def eyes(self, camera: Camera) -> tuple[Camera, ...]:
        """The view itself, or what the left and the right eye see."""
        return (camera,) if self.stereo is None else self.stereo.eyes(camera)

    def frame(self, views: Sequence[Rendering]) -> Tensor:
        """One frame [H, W, 3], sRGB, of the renderings of `eyes`."""
        pictures = [v.rgb if self.depth is None else self.depth(v.depth, v.alpha >= COVERED) for v in views]
        return pictures[0] if self.stereo is None else self.stereo.pack(*pictures)

    def sized(self, camera: Camera) -> Camera:
        """A view at the size of the video."""
        if self.options.size is None:
            return camera
        width, height = self.options.size
        return cover(camera, width + width % 2, height + height % 2)

    def frame_size(self, camera: Camera) -> tuple[int, int]:
        """Width and height of a frame of a view of this size; the file's, too, where these are even."""
        size = (camera.width, camera.height)
        return size if self.stereo is None else self.stereo.frame_size(*size)

    def note(self, name: str, camera: Camera, frames: int) -> dict[str, object]:
        """What a report says of the video: its file, for there may be others from earlier runs, and what it shows."""
        width, height = self.frame_size(self.sized(camera))
        stereo: dict[str, object] | None = None
        if self.stereo is not None:
            convergence = self.stereo.convergence if math.isfinite(self.stereo.convergence) else None  # as JSON can
            stereo = {"layout": self.stereo.layout, "ipd": self.stereo.ipd, "convergence": convergence}
        return {
            "file": name,
            "frames": frames,
            "fps": self.options.rate,
            "plays": self.options.plays,  # 0: for ever
            "width": width,
            "height": height,
            "show": self.options.show,
            "stereo": stereo,
        }


def _stereo(options: VideoOptions, gaussians: Gaussians, camera: Camera) -> Stereo | None:
    """The eyes that were chosen, or that suit the scene."""
    if options.stereo is None:
        return None
    ipd, convergence = options.ipd, options.convergence
    if ipd is None or convergence is None:
        depths = DepthRange.of(gaussians)
        ipd = default_ipd(camera, depths) if ipd is None else ipd
        convergence = depths.focus if convergence is None else convergence
    if camera.focal[0] * ipd / convergence > camera.width:
        raise ValueError(
            f"eyes {ipd:g} apart and a screen at {convergence:g}: give a smaller --ipd or a larger --convergence"
        )
    return Stereo(options.stereo, ipd, convergence)


def cover(camera: Camera, width: int, height: int) -> Camera:
    """The view on another grid with nothing squeezed: another aspect ratio cuts off two sides."""
    scale = max(width / camera.width, height / camera.height)
    K = camera.K.clone()
    K[:2, :2] *= scale
    center = torch.tensor([camera.width / 2, camera.height / 2])
    K[:2, 2] = torch.tensor([width / 2, height / 2]) + scale * (camera.K[:2, 2] - center)
    return dataclasses.replace(camera, K=K, width=width, height=height)


def video_problem(cameras: Sequence[Camera]) -> str | None:
    """Why these views cannot be the frames of a video, or None."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        return "the frames differ in size"
    if max(max(size) for size in sizes) > MAX_VIDEO_SIDE:
        return f"the frames have more than {MAX_VIDEO_SIDE} pixels a side"
    return None


def parse_size(text: str) -> tuple[int, int]:
    """WxH to (width, height); InputError for anything else."""
    match = re.fullmatch(r"([0-9]{1,5})[xX×]([0-9]{1,5})", text)
    width, height = (int(side) for side in match.groups()) if match else (0, 0)
    if not (1 <= width <= MAX_VIDEO_SIDE and 1 <= height <= MAX_VIDEO_SIDE):
        raise InputError(f"--size {text}: give width and height up to {MAX_VIDEO_SIDE}, such as 1280x720")
    return width, height


@dataclasses.dataclass(frozen=True)
class PlannedViews:
    """The views whose holes are filled, and the frames that are made of them."""

    cameras: list[Camera]
    measured: dict[str, int]  # name → index: views whose holes are reported
    frames: list[tuple[int, ...]]  # of the video: each a view, or the left eye's and the right eye's
    stills: int  # this many views, the first ones, are also saved as pictures
    maker: FrameMaker

    @staticmethod
    def of(path: list[Camera], others: dict[str, Camera], maker: FrameMaker, stills: bool) -> PlannedViews:
        """The views of a path through the eyes of its frames, and other views by their names."""
        middles = path if stills and maker.stereo else []  # the pictures show what is between the eyes
        eyes = [maker.eyes(camera) for camera in path]
        cameras = [*middles, *(eye for pair in eyes for eye in pair), *others.values()]
        first, each = len(middles), len(eyes[0])
        frames = [tuple(range(first + k * each, first + (k + 1) * each)) for k in range(len(path))]
        last = len(cameras) - len(others)
        measured = {name: last + k for k, name in enumerate(others)} or {str(k): k for k in range(len(path))}
        return PlannedViews(cameras, measured, frames, len(path) if stills else 0, maker)


COARSE_PX = 240  # long side of the pictures that show what a move uncovers
MOVE_STEP = 0.01  # of the disparities that a photo may choose
LEAST_MOVE = 0.04  # less is no parallax
LOOKS = 3  # at moves between none and the base's usual one


@contextlib.contextmanager
def _possible_path(source: Path) -> Iterator[None]:
    """InputError, naming the photo, where its depths and focal length allow no camera path."""
    try:
        yield
    except PathError:
        raise
    except ValueError as error:
        raise InputError(f"{source}: no camera path: {error}: check the depth map and the focal length") from error


@torch.no_grad()
def choose_move(prediction: BasePrediction, renderer: Renderer, source: Path) -> BasePrediction:
    """With the farthest move, up to the base's usual one, that uncovers no more of the widest views than it allows.

    The notes say the base's usual disparity, and which share of the two widest views is holes (eq. 10, 11), by coarse
    renders. InputError, naming `source`, the photo, where its depths and focal length allow no path.
    """
    gaussians, usual, allowed = prediction.gaussians, prediction.disparity, prediction.uncovered
    with _possible_path(source):
        depths = DepthRange.of(gaussians)
    camera = prediction.camera.resized(*working_size(prediction.camera.width, prediction.camera.height, COARSE_PX))

    def uncovered(disparity: float) -> float:
        ends = extremes(camera, disparity, depths)
        return sum(hole_area_ratio(renderer.render(gaussians, end).alpha) for end in ends) / len(ends)

    near, far = (0.0, 0.0), (usual, uncovered(usual))  # disparity and holes: within what is allowed, and beyond it
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
    """The given views; or a path, and where its holes are measured: at its two extremes, or at its keyframes.

    InputError, naming `source`, the photo, where its depths and focal length allow no such path.
    """
    gaussians, camera = prediction.gaussians, prediction.camera
    if given:
        return PlannedViews.of(given, {}, FrameMaker.of(path.video, gaussians, given, source), stills=True)
    try:
        with _possible_path(source):
            cameras = path.fly(gaussians, camera, keyframes, prediction.disparity)
            others = _measured(path.reach(prediction.disparity), camera.even(), DepthRange.of(gaussians), keyframes)
    except PathError as error:
        raise InputError(f"{path.path}: {error}") from error
    return PlannedViews.of(cameras, others, FrameMaker.of(path.video, gaussians, cameras, source), stills=False)


def _measured(
    disparity: float, camera: Camera, depths: DepthRange, keyframes: KeyframePath | None
) -> dict[str, Camera]:
    """The views whose holes are reported, by their names."""
    if keyframes is None:
        return dict(zip((f"{-disparity:g}", f"+{disparity:g}"), extremes(camera, disparity, depths), strict=True))
    keys = keyframes.key_cameras(camera, depths)
    step = math.ceil(len(keys) / MEASURED_KEYFRAMES)
    return {f"keyframe {index}": keys[index] for index in range(0, len(keys), step)}
