"""Lanes: queues of work for worker processes; each piece of work has an owner, a limit and an end.

A server has several lanes, so that short work does not wait behind long work.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from spackle.runtime.errors import reason_in_a_line
from spackle.runtime.task_process import (
    CANCELLED,
    NO_LIMITS,
    STARTS_QUICKLY,
    SendEvent,
    TaskFailure,
    TaskFunction,
    TaskLimits,
    TaskProcess,
    end_server_that_imports,
)

CLOSE_POLL_S = 0.02  # seconds between two attempts to end a start that a closed lane waits for


@dataclasses.dataclass(eq=False)
class Order:
    """A piece of work in a lane, which waits, runs and ends.

    `run(order)` is called in a thread of the lane when the order's turn has come. It calls
    `order.do` for what a process shall do, and its result is that of `outcome`.
    """

    lane: Lane
    owner: str  # all that an owner has ordered is cancelled together
    run: Callable[[Order], TaskFailure | None]
    outcome: Future[TaskFailure | None] = dataclasses.field(default_factory=Future)
    process: TaskProcess | None = None  # while it does a task of this order
    is_cancelled: bool = False

    def do(
        self, task: object, on_event: SendEvent, limits: TaskLimits = NO_LIMITS
    ) -> TaskFailure | None:
        """Have a process of the lane do a task; returns None at its end, or why it was not done.

        Args:
            task: what the lane's function gets.
            on_event: called with each event that the function sends.
            limits: what the task may take.
        """
        try:
            process = self.lane.take_process()
        except (OSError, EOFError) as error:  # too many processes, or too little memory
            reason = reason_in_a_line(error)
            return TaskFailure("machine", f"no worker process can be started: {reason}")
        if process is None:
            return CANCELLED
        with self.lane.lock:
            self.process = process
        try:
            if self.is_cancelled:
                return CANCELLED
            failure = process.do(task, on_event, limits)
            # A process that was killed seems to have died.
            return CANCELLED if self.is_cancelled else failure
        finally:
            with self.lane.lock:
                self.process = None
            self.lane.give_back(process)


class Lane:
    """A number of worker processes, and the orders that wait for them."""

    def __init__(
        self,
        work: TaskFunction,
        count: int,
        *,
        is_kept: bool = True,
        gpu_numbers: range = range(0),
    ) -> None:
        """Prepare a lane; no process starts before there is work.

        Args:
            work: does a task in a process.
            count: number of processes at a time.
            is_kept: whether a process does one task after the other, because it has loaded
                something. Otherwise each task has a new process, where it starts quickly: nothing
                that a task leaves behind stays.
            gpu_numbers: one number for each process, which chooses its GPU; empty: all processes
                use torch's default GPU.
        """
        self.lock = threading.RLock()  # of all that follows
        self.is_closed = False
        self._work = work
        self._is_kept = is_kept or not STARTS_QUICKLY
        self._threads = ThreadPoolExecutor(count)
        self._waiting: list[Order] = []  # the next one first
        self._running: set[Order] = set()
        self._idle: list[TaskProcess] = []
        self._starting_count = 0  # processes that are being started
        self._free_gpu_numbers = list(gpu_numbers)
        self._gpu_number_of: dict[TaskProcess, int | None] = {}  # of the processes that run

    def submit(self, owner: str, run: Callable[[Order], TaskFailure | None]) -> Order:
        """Let `run` wait for its turn; see `Order`."""
        order = Order(self, owner, run)
        with self.lock:
            if self.is_closed:
                order.outcome.set_result(CANCELLED)
                return order
            self._waiting.append(order)
            self._threads.submit(self._run_next)
        return order

    def prepare(self) -> None:
        """Start a process before there is work; returns at once."""

        def start_process(order: Order) -> None:
            """Start a process, unless the lane is closed; who gives work is told of an error."""
            with contextlib.suppress(OSError, EOFError):
                process = self.take_process()
                if process is not None:
                    self.give_back(process)

        self.submit("", start_process)

    @property
    def waiting_count(self) -> int:
        """The number of orders that wait."""
        return len(self._waiting)

    @property
    def has_process(self) -> bool:
        """Whether a process has been started."""
        return bool(self._gpu_number_of)

    def place_of(self, order: Order) -> int | None:
        """The number of orders that come before one that waits; None for one that does not."""
        try:
            return self._waiting.index(order)
        except ValueError:
            return None

    def cancel(self, order: Order) -> None:
        """End an order: it does not begin, or its process is killed."""
        with self.lock:
            order.is_cancelled = True
            if order in self._waiting:
                self._waiting.remove(order)
                order.outcome.set_result(CANCELLED)
            # Under the lock, because another order may have the process a moment later. The thread
            # that has the order waits for the end.
            if order.process is not None:
                order.process.kill(wait=False)

    def cancel_all_of(self, owner: str) -> None:
        """End all orders of an owner."""
        with self.lock:
            orders = [*self._waiting, *self._running]
        for order in orders:
            if order.owner == owner:
                self.cancel(order)

    def close(self) -> None:
        """End all orders (pieces of work) and processes, and wait until the lane's threads have
        ended.
        """
        with self.lock:
            self.is_closed = True
            orders = [*self._waiting, *self._running]
            idle = list(self._idle)
        for order in orders:
            self.cancel(order)
        for process in idle:
            process.kill()
        # The first process of all takes seconds to start: the server process from which Python
        # forks it imports torch first. Without that server the start fails at once.
        while self._starting_count:
            end_server_that_imports()
            time.sleep(CLOSE_POLL_S)
        self._threads.shutdown()

    def _run_next(self) -> None:
        """Run the order whose turn it is; none may be left, because some were cancelled."""
        with self.lock:
            if not self._waiting:
                return
            order = self._waiting.pop(0)
            self._running.add(order)
        try:
            order.outcome.set_result(order.run(order))
        except BaseException as error:
            order.outcome.set_exception(error)
            raise
        finally:
            with self.lock:
                self._running.discard(order)

    def take_process(self) -> TaskProcess | None:
        """A process that nobody else has; a new one if none is idle; None if the lane is closed.

        Raises:
            OSError, EOFError: no process can be started.
        """
        with self.lock:
            while self._idle:
                process = self._idle.pop()
                if process.alive:
                    return process
                self._forget(process)  # its GPU is free for another one
            if self.is_closed:
                return None
            # Without a number, a process computes on the GPU that torch takes by default, if any.
            gpu_number = self._free_gpu_numbers.pop(0) if self._free_gpu_numbers else None
            self._starting_count += 1

        # Not under the lock: the first one of all takes seconds.
        new_process = None
        try:
            new_process = self._start_process(gpu_number)
            return new_process
        finally:
            with self.lock:
                self._starting_count -= 1
                if new_process is not None:
                    self._gpu_number_of[new_process] = gpu_number
                elif gpu_number is not None:
                    self._free_gpu_numbers.append(gpu_number)

    def _start_process(self, gpu_number: int | None) -> TaskProcess | None:
        """A new process; None if the lane is closed meanwhile; OSError, EOFError if it fails."""
        try:
            return TaskProcess(self._work, gpu_number)
        except (OSError, EOFError):
            if self.is_closed:
                return None
            # Python forks processes from a server process. This one is gone: another lane has
            # closed and ended it, or the system lacked memory. A second attempt starts a new one.
            return TaskProcess(self._work, gpu_number)

    def give_back(self, process: TaskProcess) -> None:
        """Keep a process for the next task, or end it."""
        with self.lock:
            if self._is_kept and process.alive and not self.is_closed:
                self._idle.append(process)
                return
            self._forget(process)
        process.kill()

    def _forget(self, process: TaskProcess) -> None:
        """Note that a process has ended; the next one takes over its GPU."""
        gpu_number = self._gpu_number_of.pop(process, None)
        if gpu_number is not None:
            self._free_gpu_numbers.append(gpu_number)
