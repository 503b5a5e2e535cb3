"""Workers on a Ray cluster, with the same results as those here (optional: pip install 'spackle-nvs[ray]')."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Generic

import torch

from spackle.errors import InputError, reason_in_a_line
from spackle.files import differences
from spackle.workers.local import IN_HAND, J, PhotoWorker, R, Workers, at_work_here

ANSWER_S = 30.0  # for a cluster to answer
START_S = 600.0  # for a worker to start where there is none, on a cluster that has room for it
RETRIES = 3  # of a photo whose worker died
STARTING = -1  # in place of a job's index, for deaths before the first job
Log = Callable[[str], None]


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
    own: dict[str, Any] = {"num_cpus": cpus, "include_dashboard": False} if address == "local" else {}
    reason = None if own else _silence(address)
    if reason is None:
        before = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **own)
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
    """Why nobody answers, or None; a process of its own asks, as Ray tries for minutes and then ends its process."""
    code = "import ray, sys; ray.init(sys.argv[1], log_to_driver=False)"
    words = [sys.executable, "-W", "ignore", "-c", code, address]
    try:
        done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=ANSWER_S)
    except subprocess.TimeoutExpired:
        return f"no answer within {ANSWER_S:g} seconds"
    said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return reason_in_a_line(said[-1]) if done.returncode else None


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
    there = any(node["Alive"] and node["Resources"].get("GPU", 0) >= 1 for node in nodes)
    return int(there and workers.gpu)


class RemoteWorker:
    """A `PhotoWorker` on a node, which has to see the same files as the main process."""

    def __init__(self, open_worker: Callable[[], PhotoWorker[Any, Any]], threads: int, folder: str) -> None:
        self.open_worker = open_worker
        torch.set_num_threads(threads)
        with contextlib.suppress(OSError):  # without this folder of the main process, its relative paths fail later
            os.chdir(folder)

    def begin(self, expected: Mapping[str, Any]) -> None:
        """Set up; InputError if version or weights differ from the main process's."""
        try:
            self.worker = self.open_worker()
            own = self.worker.setup
        except InputError as error:
            raise InputError(f"node {socket.gethostname()}: {error}") from error
        if lines := differences(expected, own):
            raise InputError(
                f"node {socket.gethostname()}: would give other results ({'; '.join(lines)}): "
                "install the same version and the same weights on every node"
            )

    def make(self, job: Any, seen: object) -> Any:
        """As `PhotoWorker.make`; InputError also if the node sees another photo or depth map."""
        if self.worker.inputs(job) != seen:
            raise InputError(
                f"{job.path}: node {socket.gethostname()} does not find this photo or its depth map, or others in "
                "their place: they must lie at the same paths on every node, on a disk that all share"
            )
        return self.worker.make(job)


def at_work(
    ray: Any,
    workers: Workers,
    open_worker: Callable[[], PhotoWorker[J, R]],
    jobs: Sequence[J],
    log: Log,
    stop: Callable[[], bool],
) -> AbstractContextManager[Iterator[R]]:
    """Results as they come, in any order: from this process with one worker, from several, or on the cluster `ray`.

    Each process calls `open_worker`, which is pickled, once. InputError where no job can be done. Where SIGTERM, of
    which `stop` tells, ends the processes of this machine, the results end, too.
    """
    if ray is None:
        return at_work_here(workers, open_worker, jobs, stop)
    return _at_work_on(ray, workers, open_worker, jobs, log)


@contextlib.contextmanager
def _at_work_on(
    ray: Any, workers: Workers, open_worker: Callable[[], PhotoWorker[J, R]], jobs: Sequence[J], log: Log
) -> Iterator[Iterator[R]]:
    """As `at_work`, on the cluster; logs dead workers. InputError also for a node unlike the others."""
    pool = WorkerPool(ray, workers, open_worker, jobs, log)
    try:
        yield pool.results()
    finally:
        for worker in pool.workers:
            ray.kill(worker.actor)


@dataclasses.dataclass(eq=False)
class _Process(Generic[J]):
    """A process on a node."""

    actor: Any
    ready: bool = False
    jobs: dict[int, J] = dataclasses.field(default_factory=dict)  # in hand; it works on the first


class WorkerPool(Generic[J, R]):
    """Workers with few jobs each, replaced when they die; Ray's `ActorPool` does not name the call that failed."""

    def __init__(
        self, ray: Any, workers: Workers, open_worker: Callable[[], PhotoWorker[J, R]], jobs: Sequence[J], log: Log
    ) -> None:
        """Start workers on `ray`, which is connected to a cluster."""
        self.ray, self.options, self.open_worker, self.log = ray, workers, open_worker, log
        self.left, self.deaths = deque(enumerate(jobs)), Counter[int]()  # deaths by the index of the job
        self.here = open_worker()  # for what the others are compared with
        gpus = gpus_of(workers, ray.nodes())
        self.kind = ray.remote(num_cpus=workers.threads, num_gpus=gpus, max_restarts=0)(RemoteWorker)
        self.workers: list[_Process[J]] = []
        self.calls: dict[Any, tuple[_Process[J], int]] = {}  # awaited answers, in the order of their questions
        for _ in range(min(workers.count, len(jobs))):
            self._start_worker()

    def results(self) -> Iterator[R]:
        """Results as they come."""
        while self.left or any(worker.jobs for worker in self.workers):
            self._hand_out()
            started = any(worker.ready for worker in self.workers)
            done, _ = self.ray.wait(list(self.calls), timeout=None if started else START_S)
            if not done:
                raise InputError(
                    f"--ray {self.options.ray}: no worker could start within {START_S:g} seconds: others keep the "
                    "cluster busy, or its nodes have gone: start again when it has room; the same command goes on"
                )
            worker, index = self.calls.pop(done[0])
            try:
                answer = self.ray.get(done[0])
            except self.ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except self.ray.exceptions.RayError as error:  # the process has died, or its node
                self._replace(worker, reason_in_a_line(error))
                continue
            if worker.ready:
                del worker.jobs[index]
                yield answer
            else:
                worker.ready, self.deaths[STARTING] = True, 0

    def _start_worker(self) -> None:
        worker = _Process[J](self.kind.remote(self.open_worker, self.options.threads, os.getcwd()))
        self.workers.append(worker)
        self.calls[worker.actor.begin.remote(self.here.setup)] = worker, STARTING

    def _hand_out(self) -> None:
        """Give each worker few jobs at a time: results that are not yet taken use memory."""
        for have in range(IN_HAND):
            for worker in self.workers:
                if self.left and worker.ready and len(worker.jobs) == have:
                    index, job = self.left.popleft()
                    worker.jobs[index] = job
                    self.calls[worker.actor.make.remote(job, self.here.inputs(job))] = worker, index

    def _replace(self, worker: _Process[J], why: str) -> None:
        """Start another worker and queue the jobs of this one again; InputError after `RETRIES` deaths."""
        self.ray.kill(worker.actor)  # it may only be out of reach
        self.workers.remove(worker)
        self.calls = {call: other for call, other in self.calls.items() if other[0] is not worker}
        index, job = next(iter(worker.jobs.items()), (STARTING, None))
        self.deaths[index] += 1
        where = f"--ray {self.options.ray}: as it started" if job is None else f"{job.path}: at this photo"
        if self.deaths[index] > RETRIES:
            raise InputError(
                f"{where} a worker died for the {self.deaths[index]}th time ({why}): most likely for want of memory: "
                "take fewer --workers on a node; the same command goes on"
            )
        self.log(f"{where} a worker died, and another takes its place ({why})")
        self.left.extendleft(reversed(worker.jobs.items()))
        self._start_worker()
