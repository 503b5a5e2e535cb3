"""The choices of `spackle predict`, and which of them cannot be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from spackle.camera import Camera
from spackle.downloads import installed
from spackle.errors import InputError
from spackle.precision import PRECISIONS, Precision
from spackle.residual.weights import SHIPPED
from spackle.trajectory import MAX_DISPARITY, TrajectoryKind

Mode = Literal["scene", "view"]
BASES = ("rgbd", "sharp")
MAX_FRAMES = 10_000
MAX_VIDEO_SIDE = 8192


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """The choices of `spackle predict`."""

    base: str = "rgbd"
    depth: Path | None = None  # a depth map, or a folder of depth maps named as the photos
    calib: Path | None = None  # calibration of a disparity map
    checkpoint: Path | None = None  # weights of the base
    precision: Precision = "auto"  # of the base's network
    low_memory: bool = False
    residual: str | None = None  # a file, "seeds", "none", or None for the shipped weights if any
    render: bool = True
    trajectory: TrajectoryKind = "rotate_forward"
    disparity: float = 0.3
    cameras: Path | None = None  # exactly these views in place of a trajectory
    frames: int = 60
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
    def base_weights(self) -> Path | None:
        """The base's weights: those that were given, else those that were downloaded, if any."""
        return self.checkpoint or (installed("sharp") if self.base == "sharp" else None)


def check_options(options: PredictOptions) -> None:
    """InputError for an option that cannot be used, whatever the photo."""
    if options.base not in BASES:
        raise InputError(f"--base {options.base}: unknown base; this version has: {', '.join(BASES)}")
    if options.precision not in PRECISIONS:
        raise InputError(f"--precision {options.precision}: unknown; there are {', '.join(PRECISIONS)}")
    (_check_sharp if options.base == "sharp" else _check_rgbd)(options)
    check_path_options(options.disparity, options.frames)


def _check_sharp(options: PredictOptions) -> None:
    for name, value in (("--depth", options.depth), ("--calib", options.calib)):
        if value is not None:
            raise InputError(f"{name} {value}: the sharp base finds depth itself; leave the option out")
    if options.base_weights is None:
        raise InputError(
            "--base sharp: no weights on this machine: `spackle weights get sharp` downloads them "
            "(2.8 GB, for research only), -c FILE takes a local copy"
        )


def _check_rgbd(options: PredictOptions) -> None:
    if options.depth is None:
        raise InputError(
            "--base rgbd needs the photo's depth: give --depth FILE, or --depth FOLDER for many photos; "
            "--base sharp needs none"
        )
    if options.checkpoint is not None:
        raise InputError(f"-c {options.checkpoint}: the rgbd base has no checkpoint; leave the option out")
    for name, given in (
        (f"--precision {options.precision}", options.precision != "auto"),
        ("--low-memory", options.low_memory),
    ):
        if given:
            raise InputError(f"{name}: the rgbd base has no network; leave the option out")


def check_path_options(disparity: float, frames: int) -> None:
    """InputError for a path that cannot be flown."""
    if not (math.isfinite(disparity) and 0 <= disparity <= MAX_DISPARITY):
        raise InputError(f"--disparity must be between 0 and {MAX_DISPARITY:g}, got {disparity:g}")
    if not 1 <= frames <= MAX_FRAMES:
        raise InputError(f"--frames must be between 1 and {MAX_FRAMES}, got {frames}")


def video_problem(cameras: Sequence[Camera]) -> str | None:
    """Why these views cannot be the frames of a video, or None."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        return "the frames differ in size"
    if max(max(size) for size in sizes) > MAX_VIDEO_SIDE:
        return f"the frames have more than {MAX_VIDEO_SIDE} pixels a side"
    return None
