"""Makes the samples of a dataset: a photo's base, views, targets and files, in this process or in several."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from pathlib import Path

import torch

from spackle.bases.open import BaseError, OpenedBase, open_base
from spackle.camera_path import DepthRange
from spackle.dataset.completion import Completion, open_completion
from spackle.dataset.options import DatasetOptions
from spackle.dataset.photos import PhotoFile
from spackle.dataset.sample import pack_sample
from spackle.dataset.views import draw_path, path_cameras, render_views
from spackle.errors import InputError
from spackle.formats import atomic_path
from spackle.image import load_photo, resize_photo
from spackle.inpaint import InpainterOptions
from spackle.progress import timed
from spackle.render import Renderer, get_renderer

PARTS = "parts"  # in the output: samples that are in no shard yet
IN_HAND = 2  # photos of a worker: the one it works on, and the next

Seconds = dict[str, float]  # of each stage
Job = tuple[int, PhotoFile]  # a photo, and its place among all


@dataclasses.dataclass(frozen=True)
class Made:
    """What became of a photo."""

    index: int
    seconds: Seconds
    problem: str | None  # why there is no sample


def key_of(index: int) -> str:
    """How a photo's files begin: its place among the photos."""
    return f"{index:06d}"


def part_file(output: Path, index: int) -> Path:
    """Where a photo's sample waits for its shard."""
    return output / PARTS / f"{key_of(index)}.tar"


@dataclasses.dataclass(frozen=True)
class Maker:
    """A base, a renderer and a completion, at work on one photo after the other."""

    options: DatasetOptions
    output: Path
    base: OpenedBase
    renderer: Renderer
    completion: Completion

    @staticmethod
    def of(options: DatasetOptions, output: Path) -> Maker:
        """Set up; a network is loaded with the first photo. InputError where that cannot be."""
        base, renderer = open_base(options.base), get_renderer(options.base.device)
        device = None if options.base.device == "auto" else options.base.device
        wishes = InpainterOptions(options.inpainter_weights, options.inpainter_side, device)
        return Maker(options, output, base, renderer, open_completion(options.inpainter, wishes, renderer))

    def make(self, job: Job) -> Made:
        """Write a photo's sample, whole or not at all; InputError where no photo can be worked on or be written."""
        return keep(self.output, *self.sample(job))

    def sample(self, job: Job) -> tuple[Made, bytes | None]:
        """A photo's sample as a stretch of a tar archive, None if it gives none; BaseError if no photo can."""
        index, file = job
        seconds: Seconds = {}
        try:
            return Made(index, seconds, None), self._sample(key_of(index), file, seconds)
        except BaseError:
            raise
        except InputError as error:
            return Made(index, seconds, str(error)), None

    def _sample(self, key: str, file: PhotoFile, seconds: Seconds) -> bytes:
        with timed("load", seconds):
            photo = load_photo(file.path)
        with timed("base", seconds):
            prediction, _ = self.base.predict(photo, self.options.depth_of(file))
        choices, base, camera = self.options.choices, prediction.gaussians, prediction.camera
        with timed("render", seconds):
            path = draw_path(choices, file.sha256)
            try:
                cameras = path_cameras(path, camera.even(), DepthRange.of(base), choices.views)
            except ValueError as error:
                raise InputError(f"{file.path}: no camera path: {error}") from error
            stack = render_views(base, camera, cameras, self.renderer, choices.threshold)
        with timed("inpaint", seconds):
            targets = self.completion.complete(stack)
        with timed("encode", seconds):
            lens = {"focal_source": prediction.lens_source or photo.focal_source}
            size = {"width": photo.width, "height": photo.height}
            facts = {
                "photo": {"name": file.name, "sha256": file.sha256} | size | lens,
                "base": {"gaussians": len(base), **prediction.notes},
                "inpainter": {"name": self.completion.name, "version": self.completion.version},
                "threshold": choices.threshold,
            }
            return pack_sample(key, resize_photo(photo).rgb, stack, targets, path, facts)


def keep(output: Path, made: Made, data: bytes | None) -> Made:
    """Write a sample, if there is one, where it waits for its shard; InputError where that cannot be."""
    if data is not None:
        with timed("write", made.seconds), atomic_path(part_file(output, made.index)) as temporary:
            temporary.write_bytes(data)
    return made


@contextlib.contextmanager
def at_work(options: DatasetOptions, output: Path, jobs: Sequence[Job]) -> Iterator[Iterator[Made]]:
    """Results as they come, in any order, from this process with one worker; InputError also if a worker dies."""
    if options.workers == 1 or len(jobs) < 2:
        before = torch.get_num_threads()
        torch.set_num_threads(options.threads)
        try:
            maker = Maker.of(options, output)
            yield (maker.make(job) for job in jobs)
        finally:
            torch.set_num_threads(before)
        return
    count = min(options.workers, len(jobs))
    spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_start, initargs=(options.threads,))
    try:
        yield _results((pool.submit(_make, options, output, job) for job in jobs), IN_HAND * count)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _results(futures: Iterable[Future[Made]], most: int = 1) -> Iterator[Made]:
    """Results as they come, of at most `most` futures at a time."""
    left, pending = iter(futures), set[Future[Made]]()
    try:
        while pending := pending | set(itertools.islice(left, most - len(pending))):
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process died, most likely for want of memory: take fewer --workers; the same command goes on"
        ) from error


def _start(threads: int) -> None:
    """Begin as a worker, which leaves Ctrl-C to the main process and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    torch.set_num_threads(threads)


_maker = functools.cache(Maker.of)  # of a worker process; its errors belong to a photo's result


def _make(options: DatasetOptions, output: Path, job: Job) -> Made:
    return _maker(options, output).make(job)


def _end_with(sentinel: int) -> None:
    """A worker whose main process was killed would wait for ever."""
    connection.wait([sentinel])
    os._exit(1)
