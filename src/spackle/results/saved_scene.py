"""A saved scene as a video, and in the formats of other viewers.

Read `render_scene` or `export_scene`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import mimetypes
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.filesize import decimal
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.focal_length import ASSUMED_FOCAL_MM
from spackle.core.gaussians import Gaussians
from spackle.core.keyframes import PathError
from spackle.core.spherical_harmonics import degree_of_count
from spackle.formats import save_png
from spackle.formats.scene_content import SceneFile, harmonics_loss
from spackle.formats.scene_files import Encoder, encoder_for, load_scene
from spackle.formats.sog import META_NAME
from spackle.formats.spz import MAX_GRID_COORDINATE, spz_grid
from spackle.formats.stored_precision import count_coarse
from spackle.render import Renderer, get_renderer
from spackle.residual import hole_area_ratio
from spackle.runtime.errors import InputError, as_input_error, unknown_suffix
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Progress, Reporter
from spackle.scene import Scene
from spackle.video.encoding import save_video
from spackle.video.frames import FrameMaker, video_problem
from spackle.video.options import VideoOptions
from spackle.video.video_formats import VIDEO_FORMATS
from spackle.views import PathOptions

MAX_UNMENTIONED_HOLES = 0.01  # the log mentions holes that take a larger share of a frame
NO_PATH_MESSAGE = "no camera path: {reason}: give views with `cameras`"


# Names of pages that say nothing about the picture.
NAMES_WITHOUT_MEANING = ("scene", "page", "index")


def encode_page(file: SceneFile, output: Path | None = None, caption: str = "") -> bytes:
    """The bytes of an HTML file that shows the scene and its motion, to be sent to somebody.

    Args:
        file: the scene.
        output: the file that will be written, whose name is the page's title. None, or a name that
            says nothing: the scene's name is the title.
        caption: a text below the picture; empty for none.
    """
    title = page_name(file.path)
    if output is not None and output.stem not in NAMES_WITHOUT_MEANING:
        title = output.stem
    return Scene.of_file(file).page_file(title, caption=caption)


# Formats in which a Gaussian has one colour.
SUFFIXES_WITHOUT_HARMONICS = (".splat",)
PAGE_ENCODERS: dict[str, Encoder] = {".html": encode_page}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneVideo:
    """What the frames of a video of a scene are made of."""

    cameras: list[Camera]  # of the frames; in a stereo video, midway between the eyes
    has_given_views: bool  # the cameras come from a file of views, not from a path
    frame_maker: FrameMaker  # makes a frame from the renderings of its eyes or sets
    # The scene as one list of sets of Gaussians; for a comparison two: the base, and the scene.
    gaussian_sets: list[list[Gaussians]]
    gaussian_count: int  # of the whole scene
    renderer: Renderer
    hole_ratios: list[float] = dataclasses.field(default_factory=list)  # of the frames so far

    def frames(self, picture_files: Sequence[Path], progress: Progress) -> Iterator[Tensor]:
        """Render each frame [H, W, 3] sRGB, and append its share of holes to `hole_ratios`.

        Args:
            picture_files: a PNG file for each frame, which is also written; or none at all.
            progress: called with (frames done, all frames).
        """
        for index, camera in enumerate(self.cameras):
            frame, renderings = self.frame_maker.render(self.gaussian_sets, camera, self.renderer)
            # In a comparison the first rendering shows the base alone. Its holes do not count,
            # because completion has filled them.
            completed = renderings[1:] if self.frame_maker.options.compare else renderings
            self.hole_ratios.append(max(hole_area_ratio(view.alpha) for view in completed))
            if picture_files:
                save_png(frame, picture_files[index])
            yield frame
            progress(index + 1, len(self.cameras))


def render_scene(
    scene_file: Path,
    output: Path,
    path: PathOptions,
    reporter: Reporter,
    *,
    focal_px: float | None = None,
    fov: float | None = None,
    device: str = "auto",
) -> None:
    """Render a scene along a path to a video; given views also become pictures in a folder.

    Args:
        scene_file: the scene.
        output: a video file, or a folder, in which the video gets the scene's name.
        path: the options of camera path and video.
        reporter: gets messages, progress and the result.
        focal_px: a focal length in pixels of the video, instead of the stored one.
        fov: a horizontal field of view in degrees, instead of the stored focal length.
        device: "auto", "cpu" or "cuda".

    Raises:
        InputError: a file or option cannot be used.
    """
    # Impossible options are refused before a scene, which may be large, is read.
    is_video_file = output.suffix.lower() in VIDEO_FORMATS
    if is_video_file:
        path = dataclasses.replace(path, video=path.video.for_file(output))
    else:
        _check_is_folder_name(output)
    path.check()
    _check_lens(path, focal_px, fov)
    renderer = get_renderer(device)
    with reporter.stage("load"):
        video = _open_scene_video(scene_file, path, renderer, reporter, focal_px=focal_px, fov=fov)

    # Given views may differ in size. No video can show them then, but pictures in a folder can.
    makes_pictures = video.has_given_views and not is_video_file
    problem = video_problem([video.frame_maker.resized_camera(camera) for camera in video.cameras])
    if problem and not makes_pictures:
        hint = "give `size`"
        if video.has_given_views:
            hint = "give `size`, or a folder with `output` for pictures only"
        raise InputError(
            f"{path.cameras or scene_file}: {problem}, so no video can be made: {hint}"
        )

    video_file = output if is_video_file else output / f"{scene_file.stem}{path.video.suffix}"
    picture_names: list[str] = []
    if makes_pictures:
        picture_names = [f"{index:04d}.png" for index in range(len(video.cameras))]
    _write_frames(
        video, video_file, picture_names, path.video, reporter, writes_video=problem is None
    )

    result = _report_frames(video, scene_file, reporter)
    if problem is not None:
        reporter.log(f"{path.cameras}: {problem}: pictures only, no video")
        reporter.result({"folder": output, **result})
        return
    reporter.log(
        f"{scene_file.name}: {video.gaussian_count:,} Gaussians, {len(video.cameras)} frames "
        f"in {reporter.seconds['video']:.1f} s -> {video_file}"
    )
    reporter.result({"file": video_file, **result})


def _report_frames(video: SceneVideo, scene_file: Path, reporter: Reporter) -> dict[str, object]:
    """Log a line if a rendered frame has large holes.

    Returns:
        The fields of the JSON result that do not depend on where the frames were written:
        counts, duration, and as "open" the share of holes in the frame that has most of them.
    """
    most_holes = max(video.hole_ratios)
    if most_holes > MAX_UNMENTIONED_HOLES:
        reporter.log(f"{scene_file.name}: holes take up to {most_holes:.1%} of a frame")
    return {
        "gaussians": video.gaussian_count,
        "frames": len(video.cameras),
        "seconds": reporter.seconds["video"],
        "open": round(most_holes, 5),
    }


def _check_lens(path: PathOptions, focal_px: float | None, fov: float | None) -> None:
    """InputError if a focal length is given for views of a file, which have their own."""
    has_new_lens = focal_px is not None or fov is not None
    if path.cameras is not None and has_new_lens:
        raise InputError(
            f"`cameras` {path.cameras}: its views have their own lenses: "
            "leave `fov` and `focal_px` out"
        )


def _write_frames(
    video: SceneVideo,
    video_file: Path,
    picture_names: Sequence[str],
    options: VideoOptions,
    reporter: Reporter,
    *,
    writes_video: bool,
) -> None:
    """Render all frames, and write them as a video, as pictures, or as both.

    Args:
        video: what the frames are made of; their holes are noted in it.
        video_file: the video; the pictures lie beside it.
        picture_names: a name for each frame's picture, or none for no pictures.
        options: of the video.
        reporter: gets the progress.
        writes_video: False if the frames cannot be a video.
    """
    folder = video_file.parent
    file_names = [*picture_names, video_file.name]
    with results_folder(folder, file_names), reporter.stage("video") as progress:
        frames = video.frames([folder / name for name in picture_names], progress)
        if writes_video:
            save_video(frames, video_file, options.frames_per_second, options.loop)
        else:
            # Frames are rendered, and their pictures written, only as somebody takes them.
            for _ in frames:
                pass


def _open_scene_video(
    scene_file: Path,
    path: PathOptions,
    renderer: Renderer,
    reporter: Reporter,
    *,
    focal_px: float | None,
    fov: float | None,
) -> SceneVideo:
    """Load a scene, and choose the cameras of its video; arguments as for `render_scene`.

    InputError if the scene or a file of cameras cannot be used, or the scene allows no path.
    """
    given_path = path.load()
    loaded = load_scene(scene_file)
    log_losses(loaded, reporter)
    given = given_path.in_scene(loaded, page_name(scene_file))
    for line in given.notes:
        reporter.log(line)
    scene = Scene.of_file(loaded, path.video.size, focal_px=focal_px, fov=fov)
    gaussian_sets = _sets_to_render(scene, scene_file, compare=path.video.compare)

    # Overscan, a little zoom, hides the fill beyond the photo's border. With another lens the
    # border lies elsewhere, and a scene that was not completed for a path has no such fill.
    has_new_lens = focal_px is not None or fov is not None
    if has_new_lens or scene.disparity is None:
        path = dataclasses.replace(path, overscan=0)

    # A ValueError comes from the scene's depths; a PathError from the file of keyframes, and its
    # own text ("{reason}") is the message.
    with (
        as_input_error(scene_file, NO_PATH_MESSAGE, ValueError),
        as_input_error(path.path, "{reason}", PathError),
    ):
        cameras = given.views
        if cameras is None:
            framing = None  # keyframes say themselves what is in the frame
            if given.keyframes is None:
                framing = path.choose_framing(
                    scene.base, scene.camera, scene.depth_range, scene.disparity, renderer
                )
            cameras = path.video_cameras(
                scene.depth_range, scene.camera, given.keyframes, scene.disparity, framing
            )

    _say_if_beyond_completion(scene, scene_file, path, reporter)
    if not given.views and loaded.camera is None and not has_new_lens:
        reporter.log(
            f"{scene_file.name}: no camera stored: {ASSUMED_FOCAL_MM:g} mm assumed, "
            "`fov` gives another lens"
        )
    return SceneVideo(
        cameras=cameras,
        has_given_views=bool(given.views),
        frame_maker=FrameMaker.of(
            path.video, scene.base, cameras, scene_file, is_metric=scene.is_metric
        ),
        gaussian_sets=gaussian_sets,
        gaussian_count=len(loaded.gaussians),
        renderer=renderer,
    )


def _check_is_folder_name(output: Path) -> None:
    """InputError if the name of a folder looks like that of a video or picture.

    Who gives "scene.avi" wants a file of this kind, which cannot be written, and not a folder.
    """
    mime_type = mimetypes.guess_type(output.name)[0] or ""  # such as "video/x-msvideo"
    if mime_type.startswith(("video/", "image/")):
        raise unknown_suffix(output, "not a kind of video that can be written", [*VIDEO_FORMATS])


def _sets_to_render(scene: Scene, scene_file: Path, *, compare: bool) -> list[list[Gaussians]]:
    """What a frame shows, one entry for each picture in it.

    An entry is the list of sets of Gaussians that are rendered together. A frame shows one picture,
    of the whole scene (base and aux Gaussians). For a comparison it shows two: first the base
    alone, then the whole scene. InputError if there is nothing to compare, because the scene was
    never completed.
    """
    if not compare:
        return [[scene.base, scene.aux]]
    if not len(scene.aux):
        raise InputError(
            f"{scene_file}: `compare` needs a completed scene, "
            "such as the scene.ply of `spackle predict`"
        )
    return [[scene.base], [scene.base, scene.aux]]


def _say_if_beyond_completion(
    scene: Scene, scene_file: Path, path: PathOptions, reporter: Reporter
) -> None:
    """Log a line if the camera moves farther than the scene was completed for.

    Such views may show holes, which only a new prediction from the photo can fill.
    """
    # Not known for the scene of another program, or not given as an option.
    if scene.disparity is None or path.disparity is None or path.disparity <= scene.disparity:
        return
    option = f"`disparity` {path.disparity:g}"
    reporter.log(
        f"{scene_file.name}: {option} goes beyond the {scene.disparity:g} for which the scene was "
        f"completed: `spackle predict --disparity {path.disparity:g}` completes a photo that far"
    )


def export_scene(
    scene_file: Path, outputs: Sequence[Path], reporter: Reporter, *, caption: str = ""
) -> None:
    """Write a scene to each output in the format of its suffix; each file whole or not at all.

    Args:
        scene_file: the scene.
        outputs: the files to write.
        reporter: gets messages and results.
        caption: a text below the picture of a page; empty for none.

    Raises:
        InputError: a scene or name cannot be used, the scene is too large for a format, or there
            is a caption, but no page.
    """
    encoders = []
    for output in outputs:
        page_encoder = functools.partial(encode_page, output=output, caption=caption)
        encoders.append(encoder_for(output, {".html": page_encoder}))
    if caption and not any(output.name.lower().endswith(".html") for output in outputs):
        raise InputError("`caption` is for pages: give an `output` that ends in .html")
    with contextlib.ExitStack() as folders:
        # All names have to be known as good before the first file is written.
        for output in outputs:
            folders.enter_context(results_folder(output.parent, [output.name]))
            if os.path.realpath(output) == os.path.realpath(scene_file):
                raise InputError(
                    f"{output}: this is the scene itself: give the output another name"
                )

        loaded = load_scene(scene_file)
        log_losses(loaded, reporter)

        # Each file is written whole before the next format is encoded, which saves memory.
        for output, encode in zip(outputs, encoders, strict=True):
            start = time.perf_counter()
            try:
                content = encode(loaded)
            except InputError as error:  # the encoder does not know the file's name
                raise InputError(f"{output}: {error}") from error
            write_atomic(output, content)
            _report_file(loaded, output, time.perf_counter() - start, reporter)


def log_losses(scene: SceneFile, reporter: Reporter) -> None:
    """Log a line for each thing that was left out or assumed when a scene was read."""
    for loss in scene.losses:
        reporter.log(f"{scene.path.name}: {loss}")


def _report_file(scene: SceneFile, output: Path, seconds: float, reporter: Reporter) -> None:
    """Log a line about a written file, and others about Gaussians that its format cannot keep.

    `seconds` is the time that encoding and writing took.
    """
    size = os.path.getsize(output)
    count = len(scene.gaussians)
    reporter.log(
        f"{output}: {count:,} Gaussians, {decimal(size)}, "
        f"{size / scene.byte_count:.0%} of the size of {scene.path.name}, {seconds:.1f} s"
    )

    degree = degree_of_count(scene.gaussians.harmonics_count)
    if degree > 0 and output.name.lower().endswith(SUFFIXES_WITHOUT_HARMONICS):
        reporter.log(f"{output}: {harmonics_loss(degree)}")

    # SPZ rounds positions to a grid, which does not reach as far as some Gaussians of a sky lie.
    # The encoder moves them nearer and shrinks them by the same factor, so they look the same from
    # the photo's place.
    moved_count = 0
    if output.name.lower().endswith(".spz"):
        grid = spz_grid(scene.gaussians)
        moved_count = grid.outside_count
        if moved_count:
            # The grid's step is 2 to the power of -fraction_bits.
            largest_coordinate = MAX_GRID_COORDINATE / 2**grid.fraction_bits
            reporter.log(
                f"{output}: {moved_count:,} Gaussians beyond {largest_coordinate:,.4g} m were "
                "moved nearer, which does not change the photo's view"
            )
    coarse_count = count_coarse(scene, output)
    if coarse_count:
        reporter.log(
            f"{output}: {coarse_count:,} of {count:,} Gaussians are too small or too close "
            "together for this format, and get a wrong place or size: .ply and .glb keep them"
        )
    reporter.result(
        {
            "file": output,
            "gaussians": count,
            "bytes": size,
            "seconds": round(seconds, 3),
            "drawn_nearer": moved_count,
            "coarse": coarse_count,
        }
    )


def page_name(path: Path) -> str:
    """A scene's name on the page: its file's name, or its folder's for names that many have."""
    # `spackle predict` calls every scene scene.ply; its folder has the photo's name. An unbundled
    # SOG scene is a folder, too.
    absolute_path = path.absolute()
    folder_name = absolute_path.parent.name
    if absolute_path.name in ("scene.ply", "base.ply", META_NAME) and folder_name:
        return folder_name
    return absolute_path.stem
