"""`spackle predict`: a photo, a clip or a folder, by this process or by workers. Read `predict_all`."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import spackle
from spackle.bases.open import BaseError
from spackle.cli.clip import clip_options, predict_clip
from spackle.cli.first_use import compiled_ahead
from spackle.cli.photo import (
    REPORT,
    PredictOptions,
    earlier_report,
    predict_photo,
    request_of,
    shared_digest,
    shared_files,
)
from spackle.clips.files import is_clip
from spackle.device import thread_count
from spackle.errors import InputError
from spackle.files import check_file, files_in
from spackle.folders import as_recorded, check_mark, mark, results_folder
from spackle.image import PHOTO_SUFFIXES
from spackle.pipeline import Pipeline
from spackle.progress import Notes, Reporter, asked_to_stop
from spackle.weights import weights_digest
from spackle.workers import Workers, at_work, cluster, threads_of_torch

THREADS_ON_RAY = 2  # of a worker


class NamedPhoto(NamedTuple):
    """A photo, and the name of its results."""

    path: Path
    name: str


def predict_all(photos: Path, output: Path, options: PredictOptions, reporter: Reporter) -> int:
    """Work through a photo, a clip or a folder of photos; returns the number of photos that failed.

    InputError for an option, a clip or a single photo that cannot be used.
    """
    found = find_photos(photos)
    workers = workers_for(options, len(found))
    if is_clip(photos):
        pipeline = Pipeline.open(clip_options(options))
        check_file(photos, "clip")
        with results_folder(output), compiled_ahead(pipeline.renderer, reporter.log):
            predict_clip(photos, output / found[0].name, pipeline, options.lens, reporter)
        return 0
    pipeline = options.open()
    if not os.path.isdir(photos):
        check_file(photos, "photo")
    predictor = Predictor(photos, output, options, shared_digest(options, pipeline), pipeline)
    with (
        cluster(workers) as ray,
        results_folder(output, alone=os.path.isdir(photos) or ray is not None),
        compiled_ahead(pipeline.renderer, reporter.log),
    ):
        left = predictor.left(found, reporter)
        if workers.count == 1 and ray is None:
            with threads_of_torch(workers.threads):
                failed = sum(not predictor.predict(photo, reporter) for photo in left)
        else:
            failed = _predict_by_workers(ray, workers, predictor, list(left), len(found), reporter)
    if failed:
        reporter.log(f"{failed} of {len(found)} photos failed")
    return failed


def workers_for(options: PredictOptions, photos: int) -> Workers:
    """No more than photos, and together as many threads as torch has here; InputError for a number that cannot be."""
    Workers(options.workers, 1 if options.threads is None else options.threads).check()
    count = min(options.workers, photos)
    share = max(1, thread_count() // count) if options.ray is None else THREADS_ON_RAY
    return Workers(count, options.threads or share, options.ray, gpu=options.scene.base.device != "cpu")


def _predict_by_workers(
    ray: Any, workers: Workers, predictor: Predictor, left: Sequence[NamedPhoto], total: int, reporter: Reporter
) -> int:
    """How many photos failed; what is said of each comes when it is done.

    KeyboardInterrupt once the photos at work are done, where Ctrl-C or SIGTERM came.
    """
    if not left:
        return 0
    word = None if ray is None else mark(predictor.output)
    here = (predictor.photos, predictor.output, predictor.options, predictor.shared)
    open_predictor = partial(Predictor.open, *here, verbose=reporter.verbose, word=word)
    failed, ready = 0, total - len(left)
    done = ready
    with (
        asked_to_stop(alone=True) as stop,
        reporter.steps("photos", ready, total) as step,
        at_work(ray, workers, open_predictor, left, reporter.log, stop) as results,
    ):
        for done, result in enumerate(results, ready + 1):
            for what in result.said:
                reporter.log(what) if isinstance(what, str) else reporter.result(what)
            failed += result.failed
            step(done, result.photo)
            if stop():
                break
    if done < total:
        reporter.log("stopped; the same command goes on from here")
        raise KeyboardInterrupt
    return failed


class Predicted(NamedTuple):
    """What became of a photo in a worker."""

    photo: str
    failed: bool
    said: Sequence[str | Mapping[str, object]]


@dataclasses.dataclass(frozen=True)
class Predictor:
    """Predicts one photo after the other."""

    photos: Path  # their folder, or the only one
    output: Path
    options: PredictOptions
    shared: str  # by `shared_digest`, of the main process
    pipeline: Pipeline
    verbose: bool = False

    @staticmethod
    def open(
        photos: Path, output: Path, options: PredictOptions, shared: str, *, verbose: bool, word: str | None
    ) -> Predictor:
        """For a worker; InputError for another folder than the one that was given the mark `word`."""
        if word is not None:
            check_mark(output, word)
        return Predictor(photos, output, options, shared, options.open(), verbose)

    @property
    def setup(self) -> dict[str, str]:
        """Version, and digests of the files that all photos share."""
        files = {**shared_files(self.options.scene), **self.options.scene.base.files}
        return {"spackle": spackle.__version__, **{kind: weights_digest(file) for kind, file in files.items()}}

    def inputs(self, photo: NamedPhoto) -> str:
        """As `request_of`, also where a file is missing."""
        try:
            return request_of(photo.path, self.options.scene.base.depth, self.shared)
        except InputError:  # `predict` names it
            return "none"

    def make(self, photo: NamedPhoto) -> Predicted:
        """As `predict`, for a worker."""
        notes = Notes(self.verbose)
        done = self.predict(photo, notes)
        return Predicted(photo.path.name, not done, notes.said)

    def left(self, found: Iterable[NamedPhoto], reporter: Reporter) -> Iterator[NamedPhoto]:
        """The photos that are not done yet; logs those that are."""
        for photo in found:
            folder = self.output / photo.name
            earlier = {} if photo.path == self.photos or self.options.overwrite else earlier_report(folder)
            if (
                earlier
                and earlier.get("request") == self.inputs(photo)
                and as_recorded(folder, REPORT, earlier.get("files"))
            ):
                reporter.log(f"{photo.path.name}: done already (--overwrite does it again)")
                reporter.result({"folder": folder, "done_already": True})
            else:
                yield photo

    def predict(self, photo: NamedPhoto, reporter: Reporter) -> bool:
        """Whether a photo's results could be made; logs why not. InputError if that holds for all photos."""
        folder = self.output / photo.name
        try:
            request = request_of(photo.path, self.options.scene.base.depth, self.shared)
            predict_photo(photo.path, folder, self.options, self.pipeline, reporter, request)
        except InputError as error:
            if photo.path == self.photos or isinstance(error, BaseError):  # the only one, or no other can be worked on
                raise
            reporter.log(f"error: {error}")
            reporter.result({"folder": folder, "error": str(error)})
            return False
        return True


def find_photos(path: Path) -> list[NamedPhoto]:
    """A photo, or a folder's photos by name, each with the name of its results; InputError for a folder without any."""
    if not os.path.isdir(path):
        return [NamedPhoto(path, path.stem if path.stem.strip(".") else path.name)]  # "...png" has the stem ".."
    photos = files_in(path, PHOTO_SUFFIXES)
    if not photos:
        raise InputError(f"{path}: no photos in this folder (looked for {', '.join(PHOTO_SUFFIXES)})")
    # a.jpg and a.png must not write over each other, nor over a.jpg.png.
    stems = Counter(photo.stem.casefold() for photo in photos)
    names = {photo.name.casefold() for photo in photos}
    taken = {stem for stem, count in stems.items() if count > 1 or stem in names}
    return [NamedPhoto(photo, photo.name if photo.stem.casefold() in taken else photo.stem) for photo in photos]
