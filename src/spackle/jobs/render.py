"""`spackle render`: a scene file to a video."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.errors import InputError
from spackle.formats import load_cameras, load_ply, load_ply_camera, save_png, save_video
from spackle.gaussians import Gaussians
from spackle.image import DEFAULT_FOCAL_MM, film_to_pixels
from spackle.jobs.inputs import results_folder
from spackle.jobs.options import MAX_VIDEO_SIDE, check_path_options, video_problem
from spackle.jobs.progress import Reporter, Step
from spackle.render import Renderer, get_renderer
from spackle.scene import scene_path
from spackle.trajectory import TrajectoryKind

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
    match = re.fullmatch(r"([0-9]{1,5})[xX×]([0-9]{1,5})", text)
    width, height = (int(side) for side in match.groups()) if match else (0, 0)
    if not (1 <= width <= MAX_VIDEO_SIDE and 1 <= height <= MAX_VIDEO_SIDE):
        raise InputError(f"--size {text}: give width and height up to {MAX_VIDEO_SIDE}, such as 1280x720")
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
        views = load_cameras(options.cameras) if options.cameras else None
        gaussians = load_ply(scene)
        cameras = views or _path(scene, gaussians, options, reporter)
    single = output.suffix.lower() == ".mp4"
    target = output if single else output / f"{scene.stem}.mp4"
    names = [f"{index:04d}.png" for index in range(len(cameras))] if views and not single else []
    problem = video_problem(cameras)
    if problem and not names:
        hint = "give a folder with -o for pictures only" if views else "give --size"
        raise InputError(f"{options.cameras or scene}: {problem}, so they make no video: {hint}")
    with results_folder(target.parent, [*names, target.name]):
        for name, camera in zip(names, cameras, strict=False):
            save_png(_draw(renderer, gaussians, camera), target.parent / name)
        if problem:
            reporter.say(f"{options.cameras}: {problem}: pictures only, no video")
            return
        with reporter.stage("video", seconds) as step:
            save_video(_frames(renderer, gaussians, cameras, step), target)
    reporter.say(
        f"{scene.name}: {len(gaussians):,} Gaussians, {len(cameras)} frames in {seconds['video']:.1f} s -> {target}"
    )


def _frames(renderer: Renderer, gaussians: Gaussians, cameras: list[Camera], step: Step) -> Iterator[Tensor]:
    for index, camera in enumerate(cameras):
        yield _draw(renderer, gaussians, camera)
        step(index + 1, len(cameras))


@torch.no_grad()
def _draw(renderer: Renderer, gaussians: Gaussians, camera: Camera) -> Tensor:
    return renderer.render(gaussians, camera).rgb


def _path(scene: Path, gaussians: Gaussians, options: RenderOptions, reporter: Reporter) -> list[Camera]:
    """The cameras of the options' trajectory around the photo's place.

    Raises:
        InputError: a scene that cannot be looked at from there.
    """
    stored = load_ply_camera(scene)
    try:
        camera = _photo_camera(stored, options)
        path = scene_path(gaussians, camera, options.trajectory, options.disparity, options.frames)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{scene}: no camera path: {error}: give views with --cameras") from error
    if stored is None and options.focal_px is None:
        reporter.say(
            f"{scene.name}: no camera stored, taking {DEFAULT_FOCAL_MM:g} mm at {camera.width}×{camera.height} "
            "(--focal-px, --size)"
        )
    return path


def _photo_camera(stored: Camera | None, options: RenderOptions) -> Camera:
    """The stored camera, changed as the options say; else a lens of 30 mm."""
    width, height = options.size or ((stored.width, stored.height) if stored else DEFAULT_SIZE)
    if options.focal_px is not None:
        if not (math.isfinite(options.focal_px) and options.focal_px > 0):
            raise InputError(f"--focal-px must be a positive number, got {options.focal_px:g}")
        return Camera.from_focal(options.focal_px, width, height)
    if stored is not None:
        return _cover(stored, width, height)
    return Camera.from_focal(film_to_pixels(DEFAULT_FOCAL_MM, width, height), width, height)


def _cover(camera: Camera, width: int, height: int) -> Camera:
    """The view on another grid with nothing squeezed: another aspect ratio cuts off two sides."""
    scale = max(width / camera.width, height / camera.height)
    K = camera.K.clone()
    K[:2, :2] *= scale
    center = torch.tensor([camera.width / 2, camera.height / 2])
    K[:2, 2] = torch.tensor([width / 2, height / 2]) + scale * (camera.K[:2, 2] - center)
    return dataclasses.replace(camera, K=K, width=width, height=height)
