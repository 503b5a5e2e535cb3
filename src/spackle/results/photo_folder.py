"""Write a photo's scene, video and report to a folder; used by the command line and the server.

Read `predict_photo` first. `PhotoReport` is what report.json says.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import spackle
from spackle.bases import BasePrediction
from spackle.bases.open import ResolvedBase
from spackle.core.photo import Photo, load_photo
from spackle.depth.writers import save_depth
from spackle.formats import save_gray_png, save_ply, save_png
from spackle.pipeline import CompletedPhoto, Pipeline
from spackle.render import Renderer
from spackle.residual import hole_mask
from spackle.runtime.digests import file_records
from spackle.runtime.files import write_atomic, write_json
from spackle.runtime.folders import atomic_files, results_folder
from spackle.runtime.progress import Progress, Reporter
from spackle.scene import Scene, ViewHoles
from spackle.video.encoding import save_video

REPORT_NAME = "report.json"
SCENE_NAME = "scene.ply"
PAGE_NAME = "scene.html"  # viewer and scene in one file
VIEWS_NAME = "views"  # the folder with pictures of given views


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotoOptions:
    """How to read a photo, and which files to write; all other options belong to the pipeline."""

    lens: Mapping[str, float | None]  # `focal_px`, `focal_mm` and `fov`, as `load_photo` takes them
    render: bool = True  # write a video
    keep_base: bool = False  # write base.ply, the Gaussians of what the photo shows
    depth_out: str | None = None  # write the photo's depth to a file of this name
    keep_frame: bool = False  # keep a uniform frame around the photo
    # Leave the times out of report.json, whose bytes then depend on input and options alone.
    timeless_report: bool = False
    # Files of Gaussians: those of the whole scene, such as scene.spz, and of the base, base.ply.
    gaussian_files: tuple[str, ...] = (SCENE_NAME,)
    views: bool = True  # write pictures of the views that the user gives, if any

    @property
    def all_gaussian_files(self) -> tuple[str, ...]:
        """The names of all files of Gaussians."""
        return (*self.gaussian_files, "base.ply") if self.keep_base else self.gaussian_files


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunReport:
    """What the reports of photos and of clips have in common."""

    focal_px: float  # in pixels of the scene's camera
    focal_source: str  # such as "EXIF"
    base: str  # the base's name, such as "sharp"
    base_reason: str  # why this base
    base_gaussians: int
    passed_over: tuple[str, ...]  # better bases that could not be used, each with the error
    weights: str  # of the network that fills holes: "shipped", a file, "initial" or "none"
    views: str  # the trajectory, or the name of the file with views or keyframes
    disparity_source: str | None  # "disparity": by the option; "photo": chosen; None: no trajectory
    seconds: Mapping[str, float]  # duration of each stage

    @property
    def total_seconds(self) -> float:
        """The duration of all stages together."""
        return round(sum(self.seconds.values()), 3)

    def to_json(self) -> dict[str, Any]:
        """The fields as report.json has them."""
        base: dict[str, Any] = {
            "name": self.base,
            "chosen": self.base_reason,
            "gaussians": self.base_gaussians,
        }
        # Only a base chosen by "auto" can have had better ones before it.
        if self.passed_over:
            base["passed_over"] = list(self.passed_over)
        return {
            "spackle": spackle.__version__,
            "focal_px": round(self.focal_px, 3),
            "focal_source": self.focal_source,
            "base": base,
            "residual": {"weights": self.weights},
            "views": self.views,
            "disparity_source": self.disparity_source,
            "seconds": {**self.seconds, "total": self.total_seconds},
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotoReport:
    """What report.json says about a photo's results."""

    run: RunReport
    base_notes: Mapping[str, float | int | str]  # what the base measured, filled or assumed
    texture: str  # in the holes: "network", "exemplar", "lama" or "none"
    # "scene": one set of aux Gaussians for all views; "view", "paper": one set for each view
    mode: str
    disparity: float | None  # size of the camera's movement; None for given views and keyframes
    video: Mapping[str, object] | None  # file, frames and size of the video, if one was written
    holes: tuple[ViewHoles, ...]  # of the reported views: the widest, the keyframes, or the given
    request: str | None  # digest of the input and options; None: predict again in the next run
    photo_name: str
    photo_size: tuple[int, int]  # width and height of the scene's camera, in pixels
    frame_cut_off: Mapping[str, int] | None  # widths of the uniform frame that was cropped
    aux_gaussians: int  # number of Gaussians added in holes
    # In the modes view and paper: the view whose aux Gaussians scene.ply holds.
    saved_view: str | None
    files: Mapping[str, Mapping[str, object]]  # size and SHA-256 of each file, by name

    @property
    def aux_ratio(self) -> float:
        """The number of aux Gaussians as a share of the base's."""
        return self.aux_gaussians / self.run.base_gaussians

    @property
    def hole_ratio_before(self) -> float:
        """The mean share of holes in the base, over the reported views."""
        return sum(view.before for view in self.holes) / len(self.holes)

    @property
    def hole_ratio_after(self) -> float:
        """The mean share of holes that completion leaves, over the reported views."""
        return sum(view.after for view in self.holes) / len(self.holes)

    def to_json(self) -> dict[str, Any]:
        """The content of report.json.

        Names and order of the fields are published, so other programs may rely on them.
        """
        # First the fields that the reports of photos and of clips have in common.
        report = self.run.to_json()
        report["base"] |= self.base_notes
        report["residual"]["fill"] = self.texture
        report["merged"] = self.run.base_gaussians + self.aux_gaussians  # number in scene.ply
        report["mode"] = self.mode
        report["disparity"] = self.disparity
        report["video"] = self.video
        report["hole_area_ratio"] = [dataclasses.asdict(view) for view in self.holes]
        report["request"] = self.request

        # The size at which the photo was processed; its file may be larger.
        width, height = self.photo_size
        report["photo"] = {"file": self.photo_name, "width": width, "height": height}
        if self.frame_cut_off is not None:
            report["photo"]["frame_cut_off"] = dict(self.frame_cut_off)
        report["aux"] = {"gaussians": self.aux_gaussians, "share": self.aux_ratio}
        if self.saved_view is not None:
            report["scene_ply_view"] = self.saved_view
        report["files"] = dict(self.files)
        return report


def predict_photo(
    path: Path,
    folder: Path,
    pipeline: Pipeline,
    reporter: Reporter,
    options: PhotoOptions,
    request: str | None = None,
) -> PhotoReport:
    """Turn a photo into scene.ply, report.json and the files that the options add.

    The files appear in the folder together, once all are complete.

    Args:
        path: the photo.
        folder: where the files go.
        pipeline: the opened base, network and renderer, and the options of the scene.
        reporter: gets messages, progress and the result.
        options: which files to write.
        request: a digest of the input and options, which the report stores.

    Returns:
        The content of report.json.

    Raises:
        InputError: the photo, its depth map or the folder cannot be used.
    """
    reporter = reporter.restarted()  # the report's times are those of this photo alone

    # A depth map or cameras that the user gives belong to the whole photo. So its uniform frame,
    # such as a scan's margin, must not be cropped.
    keep_frame = options.keep_frame or pipeline.options.has_given_geometry
    with reporter.stage("load"):
        photo = load_photo(path, keep_frame=keep_frame, **options.lens)

    with contextlib.ExitStack() as folders:
        # Whether all files can be written has to be known before minutes of work. The lock keeps a
        # second run out of this photo's folder.
        names = _result_names(pipeline, options)
        folders.enter_context(results_folder(folder, names, locked=True))
        picture_names = _picture_names(pipeline) if options.views else []
        if picture_names:
            folders.enter_context(results_folder(folder / VIEWS_NAME, picture_names))

        completed = pipeline.complete(photo, reporter)

        # The files are written into a temporary folder, and moved at the end, the report last: who
        # sees a report sees complete results.
        new_folder = folders.enter_context(atomic_files(folder, REPORT_NAME))
        video = _write_files(completed, new_folder, pipeline, reporter, options)
        report = _report_of(completed, new_folder, pipeline, reporter, video, request)
        content = report.to_json()
        if options.timeless_report:
            del content["seconds"]
        write_json(content, new_folder / REPORT_NAME)

    reporter.log(
        f"{path.name}: {report.aux_gaussians:,} aux Gaussians "
        f"({report.aux_ratio:.1%} of the base's number, residual weights: {report.run.weights}), "
        f"holes {report.hole_ratio_before:.2%} -> {report.hole_ratio_after:.3%}, "
        f"{report.run.total_seconds:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report.to_json()})
    return report


def _result_names(pipeline: Pipeline, options: PhotoOptions) -> list[str]:
    """The names of the files that `predict_photo` writes, without the pictures of given views."""
    names = [*options.all_gaussian_files, REPORT_NAME]
    if options.render:
        names.append(_video_name(pipeline))
    if options.depth_out is not None:
        names.append(options.depth_out)
    return names


def _video_name(pipeline: Pipeline) -> str:
    """The name of a photo's video, such as "video.mp4"."""
    return f"video{pipeline.options.path.video.suffix}"


def _picture_names(pipeline: Pipeline) -> list[str]:
    """The names of the pictures of given views; empty for a path."""
    names: list[str] = []
    given_cameras = pipeline.given_path.cameras
    view_count = 0 if given_cameras is None else len(given_cameras.cameras)
    for index in range(view_count):
        names += [f"{index:04d}.png", f"{index:04d}_base.png", f"{index:04d}_mask.png"]
    return names


def _write_files(
    completed: CompletedPhoto,
    folder: Path,
    pipeline: Pipeline,
    reporter: Reporter,
    options: PhotoOptions,
) -> dict[str, object] | None:
    """Write all files of a photo but its report.

    Returns the report's entry for the video, or None if no video is written.
    """
    scene = completed.scene
    views = completed.views
    with reporter.stage("write"):
        for name in options.all_gaussian_files:
            _write_gaussians(scene, folder / name, completed.photo.path.stem)
        if options.depth_out is not None:
            save_depth(scene.depth_map(pipeline.renderer), folder / options.depth_out)

    video_entry = None
    if options.render:
        video_name = _video_name(pipeline)
        # All views of a video have one size, so the first frame's first view tells it.
        first_view = views.cameras[views.frames[0][0]]
        video_entry = views.frame_maker.report_entry(video_name, first_view, len(views.frames))
        with reporter.stage("video") as progress:
            save_planned_video(completed, folder / video_name, pipeline.renderer, progress)

    if views.given_view_count and options.views:
        (folder / VIEWS_NAME).mkdir()
        with reporter.stage("views") as progress:
            _save_pictures(completed, folder / VIEWS_NAME, pipeline.renderer, progress)
    return video_entry


def _write_gaussians(scene: Scene, path: Path, title: str) -> None:
    """Write a scene, or of a file whose name begins with "base" its base alone.

    The suffix decides the format; `title` is that of a page.
    """
    if path.name == PAGE_NAME:
        write_atomic(path, scene.page_file(title))
        return
    # A scene without what was added is that of its base.
    has_aux = not path.name.startswith("base.")
    shown = scene if has_aux else dataclasses.replace(scene, aux=scene.aux.select(slice(0, 0)))
    # A PLY is written in parts, and so needs little memory.
    if path.name in (SCENE_NAME, "base.ply"):
        save_ply(
            shown.gaussians,
            path,
            camera=scene.camera,
            # The Gaussians after this number are those that completion has added.
            base_count=len(scene.base),
            disparity=scene.disparity,
            is_metric=scene.is_metric,
        )
        return
    shown.export(path)


def save_planned_video(
    completed: CompletedPhoto, path: Path, renderer: Renderer, progress: Progress
) -> None:
    """Write the video of a photo's planned views, which have one size.

    InputError if the file cannot be written.
    """
    views = completed.views
    scene = completed.scene
    frame_maker = views.frame_maker

    def render_frames() -> Iterator[Tensor]:
        """Each frame [H, W, 3] sRGB, as the encoder asks for it: uint8, or floats in 0..1."""
        for frame_index, eye_views in enumerate(views.frames):
            # While it filled holes, the fill has rendered some views of the finished scene, and
            # kept their pictures. There are such pictures only for videos with one eye, so the
            # first eye's view is the whole frame.
            picture = completed.filled.pictures.get(eye_views[0])
            if picture is not None:
                yield picture
            else:
                with torch.no_grad():
                    renderings = [
                        renderer.render(
                            scene.of_view(view), frame_maker.resized_camera(views.cameras[view])
                        )
                        for view in eye_views
                    ]
                    yield frame_maker.frame(renderings)
            progress(frame_index + 1, len(views.frames))

    video = frame_maker.options
    save_video(render_frames(), path, video.frames_per_second, video.loop)


@torch.no_grad()
def _save_pictures(
    completed: CompletedPhoto, folder: Path, renderer: Renderer, progress: Progress
) -> None:
    """Write three PNG files for each view that the user gave.

    0000.png is the completed view, 0000_base.png the view before, 0000_mask.png its holes in white.
    """
    views = completed.views
    scene = completed.scene
    # The given views are the first of the planned views.
    for index in range(views.given_view_count):
        camera = views.cameras[index]
        before = renderer.render(scene.base, camera)
        after = renderer.render(scene.of_view(index), camera)
        holes = hole_mask(before.alpha).to(torch.float32)
        save_png(after.rgb, folder / f"{index:04d}.png")
        save_png(before.rgb, folder / f"{index:04d}_base.png")
        save_gray_png(holes, folder / f"{index:04d}_mask.png")
        progress(index + 1, views.given_view_count)


def _report_of(
    completed: CompletedPhoto,
    folder: Path,
    pipeline: Pipeline,
    reporter: Reporter,
    video: Mapping[str, object] | None,
    request: str | None,
) -> PhotoReport:
    """The report of a completed photo.

    Args:
        completed: the scene, and all from which it was made.
        folder: has all files but the report; their sizes and digests are part of the report.
        pipeline: the pipeline, whose options are reported.
        reporter: the reporter that timed the stages.
        video: the report's entry for the video; None without a video.
        request: a digest of the input and options, by which the next run knows finished photos.
    """
    photo = completed.photo
    predicted = completed.predicted
    scene = completed.scene
    assert scene.report is not None  # `Pipeline.complete` always makes one
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return PhotoReport(
        run=report_run(photo, predicted.prediction, predicted.base, pipeline, reporter),
        base_notes=predicted.prediction.notes,
        texture=pipeline.options.fill.texture,
        mode=pipeline.options.fill.mode,
        disparity=scene.disparity,
        video=video,
        holes=scene.report.holes,
        # If a better base only lacked memory, this result is not for good: without a request the
        # next run does not take the photo as finished, and tries the better base again.
        request=request if predicted.base.lasting else None,
        photo_name=photo.path.name,
        photo_size=(scene.camera.width, scene.camera.height),
        # Widths in pixels by side, from a named tuple.
        frame_cut_off=None if photo.frame is None else photo.frame._asdict(),
        aux_gaussians=len(scene.aux),
        saved_view=completed.filled.saved_view,
        files=file_records(folder, files),
    )


def report_run(
    photo: Photo,
    prediction: BasePrediction,
    base: ResolvedBase,
    pipeline: Pipeline,
    reporter: Reporter,
) -> RunReport:
    """What the reports of photos and of clips have in common, after all stages are done.

    Args:
        photo: the photo, or the clip's first frame.
        prediction: what the base made of it.
        base: which base it was, and why.
        pipeline: the pipeline, whose options are reported.
        reporter: the reporter that timed the stages.
    """
    path = pipeline.options.path
    given_file = path.cameras or path.path

    # What decided how far the camera moves. With a file of views or keyframes there is no such
    # choice; else it is the photo's content ("photo"), or the option `disparity`.
    if given_file is not None:
        disparity_source = None
    elif path.disparity is None:
        disparity_source = "photo"
    else:
        disparity_source = "disparity"
    return RunReport(
        focal_px=prediction.camera.focal[0],
        focal_source=prediction.lens_source or photo.focal_source.value,
        base=base.name,
        base_reason=base.reason,
        base_gaussians=len(prediction.gaussians),
        passed_over=base.failures,
        weights=pipeline.options.fill.weights_name,
        views=path.trajectory if given_file is None else given_file.name,
        disparity_source=disparity_source,
        seconds=dict(reporter.seconds),
    )


def read_earlier_report(folder: Path) -> dict[str, Any]:
    """The content of an earlier run's report.json; empty if the file is missing or damaged."""
    # A damaged report is no error, because the photo is then simply predicted again.
    try:
        report = json.loads((folder / REPORT_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return report if isinstance(report, dict) else {}
