"""One job at a time, in a thread of its own."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable

from spackle.errors import InputError, reason_in_a_line
from spackle.viewer.events import Channel, Event, Tell

STOPPED = "the viewer has been stopped"


class Stopped(BaseException):
    """The viewer stops: raised within a job when it next tells how far it is; not for `except Exception`."""


class Worker:
    """The place for a job, and the channels of the last ones."""

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
            done: called when it has ended in whatever way, before the place is free.
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

    def stop(self, patience: float) -> bool:
        """Ask the job to end and tell its listeners; whether it has ended within `patience` seconds."""
        with self._lock:
            self._stopping = True
            channels = list(self._channels.values())
        for channel in channels:
            channel.tell({"error": STOPPED})
        if self._thread is not None:
            self._thread.join(patience)
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
