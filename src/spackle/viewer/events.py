"""What a job tells, for any number of listeners, late ones too."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping

Event = Mapping[str, object]  # {"stage", "done", "total"} | {"line"} | {"ready"} | {"error"}
Tell = Callable[[Event], None]
KEPT = 50  # lines for late listeners
PACE = 0.05  # seconds between two looks of a listener: a fast job must not drown a slow page


class Channel:
    """The newest stage, the last lines and the end of one job."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._events: list[tuple[int, Event]] = []  # numbered in the order they came
        self._count = 0
        self._ended = False

    @property
    def ended(self) -> bool:
        return self._ended

    def tell(self, event: Event) -> None:
        """Add an event. A stage takes the place of the stage before it; what comes after the end is dropped."""
        with self._changed:
            if self._ended:
                return
            if "stage" in event:
                self._events = [(number, old) for number, old in self._events if "stage" not in old]
            self._ended = "ready" in event or "error" in event
            self._count += 1
            self._events = [*self._events, (self._count, event)]
            while len(self._events) > KEPT:
                self._events.pop(0)
            self._changed.notify_all()

    def listen(self, heartbeat: float) -> Iterator[Event | None]:
        """What is known and then what comes, until the end; None where nothing has come for `heartbeat` seconds."""
        seen, pace = 0, threading.Event()
        while True:
            with self._changed:
                self._changed.wait_for(lambda seen=seen: self._count > seen, heartbeat)  # type: ignore[misc]
                news: list[Event | None] = [event for number, event in self._events if number > seen]
                seen, ended = self._count, self._ended
            yield from news or [None]
            if ended:
                return
            pace.wait(PACE)
