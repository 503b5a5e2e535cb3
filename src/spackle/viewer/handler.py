"""The viewer's socket and its connections: GET and HEAD of the routes, a job's events, and POST /photos."""

from __future__ import annotations

import contextlib
import errno
import hmac
import io
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any, cast

from spackle.errors import InputError
from spackle.image import PHOTO_SUFFIXES
from spackle.viewer.guard import (
    HEADERS,
    PIECE,
    Declared,
    Limits,
    RefusedError,
    declared,
    is_loopback,
    own_names,
    refusal,
)
from spackle.viewer.page import PageScene, as_json
from spackle.viewer.work import Channel, Worker

JSON = "application/json; charset=utf-8"
Body = tuple[str, bytes]  # content type, bytes
Content = bytes | Callable[[], bytes]  # or what makes them
EVENTS = re.compile(r"/jobs/([1-9][0-9]{0,8})/events")
FULL = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
DRAINED = 1 << 26  # bytes of a refused upload that are read, so that the client gets to read why


class Routes:
    """Every path that can be asked, to its bytes: a path is looked up as it came, and no file is ever opened."""

    def __init__(self, pages: Mapping[str, Body], limits: Limits, bases: Sequence[str]) -> None:
        self._lock = threading.Lock()
        self._bodies: dict[str, tuple[str, Content]] = dict(pages)
        self._scenes: list[str] = []
        self._count = 0
        self._limits, self._bases = limits, list(bases)

    def get(self, path: str) -> Body | None:
        """Content type and bytes; None for an unknown path."""
        with self._lock:
            kind, body = self._bodies.get(path, ("", b""))
        return (kind, body if isinstance(body, bytes) else body()) if kind else None

    def add(self, scene: PageScene) -> str:
        """A scene becomes the one that is shown; the path of its description."""
        with self._lock:
            self._count += 1
            root = f"/scenes/{self._count}"
            downloads = {suffix: f"{root}/scene{suffix}" for suffix in scene.downloads}
            description = as_json(scene.description | ({"downloads": downloads} if downloads else {}))
            self._bodies[f"{root}.json"] = (JSON, description)
            made: dict[str, Content] = {f"scene{suffix}": make for suffix, make in scene.downloads.items()}
            for name, content in (made | scene.files).items():
                self._bodies[f"{root}/{name}"] = ("application/octet-stream", content)
            self._scenes.append(root)
            while len(self._scenes) > self._limits.kept_scenes:
                old = self._scenes.pop(0)
                for path in [path for path in self._bodies if path.startswith((f"{old}/", f"{old}.json"))]:
                    del self._bodies[path]
            return f"{root}.json"

    def state(self, worker: Worker) -> bytes:
        """scene.json: what is shown, what is at work, and what may be sent."""
        newest = worker.newest()
        with self._lock:
            scene = f"{self._scenes[-1]}.json" if self._scenes else None
        # One that failed is named as long as there is nothing else to see, so that a late page learns why.
        busy = newest is not None and (not newest[1].ended or scene is None)
        upload = {"suffixes": list(PHOTO_SUFFIXES), "max_bytes": self._limits.upload_bytes, "bases": self._bases}
        return as_json({"scene": scene, "job": f"/jobs/{newest[0]}" if newest and busy else None, "upload": upload})


class TimeoutReader(io.RawIOBase):
    """A socket's bytes, each piece and all of them within the time that is allowed; TimeoutError after that.

    A timeout of the socket alone would let a client that sends a byte a second go on for ever.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._pause, self._until = 0.0, 0.0

    def allow(self, pause: float, whole: float) -> None:
        """Seconds from now: for a piece, and for all that is read until this is called again."""
        self._pause, self._until = pause, time.monotonic() + whole

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left = self._until - time.monotonic()
        if left <= 0:
            raise TimeoutError("the client is too slow")
        self._connection.settimeout(min(self._pause, left))
        return self._connection.recv_into(buffer)


class Handler(BaseHTTPRequestHandler):
    """Speaks HTTP/1.1; every refusal is a status and `{"error": "one line"}`."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    @property
    def site(self) -> Listener:
        return cast("Listener", self.server)

    def setup(self) -> None:
        super().setup()
        self.reader = TimeoutReader(self.connection)
        self.rfile = io.BufferedReader(self.reader)

    def handle_one_request(self) -> None:
        limits = self.site.limits
        self.site.note(self.connection, idle=True)
        self.reader.allow(limits.request, limits.request)
        super().handle_one_request()

    def parse_request(self) -> bool:
        self.site.note(self.connection, idle=False)
        return super().parse_request()

    def handle_expect_100(self) -> bool:
        return True  # said only once the upload is going to be taken

    def do_GET(self) -> None:
        # What follows a GET with a body, or one that asks for another protocol, is no request: do not read it.
        if {"Content-Length", "Transfer-Encoding", "Upgrade"} & {name.title() for name in self.headers}:
            self.close_connection = True
        if problem := self._refusal():
            return self._refuse(*problem)
        path = self.path.partition("?")[0]
        if path == "/scene.json":
            return self._answer(HTTPStatus.OK, JSON, self.site.routes.state(self.site.worker))
        if body := self.site.routes.get(path):
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
            self.reader.allow(site.limits.pause, site.limits.upload)
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
        self.reader.allow(self.site.limits.pause / 10, self.site.limits.pause / 5)
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


class Listener(ThreadingHTTPServer):
    """Threads for connections, and what they share; a connection too many is told so and closed.

    Raises:
        InputError: nothing can listen at that host and port.
    """

    daemon_threads = True
    request_queue_size = 128
    allow_reuse_address = os.name == "posix"  # elsewhere that would take a port away from who has it

    def __init__(
        self,
        host: str,
        port: int,
        pages: Mapping[str, Body],
        limits: Limits,
        log: Callable[[str], None],
        take: Callable[[io.BufferedIOBase, Declared], int],
        bases: Sequence[str] = (),
        token: str = "",
    ) -> None:
        self.token = token  # the first part of every path, where there is one
        self.routes, self.worker = Routes(pages, limits, bases), Worker(log, limits.kept_jobs)
        self.limits, self.log, self.take = limits, log, take
        self.listeners = threading.BoundedSemaphore(limits.listeners)
        self._places = threading.BoundedSemaphore(limits.connections)
        self._lock = threading.Lock()
        self._open: dict[socket.socket, bool] = {}  # whether a connection waits for a request, in their order
        self.address_family, place = _address(host, port)
        try:
            super().__init__(place, Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            line = f"--port {port}: cannot listen at {host}: {reason}: give another, or none"
            if getattr(error, "errno", None) == errno.EADDRNOTAVAIL:
                line = f"--host {host}: is no address of this machine: leave it out, or give 0.0.0.0 for all of them"
            raise InputError(line) from error
        numeric = str(self.server_address[0])
        self.local, self.names = is_loopback(numeric), own_names(host, numeric)

    def server_bind(self) -> None:
        """Without the look-up of our own name, which may take seconds."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(blocking=False) and not self._take_from_idle():
            request.setblocking(False)
            with contextlib.suppress(OSError):
                request.send(FULL)
            self.shutdown_request(request)
            return
        with self._lock:
            self._open[request] = True
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._forget(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._forget(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away ends its own connection, and nothing else."""
        error = sys.exc_info()[1]
        self.log(f"{client_address[0]} connection ended: {type(error).__name__}: {error}")

    def server_close(self) -> None:
        """Also of the connections that are still open."""
        super().server_close()
        with self._lock:
            left = list(self._open)
        for connection in left:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def note(self, request: socket.socket, *, idle: bool) -> None:
        """Whether a connection waits for its next request."""
        with self._lock:
            if request in self._open:
                self._open[request] = idle

    def _take_from_idle(self) -> bool:
        """The place of the connection that has waited longest without a request; False where all are at work."""
        with self._lock:
            oldest = next((connection for connection, idle in self._open.items() if idle), None)
            if oldest is None:
                return False
            self._open[oldest] = False
        with contextlib.suppress(OSError):
            oldest.shutdown(socket.SHUT_RDWR)
        return self._places.acquire(timeout=self.limits.evict)

    def _forget(self, request: socket.socket) -> None:
        with self._lock:
            self._open.pop(request, None)
        self._places.release()


def _address(host: str, port: int) -> tuple[socket.AddressFamily, Any]:
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: must lie between 1 and 65535 (0: any that is free)")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        line = f"--host {host}: no address of this machine: {reason}: leave it out, or give 0.0.0.0"
        raise InputError(line) from error
    return found[0][0], found[0][4]
