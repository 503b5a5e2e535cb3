"""Samples made by workers on a Ray cluster, the same as those made here (optional: pip install 'spackle-nvs[ray]')."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from spackle.bases.open import kind_of
from spackle.errors import InputError, reason_in_a_line
from spackle.jobs.dataset.crew import Crew
from spackle.jobs.dataset.options import DatasetOptions
from spackle.jobs.dataset.worker import Job, Made

ANSWER_S = 30.0  # for a cluster to answer


@contextlib.contextmanager
def cluster(options: DatasetOptions) -> Iterator[None]:
    """Connected to the cluster of --ray, if any; it is left without a trace, and one of our own ends.

    Raises:
        InputError: Ray is not installed, nothing answers at the address, or there is too little room.
    """
    if options.ray is None:
        yield
        return
    ray = _ray(options.ray)
    try:
        _connect(ray, options.ray, options.workers * options.threads)
        _check_room(options, ray.nodes())
        yield
    finally:
        ray.shutdown()  # ends our workers too


@contextlib.contextmanager
def at_work_on_ray(
    options: DatasetOptions, output: Path, jobs: Sequence[Job], say: Callable[[str], None]
) -> Iterator[Iterator[Made]]:
    """As `at_work`, within `cluster`: results as they come, in any order; `say` is told of workers that died.

    Raises:
        InputError: a base, node, folder or disk that cannot be used, or a photo at which workers die.
    """
    ray = _ray(str(options.ray))
    crew = Crew(ray, options, output, jobs, gpus_of(options, ray.nodes()), say)
    try:
        yield crew.results()
    finally:
        crew.end()


def _ray(address: str) -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would report to its makers
    try:
        import ray
    except ImportError as error:
        raise InputError(f"--ray {address}: needs a package: pip install 'spackle-nvs[ray]'") from error
    return ray


def _connect(ray: Any, address: str, cpus: int) -> None:
    """Where the cluster is our own, it gets as many processes as are asked for, as a run without Ray does."""
    own: dict[str, Any] = {"num_cpus": cpus, "include_dashboard": False} if address == "local" else {}
    reason = None if own else _silence(address)
    if reason is None:
        try:
            with _signals_kept():
                ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **own)
            with contextlib.suppress(AttributeError):  # of each death it prints a page, and we say a line
                ray._private.worker._worker_logs_enabled = False
            return
        except (OSError, RuntimeError, ValueError) as error:
            reason = reason_in_a_line(error)
    raise InputError(
        f"--ray {address}: no cluster: {reason}: is one running there (`ray start --head`), "
        "and does it want RAY_AUTH_MODE=token in the environment?"
    )


def _silence(address: str) -> str | None:
    """Why nobody answers; asked in a process of its own, for Ray tries for minutes and then ends its process."""
    code = "import ray, sys; ray.init(sys.argv[1], log_to_driver=False)"
    words = [sys.executable, "-W", "ignore", "-c", code, address]
    try:
        done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=ANSWER_S)
    except subprocess.TimeoutExpired:
        return f"no answer within {ANSWER_S:g} seconds"
    said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return reason_in_a_line(said[-1]) if done.returncode else None


@contextlib.contextmanager
def _signals_kept() -> Iterator[None]:
    """Ray takes SIGTERM for itself when it connects."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check_room(options: DatasetOptions, nodes: Sequence[Mapping[str, Any]]) -> None:
    """Ray would wait for room for ever; what is busy now does count, what an autoscaler could add does not."""
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
    """GPUs of a worker: one where a network would use it and any node has one, so all workers are alike."""
    network = kind_of(options.base.base).network or options.inpainter == "propainter"
    there = any(node["Alive"] and node["Resources"].get("GPU", 0) >= 1 for node in nodes)
    return int(network and there and options.base.device != "cpu")
