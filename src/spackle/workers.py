"""Divide jobs between processes, on this machine or a Ray cluster; each process sets up once.

Ray (optional: pip install 'spackle-nvs[ray]') gives the same results as local processes.
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

QUEUED = 2  # jobs per worker: the current one and the next; more would hold more uncollected results in memory
MAX_WORKERS = 1024
ANSWER_S = 30.0  # how long a Ray cluster may take to answer
START_S = 600.0  # how long the first worker may take to start on a cluster that has room for it
RETRIES = 3  # how often a photo is tried again after its worker died
Log = Callable[[str], None]
R = TypeVar("R")


class PhotoWorker(Protocol):
    """Does one job after the other. Jobs are pickled; messages name a job's photo by its `path`."""

    @property
    def setup(self) -> Mapping[str, Any]:
        """Everything but the job that affects results, ready for JSON; it must be the same on every machine."""

    def inputs(self, job: Any) -> object:
        """Digests of the files that a job reads, as they lie on this machine."""

    def make(self, job: Any) -> Any:
        """Do a job and return its result, which is pickled; InputError if no job can be done."""


@dataclasses.dataclass(frozen=True)
class Workers:
    """How many processes work, and where."""

    count: int = 1
    threads: int = 2  # threads per process
    ray: str | None = None  # address of a Ray cluster; None: this machine
    gpu: bool = False  # on a cluster with GPUs each worker takes one; on this machine the workers share them

    def check(self) -> None:
        """InputError if a number is out of bounds."""
        for name, value in (("--workers", self.count), ("--threads", self.threads)):
            if not 1 <= value <= MAX_WORKERS:
                raise InputError(f"{name} must be between 1 and {MAX_WORKERS}, got {value}")


@contextlib.contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Let torch use this number of threads inside the `with` block."""
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
    """Yield results as they arrive, in any order, from the cluster `ray`; if that is None, from this machine.

    A single worker runs in this process. Each process calls `open_worker`, which is pickled, once. InputError if no job
    can be done. If SIGTERM ends this machine's processes and `stop` returns True, the results end without an error.
    """
    if ray is None:
        return at_work_here(workers, open_worker, jobs, stop)
    return contextlib.closing(_results(ray, workers, open_worker, jobs, log))


# On this machine ----------------------------------------------------------------------------------


@contextlib.contextmanager
def at_work_here(
    workers: Workers, open_worker: Callable[[], PhotoWorker], jobs: Sequence[Any], stop: Callable[[], bool]
) -> Iterator[Iterator[Any]]:
    """Like `at_work`, on this machine; InputError also if a worker dies, unless `stop` returns True."""
    if workers.count == 1 or len(jobs) < 2:
        with threads_of_torch(workers.threads):
            yield map(open_worker().make, jobs)
        return
    count = min(workers.count, len(jobs))
    spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    numbers = spawn.SimpleQueue()  # each process takes one number
    for number in range(count):
        numbers.put(number)
    start = workers.threads, open_worker, numbers if workers.gpu else None
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_start, initargs=start)
    try:
        yield results_of((pool.submit(_make, job) for job in jobs), QUEUED * count, stop)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def results_of(futures: Iterable[Future[R]], most: int = 1, stop: Callable[[], bool] = lambda: False) -> Iterator[R]:
    """Yield results as they arrive, with at most `most` futures pending; SIGTERM to all processes ends them."""
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


_open_worker: Callable[[], PhotoWorker]  # set in each worker process; a job calls it and reports its errors


def _start(threads: int, open_worker: Callable[[], PhotoWorker], numbers: Any) -> None:
    """Set up a worker process: it ignores Ctrl-C, ends with the main process, and gets a GPU by `numbers`."""
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
    """The `ray` package, connected to the cluster of --ray; None without --ray. `local` clusters end with the block.

    InputError if Ray is not installed, nothing answers at the address, or the cluster is too small.
    """
    if workers.ray is None:
        yield None
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # otherwise Ray reports usage to its makers
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
    """Connect to a cluster; `local` starts one on this machine with this number of CPUs."""
    local: dict[str, Any] = {"num_cpus": cpus, "include_dashboard": False} if address == "local" else {}
    reason = None if local else _silence(address)
    if reason is None:
        before = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **local)
            with contextlib.suppress(AttributeError):  # Ray prints a page for each dead worker; we log a line
                ray._private.worker._worker_logs_enabled = False
            return
        except (OSError, RuntimeError, ValueError) as error:
            reason = reason_in_a_line(error)
        finally:
            if threading.current_thread() is threading.main_thread():  # only there does Ray replace the SIGTERM handler
                signal.signal(signal.SIGTERM, before)
    raise InputError(
        f"--ray {address}: no cluster: {reason}: is one running there (`ray start --head`), "
        "and does it need RAY_AUTH_MODE=token in the environment?"
    )


def _silence(address: str) -> str | None:
    """The reason why no cluster answers; None if one does.

    A separate process connects, because Ray tries for minutes and then ends the process it runs in.
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
    """InputError if a cluster is too small: Ray would wait for ever. Busy CPUs count as free."""
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
    """The number of GPUs per worker: 1 if workers can use one and any node has one, else 0."""
    return int(workers.gpu and any(node["Alive"] and node["Resources"].get("GPU", 0) >= 1 for node in nodes))


class RemoteWorker:
    """A `PhotoWorker` on a cluster node; the node must see the same files as the main process."""

    def __init__(self, open_worker: Callable[[], PhotoWorker], threads: int, folder: str) -> None:
        self.open_worker, self.node = open_worker, f"node {socket.gethostname()}"
        torch.set_num_threads(threads)
        with contextlib.suppress(OSError):  # if the node lacks the main process's folder, relative paths fail later
            os.chdir(folder)

    def begin(self, expected: Mapping[str, Any]) -> None:
        """Set up the worker; InputError if its version or weights differ from the main process's."""
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
        """Like `PhotoWorker.make`; InputError also if the photo or depth map has other content on this node."""
        if self.worker.inputs(job) != expected:
            raise InputError(
                f"{job.path}: {self.node} does not find this photo or its depth map, or finds other "
                "files in their place: they must lie at the same paths on every node, on a disk that all share"
            )
        return self.worker.make(job)


def _results(
    ray: Any, workers: Workers, open_worker: Callable[[], PhotoWorker], jobs: Sequence[Any], log: Log
) -> Generator[Any, None, None]:
    """Like `at_work`, on the cluster; InputError also if a node's setup differs from the main process's.

    When a worker dies, the death is logged, a new worker starts, and the lost jobs are queued again; more than
    `RETRIES` deaths at one photo raise InputError. Ray's `ActorPool` would not tell which call failed.
    """
    here, queue, deaths = open_worker(), deque(jobs), Counter[Path | None]()  # deaths by photo; key None: during start
    gpus = gpus_of(workers, ray.nodes())
    kind = ray.remote(num_cpus=workers.threads, num_gpus=gpus, max_restarts=0)(RemoteWorker)
    queued: dict[Any, list[Any]] = {}  # jobs of each started worker; it works on the first
    calls: dict[Any, tuple[Any, Any]] = {}  # worker and job of each pending call; job None: the worker is starting
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
                    f"--ray {workers.ray}: no worker could start within {START_S:g} seconds: other jobs keep the "
                    "cluster busy, or its nodes have gone: start again when it has room; the same command resumes"
                )
            worker, finished = calls.pop(done[0])
            try:
                answer = ray.get(done[0])
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except ray.exceptions.RayError as error:  # the process or its node has died
                ray.kill(worker)  # it may be alive but unreachable
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
    """Log a worker's death; InputError after more than `RETRIES` at one photo."""
    deaths[photo] += 1
    where = f"--ray {workers.ray}: as it started" if photo is None else f"{photo}: at this photo"
    if deaths[photo] > RETRIES:
        raise InputError(
            f"{where} a worker died for the {deaths[photo]}th time ({why}): most likely for want of memory: "
            "take fewer --workers on a node; the same command resumes"
        )
    log(f"{where} a worker died, and another takes its place ({why})")
