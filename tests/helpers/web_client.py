"""A server whose worker only pretends to complete photos, and clients over sockets of this
machine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import io
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from PIL import Image

from helpers import web_work
from helpers.photos import picture
from spackle.web.app import create_app, make_server
from spackle.web.callbacks import CallbackSender
from spackle.web.clients import Client
from spackle.web.guard import Access
from spackle.web.jobs import Jobs, RetentionLimits
from spackle.web.public_address import LOCAL_ONLY, PublicAddress

MAX_BYTES = 100_000  # of an upload
PATIENCE_S = 300.0  # bound for events that take no time unless the machine is busy
SCENES, BOUNDARY = "/api/v1/scenes", "7d1"


def saved(kind: str, **options: Any) -> bytes:
    """A small picture as a file of a format."""
    Image.fromarray(picture()).save(file := io.BytesIO(), kind, **options)
    return file.getvalue()


PHOTO = saved("PNG")


def form(content: bytes = PHOTO, name: str = "photo.png", **fields: Any) -> bytes:
    """A multipart body; the value of a field is text, or a pair (file name, bytes)."""
    parts = b""
    for field, value in {"photo": (name, content), **fields}.items():
        file, data = value if isinstance(value, tuple) else (None, value.encode())
        shown = "" if file is None else f'; filename="{file}"'
        head = f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="{field}"{shown}\r\n\r\n'
        parts += head.encode() + data + b"\r\n"
    return parts + f"--{BOUNDARY}--\r\n".encode()


@dataclasses.dataclass(frozen=True)
class Reply:
    """The answer to a request."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


@dataclasses.dataclass(frozen=True)
class Served:
    """A running server."""

    port: int
    root: str = ""  # prefix of paths, with the token
    jobs: Jobs = None  # type: ignore[assignment]

    def ask(
        self, path: str = "/", method: str = "GET", body: bytes | None = None, **headers: str
    ) -> Reply:
        fields = {name.replace("_", "-"): value for name, value in headers.items()}
        if body is not None:
            fields.setdefault("Content-Type", f"multipart/form-data; boundary={BOUNDARY}")
        with contextlib.closing(
            http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        ) as connection:
            connection.request(method, self.root + path, body, fields)
            answer = connection.getresponse()
            return Reply(answer.status, dict(answer.headers), answer.read())

    def send(self, content: bytes = PHOTO, name: str = "photo.png", **fields: Any) -> Reply:
        return self.ask(SCENES, "POST", form(content, name, **fields))

    def events(self, id: str) -> list[Any]:
        """The states of a job until its end."""
        blocks = self.ask(f"{SCENES}/{id}/events").body.decode().split("\n\n")
        return [
            json.loads(block.removeprefix("data: "))
            for block in blocks
            if block.startswith("data: ")
        ]

    def dial(self, data: bytes = b"") -> socket.socket:
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)
        connection.sendall(data)
        return connection

    def raw(self, data: bytes) -> tuple[int, bytes]:
        """Status and body of the answer to these bytes; status 0 if the server closes the
        connection.
        """
        with self.dial(data) as connection:
            head, _, body = answer_of(connection).partition(b"\r\n\r\n")
            return int(head.split()[1]) if head else 0, body


@contextlib.contextmanager
def served(
    folder: Path,
    token: str | None = "s3cret",
    host: str = "127.0.0.1",
    work: Any = web_work.work,
    max_bytes: int = MAX_BYTES,
    keep: RetentionLimits = RetentionLimits(),  # noqa: B008
    public: PublicAddress = LOCAL_ONLY,
    callbacks: CallbackSender | None = None,
    clients: tuple[Client, ...] = (),
) -> Iterator[Served]:
    with socket.socket() as listener:
        listener.bind((host, 0))
        listener.listen()
        address, port = listener.getsockname()
        app = create_app(
            folder,
            work,
            keep=keep,
            access=Access.for_listener(host, address, token, public, clients),
            max_bytes=max_bytes,
            callbacks=callbacks,
        )
        server = make_server(app)
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            yield Served(port, f"/{token}" if token else "", app.state.jobs)
        finally:
            server.should_exit = True
            thread.join()


def answer_of(connection: socket.socket) -> bytes:
    """All bytes until the server closes the connection."""
    with contextlib.suppress(ConnectionResetError):
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))
    return b""


def request(target: str, *headers: str, method: str = "GET", host: str = "localhost") -> bytes:
    """The head of a request that closes the connection."""
    lines = [f"{method} {target} HTTP/1.1", f"Host: {host}", "Connection: close", *headers]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")


def post(length: int, *headers: str, method: str = "POST") -> bytes:
    kind = f"Content-Type: multipart/form-data; boundary={BOUNDARY}"
    return request(f"/s3cret{SCENES}", kind, f"Content-Length: {length}", *headers, method=method)


def eventually(condition: Callable[[], object]) -> None:
    """Wait until the condition holds; a busy machine may take minutes."""
    end = time.monotonic() + PATIENCE_S
    pause = 0.01  # seconds
    while not condition():
        assert time.monotonic() < end, "the condition stayed false"
        time.sleep(pause)
        # Longer and longer, because who asks a browser takes time from what it waits for.
        pause = min(1.5 * pause, 0.25)
