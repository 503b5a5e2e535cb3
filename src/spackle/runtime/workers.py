"""Divide jobs between processes: of this machine, or of a Ray cluster."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import torch

from spackle.runtime.device import use_gpu
from spackle.runtime.errors import InputError
from spackle.runtime.task_process import become_child, import_ahead, process_context
from spackle.runtime.worker_options import WorkerOptions

# A process always has its next job at hand; more jobs would keep more results in memory.
JOBS_PER_PROCESS = 2


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use this number of threads inside the `with` block."""
    previous_count = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(previous_count)


@contextlib.contextmanager
def parallel_map(
    open_worker: Callable[[], Any],
    jobs: Sequence[Any],
    stop: Callable[[], bool],
    workers: WorkerOptions,
    shared: Path,
) -> Iterator[Iterator[Any]]:
    """Do jobs in several processes; yields an iterator of the results, as they arrive.

    Args:
        open_worker: makes an object whose `make(job)` returns a job's result; called once in each
            process. The function, jobs and results are pickled. On a Ray cluster a job may be done
            twice if a machine dies, so `make` must see whether its result exists.
        jobs: arguments of `make`.
        stop: whether the user has asked the command to end; if so, a dead process is no error, but
            ends the results.
        workers: the processes. One process on this machine is the calling one.
        shared: the folder into which `make` writes; the machines of a cluster must share it.

    Raises:
        InputError: no worker can be made, or a process has died.
    """
    if workers.ray is not None and jobs:
        from spackle.runtime.ray_workers import ray_map  # only here, because Ray is optional

        with ray_map(open_worker, jobs, stop, workers, shared) as results:
            yield results
        return

    process_count = min(workers.count or 1, len(jobs))
    if process_count < 2:
        # One process more would only cost memory and time to start.
        with torch_threads(workers.threads):
            yield map(open_worker().make, jobs)
        return

    # Where processes can be forked from one that has imported all that they need, they start at
    # once, and share the memory of these modules.
    import_ahead(__name__, _module_of(open_worker))
    context = process_context()
    # Each process takes one number, which chooses its GPU; None means no GPU.
    gpu_numbers = context.SimpleQueue()
    for number in range(process_count):
        gpu_numbers.put(number if workers.gpu else None)

    pool = ProcessPoolExecutor(
        process_count,
        context,
        initializer=_start_process,
        initargs=(workers.threads, open_worker, gpu_numbers, dict(os.environ)),
    )
    try:
        yield _results_as_they_arrive(pool, jobs, JOBS_PER_PROCESS * process_count, stop)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _module_of(open_worker: Callable[[], Any]) -> str:
    """The name of the module that defines a function, or one with some arguments given."""
    function = open_worker.func if isinstance(open_worker, functools.partial) else open_worker
    return str(function.__module__)


def _results_as_they_arrive(
    pool: ProcessPoolExecutor, jobs: Sequence[Any], max_pending: int, stop: Callable[[], bool]
) -> Iterator[Any]:
    """Yield the results of jobs in the order in which the processes of the pool finish them.

    Args:
        pool: its processes were set up by `_start_process`.
        jobs: arguments of the worker's `make`.
        max_pending: number of jobs that the pool has at a time. It gets no more, because results
            that nobody has taken yet fill the memory.
        stop: whether the user has asked the command to end.

    Raises:
        InputError: a process has died, though the user did not stop the command.
    """
    remaining_jobs = iter(jobs)
    pending: set[Future[Any]] = set()
    try:
        while True:
            for job in itertools.islice(remaining_jobs, max_pending - len(pending)):
                pending.add(pool.submit(_make, job))
            if not pending:
                return
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        # A user who stops the command may have ended its processes, too; that is no error.
        if not stop():
            raise InputError(
                "a worker process died, probably because memory ran out: give fewer `workers`; "
                "the same command resumes"
            ) from error


# Set in each worker process. It makes the worker at the first job and then returns the same one:
# only jobs can report errors to the main process, so it may not fail before.
_get_worker: Callable[[], Any]


def _start_process(
    threads: int,
    open_worker: Callable[[], Any],
    gpu_numbers: Any,
    environment: Mapping[str, str],
) -> None:
    """Set up a worker process: it ignores Ctrl-C, ends with the main process, and takes a GPU.

    Args:
        threads: torch's threads.
        open_worker: makes the object that does the jobs.
        gpu_numbers: a queue that holds one number, or None for no GPU, for each process.
        environment: that of the main process.
    """
    # The worker is made at the first job, because only jobs can report errors to the main process.
    global _get_worker
    _get_worker = functools.cache(open_worker)
    become_child(environment)
    torch.set_num_threads(threads)

    use_gpu(gpu_numbers.get())


def _make(job: Any) -> Any:
    """Do a job in a worker process."""
    return _get_worker().make(job)
