"""Who makes the samples of a dataset: this process, or several at once."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from pathlib import Path

import torch

from spackle.bases.open import BaseError
from spackle.bases.protocol import BasePrediction
from spackle.device import MemoryShort
from spackle.errors import InputError
from spackle.formats import atomic_path
from spackle.image import Photo
from spackle.jobs.dataset.options import DatasetOptions, depth_of
from spackle.jobs.setup import Tools, make_base, set_up
from spackle.pseudo.build import Seconds, key_of, make_sample, timed
from spackle.pseudo.inpainters import Inpainter, get_inpainter
from spackle.pseudo.photos import PhotoFile

PARTS = "parts"  # in the output: samples that are in no shard yet
IN_HAND = 2  # photos of a worker: the one it works on, and the next


@dataclasses.dataclass(frozen=True)
class Made:
    """What became of a photo."""

    index: int
    seconds: Seconds
    problem: str | None  # why there is no sample


Job = tuple[int, PhotoFile]


def part_file(output: Path, index: int) -> Path:
    """Where a photo's sample waits for its shard."""
    return output / PARTS / f"{key_of(index)}.tar"


@dataclasses.dataclass(frozen=True)
class Maker:
    """A base, a renderer and an inpainter, at work on one photo after the other."""

    options: DatasetOptions
    output: Path
    tools: Tools
    inpainter: Inpainter

    @staticmethod
    def of(options: DatasetOptions, output: Path) -> Maker:
        """Set up; a network is loaded with the first photo. InputError where that cannot be."""
        tools = set_up(options.base)
        return Maker(options, output, tools, get_inpainter(options.inpainter, tools.renderer, options.for_inpainter))

    def make(self, job: Job) -> Made:
        """Write a photo's sample, whole or not at all.

        Raises:
            InputError: no photo can be worked on, or nothing can be written.
        """
        return keep(self.output, *self.sample(job))

    def sample(self, job: Job) -> tuple[Made, bytes | None]:
        """A photo's sample, or None where it gives none.

        Raises:
            InputError: no photo can be worked on.
        """
        index, photo = job
        seconds: Seconds = {}
        predict = functools.partial(self._predict, photo)
        tools, choices = self.tools, self.options.choices
        try:
            data = make_sample(photo, key_of(index), predict, tools.renderer, self.inpainter, choices, seconds)
        except BaseError:
            raise
        except InputError as error:
            return Made(index, seconds, str(error)), None
        return Made(index, seconds, None), data

    def _predict(self, file: PhotoFile, photo: Photo) -> BasePrediction:
        options = self.options.base
        if options.depth is None:
            try:
                return make_base(photo, options, self.tools).predict(photo)
            except MemoryShort as error:  # no fault of the photo's
                raise BaseError(str(error)) from error
        depth = depth_of(file, options.depth)
        return make_base(photo, dataclasses.replace(options, depth=depth), self.tools).predict(photo)


def keep(output: Path, made: Made, data: bytes | None) -> Made:
    """Write a sample, if there is one, where it waits for its shard; InputError where that cannot be."""
    if data is not None:
        with timed("write", made.seconds), atomic_path(part_file(output, made.index)) as temporary:
            temporary.write_bytes(data)
    return made


@contextlib.contextmanager
def at_work(options: DatasetOptions, output: Path, jobs: Sequence[Job]) -> Iterator[Iterator[Made]]:
    """Results as they come, in any order; with one worker in this process.

    Raises:
        InputError: a base, folder or disk that cannot be used, or a worker that died.
    """
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
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_start, initargs=(options, output))
    try:
        yield _results((pool.submit(_make, job) for job in jobs), IN_HAND * count)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _results(futures: Iterable[Future[Made]], most: int = 1) -> Iterator[Made]:
    """Results as they come; the next future is taken when fewer than `most` are open."""
    left, open_ones = iter(futures), set[Future[Made]]()
    try:
        while open_ones := open_ones | set(itertools.islice(left, most - len(open_ones))):
            done, open_ones = wait(open_ones, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process died, most likely for want of memory: take fewer --workers; the same command goes on"
        ) from error


_maker: Callable[[], Maker] | None = None  # of this worker process


def _start(options: DatasetOptions, output: Path) -> None:
    """Begin as a worker: Ctrl-C is the main process's, and without that one there is nothing to do."""
    global _maker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    torch.set_num_threads(options.threads)
    _maker = functools.cache(lambda: Maker.of(options, output))  # what it says goes wrong belongs to a photo's result


def _make(job: Job) -> Made:
    assert _maker is not None
    return _maker().make(job)


def _end_with(sentinel: int) -> None:
    """A worker whose main process was killed would wait for ever."""
    connection.wait([sentinel])
    os._exit(1)
