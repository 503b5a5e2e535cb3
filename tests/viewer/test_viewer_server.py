"""The viewer's server as browsers, strangers and broken clients meet it, each over a real socket of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from viewer_client import (
    PAGES,
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
    raw,
    request,
    send,
    serving,
)

from spackle.errors import InputError
from spackle.viewer.page import PageScene
from spackle.viewer.server import ViewerServer
from spackle.viewer.work import Tell


@pytest.fixture(scope="module")
def server() -> Iterator[ViewerServer]:
    """One that takes no photo."""
    with serving() as server:
        server.show(a_scene())
        yield server


def test_the_page_and_the_scene_are_there(server: ViewerServer) -> None:
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", server.port, timeout=5)) as connection:
        connection.connect()
        first = connection.sock
        for path in ("/", "/none", "/scene.json"):  # one connection serves many requests
            connection.request("GET", path)
            connection.getresponse().read()
            assert connection.sock is first
    page, state = ask(server), ask(server, "/scene.json").json
    assert (page.status, page.body, page.headers["Content-Type"]) == (200, b"<p>page", "text/html; charset=utf-8")
    assert (state["job"], state["upload"]["max_bytes"]) == (None, QUICK.upload_bytes)
    assert ".jpg" in state["upload"]["suffixes"]
    assert ask(server, state["scene"]).json == a_scene().description
    layer = ask(server, state["scene"].replace(".json", "/base.bin"))
    assert (layer.body, layer.headers["Content-Type"]) == (b"layer", "application/octet-stream")
    for path in ("/", "/scene.json", "/scenes/1/base.bin", "/none"):
        head, whole = ask(server, path, "HEAD"), ask(server, path)
        assert (head.status, head.headers["Content-Length"]) == (whole.status, whole.headers["Content-Length"])
        assert head.body == b""


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


@pytest.mark.parametrize(
    "target",
    [
        *("/none", "/index.html", "/scenes/", "/scenes/1", "/scenes/2.json", "/scenes/1/", "/jobs/1/events"),
        *("/../../../../etc/passwd", "/scenes/1/../../../../../etc/passwd", "/scenes/1/..%2f..%2fetc%2fpasswd"),
        *("/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "/%252e%252e%252fetc%252fpasswd", "//etc/passwd", "///etc/passwd"),
        *("/..\\..\\..\\etc\\passwd", "/..%5c..%5cetc%5cpasswd", "\\etc\\passwd", "/viewer.js/../../etc/passwd"),
        *("/viewer.js%00", "/viewer.js/", "/VIEWER.JS", "/./viewer.js", "/%76iewer.js", "/..%c0%af..%c0%afetc/passwd"),
        *("http://localhost/etc/passwd", "http://evil.example/", "file:///etc/passwd", "etc/passwd", "*", "/é"),
    ],
)
def test_nothing_but_the_routes_is_served(server: ViewerServer, target: str) -> None:
    status, body = raw(server, get(target))
    assert (status, set(json.loads(body))) == (404, {"error"})


def test_other_methods_are_refused_and_posts_go_to_one_place(server: ViewerServer) -> None:
    for method in ("PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "FOO"):
        reply = ask(server, "/", method)
        assert (reply.status, set(reply.json)) == (501, {"error"})
    for path in ("/", "/scene.json", "/photos/", "/photos/1", "//photos/"):
        assert ask(server, path, "POST", PHOTO).status == 404


@pytest.mark.parametrize(
    ("header", "value"),
    [
        *(("Host", name) for name in ("evil.example", "localhost.evil.example", "10.0.0.7", "", "0.0.0.0")),
        *(("Host", name) for name in ("127.0.0.1.evil.example", "localhost:x", "localhost@evil.example", "[::1")),
        *(("Origin", page) for page in ("http://evil.example", "null", "http://localhost:1", "")),
        *(("Sec_Fetch_Site", site) for site in ("cross-site", "same-site")),
    ],
)
def test_a_foreign_host_page_or_site_is_refused(server: ViewerServer, header: str, value: str) -> None:
    assert ask(server, **{header: value}).status == 403
    assert send(server, **{header: value}).status == 403
    if header == "Host":
        assert raw(server, get("/", host=value))[0] == 403
        assert raw(server, get("/", f"Host: {value}"))[0] == 403  # a request has one host


def test_names_of_this_machine_are_ours_at_any_port(server: ViewerServer) -> None:
    for host in ("127.0.0.1", "localhost", "LOCALHOST:9", "[::1]:9000", "127.0.0.2"):
        assert raw(server, get("/", host=host))[0] == 200
    with serving(host="0.0.0.0") as wide:  # open to the network
        assert (wide.local, wide.url) == (False, f"http://127.0.0.1:{wide.port}/")
        for host, status in {"10.0.0.7:80": 200, socket.gethostname(): 200, "evil.example": 403}.items():
            assert raw(wide, get("/", host=host))[0] == status


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", 400),  # TLS
        (b"GET\r\n\r\n", 400),
        (b"GET / HTTP/1.1 and more\r\n\r\n", 400),
        (b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n", 505),
        (b"GET /\r\n\r\n", 505),
        (b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n", 403),  # no host
        (b"GET /" + 70_000 * b"a" + b" HTTP/1.1\r\n\r\n", 414),
        (get("/", "X: " + 70_000 * "a"), 431),
        (get("/", *200 * ["X: a"]), 431),
        (get("/", "no colon", "Origin: http://evil"), 400),
        (request("/photos?name=a.png", f"Content-Length: {len(PHOTO)}", method="POST") + PHOTO, 403),  # no origin
    ],
)
def test_malformed_requests_get_a_plain_answer(server: ViewerServer, data: bytes, status: int) -> None:
    answer, body = raw(server, data)
    assert (answer, set(json.loads(body))) == (status, {"error"})
    assert ask(server).status == 200


def test_a_websocket_or_the_body_of_a_get_is_no_request(server: ViewerServer) -> None:
    upgrade = ("Upgrade: websocket", "Sec-WebSocket-Key: dGhl", "Sec-WebSocket-Version: 13")
    more = {b"\x81\x85\x37\xfa\x21\x3d\x7f\x9f\x4d\x51\x58": upgrade, get("/none"): ("Content-Length: 60",)}
    for body, headers in more.items():
        assert raw(server, request("/", *headers) + body) == (200, b"<p>page")


def test_a_silent_connection_is_closed(server: ViewerServer) -> None:
    with dial(server) as silent, dial(server, b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: ") as dripping:
        start = time.monotonic()
        with contextlib.suppress(OSError):
            for _ in range(30):  # a byte now and then keeps nothing open
                dripping.sendall(b"a")
                time.sleep(0.05)
        assert answer_of(silent) == answer_of(dripping) == b""
        assert time.monotonic() - start < 3


def test_a_client_that_never_reads_is_left() -> None:
    content = bytes(30_000_000)  # more than the socket's buffers hold
    with serving(limits=dataclasses.replace(QUICK, connections=1)) as server:
        server.show(a_scene(content=content))
        with dial(server, get("/scenes/1/base.bin")) as silent:  # it has the only place
            silent.recv(12)
            assert raw(server, get("/"))[0] == 503
            eventually(lambda: raw(server, get("/"))[0] == 200)
            assert len(answer_of(silent)) < len(content)
        eventually(lambda: len(ask(server, "/scenes/1/base.bin").body) == len(content))


def test_idle_connections_make_room_for_who_asks() -> None:
    limits = dataclasses.replace(QUICK, request=30, connections=8)
    with serving(limits=limits) as server, contextlib.ExitStack() as stack:
        idle = [stack.enter_context(dial(server, b"GET / HT")) for _ in range(40)]
        start = time.monotonic()
        assert [ask(server).status for _ in range(5)] == [200] * 5
        assert time.monotonic() - start < 3
        assert answer_of(idle[0]) == b""


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


def test_where_nothing_can_listen_the_option_is_named(server: ViewerServer) -> None:
    hosts: list[Any] = [("host", host) for host in ("192.0.2.1", "no.such.host.invalid")]
    for option, value in [*(("port", port) for port in (-1, 65536, server.port)), *hosts]:
        with pytest.raises(InputError, match=f"^--{option} {value}: "):
            ViewerServer(PAGES, complete, **{option: value})


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
