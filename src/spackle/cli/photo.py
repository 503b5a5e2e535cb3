"""`spackle predict` of one photo: a scene, a video and a report in a folder. Read `predict_photo`."""

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
from spackle.bases.depth_map import DepthMap, calibrations_beside, find_depth
from spackle.bases.settings import AUTO, AUTO_NETWORKS, BaseSettings
from spackle.errors import InputError
from spackle.files import fingerprint, write_json
from spackle.folders import digest_of, file_records, results_folder, whole_set
from spackle.formats import save_gray_png, save_ply, save_png, save_video
from spackle.image import load_photo
from spackle.pipeline import CompletedPhoto, Options, Pipeline
from spackle.progress import Reporter, Step
from spackle.render import Renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.views import video_problem
from spackle.weights import installed

REPORT = "report.json"
Holes = list[dict[str, float | str]]  # of each measured view: its name, and its HAR before and after


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """The choices of `spackle predict`."""

    scene: Options
    lens: Mapping[str, float | None]  # `focal_px`, `focal_mm` and `fov`, as `load_photo` takes them
    render: bool = True  # write a video
    keep_frame: bool = False  # a uniform frame around a photo is part of it
    overwrite: bool = False  # in a folder, do again what is done already
    workers: int = 1  # processes that share a folder's photos
    threads: int | None = None  # of each
    ray: str | None = None  # the cluster where they are; this machine where None

    @property
    def files(self) -> tuple[str, ...]:
        """What a photo's folder gets, besides views/: the video is the last."""
        files = ("base.ply", "scene.ply", REPORT)
        return (*files, f"video{self.scene.path.video.suffix}") if self.render else files

    def open(self) -> Pipeline:
        """What all photos share; InputError for an option that cannot be used, whatever the photo."""
        pipeline, path = Pipeline.open(self.scene), self.scene.path
        for option, value in {
            "--format": path.video.format,
            "--fps": path.video.fps,
            "--loop": path.video.loop,
        }.items():
            if value is not None and not self.render:
                raise InputError(
                    f"{option} {value}: is for the video, and --no-render writes none: leave one of them out"
                )
        views = pipeline.given_views
        if self.render and views and (problem := video_problem(views)):
            raise InputError(f"{path.cameras}: {problem}, so they make no video: add --no-render for pictures only")
        return pipeline


def predict_photo(
    path: Path, folder: Path, options: PredictOptions, pipeline: Pipeline, reporter: Reporter, request: str
) -> None:
    """One photo to `folder`: base.ply, scene.ply, a video, report.json, and views/ with --cameras.

    The files take their places once all are whole. InputError for a photo, a depth map or a folder that cannot be used.
    """
    reporter = reporter.restarted()
    with reporter.stage("load"):
        photo = load_photo(path, keep_frame=options.keep_frame, **options.lens)
    with contextlib.ExitStack() as folders:
        pictures = _picture_files(len(pipeline.given_views or []))
        folders.enter_context(results_folder(folder, options.files, alone=True))
        if pictures:
            folders.enter_context(results_folder(folder / "views", pictures))
        done = pipeline.complete(photo, reporter)
        _warn_of_rougher(done, folder, options.scene.base, reporter)
        scene, views = done.scene, done.views
        new = folders.enter_context(whole_set(folder, REPORT))
        with reporter.stage("write"):
            for file, part in (("base.ply", scene.base), ("scene.ply", scene.gaussians)):
                save_ply(part, new / file, camera=scene.camera, base_count=len(scene.base), disparity=scene.disparity)
        video = None
        if options.render:
            video = views.maker.note(options.files[-1], views.cameras[views.frames[0][0]], len(views.frames))
            with reporter.stage("video") as step:
                save_views(done, new / options.files[-1], pipeline.renderer, step)
        if pictures:
            (new / "views").mkdir()
            with reporter.stage("views") as step:
                _save_pictures(done, new / "views", pipeline.renderer, step)
        with reporter.stage("measure"):
            holes = _measure_holes(done, pipeline.renderer)
        report = _report(done, pipeline, holes, video, request, reporter.seconds)
        report["files"] = file_records(new, sorted(file for file in new.rglob("*") if file.is_file()))
        write_json(report, new / REPORT)
    before, after = (sum(float(view[key]) for view in holes) / len(holes) for key in ("before", "after"))
    aux = report["aux"]
    reporter.log(
        f"{path.name}: {aux['gaussians']:,} aux Gaussians ({aux['share']:.1%}, {report['residual']['weights']}), "
        f"holes {before:.2%} -> {after:.3%}, {report['seconds']['total']:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report})


def save_views(done: CompletedPhoto, path: Path, renderer: Renderer, step: Step) -> None:
    """The frames of the planned views, all of one size; InputError for a file that cannot be written."""
    views, video = done.views, done.views.maker.options

    def frames() -> Iterator[Tensor]:
        for index, frame in enumerate(views.frames):
            if frame[0] in done.pictures:
                yield done.pictures[frame[0]]
            else:
                with torch.no_grad():
                    eyes = [renderer.render(done.scene.of_view(k), views.maker.sized(views.cameras[k])) for k in frame]
                    yield views.maker.frame(eyes)
            step(index + 1, len(views.frames))

    save_video(frames(), path, video.rate, video.loop)


def _picture_files(count: int) -> list[str]:
    """What `_save_pictures` writes for so many views."""
    return [f"{index:04d}{kind}.png" for index in range(count) for kind in ("", "_base", "_mask")]


@torch.no_grad()
def _save_pictures(done: CompletedPhoto, folder: Path, renderer: Renderer, step: Step) -> None:
    """Each given view as PNG: 0000.png completed, 0000_base.png before, 0000_mask.png its holes (white)."""
    for index, camera in enumerate(done.views.cameras[: done.views.stills]):
        before = renderer.render(done.scene.base, camera)
        save_png(renderer.render(done.scene.of_view(index), camera).rgb, folder / f"{index:04d}.png")
        save_png(before.rgb, folder / f"{index:04d}_base.png")
        save_gray_png(hole_mask(before.alpha).to(torch.float32), folder / f"{index:04d}_mask.png")
        step(index + 1, done.views.stills)


@torch.no_grad()
def _measure_holes(done: CompletedPhoto, renderer: Renderer) -> Holes:
    """HAR of the measured views (eq. 11), before and after completion."""
    rows: Holes = []
    for name, index in done.views.measured.items():
        before, after = (
            hole_area_ratio(renderer.render(parts, done.views.cameras[index]).alpha)
            for parts in (done.scene.base, done.scene.of_view(index))
        )
        rows.append({"view": name, "before": before, "after": after})
    return rows


def shared_digest(options: PredictOptions, pipeline: Pipeline) -> str:
    """A digest of what all photos share: version, options, and what their files hold; InputError for a missing file."""
    base, path, fill = options.scene.base, options.scene.path, options.scene.fill
    fields: dict[str, Any] = {**dataclasses.asdict(base), **dataclasses.asdict(path), **options.lens}
    for name in ("windows", "compiled"):  # they change last bits alone
        del fields[name]
    fields |= {
        "name": base.named if base.folder is None else "hf",  # its files tell, wherever they lie
        "residual": fill.weights,
        "fill": fill.texture,
        "mode": fill.mode,
        "render": options.render,
        "keep_frame": options.keep_frame,
        "spackle": spackle.__version__,
    }
    choices = {name: value for name, value in fields.items() if not isinstance(value, Path)}
    prints = {kind: fingerprint(file, kind) for kind, file in shared_files(options.scene).items()}
    return digest_of([choices, pipeline.base.fingerprints, prints])


def shared_files(options: Options) -> dict[str, Path]:
    """The files that all photos share besides the base's, by what they are."""
    path, fill = options.path, options.fill
    files = {"calibration": options.base.calib, "camera file": path.cameras, "path file": path.path}
    files |= {"weights": fill.file, "LaMa": installed("lama") if fill.texture == "lama" else None}
    return {kind: file for kind, file in files.items() if file is not None}


def request_of(photo: Path, depth: Path | DepthMap | None, shared: str) -> str:
    """A digest of all that the result of one photo depends on; InputError if the photo or its depth map is missing."""
    files = [fingerprint(photo, "photo")]
    if isinstance(depth, Path):
        depth = find_depth(depth, photo)
        files.append(fingerprint(depth, "depth map"))
        files += [fingerprint(file, "calibration") for file in calibrations_beside(depth) if file.is_file()]
    return digest_of([shared, *files])


def _report(
    done: CompletedPhoto,
    pipeline: Pipeline,
    holes: Holes,
    video: dict[str, object] | None,
    request: str,
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """Counts, holes, times and sources of one photo, ready for JSON."""
    photo, prediction, choice, options = done.photo, done.prediction, done.choice, pipeline.options
    base, aux, weights = len(done.scene.base), len(done.scene.aux), options.fill.weights
    given = options.path.cameras or options.path.path
    report: dict[str, Any] = {
        "spackle": spackle.__version__,
        "photo": {"file": photo.path.name, "width": prediction.camera.width, "height": prediction.camera.height},
        "focal_px": round(prediction.camera.focal[0], 3),
        "focal_source": prediction.lens_source or photo.focal_source,
        "base": {"name": choice.base, "chosen": choice.why, "gaussians": base, **prediction.notes},
        "residual": {"weights": weights, "fill": options.fill.texture},
        "aux": {"gaussians": aux, "share": aux / base},
        "merged": base + aux,
        "mode": options.fill.mode,
        "views": given.name if given else options.path.trajectory,
        "disparity": done.scene.disparity,
        "disparity_source": None if given else pipeline.disparity_source(choice),
        "video": video,
        "hole_area_ratio": holes,
        "request": request if choice.lasting else None,  # None: the next run does it again
        "seconds": {**seconds, "total": round(sum(seconds.values()), 3)},
    }
    if photo.frame is not None:
        report["photo"]["frame_cut_off"] = dataclasses.asdict(photo.frame)
    if choice.failures:
        report["base"]["passed_over"] = list(choice.failures)
    if weights == "seeds":
        report["residual"]["note"] = "no trained weights: the seeds alone filled the holes"
    if done.saved_view is not None:
        report["scene_ply_view"] = done.saved_view  # the view whose aux Gaussians scene.ply holds
    return report


def _warn_of_rougher(done: CompletedPhoto, folder: Path, base: BaseSettings, reporter: Reporter) -> None:
    """Warn before rougher results replace those of a network whose weights are damaged or gone."""
    before, now = earlier_report(folder).get("base"), done.choice.base
    better = before.get("name") if isinstance(before, dict) else None
    if base.named == AUTO and better in AUTO_NETWORKS and now in AUTO_NETWORKS[AUTO_NETWORKS.index(better) + 1 :]:
        file = base.files.get(str(better))
        reporter.log(
            f"{done.photo.path.name}: warning: {folder} was made by {better} and is made again by {now}: "
            f"{done.choice.why}{'' if file is None else f' ({file})'}"
        )


def earlier_report(folder: Path) -> dict[str, Any]:
    """An earlier run's report; empty without a whole one."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return report if isinstance(report, dict) else {}
