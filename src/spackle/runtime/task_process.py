"""A process that does one task after the other, reports progress, and ends with its parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Mapping
from multiprocessing import connection
from typing import Any

from spackle.runtime.errors import InputError, reason_in_a_line

WORKER_DIED = "the worker process died, probably because memory ran out"
TaskEvent = Mapping[str, Any]  # what a task reports while it runs, such as its progress
SendEvent = Callable[[TaskEvent], None]
# Does a task, and reports by the second argument. The function and its tasks are pickled. It raises
# an InputError if a task cannot be done.
TaskFunction = Callable[[Any, SendEvent], None]


class TaskProcess:
    """A worker process and the connection to it."""

    def __init__(self, work: TaskFunction, gpu_number: int | None = None) -> None:
        """Start the process, which will call `work` for each task.

        Args:
            work: does a task.
            gpu_number: number of the GPU on which the process computes, modulo the number of this
                machine's GPUs; None: the GPU that torch uses by default.
        """
        spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
        self._pipe, worker_pipe = spawn.Pipe()
        self._process = spawn.Process(
            target=_serve, args=(worker_pipe, work, gpu_number), daemon=True
        )
        self._process.start()
        # Only the worker may hold its end, so that the pipe breaks when the worker dies.
        worker_pipe.close()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.is_alive()

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.join()

    def do(self, task: object, on_event: SendEvent) -> str | None:
        """Do a task, and wait for its end; returns None, or a line with the reason for a failure.

        Args:
            task: first argument of the process's function.
            on_event: called in this process with each event that the function sends.
        """
        try:
            self._pipe.send(task)
            # The worker sends events, which are mappings; the end of the task is None or a text.
            message = self._pipe.recv()
            while isinstance(message, Mapping):
                on_event(message)
                message = self._pipe.recv()
        except (EOFError, OSError):  # the pipe broke: the process has died
            self.kill()
            return WORKER_DIED
        error: str | None = message
        return error


def _serve(pipe: connection.Connection, work: TaskFunction, gpu_number: int | None) -> None:
    """Run in the worker process: do the tasks that come through the pipe until it closes.

    After each task, None is sent, or a line with the reason for its failure. The number of the GPU
    is that of `TaskProcess`.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    threading.Thread(target=end_with_parent, daemon=True).start()
    if gpu_number is not None:
        from spackle.runtime.device import use_gpu  # only here, because it loads torch

        use_gpu(gpu_number)
    while True:
        error = None
        try:
            work(pipe.recv(), pipe.send)
        except EOFError:  # the parent has closed the pipe
            return
        except InputError as problem:
            error = " ".join(str(problem).split())
        except Exception as bug:  # the worker lives on, because the next task may succeed
            traceback.print_exc()
            error = f"internal error: {type(bug).__name__}: {reason_in_a_line(bug)}"
        pipe.send(error)


def end_with_parent() -> None:
    """Wait until the parent process has ended, then end this process at once.

    Without a thread that does this, a worker whose parent was killed would run for ever.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
