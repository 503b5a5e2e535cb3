"""One connection to the viewer's server: GET and HEAD of what is in the table, a job's events, and POST /photos."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any, Protocol, cast

from spackle.viewer.answers import JSON, Table, as_json
from spackle.viewer.events import Channel
from spackle.viewer.guard import HEADERS, refusal
from spackle.viewer.limits import Limits
from spackle.viewer.patience import PatientReader
from spackle.viewer.upload import PIECE, Declared, RefusedError, declared
from spackle.viewer.work import Worker

EVENTS = re.compile(r"/jobs/([1-9][0-9]{0,8})/events")
DRAINED = 1 << 26  # bytes of a refused upload that are read, so that the client gets to read why


class Site(Protocol):
    """What the handlers of a server share."""

    table: Table
    worker: Worker
    limits: Limits
    listeners: threading.BoundedSemaphore
    names: frozenset[str]
    local: bool
    log: Callable[[str], None]

    def take(self, stream: io.BufferedIOBase, promise: Declared) -> int:
        """Receive a photo in the place that has been claimed, and start its job."""
        ...


class Handler(BaseHTTPRequestHandler):
    """Speaks HTTP/1.1; every refusal is a status and `{"error": "one line"}`."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    @property
    def site(self) -> Site:
        return cast("Site", self.server)

    def setup(self) -> None:
        super().setup()
        self.patience = PatientReader(self.connection)
        self.rfile = io.BufferedReader(self.patience)

    def handle_one_request(self) -> None:
        limits = self.site.limits
        self.patience.allow(limits.request, limits.request)
        super().handle_one_request()

    def handle_expect_100(self) -> bool:
        return True  # said only once the upload is going to be taken

    def do_GET(self) -> None:
        self._check_body()
        if problem := self._refusal():
            return self._refuse(*problem)
        path = self.path.partition("?")[0]
        if path == "/scene.json":
            return self._answer(HTTPStatus.OK, JSON, self.site.table.state(self.site.worker))
        if body := self.site.table.get(path):
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
            if self.headers.get("Expect", "").lower() == "100-continue":
                self.send_response_only(HTTPStatus.CONTINUE)
                super().end_headers()
            self.patience.allow(site.limits.pause, site.limits.upload)
            return site.take(self.rfile, promise)
        except BaseException:
            site.worker.release()
            raise

    def _events(self, channel: Channel) -> None:
        """The job's events until it ends, or the listener has gone."""
        if not self.site.listeners.acquire(blocking=False):
            return self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, "too many listeners")
        try:
            self.close_connection = True  # there is no length: the end of the stream is the end of the connection
            self._start(HTTPStatus.OK, {"Content-Type": "text/event-stream; charset=utf-8"})
            if self.command == "HEAD":
                return None
            for event in channel.listen(self.site.limits.heartbeat):
                self.wfile.write(b":\n\n" if event is None else b"data: " + as_json(event) + b"\n\n")
        finally:
            self.site.listeners.release()
        return None

    def _refusal(self) -> tuple[HTTPStatus, str] | None:
        if not self.request_version.startswith("HTTP/1."):
            self.request_version = "HTTP/1.0"  # an answer to HTTP/0.9 would have no headers
            return HTTPStatus.HTTP_VERSION_NOT_SUPPORTED, "this server speaks HTTP/1.1"
        if self.headers.defects:  # what stands below the broken line was not read
            return HTTPStatus.BAD_REQUEST, "a line of the headers makes no sense"
        line = refusal(self.headers, self.site.names, local=self.site.local)
        return (HTTPStatus.FORBIDDEN, line) if line else None

    def _check_body(self) -> None:
        """What follows a GET with a body, or one that asks for another protocol, is no request: do not read it."""
        if {"Content-Length", "Transfer-Encoding", "Upgrade"} & {name.title() for name in self.headers}:
            self.close_connection = True

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self._start(status, {"Content-Type": kind, "Content-Length": str(len(body))})
        if self.command != "HEAD":
            view = memoryview(body)
            for start in range(0, len(view), PIECE):  # the time limit is for a piece: the whole may be large
                self.wfile.write(view[start : start + PIECE])

    def _refuse(self, status: HTTPStatus, line: str) -> None:
        self._answer(status, JSON, as_json({"error": line}))
        if self.command == "POST":
            self._drain()

    def _start(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        self.connection.settimeout(self.site.limits.send)
        self.send_response(status)
        for name, value in {**HEADERS, **headers}.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()

    def _drain(self) -> None:
        """Read some of what a refused client still sends: closing at once would take the answer away from it."""
        self.patience.allow(self.site.limits.pause / 10, self.site.limits.pause / 5)
        try:
            for _ in range(0, DRAINED, PIECE):
                if not self.rfile.read1(PIECE):
                    return
        except OSError:
            return

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What the base class finds wrong with a request: too long, broken, or an unknown method."""
        self.close_connection = True
        self.request_version = "HTTP/1.1"
        self._answer(HTTPStatus(code), JSON, as_json({"error": HTTPStatus(code).phrase}))

    def version_string(self) -> str:
        return "spackle"  # which versions is nobody's business

    def log_message(self, format: str, *args: Any) -> None:
        self.site.log(f"{self.address_string()} {format % args!a}")
