"""Samples made by workers on a Ray cluster, the same as those made here (optional: pip install 'spackle-nvs[ray]')."""

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
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from spackle.bases.open import Log
from spackle.dataset.maker import IN_HAND, Job, Made, Maker, keep
from spackle.dataset.options import DatasetOptions, configuration
from spackle.dataset.photos import PhotoFile
from spackle.dataset.shards import differences
from spackle.digest import fingerprint
from spackle.errors import InputError, reason_in_a_line

ANSWER_S = 30.0  # for a cluster to answer
START_S = 600.0  # for a worker to start where there is none, on a cluster that has room for it
RETRIES = 3  # of a photo whose worker died
STARTING = -1  # in place of a photo's index, for deaths before the first photo


@contextlib.contextmanager
def cluster(options: DatasetOptions) -> Iterator[Any]:
    """The package, connected to the cluster of --ray; None without --ray. A cluster of our own ends with the block.

    InputError where Ray is not installed, nothing answers at the address, or there is too little room.
    """
    if options.ray is None:
        yield None
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would report to its makers
    try:
        import ray as package
    except ImportError as error:
        raise InputError(f"--ray {options.ray}: needs a package: pip install 'spackle-nvs[ray]'") from error
    ray: Any = package
    try:
        _connect(ray, options.ray, options.workers * options.threads)
        _check_room(options, ray.nodes())
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


def _check_room(options: DatasetOptions, nodes: Sequence[Mapping[str, Any]]) -> None:
    """Refuse a cluster that is too small, for which Ray would wait for ever; busy CPUs count as room."""
    alive = [node["Resources"] for node in nodes if node["Alive"]]
    cpus, gpus = options.threads, gpus_of(options, nodes)
    room = sum(int(min(has.get("CPU", 0) // cpus, has.get("GPU", 0) // gpus if gpus else 1e9)) for has in alive)
    if room < options.workers:
        needs = f"{cpus} CPUs" + (" and a GPU" if gpus else "")
        raise InputError(
            f"--ray {options.ray}: room for {room} of {options.workers} workers, which take {needs} each, "
            f"on {len(alive)} nodes: take fewer --workers or --threads, or start more nodes"
        )


def gpus_of(options: DatasetOptions, nodes: Sequence[Mapping[str, Any]]) -> int:
    """GPUs of each worker: 1 if any node has one and a network can use it, else 0."""
    there = any(node["Alive"] and node["Resources"].get("GPU", 0) >= 1 for node in nodes)
    network = options.base.kind.network or options.paints_by_network
    return int(there and network and options.base.device != "cpu")


class RemoteMaker:
    """A `Maker` on a node, which has to see the same files as the main process; it returns samples as bytes."""

    def __init__(self, options: DatasetOptions, folder: str) -> None:
        self.options = options
        torch.set_num_threads(options.threads)
        with contextlib.suppress(OSError):  # without this folder of the main process, its relative paths fail later
            os.chdir(folder)

    def begin(self, expected: Mapping[str, Any]) -> None:
        """Set up; InputError if version or weights differ from the main process's."""
        try:
            self.maker = Maker.of(self.options, Path())
            own = configuration(self.options, (), self.maker.completion)
        except InputError as error:
            raise InputError(f"node {socket.gethostname()}: {error}") from error
        if lines := differences(expected, own):
            raise InputError(
                f"node {socket.gethostname()}: would make another dataset ({'; '.join(lines)}): "
                "install the same version and the same weights on every node"
            )

    def make(self, job: Job, seen: Sequence[str]) -> tuple[Made, bytes | None]:
        """As `Maker.sample`; InputError also if the node sees another photo or depth map."""
        if what_is_seen(job[1], self.options) != seen:
            raise InputError(
                f"{job[1].path}: node {socket.gethostname()} does not find this photo or its depth map, or others in "
                "their place: they must lie at the same paths on every node, on a disk that all share"
            )
        return self.maker.sample(job)


def what_is_seen(photo: PhotoFile, options: DatasetOptions) -> list[str]:
    """The contents of a photo and of its depth map, as they lie on this machine."""
    try:
        content = fingerprint(photo.path, "photo")
    except InputError:
        content = "none"
    return [content, *options.inputs_of(photo)]


@contextlib.contextmanager
def at_work_on_ray(
    ray: Any, options: DatasetOptions, output: Path, jobs: Sequence[Job], log: Log
) -> Iterator[Iterator[Made]]:
    """As `at_work`, on the cluster of `ray`; logs dead workers. InputError also for a node unlike the others."""
    pool = WorkerPool(ray, options, output, jobs, log)
    try:
        yield pool.results()
    finally:
        for worker in pool.workers:
            ray.kill(worker.actor)


@dataclasses.dataclass(eq=False)
class _Worker:
    """A process on a node."""

    actor: Any
    ready: bool = False
    photos: dict[int, PhotoFile] = dataclasses.field(default_factory=dict)  # in hand; it works on the first


class WorkerPool:
    """Workers with few photos each, replaced when they die; Ray's `ActorPool` does not name the call that failed."""

    def __init__(self, ray: Any, options: DatasetOptions, output: Path, jobs: Sequence[Job], log: Log) -> None:
        """Start workers on `ray`, which is connected to a cluster."""
        self.ray, self.options, self.output, self.log = ray, options, output, log
        self.left, self.deaths = deque(jobs), Counter[int]()  # deaths by the index of the photo
        self.expected = configuration(options, (), Maker.of(options, output).completion)
        gpus = gpus_of(options, ray.nodes())
        self.kind = ray.remote(num_cpus=options.threads, num_gpus=gpus, max_restarts=0)(RemoteMaker)
        self.workers: list[_Worker] = []
        self.calls: dict[Any, _Worker] = {}  # answers that are awaited, in the order in which they were asked for
        for _ in range(min(options.workers, len(jobs))):
            self._start_worker()

    def results(self) -> Iterator[Made]:
        """Results as they come."""
        while self.left or any(worker.photos for worker in self.workers):
            self._hand_out()
            started = any(worker.ready for worker in self.workers)
            done, _ = self.ray.wait(list(self.calls), timeout=None if started else START_S)
            if not done:
                raise InputError(
                    f"--ray {self.options.ray}: no worker could start within {START_S:g} seconds: others keep the "
                    "cluster busy, or its nodes have gone: start again when it has room; the same command goes on"
                )
            worker = self.calls.pop(done[0])
            try:
                answer = self.ray.get(done[0])
            except self.ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except self.ray.exceptions.RayError as error:  # the process has died, or its node
                self._replace(worker, reason_in_a_line(error))
                continue
            if worker.ready:
                made, data = answer
                del worker.photos[made.index]
                yield keep(self.output, made, data)
            else:
                worker.ready, self.deaths[STARTING] = True, 0

    def _start_worker(self) -> None:
        worker = _Worker(self.kind.remote(self.options, os.getcwd()))
        self.workers.append(worker)
        self.calls[worker.actor.begin.remote(self.expected)] = worker

    def _hand_out(self) -> None:
        """Give each worker few photos at a time: samples that are not yet written take memory."""
        for have in range(IN_HAND):
            for worker in self.workers:
                if self.left and worker.ready and len(worker.photos) == have:
                    index, photo = self.left.popleft()
                    worker.photos[index] = photo
                    seen = what_is_seen(photo, self.options)
                    self.calls[worker.actor.make.remote((index, photo), seen)] = worker

    def _replace(self, worker: _Worker, why: str) -> None:
        """Start another worker and queue the photos of this one again; InputError after `RETRIES` deaths."""
        self.ray.kill(worker.actor)  # it may only be out of reach
        self.workers.remove(worker)
        self.calls = {call: other for call, other in self.calls.items() if other is not worker}
        index, photo = next(iter(worker.photos.items()), (STARTING, None))
        self.deaths[index] += 1
        where = f"--ray {self.options.ray}: as it started" if photo is None else f"{photo.path}: at this photo"
        if self.deaths[index] > RETRIES:
            raise InputError(
                f"{where} a worker died for the {self.deaths[index]}th time ({why}): most likely for want of memory: "
                "take fewer --workers on a node; the same command goes on"
            )
        self.log(f"{where} a worker died, and another takes its place ({why})")
        self.left.extendleft(reversed(worker.photos.items()))
        self._start_worker()
