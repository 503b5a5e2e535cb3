"""Show the progress of long work as bars on a terminal or lines in a log, and end long work at Ctrl-C."""

from __future__ import annotations

import contextlib
import copy
import json
import logging
import signal
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
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)
from rich.progress import (
    Progress as Bars,
)

from spackle.runtime.errors import printable_line

Progress = Callable[[int, int], None]  # reports (steps done, steps in all)


def pluralized(count: int, thing: str) -> str:
    """`1 shard`, `2 shards`."""
    return f"{count:,} {thing}{'' if count == 1 else 's'}"


class Reporter:
    """Logs messages and progress to `console` (None: the standard error), and times stages.

    `verbose` also logs details; `as_json` prints each result as a line of JSON on the standard output.
    """

    def __init__(
        self, verbose: bool = False, console: Console | None = None, *, as_json: bool = False
    ) -> None:
        self.console = console or Console(stderr=True, highlight=False)
        self.verbose = verbose
        self.as_json = as_json
        self.seconds: dict[str, float] = {}  # of each stage so far

    def restarted(self) -> Reporter:
        """A copy of this reporter with no stage timed yet."""
        other = copy.copy(self)
        other.seconds = {}
        return other

    def result(self, values: Mapping[str, object]) -> None:
        """Print a result as a line of JSON if `as_json`."""
        if self.as_json:
            print(json.dumps(values, allow_nan=False, default=str), flush=True)

    def log(self, line: str) -> None:
        """Print a line."""
        self.console.print(escape(printable_line(line)), soft_wrap=True)

    def warn(self, line: str) -> None:
        """Print a line about something that could not be done as asked."""
        self.log(line)

    def detail(self, line: str) -> None:
        """Print a line if `verbose`."""
        if self.verbose:
            self.log(line)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Progress]:
        """Add the block's duration to `self.seconds[name]`; yield a function of (done, total) that reports progress."""
        start = time.perf_counter()
        if self.console.is_terminal:
            with self._bars(MofNCompleteColumn()) as bars:
                task = bars.add_task(name, total=None)
                yield lambda done, total: bars.update(task, completed=done, total=total)
        else:
            yield lambda done, total: None
        elapsed = time.perf_counter() - start
        self.seconds[name] = round(self.seconds.get(name, 0.0) + elapsed, 3)
        self.detail(f"  {name}: {elapsed:.2f} s")

    @contextlib.contextmanager
    def steps(self, name: str, start: int, total: int) -> Iterator[Callable[[int, str], None]]:
        """Report equal steps from `start` to `total`; yield a function of (done, remark)."""
        if self.console.is_terminal:
            with self._bars(MofNCompleteColumn(), TextColumn("{task.fields[remark]}")) as bars:
                task = bars.add_task(name, total=total, completed=start, remark="")
                yield lambda done, remark: bars.update(task, completed=done, remark=remark)
        else:
            begin = time.monotonic()

            def tell(done: int, remark: str) -> None:
                left = (time.monotonic() - begin) / max(1, done - start) * (total - done)
                self.log(
                    f"{name}: {done} of {total}, {remark}, {timedelta(seconds=round(left))} left"
                )

            yield tell

    @contextlib.contextmanager
    def transfer(self, name: str) -> Iterator[Progress]:
        """Report a transfer; yield a function of (bytes done, total bytes). A log gets a line for each tenth."""
        if self.console.is_terminal:
            with self._bars(DownloadColumn(), TransferSpeedColumn()) as bars:
                task = bars.add_task(name, total=None)
                yield lambda done, total: bars.update(task, completed=done, total=total)
        else:
            told = 0

            def tell(done: int, total: int) -> None:
                nonlocal told
                if (tenth := done * 10 // total) != told and done < total:
                    told = tenth
                    self.log(f"{name}: {decimal(done)} of {decimal(total)}")

            yield tell

    def _bars(self, *columns: ProgressColumn) -> Bars:
        description = TextColumn("{task.description:<12}")
        return Bars(
            description,
            BarColumn(),
            *columns,
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
        )


class LogReporter(Reporter):
    """Logs to the logger "spackle"; with `progress`, draws a bar on the standard error."""

    def __init__(self, progress: bool = False) -> None:
        super().__init__(console=Console(stderr=True, force_terminal=progress, force_jupyter=False))
        self._log = logging.getLogger("spackle")

    def log(self, line: str) -> None:
        self._log.info(line)

    def warn(self, line: str) -> None:
        self._log.warning(line)


class BufferedReporter(Reporter):
    """Collects the messages of a worker, which the main process prints."""

    def __init__(self, verbose: bool = False) -> None:
        super().__init__(verbose, Console(quiet=True, force_terminal=False))
        self.said: list[str | Mapping[str, object]] = []

    def result(self, values: Mapping[str, object]) -> None:
        self.said.append(values)

    def log(self, line: str) -> None:
        self.said.append(line)


@contextlib.contextmanager
def catch_stop_signals(single_process: bool) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C or SIGTERM came, so that a run can end between two steps.

    If `single_process`, a second Ctrl-C ends the run at once; torchrun, which sends each Ctrl-C twice, needs `single_process=False`.
    """
    asked: list[
        int
    ] = []  # an Event could deadlock: a second signal may arrive while the first one holds its lock
    if (
        threading.current_thread() is not threading.main_thread()
    ):  # only the main thread gets signals
        yield lambda: False
        return

    def note(number: int, frame: object) -> None:
        asked.append(number)
        if single_process:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
