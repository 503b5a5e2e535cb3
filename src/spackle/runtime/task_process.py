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
TaskEvent = Mapping[str, Any]
SendEvent = Callable[[TaskEvent], None]
TaskFunction = Callable[
    [Any, SendEvent], None
]  # pickled, like tasks; raises InputError if a task cannot be done


class TaskProcess:
    """A worker process and its connection."""

    def __init__(self, work: TaskFunction) -> None:
        spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
        self._pipe, theirs = spawn.Pipe()
        self._process = spawn.Process(target=_serve, args=(theirs, work), daemon=True)
        self._process.start()
        theirs.close()

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def kill(self) -> None:
        self._process.kill()
        self._process.join()

    def do(self, task: object, tell: SendEvent) -> str | None:
        """Do a task; returns None, or a line with the reason for a failure."""
        try:
            self._pipe.send(task)
            while isinstance(event := self._pipe.recv(), Mapping):
                tell(event)
        except (EOFError, OSError):
            self.kill()
            return WORKER_DIED
        error: str | None = event
        return error


def _serve(pipe: connection.Connection, work: TaskFunction) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    threading.Thread(target=end_with_parent, daemon=True).start()
    while True:
        error = None
        try:
            work(pipe.recv(), pipe.send)
        except EOFError:
            return
        except InputError as problem:
            error = " ".join(str(problem).split())
        except Exception as bug:  # or too little memory: the next task may succeed
            traceback.print_exc()
            error = f"internal error: {type(bug).__name__}: {reason_in_a_line(bug)}"
        pipe.send(error)  # ends the task


def end_with_parent() -> None:
    """Wait until the parent process has ended, then end this process, which would otherwise run for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
