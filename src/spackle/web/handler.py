"""The viewer's jobs, one at a time, and its HTTP: GET and HEAD of pages and scenes, a job's events, POST /photos."""

from __future__ import annotations

import contextlib
import hmac
import re
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from io import BufferedIOBase
from typing import Any, Protocol, cast

from spackle.errors import InputError, reason_in_a_line
from spackle.web.guard import HEADERS, PIECE, Declared, Limits, RefusedError, declared, refusal
from spackle.web.page import as_json

JSON = "application/json; charset=utf-8"
EVENTS = re.compile(r"/jobs/([1-9][0-9]{0,8})/events")
DRAINED = 1 << 26  # bytes of a refused upload that are read, so that the client gets to read why


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
        self._place = threading.Lock()
        self._stopping = False
        self._count = 0
        self._channels: dict[int, Channel] = {}
        self._thread: threading.Thread | None = None

    def claim(self) -> bool:
        """Take the place, for an upload and then its job; False where it is taken, or the viewer stops."""
        return not self._stopping and self._place.acquire(blocking=False)

    def release(self) -> None:
        """Leave the place without a job."""
        self._place.release()

    def start(self, job: Callable[[Tell], str]) -> int:
        """Run a job in the place that has been claimed; its number.

        The job returns the path of the scene that is ready. An InputError of it is told in a line.
        """
        self._count += 1
        number, channel = self._count, Channel()
        self._channels[number] = channel
        self._channels.pop(number - self._kept, None)
        # A daemon: arithmetic that cannot be interrupted must not keep the process alive.
        self._thread = threading.Thread(target=self._run, args=(job, channel), daemon=True, name=f"job-{number}")
        self._thread.start()
        return number

    def channel(self, number: int) -> Channel | None:
        """Of a job, as long as it is kept."""
        return self._channels.get(number)

    def newest(self) -> tuple[int, Channel] | None:
        """The last job that was started."""
        channel = self._channels.get(self._count)
        return None if channel is None else (self._count, channel)

    def stop(self, timeout: float) -> bool:
        """Ask the job to end and tell its listeners; whether it has ended within `timeout` seconds."""
        self._stopping = True
        for channel in list(self._channels.values()):
            channel.tell({"error": STOPPED})
        if self._thread is not None:
            self._thread.join(timeout)
        return self._thread is None or not self._thread.is_alive()

    def _run(self, job: Callable[[Tell], str], channel: Channel) -> None:
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
        self.release()
        channel.tell(end)  # last: who hears of it may send the next photo


class Site(Protocol):
    """What connections share: the `ViewerServer`."""

    limits: Limits
    local: bool
    names: frozenset[str]
    token: str
    worker: Worker
    log: Callable[[str], None]

    def body(self, path: str) -> tuple[str, bytes] | None: ...
    def state(self) -> bytes: ...
    def take(self, stream: BufferedIOBase, promise: Declared) -> int: ...


class Handler(BaseHTTPRequestHandler):
    """Speaks HTTP/1.1; every refusal is a status and `{"error": "one line"}`."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    @property
    def site(self) -> Site:
        return cast(Site, self.server)

    def handle_one_request(self) -> None:
        self.connection.settimeout(self.site.limits.pause)
        super().handle_one_request()

    def do_GET(self) -> None:
        if problem := self._refusal():
            return self._refuse(*problem)
        path = self.path.partition("?")[0]
        if path == "/scene.json":
            return self._answer(HTTPStatus.OK, JSON, self.site.state())
        if body := self.site.body(path):
            return self._answer(HTTPStatus.OK, *body)
        match = EVENTS.fullmatch(path)
        if match and (channel := self.site.worker.channel(int(match[1]))):
            return self._events(channel)
        return self._refuse(HTTPStatus.NOT_FOUND, "there is nothing of that name")

    do_HEAD = do_GET

    def do_POST(self) -> None:
        keep, self.close_connection = not self.close_connection, True
        if problem := self._refusal():
            return self._refuse(*problem)
        path, _, query = self.path.partition("?")
        if path != "/photos":
            return self._refuse(HTTPStatus.NOT_FOUND, "photos go to /photos")
        try:
            number = self._take(declared(self.headers, query, self.site.limits.upload_bytes))
        except RefusedError as error:
            return self._refuse(error.status, error.line)
        except TimeoutError:
            return self._refuse(HTTPStatus.REQUEST_TIMEOUT, "the photo came too slowly")
        self.close_connection = not keep  # all of it has been read
        return self._answer(HTTPStatus.ACCEPTED, JSON, as_json({"job": f"/jobs/{number}"}))

    def _take(self, promise: Declared) -> int:
        site = self.site
        if not site.worker.claim():
            raise RefusedError(HTTPStatus.CONFLICT, "another photo is at work: wait until it is ready")
        try:
            return site.take(self.rfile, promise)
        except BaseException:
            site.worker.release()
            raise

    def _events(self, channel: Channel) -> None:
        """The job's events until it ends, or the listener has gone."""
        self.close_connection = True  # there is no length: the end of the stream is the end of the connection
        self._start(HTTPStatus.OK, {"Content-Type": "text/event-stream; charset=utf-8"})
        if self.command != "HEAD":
            for event in channel.listen(self.site.limits.heartbeat):
                self.wfile.write(b":\n\n" if event is None else b"data: " + as_json(event) + b"\n\n")

    def _refusal(self) -> tuple[HTTPStatus, str] | None:
        if self.headers.defects:  # the parser stops at a broken line
            return HTTPStatus.BAD_REQUEST, "a line of the headers makes no sense"
        line = refusal(self.headers, self.site.names, local=self.site.local, sends=self.command == "POST")
        if not line and self.site.token:
            _, token, path = f"{self.path}//".split("/", 2)
            if not hmac.compare_digest(token.encode(), self.site.token.encode()):
                line = "this page has an address of its own, which `spackle view` says"
            self.path = f"/{path[:-2]}"
        return (HTTPStatus.FORBIDDEN, line) if line else None

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self._start(status, {"Content-Type": kind, "Content-Length": str(len(body))})
        if self.command != "HEAD":
            view = memoryview(body)
            for start in range(0, len(view), PIECE):  # the time limit is for a piece: the whole may be large
                self.wfile.write(view[start : start + PIECE])

    def _refuse(self, status: HTTPStatus, line: str) -> None:
        self._answer(status, JSON, as_json({"error": line}))
        if self.command != "POST":
            return
        # Read some of what the client still sends: closing at once would take the answer away from it.
        self.connection.settimeout(self.site.limits.pause / 10)
        with contextlib.suppress(OSError):
            for _ in range(0, DRAINED, PIECE):
                if not self.rfile.read1(PIECE):
                    return

    def _start(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        self.connection.settimeout(self.site.limits.send)
        self.send_response(status)
        for name, value in {**HEADERS, **headers}.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What the base class finds wrong with a request: too long, broken, or an unknown method."""
        self.close_connection = True
        self.request_version = "HTTP/1.1"
        self._answer(HTTPStatus(code), JSON, as_json({"error": HTTPStatus(code).phrase}))

    def version_string(self) -> str:
        return "spackle"  # strangers learn no versions

    def log_message(self, format: str, *args: Any) -> None:
        line = f"{self.address_string()} {format % args!a}"
        self.site.log(line.replace(self.site.token, "…") if self.site.token else line)
