"""The viewer's server with nothing behind it, and clients that behave well or not."""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import io
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from photos import picture
from PIL import Image

from spackle.web.guard import Limits
from spackle.web.handler import Tell
from spackle.web.page import PageScene
from spackle.web.server import Complete, ViewerServer

Where = ViewerServer | str  # the latter: the page's address
PAGES = {"/": ("text/html; charset=utf-8", b"<p>page"), "/viewer.js": ("text/javascript", b"go()")}
QUICK = Limits(pause=0.3, upload=0.6, send=0.5, heartbeat=0.05, stop=0.3, upload_bytes=100_000)


def saved(kind: str) -> bytes:
    """A small picture as a file of a format."""
    Image.fromarray(picture()).save(file := io.BytesIO(), kind)
    return file.getvalue()


PHOTO = saved("PNG")


@dataclasses.dataclass(frozen=True)
class Reply:
    """One answer."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


def a_scene(name: str = "a", content: bytes = b"layer", **more: Any) -> PageScene:
    layers = [{"name": "base", "file": "base.bin", "count": 1}]
    return PageScene({"name": name, "layers": layers}, {"base.bin": content}, **more)


def complete(photo: Path, name: str, tell: Tell) -> PageScene:
    """What stands for the network: the scene's one layer is the photo's bytes."""
    tell({"stage": "base", "done": 1, "total": 2})
    return a_scene(name, photo.read_bytes())


@contextlib.contextmanager
def serving(work: Complete = complete, limits: Limits = QUICK, **options: Any) -> Iterator[ViewerServer]:
    with ViewerServer(PAGES, work, limits=limits, **options) as server:
        yield server


def ask(where: Where, path: str = "/", method: str = "GET", body: bytes | None = None, **headers: str) -> Reply:
    """A well-formed request to a server, or below the page's address."""
    url = urlsplit(where if isinstance(where, str) else f"http://127.0.0.1:{where.port}")
    if method == "POST":  # as every browser does
        headers = {"Origin": f"http://{url.netloc}", **headers}
    with contextlib.closing(http.client.HTTPConnection(url.netloc, timeout=60)) as connection:
        fields = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, url.path.rstrip("/") + path, body, fields)
        answer = connection.getresponse()
        return Reply(answer.status, dict(answer.headers), answer.read())


def send(where: Where, content: bytes = PHOTO, name: str = "photo.png", **headers: str) -> Reply:
    return ask(where, f"/photos?name={name}", "POST", content, **headers)


def dial(server: ViewerServer, data: bytes = b"") -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=5)
    connection.sendall(data)
    return connection


def answer_of(connection: socket.socket) -> bytes:
    """Everything until the server hangs up."""
    with contextlib.suppress(ConnectionResetError):
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))
    return b""


def raw(server: ViewerServer, data: bytes) -> tuple[int, bytes]:
    """The status and the body that the server has for these bytes, however wrong; 0 where it just hangs up."""
    with dial(server, data) as connection:
        head, _, body = answer_of(connection).partition(b"\r\n\r\n")
        return int(head.split()[1]) if head else 0, body


def request(target: str, *headers: str, method: str = "GET", host: str = "localhost") -> bytes:
    """The head of a request."""
    lines = [f"{method} {target} HTTP/1.1", f"Host: {host}", *headers]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")


def get(target: str, *headers: str, host: str = "localhost") -> bytes:
    return request(target, "Connection: close", *headers, host=host)


def post(length: int, *headers: str, name: str = "a.png") -> bytes:
    return request(
        f"/photos?name={name}", "Origin: http://localhost", f"Content-Length: {length}", *headers, method="POST"
    )


def events(where: Where, job: str) -> list[Any]:
    """All that a job tells, heartbeats left out."""
    body = ask(where, f"{job}/events").body.decode()
    return [json.loads(block.removeprefix("data: ")) for block in body.split("\n\n") if block.startswith("data: ")]


def eventually(condition: Callable[[], object], within: float = 10.0) -> None:
    end = time.monotonic() + within
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.01)


def uploads_of(server: ViewerServer) -> list[str]:
    return [name for _, _, names in os.walk(server.uploads.name) for name in names]
