"""A photo to a scene, a video and a report. Read `predict_one`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any

import spackle
from spackle.app.complete import (
    CompletedPhoto,
    PhotoCompleter,
    disparity_source,
    measure_holes,
    picture_files,
    save_pictures,
    save_views_video,
)
from spackle.app.video import PathOptions, video_problem
from spackle.bases.depth_map import DepthMap, calibrations_beside, find_depth
from spackle.bases.open import AUTO, AUTO_NETWORKS, BaseSettings, OpenedBase
from spackle.downloads import installed
from spackle.errors import InputError
from spackle.files import digest_of, file_records, fingerprint, results_folder, whole_set, write_json
from spackle.formats import save_ply
from spackle.image import load_photo
from spackle.progress import Reporter
from spackle.scene import Mode, ResidualChoice

REPORT = "report.json"


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """The choices of `spackle predict`."""

    base: BaseSettings
    residual: ResidualChoice
    path: PathOptions
    render: bool = True  # write a video
    mode: Mode = "scene"
    focal_px: float | None = None
    focal_mm: float | None = None
    fov: float | None = None
    overwrite: bool = False  # in a folder, do again what is done already
    keep_frame: bool = False  # a uniform frame around a photo is part of it
    workers: int = 1  # processes that share a folder's photos
    threads: int | None = None  # of each
    ray: str | None = None  # the cluster where they are; this machine where None

    @property
    def files(self) -> tuple[str, ...]:
        """What a photo's folder gets, besides views/: the video is the last."""
        files = ("base.ply", "scene.ply", REPORT)
        return (*files, f"video{self.path.video.suffix}") if self.render else files

    @property
    def lens(self) -> dict[str, float | None]:
        """What a person said of the lens, as `load_photo` takes it."""
        return {"focal_px": self.focal_px, "focal_mm": self.focal_mm, "fov": self.fov}


def predict_one(
    path: Path, folder: Path, options: PredictOptions, completer: PhotoCompleter, reporter: Reporter, request: str
) -> None:
    """One photo to `folder`: base.ply, scene.ply, a video, report.json, and views/ with --cameras.

    The files take their places once all are whole. InputError for a photo, a depth map or a folder that cannot be used.
    """
    reporter = reporter.restarted()
    with reporter.stage("load"):
        photo = load_photo(path, keep_frame=options.keep_frame, **options.lens)
    with contextlib.ExitStack() as folders:
        pictures = picture_files(len(completer.given_views or []))
        folders.enter_context(results_folder(folder, options.files, alone=True))
        if pictures:
            folders.enter_context(results_folder(folder / "views", pictures))
        done = completer.complete(photo, reporter)
        _warn_of_rougher(done, folder, options.base, reporter)
        scene, views, renderer = done.scene, done.views, completer.renderer
        new = folders.enter_context(whole_set(folder, REPORT))
        with reporter.stage("write"):
            for file, part in (("base.ply", scene.base), ("scene.ply", scene.gaussians)):
                save_ply(part, new / file, camera=scene.camera, base_count=len(scene.base), disparity=scene.disparity)
        video = None
        if options.render:
            video = views.maker.note(options.files[-1], views.cameras[views.frames[0][0]], len(views.frames))
            with reporter.stage("video") as step:
                save_views_video(new / options.files[-1], views, scene, done.seen, renderer, step)
        if pictures:
            (new / "views").mkdir()
            with reporter.stage("views") as step:
                save_pictures(new / "views", views, scene, renderer, step)
        with reporter.stage("measure"):
            holes = measure_holes(views, scene, renderer)
        report = make_report(done, completer, holes, video, request, reporter.seconds)
        report["files"] = file_records(new, sorted(file for file in new.rglob("*") if file.is_file()))
        write_json(report, new / REPORT)
    before, after = (sum(float(view[key]) for view in holes) / len(holes) for key in ("before", "after"))
    aux, weights, total = report["aux"], completer.residual.weights, report["seconds"]["total"]
    reporter.log(
        f"{path.name}: {aux['gaussians']:,} aux Gaussians ({aux['share']:.1%}, {weights}), "
        f"holes {before:.2%} -> {after:.3%}, {total:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report})


def open_completer(options: PredictOptions) -> PhotoCompleter:
    """What all photos share; InputError for an option that cannot be used, whatever the photo."""
    completer = PhotoCompleter(options.base, options.residual, options.path, options.mode)
    video, views = options.path.video, completer.given_views
    for option, value in {"--format": video.format, "--fps": video.fps, "--loop": video.loop}.items():
        if value is not None and not options.render:
            raise InputError(f"{option} {value}: is for the video, and --no-render writes none: leave one of them out")
    if options.render and views and (problem := video_problem(views)):
        raise InputError(f"{options.path.cameras}: {problem}, so they make no video: add --no-render for pictures only")
    return completer


def shared_digest(options: PredictOptions, base: OpenedBase) -> str:
    """A digest of what all photos share: version, options, and what their files hold; InputError for a missing file."""
    settings, residual, path = options.base, options.residual, options.path
    named = settings.named if settings.folder is None else "hf"  # its files tell, wherever they lie
    own: dict[str, object] = {
        "spackle": spackle.__version__,
        "base": named,
        "residual": residual.weights,
        "fill": residual.fill,
    }
    own |= {"render": options.render, "mode": options.mode, "keep_frame": options.keep_frame, **options.lens}
    fields = {**dataclasses.asdict(settings), **dataclasses.asdict(path)}
    for name in ("name", "windows", "compiled"):  # recorded as `base`, or change last bits alone
        del fields[name]
    choices = {name: value for name, value in fields.items() if not isinstance(value, Path)}
    prints = {kind: fingerprint(file, kind) for kind, file in shared_files(options).items()}
    return digest_of([choices | own, base.fingerprints, prints])


def shared_files(options: PredictOptions) -> dict[str, Path]:
    """The files that all photos share besides the base's, by what they are."""
    path, residual = options.path, options.residual
    files = {"calibration": options.base.calib, "camera file": path.cameras, "path file": path.path}
    files |= {"weights": residual.file, "LaMa": installed("lama") if residual.fill == "lama" else None}
    return {kind: file for kind, file in files.items() if file is not None}


def request_of(photo: Path, depth: Path | DepthMap | None, shared: str) -> str:
    """A digest of all that the result of one photo depends on; InputError if the photo or its depth map is missing."""
    files = [fingerprint(photo, "photo")]
    if isinstance(depth, Path):
        depth = find_depth(depth, photo)
        files.append(fingerprint(depth, "depth map"))
        files += [fingerprint(file, "calibration") for file in calibrations_beside(depth) if file.is_file()]
    return digest_of([shared, *files])


def make_report(
    done: CompletedPhoto,
    completer: PhotoCompleter,
    holes: list[dict[str, float | str]],
    video: dict[str, object] | None,
    request: str,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """Counts, holes, times and sources of one photo, ready for JSON."""
    photo, prediction, choice, path = done.photo, done.prediction, done.choice, completer.path
    base, aux, weights = len(done.scene.base), len(done.scene.aux), completer.residual.weights
    given = path.cameras or path.path
    report: dict[str, Any] = {
        "spackle": spackle.__version__,
        "photo": {"file": photo.path.name, "width": prediction.camera.width, "height": prediction.camera.height},
        "focal_px": round(prediction.camera.focal[0], 3),
        "focal_source": prediction.lens_source or photo.focal_source,
        "base": {"name": choice.base, "chosen": choice.why, "gaussians": base, **prediction.notes},
        "residual": {"weights": weights, "fill": completer.residual.fill},
        "aux": {"gaussians": aux, "share": aux / base},
        "merged": base + aux,
        "mode": completer.mode,
        "views": given.name if given else path.trajectory,
        "disparity": done.scene.disparity,
        "disparity_source": None if given else disparity_source(path, choice),
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
        file = base.files.get("checkpoint" if better == "sharp" else "depth weights")
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
