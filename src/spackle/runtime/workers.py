"""Divide jobs between processes of this machine."""

from __future__ import annotations

import contextlib
import functools
import itertools
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import torch

from spackle.runtime.errors import InputError
from spackle.runtime.task_process import end_with_parent

QUEUED = (
    2  # jobs per process: the current and the next job; more jobs would keep more results in memory
)


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use this number of threads inside the `with` block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def parallel_map(
    open_worker: Callable[[], Any],
    jobs: Sequence[Any],
    stop: Callable[[], bool],
    count: int,
    threads: int,
    gpu: bool,
) -> Iterator[Iterator[Any]]:
    """Yield the results of jobs as they arrive, in any order.

    Args:
        open_worker: makes an object whose `make(job)` returns a job's result; called once in each process. The
            function, jobs and results are pickled.
        stop: whether the user has asked the command to end; if so, a dead process is no error, but ends the results.
        count: number of processes; with 1, jobs run in this process.
        threads: torch's threads in each process.
        gpu: whether each process uses one GPU.

    Raises:
        InputError: no job can be done, or a process has died.
    """
    count = min(count, len(jobs))
    if count < 2:
        with torch_threads(threads):
            yield map(open_worker().make, jobs)
        return
    spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    numbers = (
        spawn.SimpleQueue()
    )  # each process takes one number, which chooses its GPU; None: no GPU
    for number in range(count):
        numbers.put(number if gpu else None)
    pool = ProcessPoolExecutor(
        count, spawn, initializer=_start, initargs=(threads, open_worker, numbers)
    )
    try:
        yield _results(pool, jobs, QUEUED * count, stop)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _results(
    pool: ProcessPoolExecutor, jobs: Sequence[Any], most: int, stop: Callable[[], bool]
) -> Iterator[Any]:
    """Submit at most `most` jobs at a time; yield their results as they arrive."""
    left, pending = iter(jobs), set[Future[Any]]()
    try:
        while pending := pending | {
            pool.submit(_make, job) for job in itertools.islice(left, most - len(pending))
        }:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        if not stop():
            raise InputError(
                "a worker process died, probably because memory ran out: give fewer --workers; the same command resumes"
            ) from error


# Set in each worker process; the first job calls it, because only jobs can report errors.
_open_worker: Callable[[], Any]


def _start(threads: int, open_worker: Callable[[], Any], numbers: Any) -> None:
    """Set up a process: it ignores Ctrl-C, ends with the main process, and chooses its GPU by the next of `numbers`."""
    global _open_worker
    _open_worker = functools.cache(open_worker)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    if (number := numbers.get()) is not None and torch.cuda.device_count() > 1:
        torch.cuda.set_device(number % torch.cuda.device_count())


def _make(job: Any) -> Any:
    return _open_worker().make(job)
