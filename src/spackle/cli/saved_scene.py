"""`spackle render` and `spackle export`: a saved scene as a video, and in the formats that other viewers read."""

from __future__ import annotations

import contextlib
import dataclasses
import mimetypes
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from rich.filesize import decimal
from torch import Tensor

from spackle.bases import USUAL_DISPARITY
from spackle.camera import Camera
from spackle.camera_path import PathError
from spackle.errors import InputError
from spackle.files import check_writable, results_folder, write_whole
from spackle.formats import save_png, save_video
from spackle.formats.html import single_html
from spackle.formats.scene_files import Encoder, SceneFile, encoder_of, load_scene
from spackle.formats.spz import LARGEST, spz_grid
from spackle.formats.video import FORMATS
from spackle.image import DEFAULT_FOCAL_MM, focal_length
from spackle.progress import Reporter
from spackle.render import get_renderer
from spackle.residual import hole_area_ratio
from spackle.scene import DEFAULT_SIZE, Scene
from spackle.video_frames import FrameMaker, video_problem
from spackle.views import PathOptions

TOLERATED = 0.01  # fraction of a frame that may be holes before the log mentions it
PAGE: dict[str, Encoder] = {".html": lambda file: single_html(Scene.of_file(file).page(page_name(file.path)))}


def render_scene(
    scene: Path, output: Path, path: PathOptions, lens: Mapping[str, float | None], device: str, reporter: Reporter
) -> None:
    """Render a scene along a path to the video `output`, or to STEM.mp4 (with --cameras also PNGs) in folder `output`.

    `lens` replaces the stored one: focal_px, in pixels of the video, or fov. InputError for a file or option that
    cannot be used.
    """
    single = output.suffix.lower() in FORMATS
    if single:
        path = dataclasses.replace(path, video=path.video.for_file(output))
    elif (mimetypes.guess_type(output.name)[0] or "").startswith(("video/", "image/")):
        raise InputError(f"{output}: not a kind of video that can be written: end it with {', '.join(FORMATS)}")
    path.check()
    compare = path.video.compare
    given_lens = [f"--{name.replace('_', '-')}" for name, value in lens.items() if value is not None]
    if path.cameras is not None and given_lens:
        raise InputError(f"{given_lens[0]}: the views of --cameras {path.cameras} have their own lenses: leave it out")
    renderer = get_renderer(device)
    with reporter.stage("load"):
        given, keyframes = path.load()
        loaded = load_scene(scene)
        gaussians, reach, base_count = loaded.gaussians, loaded.disparity, loaded.base_count
        if compare and (base_count is None or base_count >= len(gaussians)):
            raise InputError(f"{scene}: --compare needs a completed scene, such as the scene.ply of `spackle predict`")
        base = gaussians.select(slice(0, base_count))  # its depths set how far a path goes, as for `spackle predict`
        parts = [base, gaussians] if compare else [gaussians]
        if given:
            cameras = given
        else:
            camera = _photo_camera(loaded, path.video.size, lens)
            if given_lens or reach is None:  # the lens is given, or nothing is known of the scene
                path = dataclasses.replace(path, overscan=0)
            try:
                cameras = path.fly(base, camera, keyframes, USUAL_DISPARITY if reach is None else reach)
            except PathError as error:
                raise InputError(f"{path.path}: {error}") from error
            except ValueError as error:
                raise InputError(f"{scene}: no camera path: {error}: give views with --cameras") from error
            if reach is not None and (path.disparity or 0) > reach:
                far = f"--disparity {path.disparity:g}"
                reporter.log(
                    f"{scene.name}: {far} goes beyond the {reach:g} that it was completed for: "
                    f"`spackle predict {far}` completes a photo that far"
                )
            if loaded.camera is None and not given_lens:
                reporter.log(
                    f"{scene.name}: no camera stored; using {DEFAULT_FOCAL_MM:g} mm at "
                    f"{camera.width}×{camera.height} (--fov and --size change it)"
                )
        maker = FrameMaker.of(path.video, base, cameras, scene)
    target = output if single else output / f"{scene.stem}{path.video.suffix}"
    names = [f"{index:04d}.png" for index in range(len(cameras))] if given and not single else []
    problem = video_problem([maker.sized(camera) for camera in cameras])
    if problem and not names:
        hint = "give a folder with -o for pictures only" if given else "give --size"
        raise InputError(f"{path.cameras or scene}: {problem}, so they make no video: {hint}")
    holes: list[float] = []
    with results_folder(target.parent, [*names, target.name]), reporter.stage("video") as step:

        def frames() -> Iterator[Tensor]:
            """The frames of the video, each also saved as a picture if pictures are wanted."""
            for index, camera in enumerate(cameras):
                with torch.no_grad():
                    eyes = [maker.sized(eye) for eye in maker.eyes(camera)]
                    views = [renderer.render([part], eye) for part in parts for eye in eyes]
                    frame = maker.frame(views)
                holes.append(max(hole_area_ratio(view.alpha) for view in views[-len(eyes) :]))
                if names:
                    save_png(frame, target.parent / names[index])
                yield frame
                step(index + 1, len(cameras))

        if problem:
            for _ in frames():
                pass
        else:
            save_video(frames(), target, path.video.rate, path.video.loop)
    seconds = reporter.seconds["video"]
    result = {"gaussians": len(gaussians), "frames": len(cameras), "seconds": seconds, "open": round(max(holes), 5)}
    if max(holes) > TOLERATED:
        mean = sum(holes) / len(holes)
        nearer = ": a smaller --disparity shows fewer" if not given and keyframes is None else ""
        reporter.log(f"{scene.name}: holes take up to {max(holes):.1%} of a frame, {mean:.1%} on average{nearer}")
    if problem:
        reporter.log(f"{path.cameras}: {problem}: pictures only, no video")
        reporter.result({"folder": output, **result})
    else:
        count = f"{len(gaussians):,} Gaussians, {len(cameras)} frames"
        reporter.log(f"{scene.name}: {count} in {seconds:.1f} s -> {target}")
        reporter.result({"file": target, **result})


def _photo_camera(file: SceneFile, size: tuple[int, int] | None, lens: Mapping[str, float | None]) -> Camera:
    """The stored camera; a given lens replaces the stored one, and 30 mm a missing one."""
    stored = file.camera
    if stored is not None and all(value is None for value in lens.values()):
        return stored
    width, height = size or ((stored.width, stored.height) if stored else DEFAULT_SIZE)
    focal, _ = focal_length(file.path, width, height, {}, focal_mm=None, **lens)
    return Camera.from_focal(focal, width, height)


def export_scene(scene: Path, outputs: Sequence[Path], reporter: Reporter) -> None:
    """Write a scene to each output in the format of its suffix; a file is written whole or not at all.

    Raises InputError for a scene or name that cannot be used, and for a scene too large for a format.
    """
    encoders = [encoder_of(output, PAGE) for output in outputs]
    with contextlib.ExitStack() as folders:
        for output in outputs:
            folders.enter_context(results_folder(output.parent, [output.name]))
        targets = [check_writable(output) for output in outputs]
        for output, target in zip(outputs, targets, strict=True):
            if targets.count(target) > 1:
                raise InputError(f"{output}: named twice: give each output once")
        if os.path.realpath(scene) in map(str, targets):
            raise InputError(f"{scene}: is the scene itself, which would be overwritten: give the output another name")
        loaded = load_scene(scene)
        if rest := loaded.harmonics:
            reporter.log(
                f"{scene}: {rest} spherical harmonics of each Gaussian are left out: its colour is that of degree 0"
            )
        for output, encoder in zip(outputs, encoders, strict=True):
            start = time.perf_counter()
            try:
                write_whole(output, encoder(loaded))
            except InputError as error:
                raise error if str(output) in str(error) else InputError(f"{output}: {error}") from error
            _report_file(loaded, output, time.perf_counter() - start, reporter)


def _report_file(scene: SceneFile, output: Path, seconds: float, reporter: Reporter) -> None:
    """Log one line about a file, and one about what its format cannot store."""
    before, size, count = os.path.getsize(scene.path), os.path.getsize(output), len(scene.gaussians)
    factor = f"{before / size:.1f} times smaller than" if size < before else f"{size / before:.1f} times the size of"
    if 0.95 < size / before < 1.05:
        factor = "as large as"
    reporter.log(f"{output}: {count:,} Gaussians, {decimal(size)}, {factor} {scene.path.name}, {seconds:.1f} s")
    bits, far = spz_grid(scene.gaussians) if output.name.lower().endswith(".spz") else (0, 0)
    if far:
        reach = f"{LARGEST / 2**bits:,.0f} m"
        reporter.log(
            f"{output}: {far:,} Gaussians beyond {reach} were moved nearer, which does not change the photo's own view"
        )
    seconds = round(seconds, 3)
    reporter.result({"file": output, "gaussians": count, "bytes": size, "seconds": seconds, "drawn_nearer": far})


def page_name(path: Path) -> str:
    """A scene's name on the page: the folder's name for a file called scene.ply or base.ply, else the file's name."""
    place = path.absolute()
    return place.parent.name if place.name in ("scene.ply", "base.ply") and place.parent.name else place.stem
