"""`spackle predict`: photos, folders or a clip, by this process or by workers. Read `predict_all`."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import os
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import spackle
from spackle.bases.open import BaseError
from spackle.clips.files import is_clip
from spackle.clips.predict import VIDEO_FILE, clip_options, predict_clip
from spackle.core.photo import PHOTO_SUFFIXES
from spackle.depth.calibration import calibration_candidates
from spackle.depth.readers import find_depth_file
from spackle.depth.writers import check_depth_name
from spackle.pipeline import Pipeline, PipelineOptions
from spackle.render.blend import blend_tiles
from spackle.results.photo_folder import (
    REPORT_NAME,
    PhotoOptions,
    predict_photo,
    read_earlier_report,
)
from spackle.runtime.device import thread_count
from spackle.runtime.digests import file_fingerprint, json_digest, matches_records
from spackle.runtime.errors import InputError
from spackle.runtime.files import check_file, list_files
from spackle.runtime.folders import results_folder
from spackle.runtime.kernels import is_compiled
from spackle.runtime.progress import BufferedReporter, Reporter, catch_stop_signals
from spackle.runtime.workers import parallel_map, torch_threads
from spackle.video.frames import video_problem
from spackle.weights import installed_weights


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Options of `spackle predict`."""

    scene: PipelineOptions
    photo: PhotoOptions
    overwrite: bool = False  # redo photos whose results exist
    workers: int = 1  # processes that share the photos
    threads: int | None = None  # of each worker

    def open(self) -> Pipeline:
        """Open the pipeline for all photos; InputError for an option that cannot be used with any photo."""
        if (name := self.photo.depth_out) is not None:
            check_depth_name(name)
            if Path(name).name != name:
                raise InputError(
                    f"--depth-out {name}: give a name without a folder: the file lies beside scene.ply"
                )
        pipeline, path = Pipeline.open(self.scene), self.scene.path
        unused = [
            name for name in ("format", "fps", "loop") if getattr(path.video, name) is not None
        ]
        if unused and not self.photo.render:
            raise InputError(f"--{unused[0]}: --no-render writes no video: leave one of them out")
        if (
            self.photo.render
            and pipeline.given_views
            and (problem := video_problem(pipeline.given_views))
        ):
            raise InputError(
                f"{path.cameras}: {problem}, so no video can be made: add --no-render for pictures only"
            )
        return pipeline


class NamedPhoto(NamedTuple):
    """A photo, and the name of its results."""

    path: Path
    name: str


def predict_all(
    given: Sequence[Path], output: Path, options: PredictOptions, reporter: Reporter
) -> int:
    """Predict a clip, or photos and folders of photos; returns the number of photos that failed.

    Raises:
        InputError: an option, a clip or a single photo cannot be used.
    """
    named = find_photos(given)
    count = min(options.workers, len(named))
    threads = options.threads or max(1, thread_count() // count)
    single = len(given) == len(named) == 1 and not os.path.isdir(given[0])
    clips = [photo.path for photo in named if is_clip(photo.path)]
    if clips and not single:
        raise InputError(f"{clips[0]}: is a clip: give it alone, without other photos or clips")
    pipeline = (
        options.open()
        if not clips
        else Pipeline.open(clip_options(options.scene, options.photo, options.workers))
    )
    if pipeline.renderer.device.type == "cpu" and not is_compiled(blend_tiles):
        reporter.log(
            "first use: kernels are compiled for this processor, which takes about half a minute, once"
        )
    if clips:
        check_file(clips[0], "clip")
        folder = output / named[0].name
        with results_folder(output):
            predict_clip(clips[0], folder, pipeline, options.photo.lens, reporter)
        reporter.log(f"Look at {folder / VIDEO_FILE}")
        return 0
    if single:
        check_file(named[0].path, "photo")
    shared = _shared_digest(options)
    with results_folder(output, locked=not single):
        predictor = Predictor(output, options, shared, single, pipeline, reporter.verbose)
        left = predictor.left(named, reporter)
        if count == 1:
            with torch_threads(threads):
                failed = sum(not predictor.predict(photo, reporter) for photo in left)
        else:
            open_predictor = partial(Predictor.open, output, options, shared, reporter.verbose)
            gpu = options.scene.base.device != "cpu"
            failed = _predict_by_workers(
                open_predictor, list(left), len(named), count, threads, gpu, reporter
            )
    if failed:
        reporter.log(f"{failed} of {len(named)} photos failed")
    else:
        folder = output / (named[0].name if single else "NAME")
        video = (
            f" at {folder / f'video{options.scene.path.video.suffix}'}, or"
            if options.photo.render
            else ""
        )
        reporter.log(
            f"Look{video} into the scene: spackle view {shlex.quote(str(folder / 'scene.ply'))}"
        )
    return failed


def find_photos(given: Sequence[Path]) -> list[NamedPhoto]:
    """The photos that are given by name, by a pattern such as "*.png", or by folder, each with the name of its results.

    InputError for a folder without photos, and for two photos whose results would have the same name.
    """
    photos: list[Path] = []
    for path in given:
        matches = [] if os.path.lexists(path) else map(Path, sorted(glob.glob(str(path))))
        found = list_files(path, PHOTO_SUFFIXES) if os.path.isdir(path) else list(matches) or [path]
        if not found:
            raise InputError(
                f"{path}: no photos in this folder (looked for {', '.join(PHOTO_SUFFIXES)})"
            )
        photos += found
    stems = Counter(photo.stem.casefold() for photo in photos)
    named: dict[str, NamedPhoto] = {}
    for photo in photos:
        plain = stems[photo.stem.casefold()] == 1 and photo.stem.strip(
            "."
        )  # "...png" has the stem ".."
        name = photo.stem if plain else photo.name
        if other := named.get(name.casefold()):
            raise InputError(
                f"{photo}: {other.path} has the same name: predict them in two runs, each with its own -o"
            )
        named[name.casefold()] = NamedPhoto(photo, name)
    return list(named.values())


def _predict_by_workers(
    open_predictor: Callable[[], Predictor],
    left: Sequence[NamedPhoto],
    total: int,
    count: int,
    threads: int,
    gpu: bool,
    reporter: Reporter,
) -> int:
    """Predict photos by workers, print the messages about each finished photo, and return how many photos failed.

    After Ctrl-C or SIGTERM, raises KeyboardInterrupt once the photos in progress are done.
    """
    if not left:
        return 0
    failed = 0
    done = ready = total - len(left)
    with (
        catch_stop_signals(single_process=True) as stop,
        reporter.steps("photos", ready, total) as step,
        parallel_map(open_predictor, left, stop, count=count, threads=threads, gpu=gpu) as results,
    ):
        for done, result in enumerate(results, ready + 1):
            for what in result.said:
                reporter.log(what) if isinstance(what, str) else reporter.result(what)
            failed += result.failed
            step(done, result.photo)
            if stop():
                break
    if done < total:
        reporter.log("stopped; the same command resumes from here")
        raise KeyboardInterrupt
    return failed


class Predicted(NamedTuple):
    """A worker's result for a photo."""

    photo: str
    failed: bool
    said: Sequence[str | Mapping[str, object]]


@dataclasses.dataclass(frozen=True)
class Predictor:
    """Predicts one photo after the other."""

    output: Path
    options: PredictOptions
    shared: str  # digest of what the results of all photos depend on
    single: bool  # True: a single photo is always predicted again, and an error ends the command
    pipeline: Pipeline
    verbose: bool

    @staticmethod
    def open(output: Path, options: PredictOptions, shared: str, verbose: bool) -> Predictor:
        """Open the predictor of a worker process."""
        return Predictor(output, options, shared, False, options.open(), verbose)

    def is_done(self, photo: NamedPhoto) -> bool:
        """Whether an earlier run with the same input and options has left complete results."""
        folder = self.output / photo.name
        earlier = {} if self.single or self.options.overwrite else read_earlier_report(folder)
        with contextlib.suppress(InputError):  # `predict` reports a missing file
            return (
                bool(earlier)
                and earlier.get("request") == self.request(photo)
                and matches_records(folder, REPORT_NAME, earlier.get("files"))
            )
        return False

    def request(self, photo: NamedPhoto) -> str:
        """A digest of all that a photo's results depend on; InputError if the photo or depth map is missing."""
        files, depth = [file_fingerprint(photo.path, "photo")], self.options.scene.base.depth
        if isinstance(depth, Path):
            depth = find_depth_file(depth, photo.path)
            files.append(file_fingerprint(depth, "depth map"))
            files += [
                file_fingerprint(file, "calibration")
                for file in calibration_candidates(depth)
                if file.is_file()
            ]
        return json_digest([self.shared, *files])

    def make(self, photo: NamedPhoto) -> Predicted:
        notes = BufferedReporter(self.verbose)
        return Predicted(photo.path.name, not self.predict(photo, notes), notes.said)

    def left(self, photos: Iterable[NamedPhoto], reporter: Reporter) -> Iterator[NamedPhoto]:
        """The photos without complete results; logs photos that are skipped."""
        for photo in photos:
            if self.is_done(photo):
                reporter.log(f"{photo.path.name}: done already (--overwrite does it again)")
                reporter.result({"folder": self.output / photo.name, "done_already": True})
            else:
                yield photo

    def predict(self, photo: NamedPhoto, reporter: Reporter) -> bool:
        """Predict a photo; returns whether this succeeded, and logs an error. InputError if no photo can succeed."""
        folder = self.output / photo.name
        try:
            request = self.request(photo)
            predict_photo(photo.path, folder, self.pipeline, reporter, self.options.photo, request)
        except InputError as error:
            if self.single or isinstance(error, BaseError):
                raise
            reporter.log(f"error: {error}")
            reporter.result({"folder": folder, "error": str(error)})
            return False
        return True


def _shared_digest(options: PredictOptions) -> str:
    """A digest of version, options and files that all photos share; InputError for a missing file."""
    base, path, fill = options.scene.base, options.scene.path, options.scene.fill
    files = {
        "calibration": base.calib,
        "camera file": path.cameras,
        "path file": path.path,
        "weights": fill.weights_file,
    }
    files |= {
        "LaMa": installed_weights("lama") if fill.texture == "lama" else None,
        **base.model_files,
    }
    prints = {
        kind: file_fingerprint(file, kind) for kind, file in files.items() if file is not None
    }
    name = (
        base.resolved_name if base.model_folder is None else "hf"
    )  # digests identify the folder, wherever it lies
    # The number of windows changes only the last bits of results.
    base = dataclasses.replace(
        base, name=name, depth=None, calib=None, checkpoint=None, windows_per_batch=None
    )
    path = dataclasses.replace(path, cameras=None, path=None)
    choices = [dataclasses.asdict(each) for each in (base, path, options.photo)]
    return json_digest(
        [spackle.__version__, *choices, fill.weights_name, fill.texture, fill.mode, prints]
    )
