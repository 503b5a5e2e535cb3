"""`spackle render` and `spackle export`: a saved scene as a video, and in the formats that other viewers read."""

from __future__ import annotations

import contextlib
import dataclasses
import mimetypes
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from rich.filesize import decimal
from torch import Tensor

from spackle.core.focal_length import ASSUMED_FOCAL_MM
from spackle.core.keyframes import PathError
from spackle.formats import save_png
from spackle.formats.html import single_html
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import Encoder, encoder_for, load_scene
from spackle.formats.spz import MAX_GRID_COORDINATE, spz_grid
from spackle.render import get_renderer
from spackle.residual import hole_area_ratio
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.scene import Scene
from spackle.video.encoding import save_video
from spackle.video.frames import FrameMaker, video_problem
from spackle.video.video_formats import VIDEO_FORMATS
from spackle.views import PathOptions

TOLERATED = 0.01  # fraction of a frame that may be holes before the log mentions it
PAGE: dict[str, Encoder] = {
    ".html": lambda file: single_html(Scene.of_file(file).page(page_name(file.path)))
}


def render_scene(
    scene: Path,
    output: Path,
    path: PathOptions,
    lens: Mapping[str, float | None],
    device: str,
    reporter: Reporter,
) -> None:
    """Render a scene along a path to the video `output`, or to STEM.mp4 in the folder `output`.

    With --cameras, a folder also gets a PNG of each view. `lens` replaces the stored focal length: focal_px, in pixels
    of the video, or fov.

    Raises:
        InputError: a file or option cannot be used.
    """
    single = output.suffix.lower() in VIDEO_FORMATS
    if single:
        path = dataclasses.replace(path, video=path.video.for_file(output))
    elif (mimetypes.guess_type(output.name)[0] or "").startswith(("video/", "image/")):
        raise InputError(
            f"{output}: not a kind of video that can be written: end the name with {', '.join(VIDEO_FORMATS)}"
        )
    path.check()
    new_lens = any(value is not None for value in lens.values())
    if path.cameras is not None and new_lens:
        raise InputError(
            f"--cameras {path.cameras}: its views have their own lenses: leave --fov and --focal-px out"
        )
    renderer = get_renderer(device)
    with reporter.stage("load"):
        given, keyframes = path.load()
        loaded = load_scene(scene)
        whole = Scene.of_file(loaded, path.video.size, **lens)
        base, aux, reach = whole.base, whole.aux, whole.disparity
        if path.video.compare and not len(aux):
            raise InputError(
                f"{scene}: --compare needs a completed scene, such as the scene.ply of `spackle predict`"
            )
        parts = [[base]] * path.video.compare + [[base, aux]]
        if new_lens or reach is None:
            path = dataclasses.replace(path, overscan=0)
        impossible = "no camera path: {reason}: give views with --cameras"
        with (
            as_input_error(scene, impossible, ValueError),
            as_input_error(path.path, "{reason}", PathError),
        ):
            cameras = given or path.video_cameras(base, whole.camera, keyframes, reach)
        if reach is not None and (path.disparity or 0) > reach:
            far = f"--disparity {path.disparity:g}"
            reporter.log(
                f"{scene.name}: {far} goes beyond the {reach:g} for which the scene was completed: "
                f"`spackle predict {far}` completes a photo that far"
            )
        if not given and loaded.camera is None and not new_lens:
            reporter.log(
                f"{scene.name}: no camera stored: {ASSUMED_FOCAL_MM:g} mm assumed, --fov gives another lens"
            )
        maker = FrameMaker.of(path.video, base, cameras, scene)
    target = output if single else output / f"{scene.stem}{path.video.suffix}"
    names = [f"{index:04d}.png" for index in range(len(cameras))] if given and not single else []
    problem = video_problem([maker.resized_camera(camera) for camera in cameras])
    if problem and not names:
        hint = "give a folder with -o for pictures only" if given else "give --size"
        raise InputError(f"{path.cameras or scene}: {problem}, so no video can be made: {hint}")
    holes: list[float] = []
    with results_folder(target.parent, [*names, target.name]), reporter.stage("video") as step:

        def frames() -> Iterator[Tensor]:
            """Render the frames, and save each as a picture if pictures are wanted."""
            for index, camera in enumerate(cameras):
                frame, views = maker.render(parts, camera, renderer)
                completed = views[1:] if path.video.compare else views
                holes.append(max(hole_area_ratio(view.alpha) for view in completed))
                if names:
                    save_png(frame, target.parent / names[index])
                yield frame
                step(index + 1, len(cameras))

        if problem:
            for _ in frames():
                pass
        else:
            save_video(frames(), target, path.video.frames_per_second, path.video.loop)
    seconds, total = reporter.seconds["video"], len(loaded.gaussians)
    result = {
        "gaussians": total,
        "frames": len(cameras),
        "seconds": seconds,
        "open": round(max(holes), 5),
    }
    if max(holes) > TOLERATED:
        reporter.log(f"{scene.name}: holes take up to {max(holes):.1%} of a frame")
    if problem:
        reporter.log(f"{path.cameras}: {problem}: pictures only, no video")
        reporter.result({"folder": output, **result})
    else:
        count = f"{total:,} Gaussians, {len(cameras)} frames"
        reporter.log(f"{scene.name}: {count} in {seconds:.1f} s -> {target}")
        reporter.result({"file": target, **result})


def export_scene(scene: Path, outputs: Sequence[Path], reporter: Reporter) -> None:
    """Write a scene to each output in the format of its suffix; a file is written whole or not at all.

    Raises:
        InputError: a scene or name cannot be used, or the scene is too large for a format.
    """
    encoders = [encoder_for(output, PAGE) for output in outputs]
    with contextlib.ExitStack() as folders:
        for output in outputs:
            folders.enter_context(results_folder(output.parent, [output.name]))
            if os.path.realpath(output) == os.path.realpath(scene):
                raise InputError(
                    f"{output}: this is the scene itself: give the output another name"
                )
        loaded = load_scene(scene)
        if rest := loaded.unread_harmonics:
            reporter.log(
                f"{scene}: {rest} spherical harmonics of each Gaussian, above degree 0, are left out"
            )
        for output, encoder in zip(outputs, encoders, strict=True):
            start = time.perf_counter()
            try:
                data = encoder(loaded)
            except InputError as error:  # the encoder does not know the file's name
                raise InputError(f"{output}: {error}") from error
            write_atomic(output, data)
            _report_file(loaded, output, time.perf_counter() - start, reporter)


def _report_file(scene: SceneFile, output: Path, seconds: float, reporter: Reporter) -> None:
    """Log one line about a file, and one about what the format cannot store."""
    before, size, count = os.path.getsize(scene.path), os.path.getsize(output), len(scene.gaussians)
    share = f"{size / before:.0%} of the size of {scene.path.name}"
    reporter.log(f"{output}: {count:,} Gaussians, {decimal(size)}, {share}, {seconds:.1f} s")
    bits, far = spz_grid(scene.gaussians) if output.name.lower().endswith(".spz") else (0, 0)
    if far:
        reporter.log(
            f"{output}: {far:,} Gaussians beyond {MAX_GRID_COORDINATE / 2**bits:,.0f} m were moved nearer, which does not change "
            "the photo's view"
        )
    seconds = round(seconds, 3)
    reporter.result(
        {"file": output, "gaussians": count, "bytes": size, "seconds": seconds, "drawn_nearer": far}
    )


def page_name(path: Path) -> str:
    """A scene's name on the page: the folder's name for a file called scene.ply or base.ply, else the file's name."""
    place = path.absolute()
    return (
        place.parent.name
        if place.name in ("scene.ply", "base.ply") and place.parent.name
        else place.stem
    )
