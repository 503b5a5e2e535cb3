"""A process that does one task after the other within limits, and ends with its parent."""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from multiprocessing import connection
from pathlib import Path
from typing import Any, Literal, NamedTuple

from spackle.runtime.errors import (
    InputError,
    NotEnoughMemory,
    is_memory_shortage,
    reason_in_a_line,
)

WORKER_DIED = "the worker process died, probably because memory ran out"
TaskEvent = Mapping[str, Any]  # what a task reports while it runs, such as its progress
SendEvent = Callable[[TaskEvent], None]
# Does a task, and reports by the second argument. The function and its tasks are pickled. It raises
# an InputError if a task cannot be done.
TaskFunction = Callable[[Any, SendEvent], None]

# Errors of the operating system that are the fault of this machine, not of what a task was given:
# a full or broken disk, and too many open files.
MACHINE_ERRORS = {
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EIO,
    errno.EROFS,
    errno.EMFILE,
    errno.ENFILE,
}
# Lists the size in pages of a process of Linux, its address space first.
SIZE_FILE = Path("/proc/self/statm")
# Files with the bytes that a container may take, in both versions of Linux's control groups.
CONTAINER_LIMIT_FILES = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
# Only on Linux, a process can be forked from a small server that has all modules imported already,
# which takes 0.1 seconds in place of 5. Elsewhere that server, or its libraries, may not be forked.
STARTS_QUICKLY = sys.platform.startswith("linux")
# Set when the first process has been forked from that server.
_has_forked = threading.Event()


class TaskLimits(NamedTuple):
    """What a task may take; None: as much as it likes."""

    seconds: float | None = None  # by the clock
    cpu_seconds: int | None = None  # of computing, of all threads together
    memory_bytes: int | None = None  # beyond what the process has at the task's start


class TaskFailure(NamedTuple):
    """Why a task was not done."""

    # input: what the task was given is unusable. machine: the disk is full, for example; the same
    # task may succeed later. died: the process ended by itself. bug: any other exception.
    kind: Literal["input", "machine", "time", "memory", "died", "cancelled", "bug"]
    line: str


NO_LIMITS = TaskLimits()
CANCELLED = TaskFailure("cancelled", "the work was cancelled")


def machine_fault(error: BaseException | None) -> OSError | None:
    """The error of the operating system, such as a full disk, that has caused an exception.

    None if this machine has no part in it. `error` may be an InputError that was raised from it.
    """
    for cause in _causes(error):
        if isinstance(cause, OSError) and cause.errno in MACHINE_ERRORS:
            return cause
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an exception, the one that it was raised from, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def machine_memory() -> int | None:
    """The bytes of memory of this machine, or of the container that this process runs in.

    None where the system does not say: the processes of such systems cannot be limited, either.
    """
    try:
        sizes = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    except (AttributeError, ValueError, OSError):  # Windows
        return None
    for file in CONTAINER_LIMIT_FILES:
        # The file may be missing, or say "max".
        with contextlib.suppress(OSError, ValueError):
            sizes.append(int(file.read_text()))
    return min(sizes)


def import_ahead(*modules: str) -> None:
    """Have modules, and numba, imported once for all processes that start later, where possible.

    Their import must start no thread, because threads do not survive a fork. A module that cannot
    be imported is left to the processes.
    """
    if STARTS_QUICKLY:
        names = ["spackle.runtime.loaded_kernels", *modules]
        multiprocessing.get_context("forkserver").set_forkserver_preload(names)


def end_server_that_imports() -> None:
    """End the server that forks processes if it has forked none yet, because it still imports.

    Who waits for that first process gets an EOFError or an OSError, in place of seconds later a
    process. The next start of a process starts another server.
    """
    if not STARTS_QUICKLY or _has_forked.is_set():
        return
    from multiprocessing import forkserver

    # Python offers no way to end it that does not wait for the end of its imports.
    server = getattr(forkserver, "_forkserver", None)
    pid = getattr(server, "_forkserver_pid", None)
    if pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def process_context() -> Any:
    """The way in which processes start here, a context of `multiprocessing`.

    They are never forked from the caller, because torch's threads do not survive a fork.
    """
    return multiprocessing.get_context("forkserver" if STARTS_QUICKLY else "spawn")


class TaskProcess:
    """A worker process and the connection to it."""

    def __init__(self, work: TaskFunction, gpu_number: int | None = None) -> None:
        """Start the process, which will call `work` for each task.

        Args:
            work: does a task.
            gpu_number: number of the GPU on which the process computes, modulo the number of this
                machine's GPUs; None: the GPU that torch uses by default.

        Raises:
            OSError, EOFError: no process can be started.
        """
        context = process_context()
        self._pipe, worker_pipe = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(worker_pipe, work, gpu_number, dict(os.environ)), daemon=True
        )
        try:
            self._process.start()
        except BaseException:
            self._pipe.close()
            raise
        finally:
            # Only the worker may hold its end, so that the pipe breaks when the worker dies.
            worker_pipe.close()
        if STARTS_QUICKLY:
            _has_forked.set()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return bool(self._process.is_alive())

    @property
    def pid(self) -> int:
        """The number of the process."""
        number: int = self._process.pid
        return number

    def kill(self, *, wait: bool = True) -> None:
        """End the process at once; `wait` for the end, which another thread may do, too."""
        self._process.kill()
        if wait:
            self._process.join()

    def do(
        self, task: object, on_event: SendEvent, limits: TaskLimits = NO_LIMITS
    ) -> TaskFailure | None:
        """Do a task, and wait for its end; returns None, or why it was not done.

        A process that exceeds a limit of time is dead afterwards.

        Args:
            task: first argument of the process's function.
            on_event: called in this process with each event that the function sends.
            limits: what the task may take.
        """
        end = None if limits.seconds is None else time.monotonic() + limits.seconds
        try:
            self._pipe.send((task, limits))
            while True:
                seconds_left = None if end is None else max(0.0, end - time.monotonic())
                if not self._pipe.poll(seconds_left):
                    self.kill()
                    return _too_long(limits.seconds)
                # The worker sends events, which are mappings; the end is None or a failure.
                message = self._pipe.recv()
                if not isinstance(message, Mapping):
                    failure: TaskFailure | None = message
                    return failure
                on_event(message)
        except (EOFError, OSError):  # the pipe broke: the process has died
            self.kill()
            if limits.cpu_seconds is not None and self._process.exitcode == -signal.SIGXCPU:
                return _too_long(limits.cpu_seconds)
            return TaskFailure("died", WORKER_DIED)


def _too_long(seconds: float | None) -> TaskFailure:
    """The failure of a task that was ended after `seconds`."""
    return TaskFailure("time", f"took longer than {seconds:g} seconds, the limit")


def _serve(
    pipe: connection.Connection,
    work: TaskFunction,
    gpu_number: int | None,
    environment: Mapping[str, str],
) -> None:
    """Run in the worker process: do the tasks that come through the pipe until it closes.

    After each task, None is sent, or a `TaskFailure`. The number of the GPU is that of
    `TaskProcess`; `environment` is that of the parent.
    """
    become_child(environment)
    if gpu_number is not None:
        from spackle.runtime.device import use_gpu  # only here, because it loads torch

        use_gpu(gpu_number)
    while True:
        try:
            task, limits = pipe.recv()
        except EOFError:  # the parent has closed the pipe
            return
        failure = None
        try:
            with _limited(limits):
                work(task, pipe.send)
        except Exception as error:  # the worker lives on, because the next task may succeed
            failure = _failure_of(error)
        pipe.send(failure)


def _failure_of(error: Exception) -> TaskFailure:
    """What the parent learns of an exception that a task has raised."""
    fault = machine_fault(error)
    if fault is not None:
        return TaskFailure("machine", reason_in_a_line(fault))
    if isinstance(error, NotEnoughMemory):
        return TaskFailure("memory", str(error))  # it says what helps
    if any(map(is_memory_shortage, _causes(error))):
        return TaskFailure("memory", "needs more memory than it may take")
    if isinstance(error, InputError):
        return TaskFailure("input", " ".join(str(error).split()))
    traceback.print_exception(error)
    return TaskFailure("bug", f"internal error: {type(error).__name__}: {reason_in_a_line(error)}")


@contextlib.contextmanager
def _limited(limits: TaskLimits) -> Iterator[None]:
    """Limit the time of computing and the memory of this process during the block.

    A process that computes for too long is ended by the system. One that asks for too much memory
    gets a MemoryError, where the system has such a limit (Linux).
    """
    if limits.cpu_seconds is None and limits.memory_bytes is None:
        yield
        return
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        yield
        return

    former = {kind: resource.getrlimit(kind) for kind in (resource.RLIMIT_CPU, resource.RLIMIT_AS)}
    soft_limits: dict[int, int] = {}
    if limits.cpu_seconds is not None:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        soft_limits[resource.RLIMIT_CPU] = (
            int(usage.ru_utime + usage.ru_stime) + 1 + limits.cpu_seconds
        )
        # The system would write the memory of the process that it ends into a file.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if limits.memory_bytes is not None and SIZE_FILE.exists():
        pages = int(SIZE_FILE.read_text().split()[0])
        soft_limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + limits.memory_bytes

    for kind, soft_limit in soft_limits.items():
        hard_limit = former[kind][1]
        if hard_limit != resource.RLIM_INFINITY:
            soft_limit = min(soft_limit, hard_limit)
        resource.setrlimit(kind, (soft_limit, hard_limit))
    try:
        yield
    finally:
        for kind in soft_limits:
            resource.setrlimit(kind, former[kind])


def become_child(environment: Mapping[str, str]) -> None:
    """Set up a process that has just started: its parent decides what Ctrl-C ends, and it ends
    with its parent.

    `environment` replaces the variables of this process. They are those of the server that it was
    forked from, which may have been started in another environment.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.clear()
    os.environ.update(environment)


def _end_with_parent() -> None:
    """Wait until the parent process has ended, then end this process at once.

    Without a thread that does this, a worker whose parent was killed would run for ever.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
