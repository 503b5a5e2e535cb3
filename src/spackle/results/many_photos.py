"""Predict many photos, by this process or by several, and go on where an earlier run stopped.

Read `predict_photos` first; `Predictor` predicts one photo after the other. `find_photos` in
`photo_names.py` names them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import shlex
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import spackle
from spackle.bases.open import BaseError, open_base
from spackle.depth.calibration import calibration_candidates
from spackle.depth.readers import find_depth_file
from spackle.depth.writers import check_depth_name
from spackle.formats.camera_readers import camera_source_files
from spackle.pipeline import Pipeline, PipelineOptions
from spackle.render.blend import blend_tiles
from spackle.results.photo_folder import (
    REPORT_NAME,
    SCENE_NAME,
    PhotoOptions,
    predict_photo,
    read_earlier_report,
)
from spackle.results.photo_names import NamedPhoto
from spackle.results.result_tars import ResultTars
from spackle.results.results_file import RESULTS_NAME, ResultsFile
from spackle.runtime.device import report_memory_shortage
from spackle.runtime.digests import file_fingerprint, json_digest, matches_records
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.runtime.folders import results_folder
from spackle.runtime.kernels import is_compiled
from spackle.runtime.plugins import plugin_file
from spackle.runtime.progress import (
    BufferedReporter,
    Reporter,
    catch_stop_signals,
    pluralized,
)
from spackle.runtime.worker_options import WorkerOptions
from spackle.runtime.workers import parallel_map, torch_threads
from spackle.video.frames import video_problem
from spackle.weights import installed_weights

# What became of a photo, in results.jsonl.
OK = "ok"
FAILED = "failed"
STATE_DIGITS = 16  # hexadecimal; enough to tell two states of a photo's files apart


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Options for predicting photos: those of a scene, of its files, and of the run."""

    scene: PipelineOptions
    photo: PhotoOptions
    overwrite: bool = False  # redo photos whose results exist
    workers: int | None = None  # processes that share the photos; None: one a GPU, or one
    threads: int | None = None  # of each worker; None: the cores, shared evenly
    ray: str | None = None  # address of a Ray cluster, whose machines predict the photos
    tar: int | None = None  # results of so many photos become a tar; None: a folder for each photo

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


class PhotoResult(NamedTuple):
    """What a worker says about a photo."""

    photo: NamedPhoto
    line: Mapping[str, Any]  # of results.jsonl
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
        if is_single:
            with torch_threads(workers.threads):
                predictor.predict(photos[0], reporter)
            failure_count = 0
        else:
            failure_count = _predict_many(photos, predictor, workers, reporter)

    if failure_count:
        reporter.log(f"{failure_count} of {len(photos)} photos failed")
    else:
        # Of many photos the line says NAME, which stands for the name of any of them.
        folder = output / (photos[0].name if is_single else "NAME")
        if options.tar is None:
            _say_where_to_look(folder, options, reporter)
        else:
            reporter.log(f"Look at {output / 'results-*.tar'}, listed in {output / RESULTS_NAME}")
    return failure_count


def _predict_many(
    photos: Sequence[NamedPhoto],
    predictor: Predictor,
    workers: WorkerOptions,
    reporter: Reporter,
) -> int:
    """Predict the photos that have no results yet, and keep results.jsonl; returns how many failed.

    The caller has locked the folder of the results.
    """
    output = predictor.output
    with contextlib.ExitStack() as stack:
        results_file = stack.enter_context(ResultsFile(output, [photo.name for photo in photos]))
        tars = None
        if predictor.options.tar is not None:
            tars = stack.enter_context(ResultTars(output, photos, predictor.options.tar))
            predictor = dataclasses.replace(predictor, output=tars.staging)
        unfinished = predictor.unfinished(photos, results_file, tars, reporter)
        if tars is not None:
            tars.begin(unfinished)
        if workers.in_this_process:
            # A second process would hold torch and the base's network in memory twice.
            lines = _predict_in_this_process(predictor, unfinished, workers.threads, reporter)
        else:
            # Each worker opens a predictor of its own, because networks do not travel between
            # processes.
            open_predictor = functools.partial(
                Predictor.open,
                predictor.output,
                predictor.options,
                predictor.shared_digest,
                reporter.verbose,
            )
            lines = _predict_by_workers(
                open_predictor, unfinished, len(photos), workers, output, reporter
            )
        failure_count = 0
        for photo, line in lines:
            results_file.add(photo.number, _with_tar(line, photo, tars))
            if line["status"] == FAILED:
                failure_count += 1
            if tars is not None:
                tars.photo_done(photo)
    return failure_count


def _with_tar(
    line: Mapping[str, Any], photo: NamedPhoto, tars: ResultTars | None
) -> Mapping[str, Any]:
    """A photo's line with the name of the tar that its results belong to, if there are tars."""
    if tars is None or line["status"] == FAILED:
        return line
    return {**line, "tar": tars.name_of(photo)}


def _predict_in_this_process(
    predictor: Predictor, photos: Iterable[NamedPhoto], threads: int, reporter: Reporter
) -> Iterator[tuple[NamedPhoto, Mapping[str, Any]]]:
    """Predict one photo after the other with a number of threads; yields the line of each."""
    with torch_threads(threads):
        for photo in photos:
            yield photo, predictor.predict(photo, reporter)


def _say_where_to_look(folder: Path, options: PredictOptions, reporter: Reporter) -> None:
    """Log a line that names the video and the command that shows the scene."""
    if SCENE_NAME not in options.photo.gaussian_files:
        reporter.log(f"Look into {folder}")
        return
    view_command = f"spackle view {shlex.quote(str(folder / SCENE_NAME))}"
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
) -> Iterator[tuple[NamedPhoto, Mapping[str, Any]]]:
    """Predict photos by several processes, and print the messages about each finished photo.

    Args:
        open_predictor: opens a predictor in a process.
        unfinished: the photos that have no results yet.
        photo_count: the number of all photos, for the progress.
        workers: the processes.
        output: the folder of all results.
        reporter: gets messages and progress.

    Yields:
        Each finished photo, with its line of results.jsonl.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM, once the photos in progress are done.
    """
    # Workers take seconds to start, so none is started for nothing.
    if not unfinished:
        return
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
            yield result.photo, result.line
            report_step(finished_count, result.photo.path.name)
            if is_stopping():
                break

    # After a stop some photos have no results; the exit code must say so.
    if finished_count < photo_count:
        reporter.log("stopped; the same command resumes from here")
        raise KeyboardInterrupt


@dataclasses.dataclass(frozen=True, kw_only=True)
class Predictor:
    """Predicts one photo after the other."""

    output: Path  # has a folder for each photo
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
        line = self.finished_line(photo)
        if line is None:
            line = self.predict(photo, reporter)
        return PhotoResult(photo, line, reporter.said)

    def predict(self, photo: NamedPhoto, reporter: Reporter) -> Mapping[str, Any]:
        """Predict a photo, or log why it cannot be; returns its line for results.jsonl.

        An error ends the run, as an InputError, if the photo is the only one, or if the base fails
        for every photo.
        """
        folder = self.output / photo.name
        start = time.perf_counter()
        try:
            # Whatever fails with this photo alone, such as a disk that breaks or the memory for a
            # large picture, is an error of this photo.
            with (
                as_input_error(photo.path, "cannot be completed: {reason}", OSError),
                report_memory_shortage(
                    "give a smaller photo", what=f"to complete {photo.path.name}"
                ),
            ):
                facts = self._input_facts(photo)
                request = self.request_digest(photo)
                report = predict_photo(
                    photo.path,
                    folder,
                    self._pipeline_of(photo),
                    reporter,
                    self._options_of(photo),
                    request,
                )
        except InputError as error:
            # A BaseError means that the base fails for every photo. Any other error is that of one
            # photo, and must not cost the user the photos after it.
            if self.is_single or isinstance(error, BaseError):
                raise
            reporter.log(f"error: {error}")
            reporter.result({"folder": folder, "error": str(error)})
            return {
                "name": photo.name,
                "photo": str(photo.path),
                "status": FAILED,
                "seconds": round(time.perf_counter() - start, 3),
                "error": str(error),
            }
        return self._line_of(
            photo,
            seconds=time.perf_counter() - start,
            files=report.files,
            # A result that is not for good is made again in the next run.
            input_facts=None if report.request is None else facts,
        )

    def _line_of(
        self,
        photo: NamedPhoto,
        *,
        seconds: float | None,
        files: Mapping[str, Mapping[str, Any]],
        input_facts: Sequence[object] | None,
    ) -> Mapping[str, Any]:
        """The line of results.jsonl for a photo with results.

        Args:
            photo: the photo.
            seconds: that it took; None: unknown, because a killed run completed it.
            files: the records of its files in its report.
            input_facts: what `_input_facts` returned before the work; None: predict again next
                time.
        """
        folder = self.output / photo.name
        sizes = _file_sizes(files, (folder / REPORT_NAME).stat().st_size)
        state = None
        if input_facts is not None:
            # Results that go into a tar are not looked at again.
            names = sizes if self.options.tar is None else ()
            state = self._state_of(folder, names, input_facts)
        rounded_seconds = None if seconds is None else round(seconds, 3)
        return _completed_line(photo, rounded_seconds, sizes, state)

    def _pipeline_of(self, photo: NamedPhoto) -> Pipeline:
        """The pipeline for a photo: that of all photos, or one for the depth that a list names.

        InputError if the base takes no depth map.
        """
        if photo.depth is None:
            return self.pipeline
        # The base that lifts a photo by a depth map is no network, so opening it costs nothing.
        settings = dataclasses.replace(self.options.scene.base, depth=photo.depth)
        return dataclasses.replace(
            self.pipeline,
            base=open_base(settings),
            options=dataclasses.replace(self.pipeline.options, base=settings),
        )

    def _options_of(self, photo: NamedPhoto) -> PhotoOptions:
        """The options of reading and writing a photo, with the focal length that a list states."""
        if not photo.lens.stated:
            return self.options.photo
        return dataclasses.replace(self.options.photo, lens=photo.lens.stated)

    def unfinished(
        self,
        photos: Sequence[NamedPhoto],
        results_file: ResultsFile,
        tars: ResultTars | None,
        reporter: Reporter,
    ) -> list[NamedPhoto]:
        """The photos without complete results; says how many others there are.

        Photos with results about which `results_file` knows nothing get a line in it. `tars` are
        told which photos they hold.
        """
        unfinished = []
        for photo in photos:
            earlier_line = results_file.line_of(photo.number)
            line = self.finished_line(photo, earlier_line)
            if tars is not None:
                tars.check_same_place(photo, earlier_line)
                if line is None and tars.exists(photo):
                    line = self._finished_in_tar(photo, earlier_line, tars)
            if line is None:
                unfinished.append(photo)
                continue
            if line is not earlier_line:
                results_file.add(photo.number, _with_tar(line, photo, tars))
            reporter.result({"folder": self.output / photo.name, "done_already": True})
        finished_count = len(photos) - len(unfinished)
        if finished_count:
            reporter.log(
                f"{finished_count} of {pluralized(len(photos), 'photo')} done already "
                "(`overwrite` does them again)"
            )
        return unfinished

    def finished_line(
        self, photo: NamedPhoto, earlier_line: Mapping[str, Any] | None = None
    ) -> Mapping[str, Any] | None:
        """The line of a photo that has all results of the same input and options; else None.

        Args:
            photo: the photo.
            earlier_line: what an earlier run wrote about it, if anything. If it fits the photo's
                files, it is returned itself.
        """
        # Who names a single photo wants it predicted now.
        if self.is_single or self.options.overwrite:
            return None
        folder = self.output / photo.name
        try:
            facts = self._input_facts(photo)
            # Reading photo and results takes long, so sizes and times are looked at first. Of
            # photos whose results wait for a tar there are few.
            if earlier_line and facts is not None and self.options.tar is None:
                state = self._state_of(folder, earlier_line.get("files", {}), facts)
                if state is not None and state == earlier_line.get("state"):
                    return earlier_line

            report = read_earlier_report(folder)
            if not report or report.get("request") != self.request_digest(photo):
                return None
        except InputError:
            return None  # a file is missing, which `predict` will report

        # A report may be whole although other files are damaged or were not copied. So each file is
        # compared with the size and digest that the report says.
        files: Any = report.get("files")
        if not matches_records(folder, REPORT_NAME, files):
            return None
        seconds = report.get("seconds", {}).get("total")
        if earlier_line:
            seconds = earlier_line.get("seconds", seconds)
        return self._line_of(photo, seconds=seconds, files=files, input_facts=facts)

    def _finished_in_tar(
        self, photo: NamedPhoto, earlier_line: Mapping[str, Any], tars: ResultTars
    ) -> Mapping[str, Any] | None:
        """The line of a photo whose tar has results of the same input and options; else None.

        Args:
            photo: the photo, whose tar exists.
            earlier_line: what an earlier run wrote about it, if anything.
            tars: are told that the photo's results are to be kept.
        """
        if self.options.overwrite:
            return None
        try:
            facts = self._input_facts(photo)
        except InputError:
            facts = None
        if facts is None:
            return None  # a file is missing, which `predict` will report
        state = self._state_of(self.output, (), facts)
        if earlier_line.get("state") == state:
            tars.keep(photo)
            return earlier_line

        # Without a line, as after the loss of results.jsonl, the report in the tar decides.
        report, report_size = tars.report_of(photo)
        try:
            has_same_request = report.get("request") == self.request_digest(photo)
        except InputError:
            has_same_request = False
        if not has_same_request:
            return None
        tars.keep(photo)
        sizes = _file_sizes(report["files"], report_size)
        return _completed_line(photo, earlier_line.get("seconds"), sizes, state)

    def _input_facts(self, photo: NamedPhoto) -> list[object] | None:
        """Size and time of last change of the photo and of what belongs to it, and its lens.

        None if a file cannot be looked at, which `request_digest` reports. InputError if the depth
        map is missing.
        """
        try:
            facts = [os.stat(file) for file, _ in self._input_files(photo)]
        except (OSError, ValueError):  # a ValueError is that of a name with a null character
            return None
        return [*photo.lens, *((fact.st_size, fact.st_mtime_ns) for fact in facts)]

    def _state_of(
        self, folder: Path, names: Iterable[str], input_facts: Sequence[object]
    ) -> str | None:
        """A text that changes with options, and with sizes and times of inputs and results.

        Args:
            folder: of the photo's results.
            names: of the files in it.
            input_facts: those of the photo.

        Returns:
            The text; None if a file is missing.
        """
        output_facts = []
        for name in names:
            try:
                fact = os.stat(folder / name)
            except OSError:
                return None
            # A copied file may keep the time of its content (mtime), but not that of its entry.
            output_facts.append((fact.st_size, fact.st_mtime_ns, fact.st_ctime_ns))
        return json_digest([self.shared_digest, input_facts, output_facts])[:STATE_DIGITS]

    def request_digest(self, photo: NamedPhoto) -> str:
        """A digest of all that a photo's results depend on.

        InputError if the photo or its depth map is missing.
        """
        # A fingerprint says which content a file has.
        fingerprints = [file_fingerprint(file, kind) for file, kind in self._input_files(photo)]
        # Without a stated focal length the digest is that of runs before lists could state one.
        stated_lens = [photo.lens.stated] if photo.lens.stated else []
        return json_digest([self.shared_digest, *fingerprints, *stated_lens])

    def _input_files(self, photo: NamedPhoto) -> Iterator[tuple[Path, str]]:
        """Yield the photo, its depth map and calibration, each with what messages call it.

        InputError if a depth map is missing.
        """
        yield photo.path, "photo"
        # A depth map, or a folder with a map for each photo.
        depth = photo.depth or self.options.scene.base.depth
        if isinstance(depth, Path):
            depth_file = find_depth_file(depth, photo.path)
            yield depth_file, "depth map"
            # The calibration beside a depth map gives its numbers their unit.
            for calibration in calibration_candidates(depth_file):
                if calibration.is_file():
                    yield calibration, "calibration"


def _file_sizes(files: Mapping[str, Mapping[str, Any]], report_size: int) -> dict[str, int]:
    """The sizes in bytes of a photo's files, by name.

    Args:
        files: the records of all files but the report, as the report has them.
        report_size: of the report itself.
    """
    sizes: dict[str, int] = {name: record["bytes"] for name, record in files.items()}
    return {**sizes, REPORT_NAME: report_size}


def _completed_line(
    photo: NamedPhoto, seconds: float | None, sizes: Mapping[str, int], state: str | None
) -> Mapping[str, Any]:
    """The line of results.jsonl for a photo with results.

    Args:
        photo: the photo.
        seconds: that it took; None: unknown.
        sizes: of its files, in bytes.
        state: what `Predictor._state_of` returned; None: predict again next time.
    """
    return {
        "name": photo.name,
        "photo": str(photo.path),
        "status": OK,
        "seconds": seconds,
        "files": sizes,
        "state": state,
    }


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
