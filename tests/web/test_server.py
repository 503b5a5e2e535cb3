"""The viewer's server as browsers, strangers and broken clients meet it, each over a real socket of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import socket
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pillow_heif
import pytest
from web_client import (
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
from spackle.web.guard import shown_name
from spackle.web.handler import Tell
from spackle.web.page import PageScene
from spackle.web.server import ViewerServer


@pytest.fixture(scope="module")
def server() -> Iterator[ViewerServer]:
    """One that takes no photo."""
    with serving() as server:
        server.show(a_scene())
        yield server


def test_the_page_and_the_scene_are_there(server: ViewerServer) -> None:
    page, state = ask(server), ask(server, "/scene.json").json
    assert (page.status, page.body, page.headers["Content-Type"]) == (200, b"<p>page", "text/html; charset=utf-8")
    assert (state["job"], state["upload"]["max_bytes"]) == (None, QUICK.upload_bytes)
    assert ".jpg" in state["upload"]["suffixes"]
    assert ask(server, state["scene"]).json == a_scene().description
    layer = ask(server, state["scene"].replace(".json", "/base.bin"))
    assert (layer.body, layer.headers["Content-Type"]) == (b"layer", "application/octet-stream")
    head = ask(server, "/", "HEAD")
    assert (head.status, head.headers["Content-Length"], head.body) == (200, str(len(page.body)), b"")


def test_old_scenes_and_their_downloads_make_room() -> None:
    with serving(bases=["auto", "lite"]) as server:
        paths = [server.show(a_scene("0", downloads={".ply": lambda: b"ply"}))]
        place = ask(server, paths[0]).json["downloads"][".ply"]
        assert (ask(server, place).status, ask(server, place).body) == (200, b"ply")
        paths += [server.show(a_scene(str(k))) for k in (1, 2)]
        assert [ask(server, path).status for path in (*paths, place, "/scenes/1/base.bin")] == [404, 200, 200, 404, 404]
        state = ask(server, "/scene.json").json
        assert (state["scene"], state["upload"]["bases"]) == (paths[-1], ["auto", "lite"])


def test_every_answer_says_what_a_browser_may_do_with_it(server: ViewerServer) -> None:
    wanted = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}
    wanted |= {"Cross-Origin-Resource-Policy": "same-origin", "Server": "spackle"}  # no versions
    for reply in (ask(server), ask(server, "/none"), ask(server, "/", "PUT"), ask(server, "/", Host="evil.example")):
        assert wanted.items() <= reply.headers.items()
        policy = reply.headers["Content-Security-Policy"]
        assert all(part in policy for part in ("default-src 'none'", "frame-ancestors 'none'"))
        assert not any(loose in policy for loose in ("unsafe-inline", "*"))
        assert "Access-Control-Allow-Origin" not in reply.headers


def sent(*headers: str, target: str = "/photos?name=a.png", host: str = "localhost") -> bytes:
    """A photo on its way to a server that shall not take it."""
    return request(target, *headers, f"Content-Length: {len(PHOTO)}", method="POST", host=host) + PHOTO


UNKNOWN = [
    *("/none", "/index.html", "/scenes/1", "/scenes/2.json", "/jobs/1/events", "/viewer.js%00", "/./viewer.js"),
    *("/../../etc/passwd", "/scenes/1/..%2f..%2fetc%2fpasswd", "/%252e%252e%252fetc%252fpasswd", "//etc/passwd"),
    *("/..\\..\\etc\\passwd", "\\etc\\passwd", "http://localhost/etc/passwd", "file:///etc/passwd", "*", "/é"),
]
HOSTS = ["evil.example", "localhost.evil.example", "10.0.0.7", "", "localhost:x", "[::1"]
PAGES = [f"Origin: {page}" for page in ("http://evil.example", "null", "http://localhost:1", "")]
SITES = [f"Sec-Fetch-Site: {site}" for site in ("cross-site", "same-site")]
REFUSED = [
    *((get(target), 404) for target in UNKNOWN),
    *((sent("Origin: http://localhost", target=target), 404) for target in ("/", "/photos/1", "//photos/")),
    *((request("/", "Connection: close", method=method), 501) for method in ("PUT", "OPTIONS", "FOO")),
    *((get("/", host=host), 403) for host in HOSTS),
    *((get("/", f"Host: {host}"), 403) for host in HOSTS),  # a request has one host
    *((sent("Origin: http://localhost", host=host), 403) for host in HOSTS),
    *((get("/", header), 403) for header in PAGES + SITES),
    *((sent(header), 403) for header in ["X: no origin", *PAGES]),
    *((sent("Origin: http://localhost", header), 403) for header in SITES),
    (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", 400),  # TLS
    (b"GET / HTTP/1.1 and more\r\n\r\n", 400),
    (b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n", 505),
    (b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n", 403),  # no host
    (b"GET /" + 70_000 * b"a" + b" HTTP/1.1\r\n\r\n", 414),
    (get("/", *200 * ["X: a"]), 431),
    (get("/", "no colon", "Origin: http://evil"), 400),
]


@pytest.mark.parametrize(("data", "status"), REFUSED, ids=lambda value: repr(value)[:60])
def test_what_is_foreign_malformed_or_no_route_is_refused(server: ViewerServer, data: bytes, status: int) -> None:
    answer, body = raw(server, data)
    assert (answer, set(json.loads(body))) == (status, {"error"})
    assert ask(server).status == 200


def test_names_of_this_machine_are_ours_at_any_port(server: ViewerServer) -> None:
    for host in ("127.0.0.1", "localhost", "LOCALHOST:9", "[::1]:9000", "127.0.0.2"):
        assert raw(server, get("/", host=host))[0] == 200
    with serving(host="0.0.0.0") as wide:  # open to the network
        assert (wide.local, wide.url) == (False, f"http://127.0.0.1:{wide.port}/")
        for host, status in {"10.0.0.7:80": 200, socket.gethostname(): 200, "evil.example": 403}.items():
            assert raw(wide, get("/", host=host))[0] == status


def test_a_silent_connection_is_closed(server: ViewerServer) -> None:
    with dial(server, b"GET / HTTP/1.1\r\nHost: local") as silent:
        assert answer_of(silent) == b""


def test_a_client_that_never_reads_is_left() -> None:
    content = bytes(30_000_000)  # more than the socket's buffers hold
    with serving(limits=dataclasses.replace(QUICK, connections=1)) as server:
        server.show(a_scene(content=content))
        with dial(server, get("/scenes/1/base.bin")) as silent:  # it has the only place
            silent.recv(12)
            assert raw(server, get("/"))[0] == 0
            eventually(lambda: raw(server, get("/"))[0] == 200)
            assert len(answer_of(silent)) < len(content)
        eventually(lambda: len(ask(server, "/scenes/1/base.bin").body) == len(content))


def test_a_token_is_asked_for_on_every_request() -> None:
    lines: list[str] = []
    paths = ["/", "/viewer.js", "/scene.json", "/scenes/1.json", "/jobs/1/events", "/photos", "/s3cre", "/s3crett/"]
    with serving(token="s3cret", log=lines.append) as server:
        assert server.url == f"http://127.0.0.1:{server.port}/s3cret/"
        server.show(a_scene())
        for path in paths:
            for prefix in ("", "/", "/x", "/S3CRET", "/%733cret", "/x/s3cret"):
                assert ask(server, prefix + path).status == 403
            assert ask(server, path + "?token=s3cret", Cookie="s3cret", Referer=server.url).status == 403
        assert send(server).status == 403
        for path in ("", *paths[:4], "/scenes/1/base.bin"):
            assert ask(server, f"/s3cret{path}").status == 200
        job = ask(server, "/s3cret/photos?name=a.png", "POST", PHOTO).json["job"]
        assert events(server, f"/s3cret{job}")[-1]["ready"] == "/scenes/2.json"
        assert ask(server, "/s3cret/photos?name=a.png", "POST", PHOTO, Origin="http://evil.example").status == 403
    assert lines
    assert "s3cret" not in "".join(lines)


def test_closing_tells_listeners_and_removes_the_photo() -> None:
    reached, lines = threading.Event(), list[str]()

    def endless(path: Path, name: str, tell: Tell) -> PageScene:
        while True:
            tell({"stage": "base", "done": 0, "total": 0})
            reached.set()
            time.sleep(0.01)

    with serving(endless, log=lines.append) as server:
        raw(server, get("/\x1b[31m\x07"))
        assert lines
        assert all(line.isprintable() for line in lines), lines
        job = send(server).json["job"]
        assert reached.wait(3)
        with dial(server, get(f"{job}/events")) as listener, dial(server) as silent:
            listener.recv(12)
            start = time.monotonic()
            assert server.close()
            assert time.monotonic() - start < 1.5
            assert answer_of(listener).endswith(b'data: {"error": "the viewer has been stopped"}\n\n')
            assert answer_of(silent) == b""
        assert not Path(server.uploads.name).exists()
        with pytest.raises(OSError, match="refused"):
            dial(server)


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
        assert (b"<" in description.body, description.json["name"]) == (False, "<b>&.png")


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


@pytest.mark.parametrize(
    ("how", "status"), [("silent", b"408"), ("dripping", b"408"), ("half closed", b"400"), ("gone", b"")]
)
def test_a_slow_or_vanishing_client_leaves_its_place(how: str, status: bytes) -> None:
    with serving() as server, dial(server, post(90_000) + PHOTO[:50]) as connection:
        eventually(lambda: uploads_of(server))
        assert send(server).status == 409
        if how == "gone":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.close()
        elif how == "half closed":
            connection.shutdown(socket.SHUT_WR)
        elif how == "dripping":
            with contextlib.suppress(OSError):
                for _ in range(60):
                    connection.sendall(b"a")
                    time.sleep(0.05)
        if status:
            assert answer_of(connection).split()[1] == status
        eventually(lambda: not uploads_of(server))
        eventually(lambda: send(server).status == 202)


def png_claiming(width: int, height: int) -> bytes:
    """A photo that says it has that size."""
    head = b"IHDR" + struct.pack(">II", width, height) + PHOTO[24:29]
    return PHOTO[:12] + head + struct.pack(">I", zlib.crc32(head)) + PHOTO[33:]


def test_what_is_a_photo_is_found_out_by_decoding() -> None:
    pillow_heif.register_heif_opener()
    names = {"JPEG": "a.JPG", "WEBP": "a.webp", "TIFF": "a.tif", "MPO": "a.jpeg", "HEIF": "a.heic"}
    with serving() as server:
        for kind, name in names.items():
            reply = send(server, saved(kind), name)
            assert reply.status == 202, reply.body
            assert "ready" in events(server, reply.json["job"])[-1]
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


def test_progress_comes_as_it_is_made() -> None:
    go_on = threading.Event()

    def job(tell: Tell) -> PageScene:
        tell({"stage": "base", "done": 0, "total": 2})
        assert go_on.wait(60)
        tell({"line": "focal length <50> px"})
        return a_scene()

    with serving() as server:
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
        assert ask(server, "/jobs/1/events", "HEAD").status == 200
        go_on.set()
        assert events(server, "/jobs/1")[-2:] == [{"line": "focal length <50> px"}, {"ready": "/scenes/1.json"}]
        assert b"<" not in ask(server, "/jobs/1/events").body
