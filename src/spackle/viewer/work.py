"""One job at a time in a thread of its own, and the events by which it tells any number of listeners how far it is."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator, Mapping

from spackle.errors import InputError, reason_in_a_line

Event = Mapping[str, object]  # {"stage", "done", "total"} | {"line"} | {"ready"} | {"error"}
Tell = Callable[[Event], None]
KEPT = 50  # lines for late listeners
PACE = 0.05  # seconds between two looks of a listener: a fast job must not drown a slow page
STOPPED = "the viewer has been stopped"


class Channel:
    """The newest stage, the last lines and the end of one job; late listeners get them too."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._events: list[tuple[int, Event]] = []  # numbered in the order they came
        self._count = 0
        self.ended = False

    def tell(self, event: Event) -> None:
        """Add an event. A stage takes the place of the stage before it; what comes after the end is dropped."""
        with self._changed:
            if self.ended:
                return
            if "stage" in event:
                self._events = [(number, old) for number, old in self._events if "stage" not in old]
            self.ended = "ready" in event or "error" in event
            self._count += 1
            self._events = [*self._events, (self._count, event)][-KEPT:]
            self._changed.notify_all()

    def listen(self, heartbeat: float) -> Iterator[Event | None]:
        """What is known and then what comes, until the end; None where nothing has come for `heartbeat` seconds."""
        seen, pace = 0, threading.Event()
        while True:
            with self._changed:
                self._changed.wait_for(lambda seen=seen: self._count > seen, heartbeat)  # type: ignore[misc]
                fresh: list[Event | None] = [event for number, event in self._events if number > seen]
                seen, ended = self._count, self.ended
            yield from fresh or [None]
            if ended:
                return
            pace.wait(PACE)


class Stopped(BaseException):
    """The viewer stops: raised within a job when it next tells how far it is; not for `except Exception`."""


class Worker:
    """The place for one job, and the channels of the last `kept` ones; `log` gets the traceback of a job's bug."""

    def __init__(self, log: Callable[[str], None], kept: int) -> None:
        self._log, self._kept = log, kept
        self._lock = threading.Lock()
        self._taken = False
        self._stopping = False
        self._count = 0
        self._channels: dict[int, Channel] = {}
        self._thread: threading.Thread | None = None

    def claim(self) -> bool:
        """Take the place, for an upload and then its job; False where it is taken, or the viewer stops."""
        with self._lock:
            if self._taken or self._stopping:
                return False
            self._taken = True
            return True

    def release(self) -> None:
        """Leave the place without a job."""
        with self._lock:
            self._taken = False

    def start(self, job: Callable[[Tell], str], done: Callable[[], None] = lambda: None) -> int:
        """Run a job in the place that has been claimed; its number.

        Args:
            job: returns the path of the scene that is ready. An InputError of it is told in a line.
            done: called when the job has ended or failed, before the place is free.
        """
        with self._lock:
            self._count += 1
            number, channel = self._count, Channel()
            self._channels[number] = channel
            for old in list(self._channels)[: -self._kept]:
                del self._channels[old]
        # A daemon: arithmetic that cannot be interrupted must not keep the process alive.
        self._thread = threading.Thread(target=self._run, args=(job, channel, done), daemon=True, name=f"job-{number}")
        self._thread.start()
        return number

    def channel(self, number: int) -> Channel | None:
        """Of a job, as long as it is kept."""
        with self._lock:
            return self._channels.get(number)

    def newest(self) -> tuple[int, Channel] | None:
        """The last job that was started."""
        with self._lock:
            return next(reversed(self._channels.items())) if self._channels else None

    def stop(self, timeout: float) -> bool:
        """Ask the job to end and tell its listeners; whether it has ended within `timeout` seconds."""
        with self._lock:
            self._stopping = True
            channels = list(self._channels.values())
        for channel in channels:
            channel.tell({"error": STOPPED})
        if self._thread is not None:
            self._thread.join(timeout)
        return self._thread is None or not self._thread.is_alive()

    def _run(self, job: Callable[[Tell], str], channel: Channel, done: Callable[[], None]) -> None:
        def tell(event: Event) -> None:
            if self._stopping:
                raise Stopped
            channel.tell(event)

        end: Event
        try:
            end = {"ready": job(tell)}
        except Stopped:
            end = {"error": STOPPED}
        except InputError as error:
            end = {"error": " ".join(str(error).split())}
        except BaseException as error:  # our bug, or no memory: the page is told, and the next photo may do
            self._log("".join(traceback.format_exception(error)))
            end = {"error": f"this went wrong: {type(error).__name__}: {reason_in_a_line(error)}"}
        try:
            done()
        finally:
            self.release()
            channel.tell(end)  # last: who hears of it may send the next photo
