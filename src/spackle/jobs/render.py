"""`spackle render`: a scene file to a video."""

from __future__ import annotations

import dataclasses
import math
import mimetypes
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import KeyframePath, PathError, TrajectoryKind
from spackle.errors import InputError
from spackle.formats import load_cameras, load_path, load_ply, load_ply_camera, save_png, save_video
from spackle.formats.video import FORMATS, is_video_name
from spackle.gaussians import Gaussians
from spackle.image import DEFAULT_FOCAL_MM, film_to_pixels
from spackle.jobs.film import Film, cover, fly, make_film
from spackle.jobs.options import check_path_options, check_view_options, video_problem
from spackle.jobs.video_options import VideoOptions, named_format
from spackle.output_folder import results_folder
from spackle.progress import Reporter, Step
from spackle.render import Renderer, get_renderer

DEFAULT_SIZE = (1280, 720)


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """The choices of `spackle render`."""

    trajectory: TrajectoryKind = "rotate_forward"
    disparity: float = 0.3
    cameras: Path | None = None
    path: Path | None = None  # keyframes in place of a trajectory
    frames: int | None = None  # 60, or as many as the keyframes take
    focal_px: float | None = None
    device: str = "auto"
    video: VideoOptions = dataclasses.field(
        default_factory=VideoOptions
    )  # the size is the stored camera's where it is None


def render_scene(scene: Path, output: Path, options: RenderOptions, reporter: Reporter) -> None:
    """Draw a PLY along a path: the video `output`, or `output`/STEM.mp4 (with --cameras also PNGs).

    Raises:
        InputError: a scene, a camera file or an output that cannot be used.
    """
    single = is_video_name(output)
    if single:
        options = dataclasses.replace(options, video=named_format(options.video, output))
    elif (mimetypes.guess_type(output.name)[0] or "").startswith(("video/", "image/")):
        raise InputError(f"{output}: not a kind of video that can be written: end it with {', '.join(FORMATS)}")
    check_path_options(options.disparity, options.frames)
    check_view_options(options.cameras, options.path, options.video)
    if options.cameras is not None and options.focal_px is not None:
        raise InputError(f"--focal-px: the views of --cameras {options.cameras} have lenses of their own: leave it out")
    renderer = get_renderer(options.device)
    seconds: dict[str, float] = {}
    with reporter.stage("load", seconds):
        views = load_cameras(options.cameras) if options.cameras else None
        keyframes = load_path(options.path) if options.path else None
        gaussians = load_ply(scene)
        cameras = views or _path(scene, gaussians, options, keyframes, reporter)
        # A path has the video's size already.
        film = make_film(dataclasses.replace(options.video, size=None), gaussians, cameras, scene)
    target = output if single else output / f"{scene.stem}{options.video.suffix}"
    names = [f"{index:04d}.png" for index in range(len(cameras))] if views and not single else []
    problem = video_problem(cameras)
    if problem and not names:
        hint = "give a folder with -o for pictures only" if views else "give --size"
        raise InputError(f"{options.cameras or scene}: {problem}, so they make no video: {hint}")
    with results_folder(target.parent, [*names, target.name]), reporter.stage("video", seconds) as step:
        frames = _frames(renderer, gaussians, cameras, film, [target.parent / name for name in names], step)
        if problem:
            for _ in frames:
                pass
        else:
            save_video(frames, target, options.video.rate, options.video.loop)
    result = {"gaussians": len(gaussians), "frames": len(cameras), "seconds": seconds["video"]}
    if problem:
        reporter.say(f"{options.cameras}: {problem}: pictures only, no video")
        reporter.result({"folder": output, **result})
        return
    reporter.say(
        f"{scene.name}: {len(gaussians):,} Gaussians, {len(cameras)} frames in {seconds['video']:.1f} s -> {target}"
    )
    reporter.result({"file": target, **result})


def _frames(
    renderer: Renderer, gaussians: Gaussians, cameras: list[Camera], film: Film, pictures: list[Path], step: Step
) -> Iterator[Tensor]:
    """The frames of the video, each also saved as one of the pictures, where these are wanted."""
    for index, camera in enumerate(cameras):
        frame = draw(renderer, [gaussians], film, camera)
        if pictures:
            save_png(frame, pictures[index])
        yield frame
        step(index + 1, len(cameras))


@torch.no_grad()
def draw(renderer: Renderer, sets: list[Gaussians], film: Film, camera: Camera) -> Tensor:
    """One frame of a view that all its eyes see with the same Gaussians."""
    return film.frame([renderer.render(sets, eye) for eye in film.views(camera)])


def _path(
    scene: Path, gaussians: Gaussians, options: RenderOptions, keyframes: KeyframePath | None, reporter: Reporter
) -> list[Camera]:
    """The cameras of the options' path around the photo's place.

    Raises:
        InputError: a scene that cannot be looked at from there.
    """
    stored = load_ply_camera(scene)
    try:
        camera = _photo_camera(stored, options)
        path = fly(gaussians, camera, keyframes or options.trajectory, options.disparity, options.frames, options.video)
    except InputError:
        raise
    except PathError as error:
        raise InputError(f"{options.path}: {error}") from error
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
    width, height = options.video.size or ((stored.width, stored.height) if stored else DEFAULT_SIZE)
    if options.focal_px is not None:
        if not (math.isfinite(options.focal_px) and options.focal_px > 0):
            raise InputError(f"--focal-px must be a positive number, got {options.focal_px:g}")
        return Camera.from_focal(options.focal_px, width, height)
    if stored is not None:
        return cover(stored, width, height)
    return Camera.from_focal(film_to_pixels(DEFAULT_FOCAL_MM, width, height), width, height)
