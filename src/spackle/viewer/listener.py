"""The socket of the viewer's server, and how many may hold on to it."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import sys
import threading
from collections.abc import Callable
from http.server import ThreadingHTTPServer
from io import BufferedIOBase
from socketserver import TCPServer
from typing import Any

from spackle.errors import InputError
from spackle.viewer.answers import Table
from spackle.viewer.guard import is_loopback, own_names
from spackle.viewer.handler import Handler
from spackle.viewer.limits import Limits
from spackle.viewer.upload import Declared
from spackle.viewer.work import Worker

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
        table: Table,
        worker: Worker,
        limits: Limits,
        log: Callable[[str], None],
        take: Callable[[BufferedIOBase, Declared], int],
    ) -> None:
        self.table, self.worker, self.limits, self.log, self.take = table, worker, limits, log, take
        self.listeners = threading.BoundedSemaphore(limits.listeners)
        self._places = threading.BoundedSemaphore(limits.connections)
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self.address_family, place = _address(host, port)
        try:
            super().__init__(place, Handler)
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            if isinstance(error, OSError) and error.errno == errno.EADDRNOTAVAIL:
                line = f"--host {host}: is no address of this machine: leave it out, or give 0.0.0.0 for all of them"
                raise InputError(line) from error
            raise InputError(f"--port {port}: cannot listen at {host}: {reason}: give another, or none") from error
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
        raise InputError(
            f"--host {host}: no address of this machine: {reason}: leave it out, or give 0.0.0.0"
        ) from error
    return found[0][0], found[0][4]
