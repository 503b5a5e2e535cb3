"""What a worker process of a test does, in a module that a new process imports in no time."""

from __future__ import annotations

import errno
import os
import threading
from typing import Any

from spackle.runtime.errors import InputError, NotEnoughMemory


def work(task: Any, send_event: Any) -> None:
    """Do what the task says."""
    kind, value = task
    send_event({"pid": os.getpid(), "home": os.environ.get("SPACKLE_TEST")})
    if kind == "wait":
        threading.Event().wait()
    if kind == "compute":
        while True:
            pass
    if kind == "allocate":
        bytearray(value)
    if kind == "die":
        os._exit(3)
    if kind == "refuse":
        raise InputError("a.png: no\nphoto")
    if kind == "disk":
        raise InputError("a.png: cannot write") from OSError(errno.ENOSPC, "No space left")
    if kind == "torch":
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory")
    if kind == "network":
        try:
            raise RuntimeError("CUDA out of memory")
        except RuntimeError as error:
            raise NotEnoughMemory("not enough memory: give a smaller model") from error
    if kind == "bug":
        raise KeyError(value)
