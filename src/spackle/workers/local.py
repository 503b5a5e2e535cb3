"""Workers in this process, or in processes of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

from spackle.errors import InputError

QUEUED = 2  # jobs of a worker: the one it works on, and the next; results that are not yet taken use memory
MAX_WORKERS = 1024


class Job(Protocol):
    """A photo to work on; it is pickled."""

    @property
    def path(self) -> Path:
        """The photo's file, for messages."""


J = TypeVar("J", bound=Job)
R = TypeVar("R")
J_contra = TypeVar("J_contra", bound=Job, contravariant=True)
R_co = TypeVar("R_co", covariant=True)


class PhotoWorker(Protocol[J_contra, R_co]):
    """Does one job after the other."""

    @property
    def setup(self) -> Mapping[str, Any]:
        """What decides its results besides the jobs, ready for JSON: the same on every machine."""

    def inputs(self, job: J_contra) -> object:
        """The contents of the files that a job reads, as they lie on this machine."""

    def make(self, job: J_contra) -> R_co:
        """The result, which is pickled; InputError where no job can be done."""


@dataclasses.dataclass(frozen=True)
class Workers:
    """The number of processes, and where they work."""

    count: int = 1
    threads: int = 2  # of each
    ray: str | None = None  # address of their cluster; this machine where None
    gpu: bool = False  # each takes one, on a cluster that has any

    def check(self) -> None:
        """InputError for a number that cannot be."""
        for name, value in (("--workers", self.count), ("--threads", self.threads)):
            if not 1 <= value <= MAX_WORKERS:
                raise InputError(f"{name} must be between 1 and {MAX_WORKERS}, got {value}")


@contextlib.contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Compute with this number of threads during the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def at_work_here(
    workers: Workers, open_worker: Callable[[], PhotoWorker[J, R]], jobs: Sequence[J], stop: Callable[[], bool]
) -> Iterator[Iterator[R]]:
    """As `at_work`, on this machine; InputError also if a worker dies, unless `stop` says why."""
    if workers.count == 1 or len(jobs) < 2:
        with threads_of_torch(workers.threads):
            yield map(open_worker().make, jobs)
        return
    count = min(workers.count, len(jobs))
    spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_start, initargs=(workers.threads, open_worker))
    try:
        yield results_of((pool.submit(_make, job) for job in jobs), QUEUED * count, stop)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def results_of(futures: Iterable[Future[R]], most: int = 1, stop: Callable[[], bool] = lambda: False) -> Iterator[R]:
    """Results as they come, of at most `most` futures at a time; no more once SIGTERM came to all processes."""
    left, pending = iter(futures), set[Future[R]]()
    try:
        while pending := pending | set(itertools.islice(left, most - len(pending))):
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        if stop():
            return
        raise InputError(
            "a worker process died, most likely for want of memory: take fewer --workers; the same command goes on"
        ) from error


_open_worker: Callable[[], PhotoWorker[Any, Any]]  # of a worker process; its errors belong to a job's result


def _start(threads: int, open_worker: Callable[[], PhotoWorker[Any, Any]]) -> None:
    """Begin as a worker, which leaves Ctrl-C to the main process and ends with it."""
    global _open_worker
    _open_worker = functools.cache(open_worker)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    torch.set_num_threads(threads)


def _make(job: Any) -> Any:
    return _open_worker().make(job)


def _end_with(sentinel: int) -> None:
    """A worker whose main process was killed would wait for ever."""
    connection.wait([sentinel])
    os._exit(1)
