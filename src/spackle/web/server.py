"""The viewer's server: a page, its scenes, and photos that are completed one at a time.

It is the standard library's, a thread for a connection: a few people look at one page, and what they load is whole
files out of memory.
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
from collections.abc import Callable, Mapping, Sequence
from http.server import ThreadingHTTPServer
from io import BufferedIOBase
from pathlib import Path
from socketserver import TCPServer
from typing import Any

from spackle.errors import InputError
from spackle.image import PHOTO_SUFFIXES
from spackle.web.guard import DEFAULT, Declared, Limits, check_photo, is_loopback, own_names, receive, split_depth
from spackle.web.handler import JSON, Handler, Tell, Worker
from spackle.web.page import PageScene, as_json

Body = tuple[str, bytes]  # content type, bytes
Content = bytes | Callable[[], bytes]  # or what makes them
# A photo's file, its name for people, where progress goes; by keyword `base`, `disparity`, `depth`, as the page chose.
Complete = Callable[..., PageScene]
HOST = "127.0.0.1"


class ViewerServer(ThreadingHTTPServer):
    """Serves from `start` until `close`; as a context manager, for the block.

    Args:
        pages: the page's files, URL path to content type and bytes.
        complete: what turns an uploaded photo into a scene; an InputError of it is shown as a line.
        host: where to listen; anything but this machine's own addresses lets others in.
        port: 0 takes a free one.
        limits: what a client may take.
        log: gets a line for each request.
        bases: that the page offers for photos.
        token: a secret part of the page's address, checked on every request; "" answers everybody on this machine.

    Raises:
        InputError: nothing can listen there.
    """

    daemon_threads = True
    request_queue_size = 128
    allow_reuse_address = os.name == "posix"  # elsewhere that would take a port away from who has it

    def __init__(
        self,
        pages: Mapping[str, Body],
        complete: Complete,
        *,
        host: str = HOST,
        port: int = 0,
        limits: Limits = DEFAULT,
        log: Callable[[str], None] = lambda line: None,
        bases: Sequence[str] = (),
        token: str = "",
    ) -> None:
        self.limits, self.log, self.token, self.host = limits, log, token, host
        self.worker = Worker(log, limits.kept_jobs)
        self._complete, self._bases = complete, list(bases)
        self._lock = threading.Lock()
        self._bodies: dict[str, tuple[str, Content]] = dict(pages)  # by path: no file is ever opened
        self._scenes: list[str] = []  # those that are kept, the shown one last
        self._shown = 0  # scenes so far
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
        self.local, self.names = is_loopback(numeric), own_names(host, numeric)  # local: for this machine alone
        self.uploads = tempfile.TemporaryDirectory(prefix="spackle-view-")
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True, name="viewer")

    @property
    def port(self) -> int:
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        """For a browser on this machine."""
        address = str(self.server_address[0])
        return self.url_at({"0.0.0.0": HOST, "::": "::1"}.get(address, address))

    def url_at(self, address: str) -> str:
        """For a browser that reaches this machine by that address."""
        root = f"http://{f'[{address}]' if ':' in address else address}:{self.port}/"
        return root + (f"{self.token}/" if self.token else "")

    def body(self, path: str) -> Body | None:
        """Content type and bytes of a path as it came; None for an unknown one."""
        with self._lock:
            kind, body = self._bodies.get(path, ("", b""))
        return (kind, body if isinstance(body, bytes) else body()) if kind else None

    def state(self) -> bytes:
        """scene.json: what is shown, what is at work, and what may be sent."""
        newest = self.worker.newest()
        with self._lock:
            scene = f"{self._scenes[-1]}.json" if self._scenes else None
        # One that failed is named as long as there is nothing else to see, so that a late page learns why.
        busy = newest is not None and (not newest[1].ended or scene is None)
        upload = {"suffixes": list(PHOTO_SUFFIXES), "max_bytes": self.limits.upload_bytes, "bases": self._bases}
        return as_json({"scene": scene, "job": f"/jobs/{newest[0]}" if newest and busy else None, "upload": upload})

    def show(self, scene: PageScene) -> str:
        """Make a scene the one that the page shows; the path of its description."""
        with self._lock:
            self._shown += 1
            root = f"/scenes/{self._shown}"
            downloads = {suffix: f"{root}/scene{suffix}" for suffix in scene.downloads}
            description = as_json(scene.description | ({"downloads": downloads} if downloads else {}))
            self._bodies[f"{root}.json"] = (JSON, description)
            made: dict[str, Content] = {f"scene{suffix}": make for suffix, make in scene.downloads.items()}
            for name, content in (made | scene.files).items():
                self._bodies[f"{root}/{name}"] = ("application/octet-stream", content)
            self._scenes.append(root)
            for old in self._scenes[: -self.limits.kept_scenes]:
                for path in [path for path in self._bodies if path.startswith((f"{old}/", f"{old}.json"))]:
                    del self._bodies[path]
            del self._scenes[: -self.limits.kept_scenes]
            return f"{root}.json"

    def work(self, job: Callable[[Tell], PageScene]) -> None:
        """Do a job whose scene is then shown; the page shows its progress meanwhile.

        Raises:
            RuntimeError: another is at work.
        """
        if not self.worker.claim():
            raise RuntimeError("another photo is at work")
        self.worker.start(lambda tell: self.show(job(tell)))

    def start(self) -> None:
        """Answer from now on, in threads."""
        self._thread.start()

    def close(self) -> bool:
        """Stop answering and remove what was uploaded; False where a job is still at work, in a daemon thread."""
        ended = self.worker.stop(self.limits.stop)
        if self._thread.is_alive():
            self.shutdown()
            self._thread.join()
        self.server_close()
        self.uploads.cleanup()
        return ended

    def __enter__(self) -> ViewerServer:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def take(self, stream: BufferedIOBase, promise: Declared) -> int:
        """Receive a photo and start its completion; the worker's place has been claimed."""
        path = Path(tempfile.mkdtemp(dir=self.uploads.name)) / f"upload{promise.suffix}"
        choices: dict[str, object] = dict(promise.choices)

        def job(tell: Tell) -> str:
            try:
                return self.show(self._complete(path, promise.name, tell, **choices))
            except InputError as error:
                line = str(error).replace(str(path), promise.name).replace(f"{path.parent}{os.sep}", "")
                raise InputError(line) from error
            finally:
                shutil.rmtree(path.parent, ignore_errors=True)

        try:
            receive(stream, path, promise, self.limits)
            if depth := split_depth(path, promise):
                choices["depth"] = depth
            check_photo(path, promise.name)
            return self.worker.start(job)
        except BaseException:
            shutil.rmtree(path.parent, ignore_errors=True)
            raise

    def server_bind(self) -> None:
        """Without the look-up of our own name, which may take seconds."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        """A thread for a connection; one too many is closed."""
        with self._lock:
            room = len(self._open) < self.limits.connections
            if room:
                self._open.add(request)
        if room:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.discard(request)
        super().shutdown_request(request)

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
