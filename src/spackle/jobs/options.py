"""The choices of `spackle predict`, and which of them cannot be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from spackle.bases.open import AUTO, BaseSettings
from spackle.camera import Camera
from spackle.camera_path import MAX_DISPARITY, TrajectoryKind
from spackle.device import Precision
from spackle.errors import InputError
from spackle.jobs.video_options import MAX_VIDEO_SIDE, VideoOptions, check_video_options
from spackle.residual.network import SHIPPED

Mode = Literal["scene", "view"]
MAX_FRAMES = 10_000


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """The choices of `spackle predict`."""

    base: str = AUTO  # or as `kind_of` has it
    depth: Path | None = None  # a depth map, or a folder of depth maps named as the photos
    calib: Path | None = None  # calibration of a disparity map
    checkpoint: Path | None = None  # weights of the base
    precision: Precision = "auto"  # of the base's network
    low_memory: bool = False
    windows: int | None = None  # of SHARP, at once
    compiled: bool = False
    residual: str | None = None  # a file, "seeds", "none", or None for the shipped weights if any
    render: bool = True
    trajectory: TrajectoryKind = "rotate_forward"
    disparity: float = 0.3
    cameras: Path | None = None  # exactly these views in place of a trajectory
    path: Path | None = None  # keyframes in place of a trajectory
    frames: int | None = None  # 60, or as many as the keyframes take
    video: VideoOptions = dataclasses.field(default_factory=VideoOptions)
    mode: Mode = "scene"
    device: str = "auto"
    focal_px: float | None = None
    focal_mm: float | None = None
    fov: float | None = None
    overwrite: bool = False  # in a folder, do again what is done already

    @property
    def settings(self) -> BaseSettings:
        """What of this is the base's."""
        return BaseSettings(
            self.base,
            self.depth,
            self.calib,
            self.checkpoint,
            self.precision,
            self.low_memory,
            self.windows,
            self.compiled,
            self.device,
        )

    @property
    def residual_weights(self) -> str:
        """The weights that --residual means: "shipped", a file, "seeds" or "none"."""
        return self.residual or ("shipped" if SHIPPED.is_file() else "seeds")

    @property
    def residual_file(self) -> Path | None:
        """The file of those weights, where there is one."""
        named = self.residual_weights
        return SHIPPED if named == "shipped" else None if named in ("seeds", "none") else Path(named)

    @property
    def named(self) -> str:
        """As `BaseSettings.named`."""
        return self.settings.named

    @property
    def base_files(self) -> dict[str, Path]:
        """As `BaseSettings.files`."""
        return self.settings.files


def check_options(options: PredictOptions) -> None:
    """InputError for an option that cannot be used, whatever the photo."""
    options.settings.check()
    check_path_options(options.disparity, options.frames)
    check_view_options(options.cameras, options.path, options.video)
    video = options.video
    for option, value in {"--format": video.format, "--fps": video.fps, "--loop": video.loop}.items():
        if value is not None and not options.render:
            raise InputError(f"{option} {value}: is for the video, and --no-render writes none: leave one of them out")


def check_base_options(options: PredictOptions) -> None:
    """As `BaseSettings.check`."""
    options.settings.check()


def check_has_depth(options: PredictOptions) -> None:
    """As `BaseSettings.check_has_depth`."""
    options.settings.check_has_depth()


def check_path_options(disparity: float, frames: int | None) -> None:
    """InputError for a path that cannot be flown."""
    if not (math.isfinite(disparity) and 0 <= disparity <= MAX_DISPARITY):
        raise InputError(f"--disparity must be between 0 and {MAX_DISPARITY:g}, got {disparity:g}")
    if frames is not None and not 1 <= frames <= MAX_FRAMES:
        raise InputError(f"--frames must be between 1 and {MAX_FRAMES}, got {frames}")


def check_view_options(cameras: Path | None, path: Path | None, video: VideoOptions) -> None:
    """InputError for views that are given twice, or a video that cannot be."""
    if cameras is not None and path is not None:
        raise InputError(f"--path {path}: --cameras gives the views already: leave one of them out")
    if cameras is not None and video.size is not None:
        raise InputError(f"--size: the views of --cameras {cameras} have a size of their own: leave it out")
    check_video_options(video)


def video_problem(cameras: Sequence[Camera]) -> str | None:
    """Why these views cannot be the frames of a video, or None."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        return "the frames differ in size"
    if max(max(size) for size in sizes) > MAX_VIDEO_SIDE:
        return f"the frames have more than {MAX_VIDEO_SIDE} pixels a side"
    return None
