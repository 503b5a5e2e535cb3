"""Photos sent to the viewer's server, and what their listeners hear, over a real socket of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import socket
import struct
import threading
import time
import zlib
from pathlib import Path

import pillow_heif
import pytest
from PIL import Image
from viewer_client import (
    QUICK,
    a_scene,
    admitted,
    answer_of,
    ask,
    complete,
    dial,
    events,
    eventually,
    get,
    raw,
    send,
    serving,
    uploads_of,
)

from spackle.errors import InputError
from spackle.viewer.guard import shown_name
from spackle.viewer.page import PageScene
from spackle.viewer.work import Tell


def test_a_photo_becomes_the_scene_that_is_shown_one_at_a_time(photo: bytes) -> None:
    go_on = threading.Event()

    def slow(path: Path, name: str, tell: Tell) -> PageScene:
        tell({"stage": "base", "done": 3, "total": 35})
        assert go_on.wait(5)
        return complete(path, name, tell)

    with serving(slow) as server:
        reply = send(server, photo, Origin=f"http://127.0.0.1:{server.port}", Sec_Fetch_Site="same-origin")
        assert (reply.status, reply.json) == (202, {"job": "/jobs/1"})
        assert send(server, photo).status == 409
        assert ask(server, "/scene.json").json["job"] == "/jobs/1"
        assert len(uploads_of(server)) == 1
        go_on.set()
        assert events(server, "/jobs/1")[-2:] == [
            {"stage": "base", "done": 1, "total": 2},
            {"ready": "/scenes/1.json"},
        ]
        state = ask(server, "/scene.json").json
        assert (state["scene"], state["job"]) == ("/scenes/1.json", None)
        assert ask(server, "/scenes/1.json").json["name"] == "photo.png"
        assert ask(server, "/scenes/1/base.bin").body == photo
        assert not uploads_of(server)
        # What follows the declared length is not read; a name is nothing but text.
        start = "POST /photos?name=%3Cb%3E%26.png HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n"
        start += f"Content-Length: {len(photo)}\r\n\r\n"
        assert raw(server, start.encode() + photo + b"\x00 and more\r\n\r\n").split()[1] == b"202"
        assert events(server, "/jobs/2")[-1] == {"ready": "/scenes/2.json"}
        assert ask(server, "/scenes/2/base.bin").body == photo
        description = ask(server, "/scenes/2.json")
        assert not {b"<", b"&"} & set(description.body.split())
        assert description.json["name"] == "<b>&.png"


def test_a_kind_that_is_not_named_is_refused(photo: bytes) -> None:
    with serving() as server:
        for name in ("photo.gif", "photo", "", "photo.png.exe", "photo.png%00.exe", ".png%2f"):
            reply = send(server, photo, name)
            assert reply.status == 415, name
            assert "png" in reply.json["error"]
        assert ask(server, "/photos", "POST", photo).status == 415


def test_a_photo_has_a_length_within_limits(photo: bytes) -> None:
    start = "POST /photos?name=a.png HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n"
    with serving() as server:
        for headers, status in {
            "Transfer-Encoding: chunked\r\n": 411,
            "Transfer-Encoding: chunked\r\nContent-Length: 5\r\n": 411,
            "": 411,
            "Content-Length: -1\r\n": 400,
            "Content-Length: 5\r\nContent-Length: 6\r\n": 400,
            "Content-Length: ٣\r\n": 400,
            "Content-Length: 0\r\n": 400,
            "Content-Length: 100001\r\n": 413,
            "Content-Length: 9999999999999999999999\r\n": 400,
        }.items():
            with dial(server, f"{start}{headers}\r\n".encode()) as connection:
                connection.shutdown(socket.SHUT_WR)
                assert answer_of(connection).split()[1] == str(status).encode(), headers
        assert send(server, bytes(QUICK.upload_bytes + 1)).status == 413
        assert send(server, photo).status == 202  # the place was never taken


def test_a_client_may_ask_before_it_sends_and_learns_why_it_is_refused_while_it_sends(photo: bytes) -> None:
    head = f"Host: localhost\r\nOrigin: http://localhost\r\nContent-Length: {len(photo)}\r\nExpect: 100-continue\r\n"
    head += "Connection: close\r\n\r\n"
    with serving() as server:
        with dial(server, f"POST /photos?name=a.png HTTP/1.1\r\n{head}".encode()) as connection:
            assert connection.recv(1000) == b"HTTP/1.1 100 Continue\r\n\r\n"
            connection.sendall(photo)
            assert answer_of(connection).split()[1] == b"202"
        with dial(server, f"POST /photos?name=a.exe HTTP/1.1\r\n{head}".encode()) as connection:
            assert connection.recv(1000).split()[1] == b"415"
    with serving(limits=dataclasses.replace(QUICK, pause=2)) as server:
        reply = send(server, bytes(20_000_000))
        assert (reply.status, set(reply.json)) == (413, {"error"})


@pytest.mark.parametrize("how", ["silent", "dripping", "gone", "half closed"])
def test_a_slow_or_vanishing_client_leaves_the_place_to_others(photo: bytes, how: str) -> None:
    start = "POST /photos?name=a.png HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n"
    start += f"Content-Length: {len(photo)}\r\n\r\n"
    with serving() as server, dial(server, start.encode() + photo[:50]) as connection:
        eventually(lambda: uploads_of(server))
        assert send(server, photo).status == 409
        if how == "gone":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.close()
        elif how == "half closed":
            connection.shutdown(socket.SHUT_WR)
            assert answer_of(connection).split()[1] == b"400"
        elif how == "dripping":
            with contextlib.suppress(OSError):
                for byte in photo[50:70]:
                    connection.sendall(bytes([byte]))
                    time.sleep(0.05)
        if how in ("silent", "dripping"):
            assert answer_of(connection).split()[1] == b"408"
        eventually(lambda: not uploads_of(server))
        eventually(lambda: send(server, photo).status == 202)


def png_of(width: int, height: int, data: bytes) -> bytes:
    """A PNG that says it has that size."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def saved(format: str) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, format)
    return file.getvalue()


def test_what_is_no_photo_is_found_out_by_decoding_and_every_kind_that_is_named_is_taken() -> None:
    pillow_heif.register_heif_opener()
    with serving() as server:
        for content, why in (
            (b"<script>alert(1)</script>", "not an image"),
            (png_of(30_000, 30_000, bytes(1000)), "100 megapixels"),
            (png_of(2**31 - 1, 2**31 - 1, b""), ""),
            (png_of(4000, 4000, bytes(1000)), "damaged or cut off"),
            (saved("EPS"), "EPS"),  # Pillow would have another program read it
            (saved("GIF"), "GIF"),
        ):
            reply = send(server, content, "holiday.png")
            assert (reply.status, reply.json["error"].startswith("holiday.png: ")) == (415, True)
            assert why in reply.json["error"]
            assert server.uploads.name not in reply.json["error"]
            assert not uploads_of(server)
        names = {"JPEG": "a.JPG", "WEBP": "a.webp", "TIFF": "a.tif", "MPO": "a.jpeg", "HEIF": "a.heic"}
        for format, name in names.items():
            reply = send(server, saved(format), name)
            assert reply.status == 202, reply.body
            assert "ready" in events(server, reply.json["job"])[-1]


@pytest.mark.parametrize(
    ("query", "shown"),
    [
        ("name=..%2F..%2Fetc%2Fpasswd.png", "passwd.png"),
        ("name=C:%5Cphotos%5Ca.png", "a.png"),
        ("name=%1b%5b31m%0d%0aa%E2%80%AE.png", "[31ma.png"),
        ("name=a%3Cb%3E.png", "a<b>.png"),
        (f"name={200 * 'a'}.png", f"{40 * 'a'}…{36 * 'a'}.png"),
        ("", ""),
        ("&".join(["name=a.png"] * 9), ""),
    ],
)
def test_a_name_is_for_people_only(query: str, shown: str) -> None:
    assert shown_name(query) == shown


def test_what_goes_wrong_is_told_in_a_line_and_the_next_photo_may_come(photo: bytes) -> None:
    def fail(path: Path, name: str, tell: Tell) -> PageScene:
        if name == "bug.png":
            raise KeyError("oh")
        raise InputError(f"{path}: no depth\nat all")

    lines: list[str] = []
    with serving(fail, log=lines.append) as server:
        for name, error in {"a.png": "a.png: no depth at all", "bug.png": "this went wrong: KeyError: 'oh'"}.items():
            job = send(server, photo, name).json["job"]
            assert events(server, job) == [{"error": error}]
            assert ask(server, "/scene.json").json["job"] == job  # a page that comes late learns why there is nothing
            assert not uploads_of(server)
        server.show(a_scene())
        assert ask(server, "/scene.json").json["job"] is None
    assert any("Traceback" in line for line in lines)


def test_progress_comes_as_it_is_made_and_listeners_are_counted() -> None:
    go_on = threading.Event()

    def job(tell: Tell) -> PageScene:
        tell({"stage": "base", "done": 0, "total": 2})
        assert go_on.wait(60)
        tell({"line": "focal length <50> px"})
        return a_scene()

    with serving(limits=dataclasses.replace(QUICK, listeners=2)) as server:
        server.work(job)
        with pytest.raises(RuntimeError):
            server.work(job)
        listeners = [dial(server, get("/jobs/1/events")) for _ in range(2)]
        assert all(listener.recv(12).endswith(b"200") for listener in listeners)
        assert ask(server, "/jobs/1/events").status == 503
        assert ask(server).status == 200
        for listener in listeners:
            listener.close()
        with admitted(server, "/jobs/1/events") as listener:
            heard = b""
            while b": " not in heard or b":\n\n" not in heard:  # the first event, and a sign of life
                part = listener.recv(1000)
                assert part, heard  # hung up
                heard += part
            head, _, body = heard.partition(b"\r\n\r\n")
            assert b"text/event-stream" in head
            assert body.startswith(b'data: {"stage": "base", "done": 0, "total": 2}\n\n')
            go_on.set()
            rest = answer_of(listener)
        assert rest.endswith(b'data: {"ready": "/scenes/1.json"}\n\n')
        assert b"<" not in rest
