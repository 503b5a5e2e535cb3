"""The server tells a client's server that a scene is done."""

from __future__ import annotations

import contextlib
import http.server
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import ROOT
from helpers.command import refuses, run
from helpers.web_client import SCENES, Served, eventually, form, served

from spackle.runtime.errors import InputError
from spackle.web import callbacks
from spackle.web.callbacks import CallbackSender

TOKEN = "s3cret"


class Receiver:
    """A client's server, which answers with one status after the other, and 204 at the end."""

    def __init__(self, port: int) -> None:
        self.url = f"http://127.0.0.1:{port}"
        self.heard: list[tuple[str, dict[str, str], bytes]] = []  # path, headers, body
        self.answers: list[int] = []

    @property
    def states(self) -> list[Any]:
        return [json.loads(body) for _, _, body in self.heard]


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            headers = {name.lower(): value for name, value in self.headers.items()}
            receiver.heard.append((self.path, headers, body))
            status = receiver.answers.pop(0) if receiver.answers else 204
            self.send_response(status)
            if status == 302:
                self.send_header("Location", "/elsewhere")
            self.end_headers()

        def do_GET(self) -> None:
            receiver.heard.append((f"GET {self.path}", {}, b"{}"))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *arguments: object) -> None:
            """Print nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        receiver = Receiver(server.server_port)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield receiver
        server.shutdown()
        thread.join()


@contextlib.contextmanager
def calling(folder: Path, receiver: Receiver) -> Iterator[Served]:
    """A server that may call the receiver."""
    with served(folder, callbacks=CallbackSender((receiver.url,), {"": TOKEN})) as server:
        yield server


def genuine() -> Callable[[Any, bytes, str], bool]:
    """The function in the docs with which a receiver checks a message."""
    docs = (ROOT / "docs" / "http.md").read_text("utf-8")
    blocks = re.findall(r"```python\n(.*?)```", docs, re.DOTALL)
    names: dict[str, Any] = {}
    exec(next(block for block in blocks if "webhook" in block), names)
    function: Callable[[Any, bytes, str], bool] = names["is_genuine"]
    return function


def test_the_end_of_a_photo_is_told_and_signed(tmp_path: Path, receiver: Receiver) -> None:
    with calling(tmp_path, receiver) as server:
        url = f"{receiver.url}/done?job=7"
        done = server.send(callback_url=url).json["id"]
        eventually(lambda: receiver.heard)
        bad = server.send(name="bad.png", callback_url=url).json["id"]
        eventually(lambda: len(receiver.heard) == 2)
        assert receiver.states == [server.ask(f"{SCENES}/{id}").json for id in (done, bad)]
        assert [state["state"] for state in receiver.states] == ["done", "failed"]
        assert receiver.states[0]["files"] == ["photo.jpg"]
    path, headers, body = receiver.heard[0]
    assert (path, headers["webhook-id"]) == ("/done?job=7", done)
    is_genuine = genuine()
    assert is_genuine(headers, body, TOKEN)
    assert not is_genuine(headers, body, "another token")
    assert not is_genuine(headers, body.replace(b"photo", b"other"), TOKEN)
    old = {**headers, "webhook-timestamp": str(int(time.time()) - 3600)}
    assert not is_genuine(old, body, TOKEN)
    assert TOKEN.encode() not in body
    assert TOKEN not in str(headers)


def test_a_message_is_repeated_until_it_arrives(
    tmp_path: Path, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callbacks, "DELAYS_S", (0.0, 0.01, 0.01, 0.01))
    receiver.answers = [500, 302, 429]  # the redirect is not followed
    with calling(tmp_path, receiver) as server:
        id = server.send(callback_url=receiver.url).json["id"]
        eventually(lambda: len(receiver.heard) == 4)
        eventually(lambda: server.jobs.by_id[id].callback_url is None)
    assert {path for path, _, _ in receiver.heard} == {"/"}
    assert {state["id"] for state in receiver.states} == {id}


def test_a_message_is_given_up_in_the_end(
    tmp_path: Path,
    receiver: Receiver,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(callbacks, "DELAYS_S", (0.0, 0.01))
    receiver.answers = [302, 302]
    with calling(tmp_path, receiver) as server:
        id = server.send(callback_url=receiver.url).json["id"]
        eventually(lambda: server.jobs.by_id[id].callback_url is None)
    assert len(receiver.heard) == 2
    assert "given up: the answer was 302" in caplog.text


def test_a_message_that_did_not_arrive_is_sent_after_a_restart(
    tmp_path: Path, receiver: Receiver
) -> None:
    receiver.answers = [503]
    with calling(tmp_path, receiver) as server:
        id = server.send(callback_url=receiver.url).json["id"]
        eventually(lambda: receiver.heard)
    with calling(tmp_path, receiver) as server:
        eventually(lambda: len(receiver.heard) == 2)
        eventually(lambda: server.jobs.by_id[id].callback_url is None)
    with calling(tmp_path, receiver):
        time.sleep(0.3)  # nothing may come within this time
    assert [state["id"] for state in receiver.states] == [id, id]


@pytest.mark.parametrize(
    "url",
    [
        "http://localhost:{port}/",  # another name of the same host
        "http://127.0.0.1/",
        "https://127.0.0.1:{port}/",
        "http://127.0.0.1:{port}@evil.example/",
        "http://evil.example#@127.0.0.1:{port}/",
        "http://user@127.0.0.1:{port}/",
        "http://127.0.0.1:port/",
        "http://127.0.0.1:{port}/a b",
        "http://127.0.0.1:{port}/\r\nX: y",
        "//127.0.0.1:{port}/",
        "file:///etc/passwd",
        "http://127.0.0.1:{port}/" + 2000 * "a",
    ],
)
def test_only_named_hosts_are_called(tmp_path: Path, receiver: Receiver, url: str) -> None:
    sender = CallbackSender((receiver.url,), {"": TOKEN})
    port = receiver.url.rpartition(":")[2]
    with pytest.raises(Exception, match="callback_url") as refusal:
        sender.check(url.replace("{port}", port))
    assert getattr(refusal.value, "status_code", None) == 422


def test_a_server_that_may_call_nobody_refuses(tmp_path: Path) -> None:
    with served(tmp_path) as server:
        reply = server.send(callback_url="https://hooks.example.com/")
        assert (reply.status, "callback_url" in reply.json["error"]) == (422, True)
        twice = form(callback_url="", options="{}")
        assert server.ask(SCENES, "POST", twice).status == 202
        assert [path for path in tmp_path.iterdir() if path.name.startswith(".new-")] == []


@pytest.mark.parametrize("host", ["*", "ftp://a.example", "a.example/path", "", "a.example:port"])
def test_a_host_that_is_none_is_refused(tmp_path: Path, host: str) -> None:
    with pytest.raises(InputError, match="`callback_host`"):
        CallbackSender((host,), {"": TOKEN})
    if host == "*":
        refuses(run("serve", "-o", tmp_path, "--callback-host", host), "--callback-host *")
