"""Divide jobs between the machines of a Ray cluster (optional: pip install 'spackle-nvs[ray]').

Ray starts the worker processes, and starts them again, perhaps on another machine, if a process or
its machine dies. It keeps no results: workers write them into a folder that all machines share.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

import spackle
from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.worker_options import WorkerOptions

# A job that has ended its process so often will do so again, for instance because memory runs out.
RETRIES = 3
# A worker always has its next job at hand; more jobs would have to be done again if it dies.
JOBS_PER_WORKER = 2
MARK_NAME = ".ray"  # a file in the folder of the results while a cluster works on them
POLL_SECONDS = 0.5  # between two looks whether the user wants the command to end


class Surroundings(NamedTuple):
    """What every worker must find as the command found it."""

    version: str  # of Spackle
    current_folder: str  # relative paths start here
    mark: Path  # a file in the folder of the results
    mark_text: bytes  # its content; who reads it sees the same folder
    environment: dict[str, str]  # variables that say where weights lie


@contextlib.contextmanager
def ray_map(
    open_worker: Callable[[], Any],
    jobs: Sequence[Any],
    stop: Callable[[], bool],
    options: WorkerOptions,
    shared: Path,
) -> Iterator[Iterator[Any]]:
    """Do jobs on a Ray cluster; yields an iterator of the results, as they arrive.

    Args:
        open_worker: makes an object whose `make(job)` returns a job's result; called in each
            worker process. A job may be done twice if a worker dies, so `make` must see whether
            its result exists.
        jobs: arguments of `make`; at least one.
        stop: whether the user has asked the command to end; if so, the results end.
        options: of the workers. Their `ray` is HOST:PORT, "auto" for the cluster that this machine
            belongs to, or "local" for one that is started here for this command. Each worker takes
            `threads` CPUs of its machine, and with `gpu` one GPU if the cluster has any. Without
            a `count` there are as many as the cluster has room for.
        shared: the folder of the results, which all machines see by this path.

    Raises:
        InputError: Ray or the cluster is missing, no machine has room for a worker, a worker does
            not see the folder or runs another version, or a job has ended its worker several times.
    """
    ray = _connect(str(options.ray))
    # Of one name, so that the next run removes that of a killed one.
    mark = shared.absolute() / MARK_NAME
    mark_text = uuid.uuid4().hex.encode()
    try:
        room, gpu_count = _room(ray, options)
        mark.write_bytes(mark_text)
        worker_class = ray.remote(
            num_cpus=options.threads,
            num_gpus=gpu_count,
            max_restarts=-1,  # as often as machines die
            max_task_retries=RETRIES,
        )(RayWorker)
        surroundings = Surroundings(
            version=spackle.__version__,
            current_folder=os.getcwd(),
            mark=mark,
            mark_text=mark_text,
            environment={
                name: value for name, value in os.environ.items() if name.startswith("SPACKLE_")
            },
        )
        # Pickled here, so that a worker of another version can say so before it reads them.
        opener = ray.cloudpickle.dumps(open_worker)
        worker_count = min(options.count or room, len(jobs))
        workers = [
            worker_class.remote(surroundings, opener, options.threads) for _ in range(worker_count)
        ]
        yield _results_as_they_arrive(ray, workers, jobs, stop)
    finally:
        mark.unlink(missing_ok=True)
        ray.shutdown()  # ends the workers


def _connect(address: str) -> Any:
    """Connect to a cluster, and return the package ray; InputError if either is missing."""
    try:
        import ray
    except ImportError as error:
        raise InputError("`ray` needs Ray: pip install 'spackle-nvs[ray]'") from error

    # Spackle contacts nobody unasked; by default Ray reports to its makers that it was started.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # For a cluster of this command alone no dashboard is started, which would take jobs from
    # everybody who can reach its port. To a cluster that runs already Ray passes no such option.
    own_cluster = {"include_dashboard": False} if address == "local" else {}
    # Ray sets a handler for SIGTERM, but the command has its own, which ends it between two jobs.
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **own_cluster)
    except Exception as error:  # Ray raises errors of many kinds here
        reason = reason_in_a_line(error)
        if address == "local":
            # Ray gives its processes half a minute to start, whatever else the machine does.
            message = f"no cluster starts here ({reason}): try again when less else runs"
        else:
            message = (
                f"no cluster answers ({reason}): "
                "start one with `ray start --head`, or give `ray` local"
            )
        raise InputError(f"`ray` {address}: {message}") from error
    finally:
        if in_main_thread:
            signal.signal(signal.SIGTERM, handler)
    return ray


def _room(ray: Any, options: WorkerOptions) -> tuple[int, int]:
    """How many workers the cluster has room for, and how many GPUs each takes: 0 or 1.

    InputError if no machine of the cluster is large enough for one worker.
    """
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    # Networks run on GPUs where there are any, and a worker without one would be much slower.
    takes_gpu = options.gpu and any(resources.get("GPU", 0) for resources in machines)
    room = 0
    for resources in machines:
        machine_room = int(resources.get("CPU", 0)) // options.threads
        if takes_gpu:
            machine_room = min(machine_room, int(resources.get("GPU", 0)))
        room += machine_room
    if not room:
        needed = f"{options.threads} CPUs" + (" beside its GPU" if takes_gpu else "")
        raise InputError(
            f"`ray` {options.ray}: no machine of the cluster has {needed}, as each worker needs: "
            "give fewer `threads`"
        )
    return room, int(takes_gpu)


def _results_as_they_arrive(
    ray: Any, workers: Sequence[Any], jobs: Sequence[Any], stop: Callable[[], bool]
) -> Iterator[Any]:
    """Yield the results of jobs in the order in which the workers finish them.

    A worker gets its first job once it runs, because a full cluster starts some of them late.
    """
    remaining_jobs = iter(jobs)
    pending = {worker.is_ready.remote(): worker for worker in workers}  # future -> its worker
    waiting_jobs = dict.fromkeys(workers, 0)
    unready = set(pending)
    while pending and not stop():
        done, _ = ray.wait(list(pending), num_returns=1, timeout=POLL_SECONDS)
        for future in done:
            worker = pending.pop(future)
            result = _result_of(ray, future)
            is_job = future not in unready
            waiting_jobs[worker] -= is_job

            for _ in range(JOBS_PER_WORKER - waiting_jobs[worker]):
                job = next(remaining_jobs, None)
                if job is not None:
                    pending[worker.make.remote(pickle.dumps(job))] = worker
                    waiting_jobs[worker] += 1
            # An idle worker makes room for one that has lost its machine with jobs at hand.
            if waiting_jobs[worker] == 0:
                ray.kill(worker)
            if is_job:
                yield result


def _result_of(ray: Any, future: Any) -> Any:
    """The result of a call of a worker; InputError if the worker has died too often."""
    try:
        return ray.get(future)
    except ray.exceptions.RayTaskError as error:  # an exception in the worker's own code
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise InputError(
            f"a worker died {RETRIES + 1} times at the same job, probably because memory ran out: "
            "start fewer workers on a machine, by more `threads` for each; "
            f"the same command resumes ({reason_in_a_line(error)})"
        ) from error


class RayWorker:
    """A worker process of the cluster. All arguments are plain, so that any version reads them."""

    def __init__(self, surroundings: Surroundings, opener: bytes, threads: int) -> None:
        """Set up the process; the object that does the jobs is opened with the first one.

        Args:
            surroundings: what the worker must find.
            opener: the pickled function that makes this object.
            threads: torch's threads.
        """
        self.surroundings = surroundings
        self.opener = opener
        self.worker: Any = None
        torch.set_num_threads(threads)

    def is_ready(self) -> bool:
        """Returns True once the process runs."""
        return True

    def make(self, pickled_job: bytes) -> Any:
        """Do a job; InputError if this machine is not as the command's."""
        if self.worker is None:
            self._check_surroundings()
            self.worker = pickle.loads(self.opener)()
        return self.worker.make(pickle.loads(pickled_job))

    def _check_surroundings(self) -> None:
        """Go to the command's current folder; InputError if it, results or version differ."""
        expected = self.surroundings
        machine = f"machine {os.uname().nodename} of the Ray cluster"
        if spackle.__version__ != expected.version:
            raise InputError(
                f"{machine} runs Spackle {spackle.__version__}, and the command "
                f"{expected.version}: install one version everywhere"
            )
        mark_text = b""
        with contextlib.suppress(OSError):
            mark_text = expected.mark.read_bytes()
        if mark_text != expected.mark_text:
            raise InputError(
                f"{machine} does not see {expected.mark.parent}: all machines need the same "
                "`output` by the same path, such as a network folder"
            )
        os.environ.update(expected.environment)
        try:
            os.chdir(expected.current_folder)
        except OSError as error:
            raise InputError(
                f"{machine} does not see {expected.current_folder}: start the command in a folder "
                "that all machines share"
            ) from error
