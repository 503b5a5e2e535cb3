"""The choices of `spackle predict`, and which of them cannot be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from spackle.bases.sharp.base import check_windows
from spackle.camera import Camera
from spackle.errors import InputError
from spackle.jobs.bases import AUTO, HF, KINDS, NETWORKS, base_files, kind_of
from spackle.jobs.names import check_name
from spackle.jobs.video_options import MAX_VIDEO_SIDE, VideoOptions, check_video_options
from spackle.precision import PRECISIONS, Precision
from spackle.residual.network import SHIPPED
from spackle.trajectory import MAX_DISPARITY, TrajectoryKind

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
    def gives_focal(self) -> bool:
        """Whether a person said what the focal length is."""
        return any(value is not None for value in (self.focal_px, self.focal_mm, self.fov))

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
        """The base that is named: with --depth `auto` is `rgbd`, and with -c it is `sharp`."""
        if self.base != AUTO:
            return self.base
        return "rgbd" if self.depth is not None else AUTO if self.checkpoint is None else "sharp"

    @property
    def base_files(self) -> dict[str, Path]:
        """As `spackle.jobs.bases.base_files` has it."""
        return base_files(self.named, self.checkpoint)


def check_options(options: PredictOptions) -> None:
    """InputError for an option that cannot be used, whatever the photo."""
    if not options.base.startswith(HF):
        check_name("--base", options.base, (AUTO, *KINDS))
    check_base_options(options)
    check_path_options(options.disparity, options.frames)
    check_view_options(options.cameras, options.path, options.video)
    video = options.video
    for option, value in {"--format": video.format, "--fps": video.fps, "--loop": video.loop}.items():
        if value is not None and not options.render:
            raise InputError(f"{option} {value}: is for the video, and --no-render writes none: leave one of them out")


def check_base_options(options: PredictOptions) -> None:
    """InputError for a base that there is not, or that has no use for an option that is given."""
    if options.precision not in PRECISIONS:
        raise InputError(f"--precision {options.precision}: unknown: there are {', '.join(PRECISIONS)}")
    refuses = {} if options.named == AUTO else kind_of(options.named).refuses
    for option, value in _given(options).items():
        if option in refuses:
            who = options.named.partition(":")[0]
            raise InputError(f"{option}{value}: the {who} base {refuses[option]}; leave the option out")
    check_windows("--windows", options.windows, options.low_memory)
    if options.calib is not None and options.depth is None:
        raise InputError(f"--calib {options.calib}: is for a disparity map: give that with --depth")
    if options.named == "sharp" and not options.base_files:
        raise InputError(
            "--base sharp: no weights on this machine: `spackle weights get sharp` downloads them "
            "(2.8 GB, for research only), -c FILE takes a local copy"
        )


def check_has_depth(options: PredictOptions) -> None:
    """InputError where the base takes depth and none is given."""
    if not kind_of(options.named).network and options.depth is None:
        raise InputError(
            f"--base {options.base} needs the photos' depth: give --depth FOLDER; {', '.join(NETWORKS)} need none"
        )


def _given(options: PredictOptions) -> dict[str, str]:
    """What was given of the options that not every base has a use for, by their names."""
    values = {
        "--depth": options.depth,
        "--calib": options.calib,
        "-c": options.checkpoint,
        "--windows": options.windows,
    }
    given = {name: f" {value}" for name, value in values.items() if value is not None}
    if options.precision != "auto":
        given["--precision"] = f" {options.precision}"
    flags = {"--low-memory": options.low_memory, "--compile": options.compiled}
    given |= {name: "" for name, value in flags.items() if value}
    return given


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
