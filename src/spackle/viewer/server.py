"""The viewer's server: a page, its scenes, and photos that are completed one at a time.

It is the standard library's, a thread for a connection: a few people look at one page, and what they load is whole
files out of memory. A framework would be one more thing to install, to keep up with and to trust with a photo.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from http.server import ThreadingHTTPServer
from io import BufferedIOBase
from pathlib import Path
from socketserver import TCPServer
from typing import Any

from spackle.errors import InputError
from spackle.viewer.guard import DEFAULT, Declared, Limits, check_photo, is_loopback, own_names, receive
from spackle.viewer.handler import Body, Handler, Routes
from spackle.viewer.page import PageScene
from spackle.viewer.work import Tell, Worker

Complete = Callable[[Path, str, Tell], PageScene]  # a photo's file, its name for people, where progress goes
HOST = "127.0.0.1"
FULL = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


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
        take: Callable[[BufferedIOBase, Declared], int],
    ) -> None:
        self.routes, self.worker = Routes(pages, limits), Worker(log, limits.kept_jobs)
        self.limits, self.log, self.take = limits, log, take
        self.listeners = threading.BoundedSemaphore(limits.listeners)
        self._places = threading.BoundedSemaphore(limits.connections)
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
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
        if not self._places.acquire(blocking=False):
            request.setblocking(False)
            with contextlib.suppress(OSError):
                request.send(FULL)
            self.shutdown_request(request)
            return
        with self._lock:
            self._open.add(request)
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

    def _forget(self, request: socket.socket) -> None:
        with self._lock:
            self._open.discard(request)
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


class ViewerServer:
    """Serves from `start` until `close`; as a context manager, for the block.

    Args:
        pages: the page's files, URL path to content type and bytes.
        complete: what turns an uploaded photo into a scene; an InputError of it is shown as a line.
        host: where to listen; anything but this machine's own addresses lets others in.
        port: 0 takes a free one.
        limits: what a client may take.
        log: gets a line for each request.

    Raises:
        InputError: nothing can listen there.
    """

    def __init__(
        self,
        pages: Mapping[str, Body],
        complete: Complete,
        *,
        host: str = HOST,
        port: int = 0,
        limits: Limits = DEFAULT,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._http = Listener(host, port, pages, limits, log, self._take)
        self._worker = self._http.worker
        self.uploads = tempfile.TemporaryDirectory(prefix="spackle-view-")
        self._complete, self._limits = complete, limits
        self.host = host
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.1,), daemon=True, name="viewer")

    @property
    def port(self) -> int:
        return int(self._http.server_address[1])

    @property
    def local(self) -> bool:
        """Whether this machine alone can reach it."""
        return self._http.local

    @property
    def url(self) -> str:
        """For a browser on this machine."""
        address = str(self._http.server_address[0])
        return self.url_at({"0.0.0.0": HOST, "::": "::1"}.get(address, address))

    def url_at(self, address: str) -> str:
        """For a browser that reaches this machine by that address."""
        return f"http://{f'[{address}]' if ':' in address else address}:{self.port}/"

    def show(self, scene: PageScene) -> str:
        """Make a scene the one that the page shows; the path of its description."""
        return self._http.routes.add(scene)

    def work(self, job: Callable[[Tell], PageScene]) -> None:
        """Do a job whose scene is then shown; the page shows its progress meanwhile.

        Raises:
            RuntimeError: another is at work.
        """
        if not self._worker.claim():
            raise RuntimeError("another photo is at work")
        self._worker.start(lambda tell: self.show(job(tell)))

    def start(self) -> None:
        """Answer from now on, in threads."""
        self._thread.start()

    def close(self) -> bool:
        """Stop answering and remove what was uploaded; False where a job is still at work, in a daemon thread."""
        ended = self._worker.stop(self._limits.stop)
        if self._thread.is_alive():
            self._http.shutdown()
            self._thread.join()
        self._http.server_close()
        self.uploads.cleanup()
        return ended

    def __enter__(self) -> ViewerServer:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _take(self, stream: BufferedIOBase, promise: Declared) -> int:
        """Receive a photo and start its completion; the worker's place has been claimed."""
        path = Path(tempfile.mkdtemp(dir=self.uploads.name)) / f"upload{promise.suffix}"

        def remove() -> None:
            shutil.rmtree(path.parent, ignore_errors=True)

        def job(tell: Tell) -> str:
            try:
                return self.show(self._complete(path, promise.name, tell))
            except InputError as error:
                raise InputError(str(error).replace(str(path), promise.name)) from error

        try:
            receive(stream, path, promise)
            check_photo(path, promise.name)
            return self._worker.start(job, remove)
        except BaseException:
            remove()
            raise
