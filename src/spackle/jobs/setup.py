"""What a prediction was asked for, checked before any work begins."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import spackle
from spackle.bases.depth_maps import load_depth
from spackle.bases.protocol import Base
from spackle.bases.rgbd import RgbdBase
from spackle.bases.sharp import PRECISIONS, Precision, SharpBase
from spackle.camera import Camera
from spackle.downloads import check_recorded, installed
from spackle.errors import InputError
from spackle.formats import load_cameras
from spackle.image import Photo
from spackle.jobs.inputs import find_depth
from spackle.render import Renderer, get_renderer
from spackle.residual import ResidualNet
from spackle.residual.weights import SHIPPED, load_residual
from spackle.trajectory import MAX_DISPARITY, TrajectoryKind

Mode = Literal["scene", "view"]
BASES = ("rgbd", "sharp")
MAX_FRAMES = 10_000
MAX_VIDEO_SIDE = 8192
MAX_HASHED = 200_000_000  # bytes of a file that is read to tell whether it has changed


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


def request_of(photo: Path, options: PredictOptions) -> str:
    """A digest of all that a result depends on: the version, the options, and what the files hold."""
    files = [photo, options.calib, options.cameras, _checkpoint(options)]
    if options.depth is not None:
        depth = find_depth(options.depth, photo)
        beside = [depth.with_name(name) for name in ("calib.txt", "scene.json")]  # as `load_depth` finds them
        files += [depth, *(file for file in beside if file.is_file())]
    if (residual := _residual(options)) not in ("seeds", "none"):
        files.append(Path(residual))
    contents = [file and _fingerprint(file) for file in files]
    choices = {name: value for name, value in dataclasses.asdict(options).items() if not isinstance(value, Path)}
    for irrelevant in ("overwrite", "residual"):
        del choices[irrelevant]
    choices |= {"spackle": spackle.__version__, "residual": residual, "files": contents}
    return hashlib.sha256(json.dumps(choices, sort_keys=True).encode()).hexdigest()


def _fingerprint(file: Path) -> str:
    """The digest of what a file holds; of gigabytes, which would take seconds to read, size and time of change."""
    status = file.stat()
    if status.st_size > MAX_HASHED:
        return f"{status.st_size} bytes of {status.st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _checkpoint(options: PredictOptions) -> Path | None:
    """The base's weights: those that were given, else those that were downloaded, if any."""
    if options.base != "sharp":
        return options.checkpoint
    return options.checkpoint or installed("sharp")


def _residual(options: PredictOptions) -> str:
    """The weights that --residual means: a file, "seeds" or "none"."""
    return options.residual or (str(SHIPPED) if SHIPPED.exists() else "seeds")


@dataclasses.dataclass(frozen=True)
class Tools:
    """What is set up once for all photos."""

    renderer: Renderer
    base: Base | None  # one that needs nothing beside the photo
    network: ResidualNet | None
    residual: str  # for the report: a path, "seeds" or "none"
    views: list[Camera] | None  # of --cameras


def set_up(options: PredictOptions) -> Tools:
    """Check the options that do not depend on a photo, and load what all photos share.

    Raises:
        InputError: an option that cannot be used.
    """
    if options.base not in BASES:
        raise InputError(f"--base {options.base}: unknown base; this version has: {', '.join(BASES)}")
    _check_base_options(options)
    check_path_options(options.disparity, options.frames)
    residual = _residual(options)
    network = None if residual in ("seeds", "none") else load_residual(residual)
    views = load_cameras(options.cameras) if options.cameras else None
    if views and options.render and (problem := video_problem(views)):
        raise InputError(f"{options.cameras}: {problem}, so they make no video: add --no-render for pictures only")
    renderer = get_renderer(options.device)
    base = _load_sharp(options) if options.base == "sharp" else None  # last, because it takes seconds
    return Tools(renderer, base, network, residual, views)


def _check_base_options(options: PredictOptions) -> None:
    if options.precision not in PRECISIONS:
        raise InputError(f"--precision {options.precision}: unknown; there are {', '.join(PRECISIONS)}")
    if options.base == "sharp":
        for name, value in (("--depth", options.depth), ("--calib", options.calib)):
            if value is not None:
                raise InputError(f"{name} {value}: the sharp base finds depth itself; leave the option out")
        return
    if options.depth is None:
        raise InputError(
            "--base rgbd needs the photo's depth: give --depth FILE, or --depth FOLDER for many photos; "
            "--base sharp needs none"
        )
    if options.checkpoint is not None:
        raise InputError(f"-c {options.checkpoint}: the rgbd base has no checkpoint; leave the option out")


def _load_sharp(options: PredictOptions) -> SharpBase:
    """SHARP with the weights that were given or downloaded; a download is held to its record first."""
    path = _checkpoint(options)
    if path is None:
        raise InputError(
            "--base sharp: no weights on this machine: `spackle weights get sharp` downloads them "
            "(2.8 GB, for research only), -c FILE takes a local copy"
        )
    check_recorded(path)  # where there is a record
    device = None if options.device == "auto" else options.device
    return SharpBase.load(path, precision=options.precision, low_memory=options.low_memory, device=device)


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


def make_base(photo: Photo, options: PredictOptions, tools: Tools) -> Base:
    """The base for one photo, given at its full size.

    Raises:
        InputError: a depth map that cannot be used, or none for this photo.
    """
    if tools.base is not None:
        return tools.base
    assert options.depth is not None  # set_up has refused it
    path = find_depth(options.depth, photo.path)
    depth = load_depth(path, calib=options.calib)
    depth.check_shape(photo.height, photo.width, photo.path)
    if options.gives_focal and depth.K is not None:  # a person's word beats the calibration's
        scale = depth.depth.shape[1] / photo.width
        depth = load_depth(path, calib=options.calib, focal_px=photo.focal_px * scale)
    return RgbdBase(depth)
