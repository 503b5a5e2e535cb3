"""Tell how far long work is, as bars, log lines or calls of a function, and end it when asked.

Functions that take long have a parameter `progress` of the type `Progress`. Work of several stages
gets a `Reporter`, which logs messages, times stages, and makes such `progress` functions. All of
them pass through `Reporter.stage`: bars on a terminal, the jobs of the server, and the functions
that a Python program gives as `progress` and `cancel`.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
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

from spackle.runtime.errors import Cancelled, printable_line

Progress = Callable[[int, int], None]  # reports (steps done, steps in all)
# Asks for the end of work: an event that is set, or a function that returns true.
Cancel = threading.Event | Callable[[], bool]


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageProgress:
    """How far a stage of the work is."""

    stage: str  # its name, as in the times of the report, such as "base" or "complete"
    done: int  # steps: views, windows of a network, or frames
    total: int  # steps in all; 0 if nobody knows how many

    @property
    def share(self) -> float | None:
        """The part of the stage that is done, 0..1; None if nobody knows."""
        return self.done / self.total if self.total else None


ProgressListener = Callable[[StageProgress], None]  # called at each stage's start and each step


def raise_if_cancelled(cancel: Cancel | None) -> None:
    """Raise `Cancelled` if `cancel` asks for the end of the work."""
    if cancel is None:
        return
    is_cancelled = cancel.is_set() if isinstance(cancel, threading.Event) else cancel()
    if is_cancelled:
        raise Cancelled("cancelled, as `cancel` asked")


def cancellable(progress: Progress | None, cancel: Cancel | None) -> Progress:
    """A function of (steps done, steps in all) that calls `progress`, or raises `Cancelled`.

    It raises once `cancel` asks for the end of the work, so that work ends after any step.
    """

    def step(done: int, total: int) -> None:
        """Report a step, unless the work is to end."""
        raise_if_cancelled(cancel)
        if progress is not None:
            progress(done, total)

    return step


def pluralized(count: int, thing: str) -> str:
    """A number with its noun: `1 shard`, `2 shards`."""
    return f"{count:,} {thing}" if count == 1 else f"{count:,} {thing}s"


class Reporter:
    """Logs messages and progress, and times stages."""

    def __init__(
        self,
        verbose: bool = False,
        console: Console | None = None,
        *,
        as_json: bool = False,
        listener: ProgressListener | None = None,
        cancel: Cancel | None = None,
    ) -> None:
        """Make a reporter.

        Args:
            verbose: also log details.
            console: where messages and bars go; None is the standard error.
            as_json: print each result as a line of JSON on the standard output.
            listener: called at the start of each stage, and after each of its steps.
            cancel: asks for the end of the work, which a stage then ends by `Cancelled`.
        """
        self.console = console or Console(stderr=True, highlight=False)
        self.verbose = verbose
        self.as_json = as_json
        self._listener = listener
        self._cancel = cancel
        self.seconds: dict[str, float] = {}  # durations of the stages so far

    def restarted(self) -> Reporter:
        """A copy of this reporter with no stage timed yet."""
        other = copy.copy(self)
        other.seconds = {}
        return other

    def result(self, values: Mapping[str, object]) -> None:
        """Print a result as a line of JSON if the user asked for JSON."""
        if self.as_json:
            print(json.dumps(values, allow_nan=False, default=str), flush=True)

    def log(self, line: str) -> None:
        """Print a line."""
        self.console.print(escape(printable_line(line)), soft_wrap=True)

    def warn(self, line: str) -> None:
        """Print a line about something that could not be done as asked."""
        self.log(line)

    def detail(self, line: str) -> None:
        """Print a line if the reporter is verbose."""
        if self.verbose:
            self.log(line)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Progress]:
        """Time the block, and tell how far it is; yields the function to call after each step.

        The duration is added to `self.seconds[name]`.

        Raises:
            Cancelled: `cancel` asked for the end, before the block, at a step, or after it.
        """
        start = time.perf_counter()

        def tell(done: int, total: int) -> None:
            """Tell the listener how far the stage is, unless the work is to end."""
            raise_if_cancelled(self._cancel)
            if self._listener is not None:
                self._listener(StageProgress(stage=name, done=done, total=total))

        tell(0, 0)  # nobody knows yet how many steps there are
        if self.console.is_terminal:
            with self._bars(MofNCompleteColumn()) as bars:
                task = bars.add_task(name, total=None)

                def tell_and_draw(done: int, total: int) -> None:
                    """Tell the listener how far the stage is, and move the bar."""
                    tell(done, total)
                    bars.update(task, completed=done, total=total)

                yield tell_and_draw
        else:
            yield tell
        raise_if_cancelled(self._cancel)

        # A stage may run several times, such as once for each photo; its durations add up.
        elapsed = time.perf_counter() - start
        self.seconds[name] = round(self.seconds.get(name, 0.0) + elapsed, 3)
        self.detail(f"  {name}: {elapsed:.2f} s")

    @contextlib.contextmanager
    def steps(self, name: str, start: int, total: int) -> Iterator[Callable[[int, str], None]]:
        """Report equally long steps as a bar on a terminal, or as lines in a log.

        Args:
            name: of the work.
            start: number of steps that an earlier run has done.
            total: number of steps in all.

        Yields:
            A function of the number of steps done and a remark, such as the loss.
        """
        if self.console.is_terminal:
            with self._bars(MofNCompleteColumn(), TextColumn("{task.fields[remark]}")) as bars:
                task = bars.add_task(name, total=total, completed=start, remark="")
                yield lambda done, remark: bars.update(task, completed=done, remark=remark)
            return

        start_time = time.monotonic()

        def log_step(done: int, remark: str) -> None:
            """Log the steps done, and the time left if all steps take equally long."""
            # Steps of an earlier run took no time in this one, so they do not count.
            seconds_per_step = (time.monotonic() - start_time) / max(1, done - start)
            time_left = timedelta(seconds=round(seconds_per_step * (total - done)))
            self.log(f"{name}: {done} of {total}, {remark}, {time_left} left")

        yield log_step

    @contextlib.contextmanager
    def transfer(self, name: str) -> Iterator[Progress]:
        """Report a transfer, such as a download; a log gets a line for each tenth.

        Yields:
            A function of the bytes done and the bytes in all.
        """
        if self.console.is_terminal:
            with self._bars(DownloadColumn(), TransferSpeedColumn()) as bars:
                task = bars.add_task(name, total=None)
                yield lambda done, total: bars.update(task, completed=done, total=total)
            return

        logged_tenth = 0

        def log_transfer(done: int, total: int) -> None:
            """Log a line if another tenth of the bytes has arrived, but none at the end."""
            nonlocal logged_tenth
            tenth = done * 10 // total
            if tenth != logged_tenth and done < total:
                logged_tenth = tenth
                self.log(f"{name}: {decimal(done)} of {decimal(total)}")

        yield log_transfer

    def _bars(self, *columns: ProgressColumn) -> Bars:
        """A display of progress bars with these columns between the bar and the remaining time."""
        name_column = TextColumn("{task.description:<12}")  # the names of stages are shorter
        return Bars(
            name_column,
            BarColumn(),
            *columns,
            TimeRemainingColumn(),
            console=self.console,
            transient=True,  # the bars vanish at the end
        )


class LogReporter(Reporter):
    """Logs to the logger "spackle", for use as a library."""

    def __init__(
        self, progress: bool | ProgressListener = False, cancel: Cancel | None = None
    ) -> None:
        """Make a reporter.

        Args:
            progress: True draws bars on the standard error; a function is called at the start of
                each stage, and after each of its steps.
            cancel: asks for the end of the work, which then raises `Cancelled`.
        """
        super().__init__(
            console=Console(stderr=True, force_terminal=progress is True, force_jupyter=False),
            listener=None if isinstance(progress, bool) else progress,
            cancel=cancel,
        )
        self._log = logging.getLogger("spackle")

    def log(self, line: str) -> None:
        """Log a line as information."""
        self._log.info(line)

    def warn(self, line: str) -> None:
        """Log a line as a warning."""
        self._log.warning(line)


class BufferedReporter(Reporter):
    """Collects the messages and results of a worker process, which the main process prints."""

    def __init__(self, verbose: bool = False) -> None:
        """Make a reporter without messages; `verbose` also collects details."""
        super().__init__(verbose, Console(quiet=True, force_terminal=False))
        self.said: list[str | Mapping[str, object]] = []  # messages, and results, in order

    def result(self, values: Mapping[str, object]) -> None:
        """Keep a result."""
        self.said.append(values)

    def log(self, line: str) -> None:
        """Keep a line."""
        self.said.append(line)


@contextlib.contextmanager
def catch_stop_signals(single_process: bool) -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C and SIGTERM ask for a stop, instead of ending the process, during the block.

    Outside of the main thread, which alone gets signals, nothing ever asks for a stop.

    Args:
        single_process: let a second Ctrl-C end the run at once. Under torchrun, which sends each
            Ctrl-C twice to its processes, this must be False.

    Yields:
        A function that tells whether a signal came, so that a run can end between two steps.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    # A list, because threading.Event could deadlock: a second signal may arrive while the handler
    # of the first one holds the event's lock.
    caught_signals: list[int] = []

    def remember(number: int, frame: object) -> None:
        """Handle a signal: note it, and let a second Ctrl-C raise a KeyboardInterrupt."""
        caught_signals.append(number)
        if single_process:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    previous_handlers = {
        number: signal.signal(number, remember) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(caught_signals)
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)
