"""`spackle render`: a scene file to a video."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.errors import InputError
from spackle.formats import load_cameras, load_ply, load_ply_camera, save_png, save_video
from spackle.image import DEFAULT_FOCAL_MM, film_to_pixels
from spackle.jobs.inputs import make_folder
from spackle.jobs.progress import Reporter
from spackle.jobs.setup import check_path_options
from spackle.render import get_renderer
from spackle.scene import scene_path
from spackle.trajectory import TrajectoryKind

MAX_SIZE = 8192
DEFAULT_SIZE = (1280, 720)


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """The choices of `spackle render`."""

    trajectory: TrajectoryKind = "rotate_forward"
    disparity: float = 0.3
    cameras: Path | None = None
    frames: int = 60
    size: tuple[int, int] | None = None  # width, height; the stored camera's where None
    focal_px: float | None = None
    device: str = "auto"


def parse_size(text: str) -> tuple[int, int]:
    """WxH to (width, height).

    Raises:
        InputError: anything else.
    """
    match = re.fullmatch(r"(\d{1,5})[xX×](\d{1,5})", text)
    width, height = (int(side) for side in match.groups()) if match else (0, 0)
    if not (1 <= width <= MAX_SIZE and 1 <= height <= MAX_SIZE):
        raise InputError(f"--size {text}: give width and height up to {MAX_SIZE}, such as 1280x720")
    return width, height


def render_scene(scene: Path, output: Path, options: RenderOptions, reporter: Reporter) -> None:
    """Draw a PLY along a path: `output`.mp4, or `output`/STEM.mp4 (with --cameras also PNGs).

    Raises:
        InputError: a scene, a camera file or an output that cannot be used.
    """
    check_path_options(options.disparity, options.frames)
    renderer = get_renderer(options.device)
    seconds: dict[str, float] = {}
    with reporter.stage("load", seconds):
        gaussians = load_ply(scene)
        photo_camera = _photo_camera(scene, options, reporter)
        try:
            path = scene_path(gaussians, photo_camera, options.trajectory, options.disparity, options.frames)
            cameras = load_cameras(options.cameras) if options.cameras else path
        except ValueError as error:
            raise InputError(f"{scene}: {error}: nothing to look at from the photo's place") from error
    single = output.suffix.lower() == ".mp4"
    folder = output.parent if single else output
    make_folder(folder)
    if options.cameras and not single:
        for index, camera in enumerate(cameras):
            with torch.no_grad():
                save_png(renderer.render(gaussians, camera).rgb, folder / f"{index:04d}.png")
    target = output if single else folder / f"{scene.stem}.mp4"
    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        reporter.say(f"{options.cameras}: the frames differ in size: pictures only, no video")
        return
    with reporter.stage("video", seconds) as step:

        def frames() -> Iterator[Tensor]:
            for index, camera in enumerate(cameras):
                with torch.no_grad():
                    yield renderer.render(gaussians, camera).rgb
                step(index + 1, len(cameras))

        save_video(frames(), target)
    reporter.say(
        f"{scene.name}: {len(gaussians):,} Gaussians, {len(cameras)} frames in {seconds['video']:.1f} s -> {target}"
    )


def _photo_camera(scene: Path, options: RenderOptions, reporter: Reporter) -> Camera:
    """The stored camera, changed as the options say; else a lens of 30 mm."""
    stored = load_ply_camera(scene)
    width, height = options.size or ((stored.width, stored.height) if stored else DEFAULT_SIZE)
    if options.focal_px is not None:
        if not options.focal_px > 0:
            raise InputError(f"--focal-px must be positive, got {options.focal_px:g}")
        return Camera.from_focal(options.focal_px, width, height)
    if stored is not None:
        return stored.resized(width, height)
    focal = film_to_pixels(DEFAULT_FOCAL_MM, width, height)
    reporter.say(
        f"{scene.name}: no camera stored, taking {DEFAULT_FOCAL_MM:g} mm at {width}×{height} (--focal-px, --size)"
    )
    return Camera.from_focal(focal, width, height)
