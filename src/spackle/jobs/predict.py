"""`spackle predict`: photos to scenes, videos and reports."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections import Counter
from pathlib import Path

from spackle.bases.lite.base import LiteBase
from spackle.bases.open import AUTO, BaseError, Choice, all_finite
from spackle.bases.protocol import BasePrediction
from spackle.bases.sharp import SharpBase
from spackle.errors import InputError
from spackle.formats import save_ply
from spackle.formats.clip import is_clip
from spackle.gaussians import Gaussians
from spackle.image import PHOTO_SUFFIXES, Photo, load_photo, resize_photo
from spackle.jobs.clip import check_clip_options, predict_clip
from spackle.jobs.options import PredictOptions
from spackle.jobs.report import base_before, focal_source, is_done, make_report, summary, write_report
from spackle.jobs.request import request_of
from spackle.jobs.setup import Tools, set_up
from spackle.jobs.views import (
    Completed,
    Plan,
    complete,
    describe_video,
    make_plan,
    measure_holes,
    save_plan_video,
    save_views,
    view_files,
)
from spackle.output_folder import results_folder
from spackle.progress import Reporter

FILES = ("base.ply", "scene.ply", "report.json")  # and the video


@dataclasses.dataclass(frozen=True)
class Done:
    """What became of a photo."""

    photo: Photo  # at its working size
    prediction: BasePrediction
    choice: Choice
    plan: Plan
    completed: Completed


def predict_all(photos: Path, output: Path, options: PredictOptions, reporter: Reporter) -> int:
    """Work through a photo, a clip or a folder of photos; returns the number of photos that failed.

    Raises:
        InputError: a single photo, a clip, or an option, that cannot be used.
    """
    found = find_photos(photos)
    if is_clip(photos):
        check_clip_options(options)
        with results_folder(output):
            predict_clip(photos, output / found[0][1], options, set_up(options), reporter)
        return 0
    tools = set_up(options)
    files = _results(options, tools)
    failed = 0
    with results_folder(output):
        for path, name in found:
            try:
                request = request_of(path, options, tools.digest)
                if path != photos and not options.overwrite and is_done(output / name, files, request):
                    reporter.say(f"{path.name}: done already (--overwrite does it again)")
                    reporter.result({"folder": output / name, "done_already": True})
                    continue
                predict_one(path, output / name, options, tools, reporter, request)
            except InputError as error:
                if path == photos or isinstance(error, BaseError):  # the only one, or no other can be worked on
                    raise
                failed += 1
                reporter.say(f"error: {error}")
                reporter.result({"folder": output / name, "error": str(error)})
    if failed:
        reporter.say(f"{failed} of {len(found)} photos failed")
    return failed


def predict_one(
    path: Path, folder: Path, options: PredictOptions, tools: Tools, reporter: Reporter, request: str
) -> None:
    """One photo to `folder`: base.ply, scene.ply, a video, report.json, and views/ with --cameras.

    Raises:
        InputError: a photo or depth map that cannot be used, or a folder that cannot be written to.
    """
    seconds: dict[str, float] = {}
    with reporter.stage("load", seconds):
        full = load_photo(path, focal_px=options.focal_px, focal_mm=options.focal_mm, fov=options.fov)
    with contextlib.ExitStack() as folders:
        folders.enter_context(results_folder(folder, _files(options)))
        if tools.views:
            folders.enter_context(results_folder(folder / "views", view_files(len(tools.views))))
        _predict_loaded(full, folder, options, tools, reporter, request, seconds)


def _predict_loaded(
    photo: Photo,
    folder: Path,
    options: PredictOptions,
    tools: Tools,
    reporter: Reporter,
    request: str,
    seconds: dict[str, float],
) -> None:
    """The stages after loading; nothing is written before all is computed."""
    name = photo.path.name
    done = complete_photo(photo, name, options, tools, reporter, seconds)
    photo, prediction, choice, plan, completed = done.photo, done.prediction, done.choice, done.plan, done.completed
    _warn_of_lite(name, folder, choice, options, reporter)
    with reporter.stage("write", seconds):
        (folder / "report.json").unlink(missing_ok=True)  # an earlier run's, which vouches for the other files
        count = len(completed.base)
        reach = None if options.cameras or options.path else options.disparity
        merged = Gaussians.cat([completed.base, completed.aux])
        for file, part in (("base.ply", completed.base), ("scene.ply", merged)):
            save_ply(part, folder / file, camera=prediction.camera, base_count=count, disparity=reach)
    video = None
    if options.render:
        video = describe_video(plan, _video(options))
        with reporter.stage("video", seconds) as step:
            save_plan_video(folder / _video(options), plan, completed, tools.renderer, step)
    if tools.views:
        with reporter.stage("views", seconds) as step:
            save_views(folder / "views", plan, completed, tools.renderer, step)
    with reporter.stage("measure", seconds):
        holes = measure_holes(plan, completed, tools.renderer)
    report = make_report(photo, prediction, choice, completed, options, tools, holes, video, request, seconds)
    write_report(report, folder / "report.json")
    reporter.say(f"{name}: {summary(report)} -> {folder}")
    reporter.result({"folder": folder, **report})


def _warn_of_lite(name: str, folder: Path, choice: Choice, options: PredictOptions, reporter: Reporter) -> None:
    """A line where SHARP's results are about to give way to rough ones, because its weights are damaged or gone."""
    if options.named == AUTO and choice.base == LiteBase.name and base_before(folder) == SharpBase.name:
        file = options.base_files.get("checkpoint")
        reporter.say(
            f"{name}: warning: {folder} was made by sharp and is made again by lite: "
            f"{choice.why}{'' if file is None else f' ({file})'}"
        )


def complete_photo(
    photo: Photo, name: str, options: PredictOptions, tools: Tools, reporter: Reporter, seconds: dict[str, float]
) -> Done:
    """A photo, given at its full size, to a completed scene in memory; `name` is what the lines call it.

    Raises:
        InputError: a photo or depth map that cannot be used.
    """
    with reporter.stage("prepare", seconds):
        base = tools.opened.load(photo, log=reporter.say)
    with reporter.stage("base", seconds) as step:
        prediction, choice = base.predict(step)
    photo = resize_photo(photo)
    if choice.news:
        reporter.say(f"{name}: {choice.news}")
    reporter.say(
        f"{name}: {len(prediction.gaussians):,} Gaussians from {choice.base}, "
        f"focal length {prediction.camera.focal[0]:.0f} px ({focal_source(photo, prediction)})"
    )
    if missing := float(prediction.notes.get("depth_filled", 0)):
        reporter.say(f"{name}: {missing:.1%} of the depth was missing and has been filled")
    if options.depth is not None and (size := prediction.notes.get("depth_resampled_from")):
        reporter.say(f"{name}: the depth map is {size}, and was resampled to the photo's {photo.width}×{photo.height}")
    plan = make_plan(photo.path, prediction, options, tools)
    with reporter.stage("complete", seconds) as step:
        completed = complete(prediction, plan, options, tools, step)
        if not all_finite(completed.aux):
            raise InputError(f"{options.cameras or photo.path}: views too extreme to complete: check their K")
    return Done(photo, prediction, choice, plan, completed)


def _results(options: PredictOptions, tools: Tools) -> list[str]:
    """All files that a prediction writes."""
    views = [f"views/{name}" for name in view_files(len(tools.views or []))]
    return [*_files(options), *views]


def _files(options: PredictOptions) -> tuple[str, ...]:
    return (*FILES, _video(options)) if options.render else FILES


def _video(options: PredictOptions) -> str:
    return f"video{options.video.suffix}"


def find_photos(path: Path) -> list[tuple[Path, str]]:
    """A photo, or the photos of a folder in order of their names, each with the name of its results.

    Raises:
        InputError: nothing there, or a folder without photos.
    """
    if not os.path.isdir(path):
        return [(path, path.stem if path.stem.strip(".") else path.name)]  # "...png" has the stem ".."
    try:
        files = (p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
        photos = sorted(p for p in files if p.suffix.lower() in PHOTO_SUFFIXES)
    except OSError as error:
        raise InputError(f"{path}: cannot read the folder: {error.strerror}") from error
    if not photos:
        raise InputError(f"{path}: no photos in this folder (looked for {', '.join(PHOTO_SUFFIXES)})")
    # a.jpg and a.png must not write over each other, nor over a.jpg.png.
    stems = Counter(photo.stem.casefold() for photo in photos)
    names = {photo.name.casefold() for photo in photos}
    taken = {stem for stem, count in stems.items() if count > 1 or stem in names}
    return [(photo, photo.name if photo.stem.casefold() in taken else photo.stem) for photo in photos]
