"""A local web server for one file, which can imitate faults of servers and networks."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclasses.dataclass
class Site:
    """A server's content and faults, and the requests that it has received."""

    url: str
    content: bytes
    ranges: bool = True
    status: int = 200
    headers: dict[str, str | None] = dataclasses.field(default_factory=dict)  # None omits a header
    # bytes after which the next answers break off
    drops: list[int] = dataclasses.field(default_factory=list)
    hang_after: int | None = None  # bytes after which an answer waits for `go_on`
    go_on: threading.Event = dataclasses.field(default_factory=threading.Event)
    requests: list[dict[str, str]] = dataclasses.field(default_factory=list)  # headers and path


@contextlib.contextmanager
def serve(content: bytes) -> Iterator[Site]:
    server = _Server(("127.0.0.1", 0), _Handler)
    server.site = Site(f"http://127.0.0.1:{server.server_port}/weights.pt", content)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server.site
    finally:
        server.site.go_on.set()
        server.shutdown()
        thread.join()
        server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = False  # closing the server waits for its threads
    site: Site

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Do not log clients that hang up."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def do_GET(self) -> None:
        site = self.server.site
        site.requests.append({**self.headers, "path": self.path})
        content = site.content
        wanted = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        start = int(wanted[1]) if wanted and site.ranges else 0
        status, body = site.status, content[start:]
        headers: dict[str, str | None] = {
            "Content-Length": str(len(body)),
            "Content-Type": "application/octet-stream",
        }
        if start and status == 200:
            status, headers["Content-Range"] = (
                206,
                f"bytes {start}-{len(content) - 1}/{len(content)}",
            )
        self.send_response(416 if start and start >= len(content) else status)
        for name, value in (headers | site.headers).items():
            if value is not None:
                self.send_header(name, value)
        self.end_headers()
        if site.drops:
            body = body[: site.drops.pop(0)]
        elif site.hang_after is not None:
            self.wfile.write(body[: site.hang_after])
            body = body[site.hang_after :]
            site.go_on.wait(60)
        self.wfile.write(body)
