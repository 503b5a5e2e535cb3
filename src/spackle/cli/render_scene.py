"""`spackle render`: a scene file to a video."""

from __future__ import annotations

import dataclasses
import math
import mimetypes
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases.protocol import USUAL_DISPARITY
from spackle.camera import Camera
from spackle.camera_path import KeyframePath, PathError
from spackle.errors import InputError
from spackle.folders import results_folder
from spackle.formats import PlyFile, load_ply, save_png, save_video
from spackle.formats.video import FORMATS
from spackle.gaussians import Gaussians
from spackle.image import DEFAULT_FOCAL_MM, film_to_pixels
from spackle.progress import Reporter
from spackle.render import get_renderer
from spackle.residual import hole_area_ratio
from spackle.scene import DEFAULT_SIZE
from spackle.views import FrameMaker, PathOptions, cover, video_problem

TOLERATED = 0.01  # holes of a frame that nobody need be told of


def render_scene(
    scene: Path, output: Path, path: PathOptions, focal_px: float | None, device: str, reporter: Reporter
) -> None:
    """Draw a PLY along a path: the video `output`, or in the folder `output` STEM.mp4 (with --cameras also PNGs).

    `focal_px`, in pixels of the video, replaces the stored lens. InputError for a file or option that cannot be used.
    """
    single = output.suffix.lower() in FORMATS
    if single:
        path = dataclasses.replace(path, video=path.video.for_file(output))
    elif (mimetypes.guess_type(output.name)[0] or "").startswith(("video/", "image/")):
        raise InputError(f"{output}: not a kind of video that can be written: end it with {', '.join(FORMATS)}")
    path.check()
    if path.cameras is not None and focal_px is not None:
        raise InputError(f"--focal-px: the views of --cameras {path.cameras} have lenses of their own: leave it out")
    renderer = get_renderer(device)
    with reporter.stage("load"):
        given, keyframes = path.load()
        gaussians = load_ply(scene)
        cameras = given or _fly(scene, gaussians, path, keyframes, focal_px, reporter)
        # A path has the video's size already.
        maker = FrameMaker.of(dataclasses.replace(path.video, size=None), gaussians, cameras, scene)
    target = output if single else output / f"{scene.stem}{path.video.suffix}"
    names = [f"{index:04d}.png" for index in range(len(cameras))] if given and not single else []
    problem = video_problem(cameras)
    if problem and not names:
        hint = "give a folder with -o for pictures only" if given else "give --size"
        raise InputError(f"{path.cameras or scene}: {problem}, so they make no video: {hint}")
    open_shares: list[float] = []
    with results_folder(target.parent, [*names, target.name]), reporter.stage("video") as step:

        def frames() -> Iterator[Tensor]:
            """The frames of the video, each also saved as a picture, where these are wanted."""
            for index, camera in enumerate(cameras):
                with torch.no_grad():
                    views = [renderer.render([gaussians], eye) for eye in maker.eyes(camera)]
                    frame = maker.frame(views)
                open_shares.append(max(hole_area_ratio(view.alpha) for view in views))
                if names:
                    save_png(frame, target.parent / names[index])
                yield frame
                step(index + 1, len(cameras))

        if problem:
            for _ in frames():
                pass
        else:
            save_video(frames(), target, path.video.rate, path.video.loop)
    widest = max(open_shares)
    result = {
        "gaussians": len(gaussians),
        "frames": len(cameras),
        "seconds": reporter.seconds["video"],
        "open": round(widest, 5),
    }
    if widest > TOLERATED:
        mean = sum(open_shares) / len(open_shares)
        reporter.log(f"{scene.name}: holes take up to {widest:.1%} of a frame, {mean:.1%} on average{_reach(scene)}")
    if problem:
        reporter.log(f"{path.cameras}: {problem}: pictures only, no video")
        reporter.result({"folder": output, **result})
        return
    reporter.log(
        f"{scene.name}: {len(gaussians):,} Gaussians, {len(cameras)} frames in "
        f"{reporter.seconds['video']:.1f} s -> {target}"
    )
    reporter.result({"file": target, **result})


def _reach(scene: Path) -> str:
    """How far a scene was completed, where its file says it."""
    disparity = PlyFile(scene).disparity()
    return "" if disparity is None else f": the scene was completed for --disparity {disparity:g}"


def _fly(
    scene: Path,
    gaussians: Gaussians,
    path: PathOptions,
    keyframes: KeyframePath | None,
    focal_px: float | None,
    reporter: Reporter,
) -> list[Camera]:
    """The cameras of the path around the photo's place; InputError where the scene cannot be looked at from there."""
    stored = PlyFile(scene).camera()
    try:
        camera = _photo_camera(stored, path.video.size, focal_px)
        completed = PlyFile(scene).disparity()
        cameras = path.fly(gaussians, camera, keyframes, USUAL_DISPARITY if completed is None else completed)
    except InputError:
        raise
    except PathError as error:
        raise InputError(f"{path.path}: {error}") from error
    except ValueError as error:
        raise InputError(f"{scene}: no camera path: {error}: give views with --cameras") from error
    if stored is None and focal_px is None:
        reporter.log(
            f"{scene.name}: no camera stored, taking {DEFAULT_FOCAL_MM:g} mm at {camera.width}×{camera.height} "
            "(--focal-px, --size)"
        )
    return cameras


def _photo_camera(stored: Camera | None, size: tuple[int, int] | None, focal_px: float | None) -> Camera:
    """The stored camera, changed as the options say; else a lens of 30 mm."""
    width, height = size or ((stored.width, stored.height) if stored else DEFAULT_SIZE)
    if focal_px is not None:
        if not (math.isfinite(focal_px) and focal_px > 0):
            raise InputError(f"--focal-px must be a positive number, got {focal_px:g}")
        return Camera.from_focal(focal_px, width, height)
    if stored is not None:
        return cover(stored, width, height)
    return Camera.from_focal(film_to_pixels(DEFAULT_FOCAL_MM, width, height), width, height)
