"""Photos shared by processes, here or on a Ray cluster: each sets up once, and results come as they are made.

Ray (optional: pip install 'spackle-nvs[ray]') gives the same results as the processes of this machine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import logging
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

from spackle.errors import InputError, reason_in_a_line
from spackle.folders import differences
from spackle.task_process import end_with_parent

QUEUED = 2  # jobs of a worker: the one it works on, and the next; results that are not yet taken use memory
MAX_WORKERS = 1024
ANSWER_S = 30.0  # for a Ray cluster to answer
START_S = 600.0  # for a worker to start where there is none, on a cluster that has room for it
RETRIES = 3  # of a photo whose worker died
Log = Callable[[str], None]
R = TypeVar("R")


class PhotoWorker(Protocol):
    """A worker, which does one job after the other. A job is pickled, and its `path` names the photo in messages."""

    @property
    def setup(self) -> Mapping[str, Any]:
        """The setup that decides results besides the jobs, ready for JSON: it must be the same on every machine."""

    def inputs(self, job: Any) -> object:
        """Digests of the files that a job reads, as they lie on this machine."""

    def make(self, job: Any) -> Any:
        """The result, which is pickled; InputError where no job can be done."""


@dataclasses.dataclass(frozen=True)
class Workers:
    """The number of processes, and where they work."""

    count: int = 1
    threads: int = 2  # of each
    ray: str | None = None  # address of their cluster; this machine where None
    gpu: bool = False  # each takes one, on a cluster that has any; on this machine they share what there is

    def check(self) -> None:
        """InputError for a number out of bounds."""
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


def at_work(
    ray: Any,
    workers: Workers,
    open_worker: Callable[[], PhotoWorker],
    jobs: Sequence[Any],
    log: Log,
    stop: Callable[[], bool],
) -> AbstractContextManager[Iterator[Any]]:
    """Results as they come, in any order: from this process with one worker, from several, or on the cluster `ray`.

    Each process calls `open_worker`, which is pickled, once. InputError where no job can be done. Where SIGTERM, of
    which `stop` tells, ends the processes of this machine, the results end, too.
    """
    if ray is None:
        return at_work_here(workers, open_worker, jobs, stop)
    return contextlib.closing(_results(ray, workers, open_worker, jobs, log))


# On this machine ----------------------------------------------------------------------------------


@contextlib.contextmanager
def at_work_here(
    workers: Workers, open_worker: Callable[[], PhotoWorker], jobs: Sequence[Any], stop: Callable[[], bool]
) -> Iterator[Iterator[Any]]:
    """Like `at_work`, on this machine; InputError also if a worker dies, unless `stop` says why."""
    if workers.count == 1 or len(jobs) < 2:
        with threads_of_torch(workers.threads):
            yield map(open_worker().make, jobs)
        return
    count = min(workers.count, len(jobs))
    spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    numbers = spawn.SimpleQueue()  # each process takes one
    for number in range(count):
        numbers.put(number)
    start = workers.threads, open_worker, numbers if workers.gpu else None
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_start, initargs=start)
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
        if not stop():
            raise InputError(
                "a worker process died, most likely for want of memory: take fewer --workers; the same command resumes"
            ) from error


_open_worker: Callable[[], PhotoWorker]  # of a worker process; its errors belong to a job's result


def _start(threads: int, open_worker: Callable[[], PhotoWorker], numbers: Any) -> None:
    """Start a worker process, which ignores Ctrl-C and ends with the main process; `numbers` assigns the GPUs."""
    global _open_worker
    _open_worker = functools.cache(open_worker)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    if numbers is not None and torch.cuda.device_count() > 1:
        torch.cuda.set_device(numbers.get() % torch.cuda.device_count())


def _make(job: Any) -> Any:
    return _open_worker().make(job)


# On a Ray cluster ---------------------------------------------------------------------------------


@contextlib.contextmanager
def cluster(workers: Workers) -> Iterator[Any]:
    """The package, connected to the cluster of --ray; None without --ray. A cluster of our own ends with the block.

    InputError where Ray is not installed, nothing answers at the address, or there is too little room.
    """
    if workers.ray is None:
        yield None
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would report to its makers
    try:
        import ray as package
    except ImportError as error:
        raise InputError(f"--ray {workers.ray}: needs a package: pip install 'spackle-nvs[ray]'") from error
    ray: Any = package
    try:
        _connect(ray, workers.ray, workers.count * workers.threads)
        _check_room(workers, ray.nodes())
        yield ray
    finally:
        ray.shutdown()  # ends our workers too


def _connect(ray: Any, address: str, cpus: int) -> None:
    """Connect to a cluster, or start one of our own (`local`) with this number of CPUs."""
    local: dict[str, Any] = {"num_cpus": cpus, "include_dashboard": False} if address == "local" else {}
    reason = None if local else _silence(address)
    if reason is None:
        before = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **local)
            with contextlib.suppress(AttributeError):  # of each death it prints a page, and we say a line
                ray._private.worker._worker_logs_enabled = False
            return
        except (OSError, RuntimeError, ValueError) as error:
            reason = reason_in_a_line(error)
        finally:
            if threading.current_thread() is threading.main_thread():  # where Ray takes SIGTERM for itself
                signal.signal(signal.SIGTERM, before)
    raise InputError(
        f"--ray {address}: no cluster: {reason}: is one running there (`ray start --head`), "
        "and does it want RAY_AUTH_MODE=token in the environment?"
    )


def _silence(address: str) -> str | None:
    """Why no cluster answers, or None. A separate process asks, because Ray tries for minutes and then ends its
    process.
    """
    code = "import ray, sys; ray.init(sys.argv[1], log_to_driver=False)"
    words = [sys.executable, "-W", "ignore", "-c", code, address]
    try:
        done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=ANSWER_S)
    except subprocess.TimeoutExpired:
        return f"no answer within {ANSWER_S:g} seconds"
    lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return reason_in_a_line(lines[-1]) if done.returncode else None


def _check_room(workers: Workers, nodes: Sequence[Mapping[str, Any]]) -> None:
    """Refuse a cluster that is too small, for which Ray would wait for ever; busy CPUs count as room."""
    alive = [node["Resources"] for node in nodes if node["Alive"]]
    cpus, gpus = workers.threads, gpus_of(workers, nodes)
    room = sum(int(min(has.get("CPU", 0) // cpus, has.get("GPU", 0) // gpus if gpus else 1e9)) for has in alive)
    if room < workers.count:
        needs = f"{cpus} CPUs" + (" and a GPU" if gpus else "")
        raise InputError(
            f"--ray {workers.ray}: room for {room} of {workers.count} workers, which take {needs} each, "
            f"on {len(alive)} nodes: take fewer --workers or --threads, or start more nodes"
        )


def gpus_of(workers: Workers, nodes: Sequence[Mapping[str, Any]]) -> int:
    """GPUs of each worker: 1 if it can use one and any node has one, else 0."""
    return int(workers.gpu and any(node["Alive"] and node["Resources"].get("GPU", 0) >= 1 for node in nodes))


class RemoteWorker:
    """A `PhotoWorker` on a node, which has to see the same files as the main process."""

    def __init__(self, open_worker: Callable[[], PhotoWorker], threads: int, folder: str) -> None:
        self.open_worker, self.node = open_worker, f"node {socket.gethostname()}"
        torch.set_num_threads(threads)
        with contextlib.suppress(OSError):  # without this folder of the main process, its relative paths fail later
            os.chdir(folder)

    def begin(self, expected: Mapping[str, Any]) -> None:
        """Set the worker up; InputError if version or weights differ from the main process's."""
        try:
            self.worker = self.open_worker()
            setup = self.worker.setup
        except InputError as error:
            raise InputError(f"{self.node}: {error}") from error
        if lines := differences(expected, setup):
            raise InputError(
                f"{self.node}: would give other results ({'; '.join(lines)}): "
                "install the same version and the same weights on every node"
            )

    def make(self, job: Any, expected: object) -> Any:
        """Like `PhotoWorker.make`; InputError also if the node sees another photo or depth map."""
        if self.worker.inputs(job) != expected:
            raise InputError(
                f"{job.path}: {self.node} does not find this photo or its depth map, or others in "
                "their place: they must lie at the same paths on every node, on a disk that all share"
            )
        return self.worker.make(job)


def _results(
    ray: Any, workers: Workers, open_worker: Callable[[], PhotoWorker], jobs: Sequence[Any], log: Log
) -> Generator[Any, None, None]:
    """Like `at_work`, on the cluster; InputError also for a node that differs from the main process.

    A worker that dies is logged and replaced, and its jobs are queued again; InputError after `RETRIES` deaths at one
    photo. Ray's `ActorPool` does not name the call that failed.
    """
    here, queue, deaths = open_worker(), deque(jobs), Counter[Path | None]()  # deaths by photo; None as workers start
    gpus = gpus_of(workers, ray.nodes())
    kind = ray.remote(num_cpus=workers.threads, num_gpus=gpus, max_restarts=0)(RemoteWorker)
    queued: dict[Any, list[Any]] = {}  # of each worker that has started; it works on the first
    calls: dict[Any, tuple[Any, Any]] = {}  # worker and job of each awaited answer; no job as it starts
    missing = min(workers.count, len(jobs))
    try:
        while queue or any(queued.values()):
            for _ in range(missing):
                worker = kind.remote(open_worker, workers.threads, os.getcwd())
                calls[worker.begin.remote(here.setup)] = worker, None
            missing = 0
            for count in range(QUEUED):
                for worker, mine in queued.items():
                    if queue and len(mine) == count:
                        mine.append(job := queue.popleft())
                        calls[worker.make.remote(job, here.inputs(job))] = worker, job
            done, _ = ray.wait(list(calls), timeout=None if queued else START_S)
            if not done:
                raise InputError(
                    f"--ray {workers.ray}: no worker could start within {START_S:g} seconds: others keep the "
                    "cluster busy, or its nodes have gone: start again when it has room; the same command resumes"
                )
            worker, finished = calls.pop(done[0])
            try:
                answer = ray.get(done[0])
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except ray.exceptions.RayError as error:  # the process has died, or its node
                ray.kill(worker)  # it may only be out of reach
                calls = {call: pair for call, pair in calls.items() if pair[0] is not worker}
                lost = queued.pop(worker, [])
                queue.extendleft(reversed(lost))
                _count_death(deaths, lost[0].path if lost else None, workers, reason_in_a_line(error), log)
                missing = 1
                continue
            if finished is None:
                queued[worker], deaths[None] = [], 0
            else:
                queued[worker].remove(finished)
                yield answer
    finally:
        for worker in {worker for worker, _ in calls.values()} | set(queued):
            ray.kill(worker)


def _count_death(deaths: Counter[Path | None], photo: Path | None, workers: Workers, why: str, log: Log) -> None:
    """Log a worker's death; InputError after too many."""
    deaths[photo] += 1
    where = f"--ray {workers.ray}: as it started" if photo is None else f"{photo}: at this photo"
    if deaths[photo] > RETRIES:
        raise InputError(
            f"{where} a worker died for the {deaths[photo]}th time ({why}): most likely for want of memory: "
            "take fewer --workers on a node; the same command resumes"
        )
    log(f"{where} a worker died, and another takes its place ({why})")
