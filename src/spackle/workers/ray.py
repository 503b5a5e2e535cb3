"""Workers on a Ray cluster, with the same results as those here (optional: pip install 'spackle-nvs[ray]')."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch

from spackle.errors import InputError, reason_in_a_line
from spackle.folders import differences
from spackle.workers.local import QUEUED, J, PhotoWorker, R, Workers, at_work_here

ANSWER_S = 30.0  # for a cluster to answer
START_S = 600.0  # for a worker to start where there is none, on a cluster that has room for it
RETRIES = 3  # of a photo whose worker died
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
    """Why nobody answers, or None; a process of its own asks, as Ray tries for minutes and then ends its process."""
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

    def __init__(self, open_worker: Callable[[], PhotoWorker[Any, Any]], threads: int, folder: str) -> None:
        self.open_worker, self.node = open_worker, f"node {socket.gethostname()}"
        torch.set_num_threads(threads)
        with contextlib.suppress(OSError):  # without this folder of the main process, its relative paths fail later
            os.chdir(folder)

    def begin(self, expected: Mapping[str, Any]) -> None:
        """Set up; InputError if version or weights differ from the main process's."""
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
        """As `PhotoWorker.make`; InputError also if the node sees another photo or depth map."""
        if self.worker.inputs(job) != expected:
            raise InputError(
                f"{job.path}: {self.node} does not find this photo or its depth map, or others in "
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
    return contextlib.closing(_results(ray, workers, open_worker, jobs, log))


def _results(
    ray: Any, workers: Workers, open_worker: Callable[[], PhotoWorker[J, R]], jobs: Sequence[J], log: Log
) -> Generator[R, None, None]:
    """As `at_work`, on the cluster; InputError also for a node unlike the others.

    A worker that dies is logged and replaced, and its jobs are queued again; InputError after `RETRIES` deaths at one
    photo. Ray's `ActorPool` does not name the call that failed.
    """
    here, queue, deaths = open_worker(), deque(jobs), Counter[Path | None]()  # deaths by photo; None as workers start
    gpus = gpus_of(workers, ray.nodes())
    kind = ray.remote(num_cpus=workers.threads, num_gpus=gpus, max_restarts=0)(RemoteWorker)
    queued: dict[Any, list[J]] = {}  # of each worker that has started; it works on the first
    calls: dict[Any, tuple[Any, J | None]] = {}  # worker and job of each awaited answer; no job as it starts
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
                    "cluster busy, or its nodes have gone: start again when it has room; the same command goes on"
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
    """Log a worker's death; InputError where it is one too many."""
    deaths[photo] += 1
    where = f"--ray {workers.ray}: as it started" if photo is None else f"{photo}: at this photo"
    if deaths[photo] > RETRIES:
        raise InputError(
            f"{where} a worker died for the {deaths[photo]}th time ({why}): most likely for want of memory: "
            "take fewer --workers on a node; the same command goes on"
        )
    log(f"{where} a worker died, and another takes its place ({why})")
