"""Ending a long job between two steps, where nothing is half done."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn


def exit_on_sigterm() -> None:
    """SIGTERM ends the process with code 143, after every `finally`: no half-written file stays."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _end)


def _end(number: int, frame: object) -> NoReturn:
    sys.exit(128 + number)


@contextlib.contextmanager
def asked_to_stop(alone: bool) -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C or SIGTERM came, which then ends the run between two steps.

    A second Ctrl-C ends it at once; not so under torchrun, which passes on what the terminal has sent already.
    """
    asked: list[int] = []  # no Event: its lock would hold up a second signal that comes while it is set, for ever
    if threading.current_thread() is not threading.main_thread():  # signals are not for this one
        yield lambda: False
        return

    def note(number: int, frame: object) -> None:
        asked.append(number)
        if alone:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
