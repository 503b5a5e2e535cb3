"""Predict many photos, by this process or by several, and go on where an earlier run stopped.

Read `predict_photos` first; `find_photos` names the photos, and `Predictor` predicts one after the
other.
"""

from __future__ import annotations

import dataclasses
import functools
import glob
import os
import shlex
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import spackle
from spackle.bases.open import BaseError
from spackle.core.image_formats import list_photos
from spackle.depth.calibration import calibration_candidates
from spackle.depth.readers import find_depth_file
from spackle.depth.writers import check_depth_name
from spackle.formats.camera_readers import camera_source_files
from spackle.pipeline import Pipeline, PipelineOptions
from spackle.render.blend import blend_tiles
from spackle.results.photo_folder import (
    REPORT_NAME,
    PhotoOptions,
    predict_photo,
    read_earlier_report,
)
from spackle.runtime.digests import file_fingerprint, json_digest, matches_records
from spackle.runtime.errors import InputError
from spackle.runtime.files import check_file
from spackle.runtime.folders import results_folder
from spackle.runtime.kernels import is_compiled
from spackle.runtime.plugins import plugin_file
from spackle.runtime.progress import BufferedReporter, Reporter, catch_stop_signals
from spackle.runtime.worker_options import WorkerOptions
from spackle.runtime.workers import parallel_map, torch_threads
from spackle.video.frames import video_problem
from spackle.weights import installed_weights


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Options for predicting photos: those of a scene, of its files, and of the run."""

    scene: PipelineOptions
    photo: PhotoOptions
    overwrite: bool = False  # redo photos whose results exist
    workers: int | None = None  # processes that share the photos; None: one a GPU, or one
    threads: int | None = None  # of each worker; None: the cores, shared evenly
    ray: str | None = None  # address of a Ray cluster, whose machines predict the photos

    def open_pipeline(self) -> Pipeline:
        """Open the pipeline for all photos; InputError for an option that no photo can use."""
        self._check_depth_out()
        pipeline = Pipeline.open(self.scene)
        path = self.scene.path
        # An option without effect is a mistake of the user, so it is refused before the work.
        if not self.photo.render:
            for option in ("format", "fps", "loop"):
                if getattr(path.video, option) is not None:
                    raise InputError(
                        f"`{option}`: `no_render` writes no video: leave one of them out"
                    )
        elif pipeline.given_path.cameras is not None and path.video.size is None:
            problem = video_problem(pipeline.given_path.cameras.views())
            if problem:
                raise InputError(
                    f"{path.cameras}: {problem}, so no video can be made: "
                    "give `size`, or add `no_render` for pictures only"
                )
        return pipeline

    def _check_depth_out(self) -> None:
        """InputError if the name for the photo's depth is no file name of a known format."""
        name = self.photo.depth_out
        if name is None:
            return
        check_depth_name(name)
        if Path(name).name != name:
            raise InputError(
                f"`depth_out` {name}: give a name without a folder: the file lies beside scene.ply"
            )


class NamedPhoto(NamedTuple):
    """A photo, and the name of the folder with its results."""

    path: Path
    name: str


class PhotoResult(NamedTuple):
    """What a worker says about a photo."""

    file_name: str
    failed: bool
    messages: Sequence[str | Mapping[str, object]]  # log lines, and results for JSON, in order


def say_if_kernels_compile(pipeline: Pipeline, reporter: Reporter) -> None:
    """Log that the first run takes longer, if the renderer's functions are not yet compiled.

    On a GPU there is nothing to compile.
    """
    if pipeline.renderer.device.type == "cpu" and not is_compiled(blend_tiles):
        reporter.log(
            "first use: kernels are compiled for this processor, "
            "which takes about half a minute, once"
        )


def find_photos(
    sources: Sequence[Path], log: Callable[[str], None] | None = None
) -> list[NamedPhoto]:
    """The photos that are given by name, by a pattern such as "*.png", or by folder.

    The folder of a photo's results is named by the photo's file without the suffix, or with the
    suffix if another photo has the same name without it.

    Args:
        sources: names, patterns and folders.
        log: receives a line that names and counts the files of a folder that are no photos.

    Raises:
        InputError: a folder without photos, or two photos whose results would have the same name.
    """
    photos: list[Path] = []
    for source in sources:
        photos += _photos_of(source, log)

    # Names that differ only in upper and lower case count as equal, because the file systems of
    # Windows and macOS do not distinguish them.
    stem_counts = Counter(photo.stem.casefold() for photo in photos)
    named: dict[str, NamedPhoto] = {}
    for photo in photos:
        is_unique = stem_counts[photo.stem.casefold()] == 1
        is_only_dots = not photo.stem.strip(".")  # "...png" has the stem "..", the folder above
        name = photo.stem if is_unique and not is_only_dots else photo.name
        other = named.get(name.casefold())
        if other is not None:
            raise InputError(
                f"{photo}: {other.path} has the same name: "
                "predict them in two runs, each with its own `output`"
            )
        named[name.casefold()] = NamedPhoto(photo, name)
    return list(named.values())


def _photos_of(source: Path, log: Callable[[str], None] | None) -> list[Path]:
    """The photos in a folder, or those that match a pattern, or the file itself.

    `log` receives a line about other files of the folder. InputError for a folder without photos.
    """
    if os.path.isdir(source):
        photos = list_photos(source, log=log)
        if not photos:
            raise InputError(f"{source}: no photos in this folder: give another one")
        return photos

    # Not every shell replaces a pattern by names. If a file has just this name, such as "a[1].png",
    # the file is meant.
    if not os.path.lexists(source):
        matches = sorted(glob.glob(str(source)))
        if matches:
            return [Path(match) for match in matches]

    # Whether the file exists is checked when it is read, where the message can say more.
    return [source]


def predict_photos(
    photos: Sequence[NamedPhoto],
    output: Path,
    options: PredictOptions,
    reporter: Reporter,
    *,
    is_single: bool,
    left_out: Sequence[str] = (),
) -> int:
    """Predict photos into the folder `output`, each into a folder of its name.

    Args:
        photos: the photos.
        output: the folder of all results.
        options: of scenes, files and run.
        reporter: gets messages, progress and results.
        is_single: whether one photo was named, not a folder; it is predicted even if its results
            exist, and its error ends the run.
        left_out: lines about files of the folders that are no photos, which are logged once
            nothing stands in the way of the run.

    Returns:
        The number of photos that failed.

    Raises:
        InputError: an option, or a single photo, cannot be used.
    """
    workers = WorkerOptions.of_command(
        options.workers, options.threads, options.scene.base.device, options.ray, len(photos)
    )
    pipeline = options.open_pipeline()
    say_if_kernels_compile(pipeline, reporter)
    if is_single:
        check_file(photos[0].path, "photo")

    # Two runs over many photos must not share a folder. A single photo locks only its own folder,
    # so that several may be predicted at once.
    shared_digest = options_digest(options)
    with results_folder(output, locked=not is_single):
        for line in left_out:
            reporter.log(line)
        predictor = Predictor(
            output=output,
            options=options,
            shared_digest=shared_digest,
            is_single=is_single,
            pipeline=pipeline,
            verbose=reporter.verbose,
        )
        unfinished = predictor.unfinished(photos, reporter)
        # A single photo is not worth a worker's start.
        if workers.in_this_process or is_single:
            failure_count = _predict_in_this_process(
                predictor, unfinished, workers.threads, reporter
            )
        else:
            # Each worker opens a predictor of its own, because networks do not travel between
            # processes.
            failure_count = _predict_by_workers(
                functools.partial(Predictor.open, output, options, shared_digest, reporter.verbose),
                list(unfinished),
                photo_count=len(photos),
                workers=workers,
                output=output,
                reporter=reporter,
            )

    if failure_count:
        reporter.log(f"{failure_count} of {len(photos)} photos failed")
    else:
        # Of many photos the line says NAME, which stands for the name of any of them.
        folder = output / (photos[0].name if is_single else "NAME")
        _say_where_to_look(folder, options, reporter)
    return failure_count


def _predict_in_this_process(
    predictor: Predictor, photos: Iterable[NamedPhoto], threads: int, reporter: Reporter
) -> int:
    """Predict one photo after the other with a number of threads; returns how many failed.

    A second process would hold torch and the base's network in memory twice.
    """
    failure_count = 0
    with torch_threads(threads):
        for photo in photos:
            if not predictor.predict(photo, reporter):
                failure_count += 1
    return failure_count


def _say_where_to_look(folder: Path, options: PredictOptions, reporter: Reporter) -> None:
    """Log a line that names the video and the command that shows the scene."""
    view_command = f"spackle view {shlex.quote(str(folder / 'scene.ply'))}"
    if options.photo.render:
        video = folder / f"video{options.scene.path.video.suffix}"
        reporter.log(f"Look at {video}, or into the scene: {view_command}")
    else:
        reporter.log(f"Look into the scene: {view_command}")


def _predict_by_workers(
    open_predictor: Callable[[], Predictor],
    unfinished: Sequence[NamedPhoto],
    photo_count: int,
    workers: WorkerOptions,
    output: Path,
    reporter: Reporter,
) -> int:
    """Predict photos by several processes, and print the messages about each finished photo.

    Args:
        open_predictor: opens a predictor in a process.
        unfinished: the photos that have no results yet.
        photo_count: the number of all photos, for the progress.
        workers: the processes.
        output: the folder of all results.
        reporter: gets messages and progress.

    Returns:
        The number of photos that failed.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM, once the photos in progress are done.
    """
    # Workers take seconds to start, so none is started for nothing.
    if not unfinished:
        return 0
    failure_count = 0
    finished_before = photo_count - len(unfinished)
    finished_count = finished_before
    with (
        catch_stop_signals(single_process=True) as is_stopping,
        reporter.steps("photos", finished_before, photo_count) as report_step,
        parallel_map(open_predictor, unfinished, is_stopping, workers, output) as results,
    ):
        for result in results:
            finished_count += 1
            # Workers keep their messages until a photo is done, so that those of two photos do not
            # mix. A text is a line of the log; everything else is a result to print as JSON.
            for message in result.messages:
                if isinstance(message, str):
                    reporter.log(message)
                else:
                    reporter.result(message)
            if result.failed:
                failure_count += 1
            report_step(finished_count, result.file_name)
            if is_stopping():
                break

    # After a stop some photos have no results; the exit code must say so.
    if finished_count < photo_count:
        reporter.log("stopped; the same command resumes from here")
        raise KeyboardInterrupt
    return failure_count


@dataclasses.dataclass(frozen=True, kw_only=True)
class Predictor:
    """Predicts one photo after the other."""

    output: Path
    options: PredictOptions
    shared_digest: str  # of what the results of all photos depend on
    is_single: bool  # one photo was named: it is always predicted, and an error ends the run
    pipeline: Pipeline
    verbose: bool

    @staticmethod
    def open(output: Path, options: PredictOptions, shared_digest: str, verbose: bool) -> Predictor:
        """Open the predictor of a worker process.

        InputError if its machine does not have the weights and files of the command's.
        """
        # On the machine of the command there is nothing to compare.
        if options.ray is not None and options_digest(options) != shared_digest:
            raise InputError(
                f"{socket.gethostname()}: has other weights or files than the machine of the "
                "command: a network folder for all of them is named by SPACKLE_WEIGHTS"
            )
        return Predictor(
            output=output,
            options=options,
            shared_digest=shared_digest,
            is_single=False,  # a single photo is predicted by the main process
            pipeline=options.open_pipeline(),
            verbose=verbose,
        )

    def make(self, photo: NamedPhoto) -> PhotoResult:
        """Predict a photo in a worker process, and keep the messages for the main process."""
        reporter = BufferedReporter(self.verbose)
        # A worker that died may have finished the photo without saying so.
        if self.is_done(photo):
            return PhotoResult(photo.path.name, False, reporter.said)
        succeeded = self.predict(photo, reporter)
        return PhotoResult(photo.path.name, not succeeded, reporter.said)

    def predict(self, photo: NamedPhoto, reporter: Reporter) -> bool:
        """Predict a photo and return True, or log the error and return False.

        An error ends the run, as an InputError, if the photo is the only one, or if the base fails
        for every photo.
        """
        folder = self.output / photo.name
        try:
            request = self.request_digest(photo)
            predict_photo(photo.path, folder, self.pipeline, reporter, self.options.photo, request)
        except InputError as error:
            # A BaseError means that the base fails for every photo. Any other error is that of one
            # photo, and must not cost the user the photos after it.
            if self.is_single or isinstance(error, BaseError):
                raise
            reporter.log(f"error: {error}")
            reporter.result({"folder": folder, "error": str(error)})
            return False
        return True

    def unfinished(self, photos: Iterable[NamedPhoto], reporter: Reporter) -> Iterator[NamedPhoto]:
        """The photos without complete results; logs each photo that is skipped."""
        for photo in photos:
            if self.is_done(photo):
                reporter.log(f"{photo.path.name}: done already (`overwrite` does it again)")
                reporter.result({"folder": self.output / photo.name, "done_already": True})
            else:
                yield photo

    def is_done(self, photo: NamedPhoto) -> bool:
        """Whether an earlier run with the same input and options has written all results."""
        # Who names a single photo wants it predicted now.
        if self.is_single or self.options.overwrite:
            return False
        folder = self.output / photo.name
        earlier_report = read_earlier_report(folder)
        if not earlier_report:
            return False
        try:
            request = self.request_digest(photo)
        except InputError:
            return False  # a file is missing, which `predict` will report

        # A report may be whole although other files are damaged or were not copied. So each file is
        # compared with the size and digest that the report says.
        has_same_request = earlier_report.get("request") == request
        return has_same_request and matches_records(
            folder, REPORT_NAME, earlier_report.get("files")
        )

    def request_digest(self, photo: NamedPhoto) -> str:
        """A digest of all that a photo's results depend on.

        InputError if the photo or its depth map is missing.
        """
        # A fingerprint says which content a file has; the second argument names the file in an
        # error message.
        fingerprints = [file_fingerprint(photo.path, "photo")]
        depth = self.options.scene.base.depth
        if isinstance(depth, Path):  # a depth map, or a folder with a map for each photo
            depth_file = find_depth_file(depth, photo.path)
            fingerprints.append(file_fingerprint(depth_file, "depth map"))
            # The calibration beside a depth map gives its numbers their unit.
            for calibration in calibration_candidates(depth_file):
                if calibration.is_file():
                    fingerprints.append(file_fingerprint(calibration, "calibration"))
        return json_digest([self.shared_digest, *fingerprints])


def options_digest(options: PredictOptions) -> str:
    """A digest of everything that the results of all photos depend on, beside the photo itself.

    These are Spackle's version, the options, and the content of the files that options name. If the
    digest has changed, earlier results are out of date. InputError for a missing file.
    """
    base = options.scene.base
    path = options.scene.path
    fill = options.scene.fill
    files: dict[str, Path | None] = {
        "calibration": base.calib,
        "weights": fill.weights_file,
        "LaMa": installed_weights("lama") if fill.texture == "lama" else None,
        # Code of another package, by which results may change, too.
        "inpainter": plugin_file(fill.texture, "fill"),
        "network": plugin_file(fill.residual_network or "", "residual_network"),
        **base.model_files,
    }
    fingerprints = {
        kind: file_fingerprint(file, kind) for kind, file in files.items() if file is not None
    }

    # Cameras of other programs may be in several files.
    for kind, source in {"camera file": path.cameras, "path file": path.path}.items():
        if source is not None:
            sources = camera_source_files(source)
            fingerprints[kind] = " ".join(file_fingerprint(file, kind) for file in sources)

    # A file counts by its content, which is in `fingerprints`, not by its path: a folder of photos
    # and weights may be moved. So options that name a file are emptied here.
    base = dataclasses.replace(
        base,
        # A base "hf:FOLDER" has a path in its name; "hf" is what remains without it.
        name=base.resolved_name if base.model_folder is None else "hf",
        depth=None,  # each photo has its own depth map, which `request_digest` adds
        calib=None,
        checkpoint=None,
        windows_per_batch=None,  # changes only the last bits of SHARP's results
    )
    path = dataclasses.replace(path, cameras=None, path=None)

    # `options` has more: `overwrite`, and the numbers of workers and threads. These do not change
    # results.
    return json_digest(
        [
            spackle.__version__,
            dataclasses.asdict(base),
            dataclasses.asdict(path),
            dataclasses.asdict(options.photo),
            fill.weights_name,
            fill.texture,
            fill.mode,
            fingerprints,
        ]
    )
