"""A folder of results, which a killed run resumes.

- config.json: the options that determine the results;
- images/: for each finished image a file with its numbers, and its pictures;
- rows.jsonl: all numbers, one a line; written last, so it exists only once all images are done.

`measure_images` writes the images' files, `write_measurements` and `load_run` write and read the
rest.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from spackle.bases.open import BaseError
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.measurements import (
    PROBLEM_METRIC,
    Measurement,
    Run,
    image_measurement,
)
from spackle.paper.evaluation.stored_runs import check_config, read_row
from spackle.paper.evaluation.table import NOT_RUN
from spackle.runtime.digests import (
    config_differences,
    file_records,
    json_digest,
    matches_records,
    photo_digest,
    signed,
    unsigned,
)
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import (
    remove_half_written,
    write_atomic,
    write_json,
)
from spackle.runtime.folders import make_folder
from spackle.runtime.progress import BufferedReporter, Reporter, catch_stop_signals
from spackle.runtime.worker_options import WorkerOptions
from spackle.runtime.workers import parallel_map

CONFIG_FILE = "config.json"
MEASUREMENTS_FILE = "rows.jsonl"
IMAGES_FOLDER = "images"
FORMAT_VERSION = 3  # of config.json and rows.jsonl
DAMAGED = "not written by `spackle evaluate` or `spackle bench` ({reason}): run the command again"
# An image's file is named after the last letters of the image's name, as many as file systems
# allow.
MAX_NAME_LETTERS = 80


class ImageResults(NamedTuple):
    """What the measurement of one image gives."""

    measurements: list[Measurement]
    files: list[Path]  # pictures that were written into images/


# Measures the case with this index, and says what is remarkable.
MeasureImage = Callable[[int, Case, Reporter], ImageResults]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunPlan:
    """What an evaluation or a benchmark measures, and where its results go."""

    cases: Sequence[Case]  # the dataset's images
    root: Path  # the dataset's folder; left out of messages about images
    output: Path  # the folder of the results
    config: Mapping[str, Any]  # options that determine the results; they may not change on resuming
    about: Mapping[str, Any]  # versions, machine, and for each metric how it is measured


def write_measurements(measurements: Iterable[Measurement], path: Path) -> None:
    """Write measurements as JSON, one a line; the file appears complete or not at all."""
    lines = [
        json.dumps(measurement._asdict(), allow_nan=False) + "\n" for measurement in measurements
    ]
    write_atomic(path, "".join(lines).encode())


def load_run(folder: Path) -> Run:
    """Read the finished results of `spackle evaluate` or `spackle bench` from their folder.

    Raises:
        InputError: the results are missing, unfinished, damaged or of another version.
    """
    measurements_path = folder / MEASUREMENTS_FILE
    config_path = folder / CONFIG_FILE

    if not measurements_path.is_file():
        was_begun = config_path.is_file()
        state = "not finished: run its command again" if was_begun else "no results"
        raise InputError(f"{folder}: {state}: {MEASUREMENTS_FILE} is missing")

    with as_input_error(measurements_path, DAMAGED):
        lines = measurements_path.read_text("utf-8").splitlines()
        measurements = [read_row(line) for line in lines]
        if not measurements:
            raise ValueError("no measurements")

    with as_input_error(config_path, DAMAGED):
        config = json.loads(config_path.read_text("utf-8"))
        if config.pop("format") != FORMAT_VERSION:
            raise ValueError("of another version")  # the reason in the InputError's message
        check_config(config)
        about = config.pop("about")
        return Run(config, measurements, about)


def metrics_of_earlier_run(folder: Path) -> list[str]:
    """The metrics that an earlier run measured in this folder; empty if there is none."""
    # Any damage of the file is ignored here, because `measure_images` reports it later.
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        config = json.loads((folder / CONFIG_FILE).read_text("utf-8"))
        states = config["about"]["metrics"]
        return [metric for metric, state in states.items() if not state.startswith(NOT_RUN)]
    return []


def image_file(output: Path, index: int, name: str, suffix: str) -> Path:
    """The path in images/ of an image's numbers (suffix .json) or of a picture (.METHOD.webp).

    Args:
        output: the folder of the results.
        index: the image's place in the dataset; it keeps shortened names apart.
        name: the image's name; letters that are unusual in file names become "_".
        suffix: the end of the file's name.
    """
    safe_name = re.sub(r"[^A-Za-z0-9.-]+", "_", name)
    # Of a long name the end is kept, because the beginning is often the same for all images.
    short_name = safe_name[-MAX_NAME_LETTERS:]
    return output / IMAGES_FOLDER / f"{index:05d}-{short_name}{suffix}"


@dataclasses.dataclass(frozen=True)
class ImageJob:
    """An image to measure."""

    index: int  # the image's place in the dataset
    inputs_digest: str  # tells a later run whether photos or metrics have changed


@dataclasses.dataclass(frozen=True)
class ImageDone:
    """What a worker says about an image."""

    index: int
    measurements: list[Measurement]
    messages: Sequence[str | Mapping[str, object]]  # for the user


@dataclasses.dataclass(frozen=True)
class ImageWorker:
    """Measures one image after the other, and saves their numbers in images/."""

    plan: RunPlan
    measure: MeasureImage
    verbose: bool  # whether to say how long each image took

    def make(self, job: ImageJob) -> ImageDone:
        """Measure an image, and save its numbers so that a later run need not measure it.

        If a file of the image cannot be used, the result is a measurement with this problem, which
        is not saved.

        Raises:
            BaseError: every image would fail, for instance because memory is too small.
        """
        case = self.plan.cases[job.index]
        reporter = BufferedReporter(self.verbose)
        results_path = image_file(self.plan.output, job.index, case.name, ".json")
        # A worker that died may have measured the image without saying so.
        measurements = _load_image_results(results_path, job.inputs_digest)
        if measurements is not None:
            return ImageDone(job.index, measurements, reporter.said)

        start = time.perf_counter()
        try:
            results = self.measure(job.index, case, reporter)
        except BaseError:  # an InputError that concerns all images, so it ends the run
            raise
        except InputError as error:
            problem = _problem_of(case, error, self.plan)
            reporter.log(f"passed over: {problem.value}")
            return ImageDone(job.index, [problem], reporter.said)

        content = {
            "inputs": job.inputs_digest,
            "files": file_records(results_path.parent, results.files),
            "rows": results.measurements,
        }
        text = json.dumps(signed(content), allow_nan=False)
        write_atomic(results_path, f"{text}\n".encode())
        reporter.detail(f"  {case.name}: {time.perf_counter() - start:.1f} s")
        return ImageDone(job.index, results.measurements, reporter.said)


def measure_images(
    plan: RunPlan,
    open_worker: Callable[[], ImageWorker],
    reporter: Reporter,
    workers: WorkerOptions,
) -> Run | None:
    """Measure the images that earlier runs in the folder have not finished, and return all results.

    A finished image is measured again if its photos or the versions of the metrics have changed.
    An image that cannot be used gives one measurement with the problem, and the next run tries
    that image again.

    Args:
        plan: the images, the options and the folder.
        open_worker: opens what measures images, in each process that does so.
        reporter: gets progress, and a line for each image that cannot be used.
        workers: the processes that share the images.

    Returns:
        The results of all images; None after Ctrl-C.

    Raises:
        BaseError: every image would fail, for instance because memory is too small.
        InputError: no image could be measured, or the folder holds results of other options.
    """
    _open_folder(plan)
    measured, jobs = _finished_and_unfinished(plan)
    if jobs:
        # This file says that the results are complete, but from now on they are not.
        (plan.output / MEASUREMENTS_FILE).unlink(missing_ok=True)
        if measured:
            finished = f"{len(measured)} of {len(plan.cases)} images are done"
            reporter.log(f"{plan.output}: going on, {finished}")

    with (
        reporter.stage("images") as progress,
        # In a single process, unlike under torchrun, a second Ctrl-C can end the run at once.
        catch_stop_signals(single_process=True) as is_stopped,
        parallel_map(open_worker, jobs, is_stopped, workers, plan.output) as results,
    ):
        for image in results:
            measured[image.index] = image.measurements
            for message in image.messages:
                reporter.log(str(message))
            progress(len(measured), len(plan.cases))
            if is_stopped():
                break
    if len(measured) < len(plan.cases):
        reporter.log("stopped; the same command resumes from here")
        return None

    # In the order of the dataset, however many processes there were.
    all_measurements: list[Measurement] = []
    for index in range(len(plan.cases)):
        all_measurements += measured[index]
    run = Run(plan.config, all_measurements, plan.about)
    if not run.measured_images:
        raise InputError(
            f"{plan.root}: none of {len(plan.cases)} images could be measured "
            "(the lines above say why)"
        )
    return run


def _finished_and_unfinished(
    plan: RunPlan,
) -> tuple[dict[int, list[Measurement]], list[ImageJob]]:
    """The numbers of images that earlier runs have measured, by index, and the other images."""
    # Cached, because many cases may share a second photo.
    cached_photo_digest = functools.cache(photo_digest)
    measured: dict[int, list[Measurement]] = {}
    jobs = []
    for index, case in enumerate(plan.cases):
        results_path = image_file(plan.output, index, case.name, ".json")
        inputs_digest = _inputs_digest(case, plan, cached_photo_digest)
        measurements = _load_image_results(results_path, inputs_digest)
        if measurements is None:
            jobs.append(ImageJob(index, inputs_digest))
        else:
            measured[index] = measurements
    return measured, jobs


def _inputs_digest(case: Case, plan: RunPlan, digest_of_photo: Callable[[Path], str]) -> str:
    """A digest of what may change between runs: the case's photos, and how metrics are measured."""
    # A metric that can be measured now may not have been in an earlier run.
    photos = [case.photo, *(view.photo for view in case.second_views)]
    photo_digests = [digest_of_photo(photo) for photo in photos]
    return json_digest([photo_digests, plan.about.get("metrics")])


def _problem_of(case: Case, error: InputError, plan: RunPlan) -> Measurement:
    """The measurement of an image that could not be measured: its value is the reason."""
    # Results go to other people, so the path of the dataset on this machine is cut off.
    reason = str(error).replace(f"{plan.root}/", "")
    reason = " ".join(reason.splitlines())
    # The reason may name a photo that several cases share, so the case is named, too.
    if not reason.startswith(case.name):
        reason = f"{case.name}: {reason}"
    return image_measurement(str(plan.config["title"]), case.name, PROBLEM_METRIC, reason)


def _open_folder(plan: RunPlan) -> None:
    """Make the folder of the results; if it exists, check that its options are the same.

    Raises:
        InputError: the folder holds results of another command or with other options.
    """
    make_folder(plan.output / IMAGES_FOLDER)
    # A killed run may have left files that were not yet renamed to their final names.
    remove_half_written(plan.output, plan.output / IMAGES_FOLDER)

    config_path = plan.output / CONFIG_FILE
    if config_path.exists():
        _check_same_config(config_path, plan)
    write_json({"format": FORMAT_VERSION, **plan.config, "about": plan.about}, config_path)


def _check_same_config(config_path: Path, plan: RunPlan) -> None:
    """Raise an InputError unless an earlier run's config.json has the same options as this run."""
    with as_input_error(config_path, "damaged, or not JSON ({reason}): choose another `output`"):
        earlier = json.loads(config_path.read_text("utf-8"))

    kind = plan.config["kind"]
    is_same_kind = (
        isinstance(earlier, dict)
        and earlier.get("format") == FORMAT_VERSION
        and earlier.get("kind") == kind
    )
    if not is_same_kind:
        raise InputError(f"{config_path}: not written by `spackle {kind}`: choose another `output`")

    # Only options are compared. The plan's configuration has no format, and "about" has versions
    # and the machine, which may change between runs.
    del earlier["format"]
    earlier.pop("about", None)

    # The configuration goes through JSON, because tuples come back from a file as lists.
    changed_options = config_differences(earlier, json.loads(json.dumps(plan.config)))
    if changed_options:
        raise InputError(
            f"{plan.output}: holds results with other options ({'; '.join(changed_options)}): "
            "choose another `output`"
        )


def _load_image_results(path: Path, inputs_digest: str) -> list[Measurement] | None:
    """Read an image's numbers from an earlier run.

    Returns:
        The measurements; None if the image is to be measured: the file is missing or damaged, a
        picture is missing or was changed, or photos or metrics are not those of `inputs_digest`.
    """
    # A file that is missing, or damaged in any way, counts as not measured.
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        # A flipped bit makes another number.
        content = unsigned(json.loads(path.read_text("utf-8")))
        # A benchmark saves no pictures, so there is nothing to compare.
        pictures_match = not content["files"] or matches_records(
            path.parent, path.name, content["files"]
        )
        if pictures_match and content["inputs"] == inputs_digest:
            # A row is a list of a measurement's fields, in the order of their declaration.
            return [Measurement(*values) for values in content["rows"]]
    return None
