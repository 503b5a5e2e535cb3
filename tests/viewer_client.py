"""The viewer's server with nothing behind it, and clients that behave well or not."""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from spackle.viewer.guard import Limits
from spackle.viewer.page import PageScene
from spackle.viewer.server import Complete, ViewerServer
from spackle.viewer.work import Tell

PAGES = {"/": ("text/html; charset=utf-8", b"<p>page"), "/viewer.js": ("text/javascript", b"go()")}
QUICK = Limits(request=0.6, pause=0.3, upload=0.6, send=0.5, heartbeat=0.05, stop=0.3, upload_bytes=100_000)


@dataclasses.dataclass(frozen=True)
class Reply:
    """One answer."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


def a_scene(name: str = "a", content: bytes = b"layer") -> PageScene:
    return PageScene(
        {"name": name, "layers": [{"name": "base", "file": "base.bin", "count": 1}]}, {"base.bin": content}
    )


def complete(photo: Path, name: str, tell: Tell) -> PageScene:
    """What stands for the network: the scene's one layer is the photo's bytes."""
    tell({"stage": "base", "done": 1, "total": 2})
    return a_scene(name, photo.read_bytes())


@contextlib.contextmanager
def serving(work: Complete = complete, limits: Limits = QUICK, **options: Any) -> Iterator[ViewerServer]:
    with ViewerServer(PAGES, work, limits=limits, **options) as server:
        yield server


def ask(server: ViewerServer, path: str = "/", method: str = "GET", body: bytes | None = None, **headers: str) -> Reply:
    """A well-formed request."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=5)
    if method == "POST":  # as every browser does
        headers = {"Origin": f"http://127.0.0.1:{server.port}", **headers}
    with contextlib.closing(connection):
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return Reply(answer.status, dict(answer.headers), answer.read())


def dial(server: ViewerServer, data: bytes = b"") -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=5)
    connection.sendall(data)
    return connection


def answer_of(connection: socket.socket) -> bytes:
    """Everything until the server hangs up."""
    parts = []
    with contextlib.suppress(ConnectionResetError):
        while part := connection.recv(1 << 16):
            parts.append(part)
    return b"".join(parts)


def raw(server: ViewerServer, data: bytes) -> bytes:
    """What the server says to these bytes, however wrong they are; it must hang up."""
    with dial(server, data) as connection:
        return answer_of(connection)


def get(target: str, *headers: str, host: str = "localhost") -> bytes:
    lines = [f"GET {target} HTTP/1.1", f"Host: {host}", "Connection: close", *headers]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")


def send(server: ViewerServer, content: bytes, name: str = "photo.png", **headers: str) -> Reply:
    return ask(server, f"/photos?name={name}", "POST", content, **headers)


def events(server: ViewerServer, job: str) -> list[Any]:
    """All that a job tells, heartbeats left out."""
    body = ask(server, f"{job}/events").body.decode()
    return [json.loads(block.removeprefix("data: ")) for block in body.split("\n\n") if block.startswith("data: ")]


def eventually(condition: Callable[[], object], within: float = 10.0) -> None:
    end = time.monotonic() + within
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.01)


def uploads_of(server: ViewerServer) -> list[Path]:
    return [Path(folder) / name for folder, _, names in os.walk(server.uploads.name) for name in names]


def admitted(server: ViewerServer, path: str, within: float = 10.0) -> socket.socket:
    """A connection with the answer 200: the server lets go of earlier ones only when it next writes to them."""
    end = time.monotonic() + within
    while True:
        connection = dial(server, get(path))
        if connection.recv(12, socket.MSG_PEEK).endswith(b"200"):
            return connection
        connection.close()
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.01)
