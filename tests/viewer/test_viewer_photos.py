"""Photos sent to the viewer's server, and what their listeners hear, over a real socket of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import struct
import threading
import time
import zlib
from pathlib import Path
from typing import Any

import pillow_heif
import pytest
from viewer_client import (
    PHOTO,
    QUICK,
    a_scene,
    answer_of,
    ask,
    complete,
    dial,
    events,
    eventually,
    get,
    post,
    raw,
    request,
    saved,
    send,
    serving,
    uploads_of,
)

from spackle.errors import InputError
from spackle.viewer.guard import shown_name
from spackle.viewer.page import PageScene
from spackle.viewer.work import Tell


def test_a_photo_becomes_the_scene_that_is_shown() -> None:
    go_on = threading.Event()

    def slow(path: Path, name: str, tell: Tell) -> PageScene:
        tell({"stage": "base", "done": 3, "total": 35})
        assert go_on.wait(5)
        return complete(path, name, tell)

    with serving(slow) as server:
        reply = send(server, Sec_Fetch_Site="same-origin")
        assert (reply.status, reply.json) == (202, {"job": "/jobs/1"})
        assert send(server).status == 409  # one at a time
        assert ask(server, "/scene.json").json["job"] == "/jobs/1"
        assert len(uploads_of(server)) == 1
        go_on.set()
        assert events(server, "/jobs/1")[-2:] == [{"stage": "base", "done": 1, "total": 2}, {"ready": "/scenes/1.json"}]
        state = ask(server, "/scene.json").json
        assert (state["scene"], state["job"]) == ("/scenes/1.json", None)
        assert ask(server, "/scenes/1.json").json["name"] == "photo.png"
        assert ask(server, "/scenes/1/base.bin").body == PHOTO
        assert not uploads_of(server)
        # What follows the declared length is not read; a name is nothing but text.
        assert raw(server, post(len(PHOTO), name="%3Cb%3E%26.png") + PHOTO + b"\x00 and more\r\n\r\n")[0] == 202
        assert events(server, "/jobs/2")[-1] == {"ready": "/scenes/2.json"}
        assert ask(server, "/scenes/2/base.bin").body == PHOTO
        description = ask(server, "/scenes/2.json")
        assert not {b"<", b"&"} & set(description.body.split())
        assert description.json["name"] == "<b>&.png"


def test_a_photos_choices_and_its_depth_map_reach_the_work() -> None:
    heard: list[dict[str, Any]] = []

    def choosing(photo: Path, name: str, tell: Tell, **choices: Any) -> PageScene:
        read = {key: value.read_bytes() if isinstance(value, Path) else value for key, value in choices.items()}
        heard.append({**read, "photo": photo.read_bytes()})
        return a_scene(name)

    with serving(choosing) as server:
        url = "/photos?name=a.png&base=lite&disparity=0.2&depth=.npy:"
        for wrong in ("0", "99999999", "x"):
            assert ask(server, url + wrong, "POST", PHOTO + b"depth").status == 400
        events(server, ask(server, url + "5", "POST", PHOTO + b"depth").json["job"])
    assert heard == [{"base": "lite", "disparity": "0.2", "depth": b"depth", "photo": PHOTO}]


def test_a_photo_has_a_known_kind_and_a_length_within_limits() -> None:
    plain = ("/photos?name=a.png", "Origin: http://localhost")
    with serving() as server:
        for name in ("photo.gif", "photo", "", "photo.png.exe", "photo.png%00.exe", ".png%2f"):
            reply = send(server, name=name)
            assert (reply.status, "png" in reply.json["error"]) == (415, True), name
        assert ask(server, "/photos", "POST", PHOTO).status == 415
        for headers, status in {
            ("Transfer-Encoding: chunked",): 411,
            ("Transfer-Encoding: chunked", "Content-Length: 5"): 411,
            (): 411,
            ("Content-Length: 5", "Content-Length: 6"): 400,
            **{(f"Content-Length: {text}",): 400 for text in ("-1", "\xb2", "0", "9999999999999999999999")},
            ("Content-Length: 100001",): 413,
        }.items():
            with dial(server, request(*plain, *headers, method="POST")) as connection:
                connection.shutdown(socket.SHUT_WR)
                assert int(answer_of(connection).split()[1]) == status, headers
        assert send(server, bytes(QUICK.upload_bytes + 1)).status == 413
        assert send(server).status == 202  # the place was never taken
    with serving(limits=dataclasses.replace(QUICK, pause=2)) as server:  # it learns why while it sends
        reply = send(server, bytes(20_000_000))
        assert (reply.status, set(reply.json)) == (413, {"error"})


def test_a_client_may_ask_before_it_sends() -> None:
    asking = ("Expect: 100-continue", "Connection: close")
    with serving() as server:
        with dial(server, post(len(PHOTO), *asking)) as connection:
            assert connection.recv(1000) == b"HTTP/1.1 100 Continue\r\n\r\n"
            connection.sendall(PHOTO)
            assert answer_of(connection).split()[1] == b"202"
        with dial(server, post(len(PHOTO), *asking, name="a.exe")) as connection:
            assert connection.recv(1000).split()[1] == b"415"


@pytest.mark.parametrize("how", ["silent", "dripping", "below the rate", "gone", "half closed"])
def test_a_slow_or_vanishing_client_leaves_its_place(how: str) -> None:
    limits = dataclasses.replace(QUICK, upload=60, rate=100_000) if how == "below the rate" else QUICK
    with serving(limits=limits) as server, dial(server, post(90_000) + PHOTO[:50]) as connection:
        eventually(lambda: uploads_of(server))
        assert send(server).status == 409
        start = time.monotonic()
        if how == "gone":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.close()
        elif how == "half closed":
            connection.shutdown(socket.SHUT_WR)
            assert answer_of(connection).split()[1] == b"400"
        elif how != "silent":
            with contextlib.suppress(OSError):
                for _ in range(60):
                    connection.sendall(b"a")
                    time.sleep(0.05)
        if how in ("silent", "dripping"):
            assert answer_of(connection).split()[1] == b"408"
        eventually(lambda: not uploads_of(server))
        eventually(lambda: send(server).status == 202)
        assert time.monotonic() - start < 8


def png_claiming(width: int, height: int) -> bytes:
    """A photo that says it has that size."""
    head = b"IHDR" + struct.pack(">II", width, height) + PHOTO[24:29]
    return PHOTO[:12] + head + struct.pack(">I", zlib.crc32(head)) + PHOTO[33:]


def test_what_is_no_photo_is_found_out_by_decoding() -> None:
    with serving() as server:
        for content, why in (
            (b"<script>alert(1)</script>", "not an image"),
            (png_claiming(30_000, 30_000), "100 megapixels"),
            (png_claiming(2**31 - 1, 2**31 - 1), ""),
            (png_claiming(4000, 4000), "damaged or cut off"),
            (saved("EPS"), "EPS"),  # Pillow would have another program read it
            (saved("GIF"), "GIF"),
        ):
            reply = send(server, content, "holiday.png")
            assert (reply.status, reply.json["error"].startswith("holiday.png: ")) == (415, True)
            assert why in reply.json["error"]
            assert server.uploads.name not in reply.json["error"]
            assert not uploads_of(server)


def test_every_kind_of_photo_that_is_named_is_taken() -> None:
    pillow_heif.register_heif_opener()
    names = {"JPEG": "a.JPG", "WEBP": "a.webp", "TIFF": "a.tif", "MPO": "a.jpeg", "HEIF": "a.heic"}
    with serving() as server:
        for kind, name in names.items():
            reply = send(server, saved(kind), name)
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


def test_what_goes_wrong_is_told_in_a_line() -> None:
    def fail(path: Path, name: str, tell: Tell) -> PageScene:
        raise KeyError("oh") if name == "bug.png" else InputError(f"{path}: no depth\nat all")

    lines: list[str] = []
    with serving(fail, log=lines.append) as server:
        for name, error in {"a.png": "a.png: no depth at all", "bug.png": "this went wrong: KeyError: 'oh'"}.items():
            job = send(server, name=name).json["job"]
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

    with serving(limits=dataclasses.replace(QUICK, listeners=1)) as server:
        server.work(job)
        with pytest.raises(RuntimeError):
            server.work(job)
        with dial(server, get("/jobs/1/events")) as listener:
            heard = b""
            while not heard.endswith(b"\n\n:\n\n"):  # the first event, and a sign of life
                heard += (part := listener.recv(1000))
                assert part, heard  # hung up
            head, _, body = heard.partition(b"\r\n\r\n")
            assert b"text/event-stream" in head
            assert body.startswith(b'data: {"stage": "base", "done": 0, "total": 2}\n\n')
            assert ask(server, "/jobs/1/events").status == 503
            assert ask(server).status == 200
        eventually(lambda: ask(server, "/jobs/1/events", "HEAD").status == 200)  # the place of one that has gone
        go_on.set()
        assert events(server, "/jobs/1")[-2:] == [{"line": "focal length <50> px"}, {"ready": "/scenes/1.json"}]
        assert b"<" not in ask(server, "/jobs/1/events").body
