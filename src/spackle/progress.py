"""Progress of long work: bars on a terminal, lines in a log. Also ends long work at Ctrl-C."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta

from rich.console import Console
from rich.filesize import decimal
from rich.markup import escape
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from spackle.errors import one_line

Step = Callable[[int, int], None]  # (done, of how many)


@contextlib.contextmanager
def timed(stage: str, seconds: dict[str, float]) -> Iterator[None]:
    """Add the block's duration to `seconds[stage]`."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start


def counted(count: int, thing: str) -> str:
    """`1 shard`, `2 shards`."""
    return f"{count:,} {thing}{'' if count == 1 else 's'}"


@contextlib.contextmanager
def progress_line(name: str, shown: bool = True) -> Iterator[Step]:
    """Yields a function of (done, of how many) that draws a bar on one line, in terminals and notebooks alike."""
    start = time.monotonic()

    def draw(done: int, total: int) -> None:
        if shown:
            bar = "█" * (20 * done // total) if total else ""
            print(f"\r{name:<10}{bar:<20} {done}/{total} {time.monotonic() - start:.0f} s", end="", file=sys.stderr)

    yield draw
    if shown:
        print(file=sys.stderr)


class Reporter:
    """Logs what is going on, and how long each stage took, to `console` (None: the standard error).

    `verbose` logs details, too; `as_json` prints each result as a line of JSON on the standard output, for scripts.
    """

    def __init__(self, verbose: bool = False, console: Console | None = None, *, as_json: bool = False) -> None:
        self.console = console or Console(stderr=True, highlight=False)
        self.verbose = verbose
        self.as_json = as_json
        self.seconds: dict[str, float] = {}  # of each stage so far

    def restarted(self) -> Reporter:
        """A copy of this reporter for the next photo, with no stage timed yet."""
        other = copy.copy(self)
        other.seconds = {}
        return other

    def result(self, values: Mapping[str, object]) -> None:
        """Print a result as JSON, if scripts asked for it."""
        if self.as_json:
            print(json.dumps(values, allow_nan=False, default=str), flush=True)  # paths are given as text

    def log(self, line: str) -> None:
        """Print a line."""
        self.console.print(escape(one_line(line)), soft_wrap=True)

    def warn(self, line: str) -> None:
        """Print a warning: a line about something that could not be done as asked."""
        self.log(line)

    def detail(self, line: str) -> None:
        """Print a line if `verbose`."""
        if self.verbose:
            self.log(line)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Step]:
        """Time a stage into `self.seconds[name]`; yields a function to call as it advances."""
        start, busy = time.perf_counter(), time.process_time()
        if self.console.is_terminal:
            with self._bars(MofNCompleteColumn()) as bars:
                task = bars.add_task(name, total=None)
                yield lambda done, total: bars.update(task, completed=done, total=total)
        else:
            yield lambda done, total: None
        elapsed = time.perf_counter() - start
        self.seconds[name] = round(self.seconds.get(name, 0.0) + elapsed, 3)
        cores = os.cpu_count() or 1
        busy = (time.process_time() - busy) / max(elapsed, 1e-9) / cores
        self.detail(f"  {name}: {elapsed:.2f} s, {counted(cores, 'core')} {min(busy, 1.0):.0%} busy")

    @contextlib.contextmanager
    def steps(self, name: str, start: int, total: int) -> Iterator[Callable[[int, str], None]]:
        """Report equal steps from `start` on; yields a function of (done, a remark). A log gets a line for each."""
        if self.console.is_terminal:
            with self._bars(MofNCompleteColumn(), TextColumn("{task.fields[remark]}")) as bars:
                task = bars.add_task(name, total=total, completed=start, remark="")
                yield lambda done, remark: bars.update(task, completed=done, remark=remark)
        else:
            begin = time.monotonic()

            def tell(done: int, remark: str) -> None:
                left = (time.monotonic() - begin) / max(1, done - start) * (total - done)
                self.log(f"{name}: {done} of {total}, {remark}, {timedelta(seconds=round(left))} left")

            yield tell

    @contextlib.contextmanager
    def transfer(self, name: str) -> Iterator[Step]:
        """Report a transfer; yields a function of (bytes done, of how many). A log gets a line for each tenth."""
        if self.console.is_terminal:
            with self._bars(DownloadColumn(), TransferSpeedColumn()) as bars:
                task = bars.add_task(name, total=None)

                def advance(done: int, total: int) -> None:
                    if not 0 < bars.tasks[0].completed <= done:  # bytes of earlier runs would distort the speed
                        bars.reset(task, total=total, completed=done)
                    bars.update(task, completed=done)

                yield advance
        else:
            said = 0

            def tell(done: int, total: int) -> None:
                nonlocal said
                if (tenth := done * 10 // total) != said and done < total:
                    said = tenth
                    self.log(f"{name}: {decimal(done)} of {decimal(total)}")

            yield tell

    def _bars(self, *columns: ProgressColumn) -> Progress:
        description = TextColumn("{task.description:<12}")
        return Progress(description, BarColumn(), *columns, TimeRemainingColumn(), console=self.console, transient=True)


class LogReporter(Reporter):
    """Reports to the logger "spackle", and draws progress on one line of the standard error if asked to."""

    def __init__(self, progress: bool = False) -> None:
        super().__init__()
        self._progress, self._log = progress, logging.getLogger("spackle")

    def log(self, line: str) -> None:
        self._log.info(line)

    def warn(self, line: str) -> None:
        self._log.warning(line)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Step]:
        with progress_line(name, self._progress and name in ("base", "complete")) as step:
            yield step


class Notes(Reporter):
    """Collects messages in a worker, for the main process to print."""

    def __init__(self, verbose: bool = False) -> None:
        super().__init__(verbose, Console(file=io.StringIO(), force_terminal=False))
        self.said: list[str | Mapping[str, object]] = []

    def result(self, values: Mapping[str, object]) -> None:
        self.said.append(values)

    def log(self, line: str) -> None:
        self.said.append(line)


@contextlib.contextmanager
def asked_to_stop(alone: bool) -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether Ctrl-C or SIGTERM came, so that a run can end between two steps.

    A second Ctrl-C ends the run at once, except under torchrun, which sends the first Ctrl-C a second time.
    """
    asked: list[int] = []  # not an Event: a signal that arrives while an Event is set waits for its lock for ever
    if threading.current_thread() is not threading.main_thread():  # only the main thread gets signals
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
