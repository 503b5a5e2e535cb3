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
import torch
from viewer_client import (
    PAGES,
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
    send,
    serving,
)

from spackle.errors import InputError
from spackle.formats import save_png
from spackle.viewer.page import PageScene
from spackle.viewer.server import ViewerServer
from spackle.viewer.work import Tell


@pytest.fixture(scope="module")
def server() -> Iterator[ViewerServer]:
    """One that nobody sends photos to."""
    with serving() as server:
        server.show(a_scene())
        yield server


def test_the_page_and_the_scene_are_there(server: ViewerServer) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=5)
    with contextlib.closing(connection):  # one connection serves many requests
        connection.connect()
        first = connection.sock
        for path in ("/", "/none", "/scene.json"):
            connection.request("GET", path)
            connection.getresponse().read()
            assert connection.sock is first
    page = ask(server)
    assert (page.status, page.body, page.headers["Content-Type"]) == (200, b"<p>page", "text/html; charset=utf-8")
    state = ask(server, "/scene.json").json
    assert state["job"] is None
    assert ".jpg" in state["upload"]["suffixes"]
    assert state["upload"]["max_bytes"] == QUICK.upload_bytes
    description = ask(server, state["scene"]).json
    assert description == a_scene().description
    layer = ask(server, state["scene"].replace(".json", "/") + description["layers"][0]["file"])
    assert (layer.body, layer.headers["Content-Type"]) == (b"layer", "application/octet-stream")
    for path in ("/", "/scene.json", "/scenes/1/base.bin", "/none"):
        head, whole = ask(server, path, "HEAD"), ask(server, path)
        assert head.body == b""
        assert (head.status, head.headers["Content-Length"]) == (whole.status, whole.headers["Content-Length"])
    with serving() as other:  # old scenes make room
        paths = [other.show(a_scene(str(k))) for k in range(3)]
        assert [ask(other, path).status for path in (*paths, "/scenes/1/base.bin")] == [404, 200, 200, 404]
        assert ask(other, "/scene.json").json["scene"] == paths[-1]


def test_every_answer_says_what_a_browser_may_do_with_it(server: ViewerServer) -> None:
    wanted = {
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Server": "spackle",  # no versions
    }
    for reply in (ask(server), ask(server, "/none"), ask(server, "/", "PUT"), ask(server, "/", Host="evil.example")):
        assert wanted.items() <= reply.headers.items()
        policy = reply.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert not any(loose in policy for loose in ("unsafe-inline", "*"))
        assert "Access-Control-Allow-Origin" not in reply.headers


def test_a_silent_connection_is_closed(server: ViewerServer) -> None:
    with dial(server) as silent, dial(server, b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: ") as dripping:
        start = time.monotonic()
        with contextlib.suppress(OSError):
            for _ in range(30):  # a byte now and then keeps nothing open
                dripping.sendall(b"a")
                time.sleep(0.05)
        assert answer_of(silent) == answer_of(dripping) == b""
        assert time.monotonic() - start < 3


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
    head, _, body = raw(server, get(target)).partition(b"\r\n\r\n")
    assert head.split()[1] == b"404"
    assert b"root:" not in body
    assert set(json.loads(body)) == {"error"}


def test_other_methods_are_refused_and_posts_go_to_one_place(server: ViewerServer, photo: bytes) -> None:
    for method in ("PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "FOO"):
        reply = ask(server, "/", method)
        assert (reply.status, set(reply.json)) == (501, {"error"})
    for path in ("/", "/scene.json", "/photos/", "/photos/1", "//photos/"):
        assert ask(server, path, "POST", photo).status == 404


@pytest.mark.parametrize(
    ("header", "value"),
    [
        *(("Host", name) for name in ("evil.example", "localhost.evil.example", "10.0.0.7", "", "0.0.0.0")),
        *(("Host", name) for name in ("127.0.0.1.evil.example", "localhost:x", "localhost@evil.example", "[::1")),
        *(("Origin", page) for page in ("http://evil.example", "null", "http://localhost:1", "")),
        *(("Sec_Fetch_Site", site) for site in ("cross-site", "same-site")),
    ],
)
def test_a_foreign_host_page_or_site_is_refused(server: ViewerServer, header: str, value: str, photo: bytes) -> None:
    assert ask(server, **{header: value}).status == 403
    assert send(server, photo, **{header: value}).status == 403
    if header == "Host":
        assert raw(server, get("/", host=value)).split()[1] == b"403"
        assert raw(server, get("/", f"Host: {value}")).split()[1] == b"403"  # a request has one host
        assert raw(server, b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n").split()[1] == b"403"


def test_names_of_this_machine_are_ours_at_any_port_and_open_to_the_network_more(server: ViewerServer) -> None:
    for host in ("127.0.0.1", "localhost", "LOCALHOST:9", "[::1]:9000", "127.0.0.2"):
        assert raw(server, get("/", host=host)).split()[1] == b"200"
    with serving(host="0.0.0.0") as wide:
        assert (wide.local, wide.url) == (False, f"http://127.0.0.1:{wide.port}/")
        for host, status in {"10.0.0.7:80": b"200", socket.gethostname(): b"200", "evil.example": b"403"}.items():
            assert raw(wide, get("/", host=host)).split()[1] == status


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", b"400"),  # TLS
        (b"GET\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1 and more\r\n\r\n", b"400"),
        (b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n", b"505"),
        (b"GET /\r\n\r\n", b"505"),
        (b"GET /" + 70_000 * b"a" + b" HTTP/1.1\r\n\r\n", b"414"),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + 70_000 * b"a" + b"\r\n\r\n", b"431"),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n" + 200 * b"X: a\r\n" + b"\r\n", b"431"),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nno colon\r\nOrigin: http://evil\r\n\r\n", b"400"),
    ],
)
def test_malformed_requests_get_a_plain_answer(server: ViewerServer, data: bytes, status: bytes) -> None:
    answer = raw(server, data)
    assert answer.split()[1] == status, answer
    assert set(json.loads(answer.partition(b"\r\n\r\n")[2])) == {"error"}
    assert ask(server).status == 200


def test_there_is_no_websocket_and_the_body_of_a_get_is_no_request(server: ViewerServer) -> None:
    upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: dGhl\r\nSec-WebSocket-Version: 13\r\n"
    body = f"Content-Length: {len(get('/none'))}\r\n"
    for headers, more in ((upgrade, b"\x81\x85\x37\xfa\x21\x3d\x7f\x9f\x4d\x51\x58"), (body, get("/none"))):
        answer = raw(server, f"GET / HTTP/1.1\r\nHost: localhost\r\n{headers}\r\n".encode() + more)
        assert (answer.split()[1], answer.count(b"HTTP/1.1")) == (b"200", 1)


def test_connections_are_counted_and_a_client_that_never_reads_is_left() -> None:
    content = bytes(30_000_000)  # more than the socket's buffers hold
    with serving(limits=dataclasses.replace(QUICK, connections=1)) as server:
        server.show(a_scene(content=content))
        with dial(server, get("/scenes/1/base.bin")) as silent:  # it has the only place
            silent.recv(12)
            assert raw(server, get("/"))[9:12] == b"503"
            eventually(lambda: raw(server, get("/"))[9:12] == b"200")
            assert len(answer_of(silent)) < len(content)
        eventually(lambda: len(ask(server, "/scenes/1/base.bin").body) == len(content))


def test_idle_connections_make_room_for_who_asks() -> None:
    with (
        serving(limits=dataclasses.replace(QUICK, request=30, connections=8)) as server,
        contextlib.ExitStack() as stack,
    ):
        idle = [stack.enter_context(dial(server, b"GET / HT")) for _ in range(40)]
        start = time.monotonic()
        assert [ask(server).status for _ in range(5)] == [200] * 5
        assert time.monotonic() - start < 3
        assert answer_of(idle[0]) == b""


def test_an_upload_that_trickles_leaves_its_place(photo: bytes) -> None:
    limits = dataclasses.replace(QUICK, upload=60, rate=100_000)
    head = b"POST /photos?name=a.png HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n"
    head += b"Content-Length: 90000\r\n\r\n"
    with serving(limits=limits) as server, dial(server, head) as slow:
        start = time.monotonic()
        with contextlib.suppress(OSError):
            while time.monotonic() - start < 10 and send(server, photo).status == 409:
                slow.sendall(b"a")
                time.sleep(0.05)
        assert time.monotonic() - start < 3


def test_a_post_without_an_origin_is_refused(server: ViewerServer, photo: bytes) -> None:
    head = f"POST /photos?name=a.png HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(photo)}\r\n\r\n".encode()
    assert raw(server, head + photo).split()[1] == b"403"


def test_a_token_is_asked_for_on_every_request(photo: bytes) -> None:
    lines: list[str] = []
    with serving(token="s3cret", log=lines.append) as server:
        assert server.url == f"http://127.0.0.1:{server.port}/s3cret/"
        server.show(a_scene())
        for path in (
            "/",
            "/viewer.js",
            "/scene.json",
            "/scenes/1.json",
            "/jobs/1/events",
            "/photos",
            "/s3cre",
            "/s3crett/",
        ):
            for prefix in ("", "/", "/x", "/S3CRET", "/%733cret", "/x/s3cret"):
                assert ask(server, prefix + path).status == 403
            assert ask(server, path + "?token=s3cret", Cookie="s3cret", Referer=server.url).status == 403
        assert send(server, photo).status == 403
        for path in ("", "/", "/viewer.js", "/scene.json", "/scenes/1.json", "/scenes/1/base.bin"):
            assert ask(server, f"/s3cret{path}").status == 200
        job = ask(server, "/s3cret/photos?name=a.png", "POST", photo).json["job"]
        assert events(server, f"/s3cret{job}")[-1]["ready"] == "/scenes/2.json"
        assert ask(server, "/s3cret/photos?name=a.png", "POST", photo, Origin="http://evil.example").status == 403
    assert lines
    assert "s3cret" not in "".join(lines)


def test_closing_tells_the_listeners_ends_the_job_and_removes_the_photo(photo: bytes) -> None:
    reached, lines = threading.Event(), list[str]()

    def endless(path: Path, name: str, tell: Tell) -> PageScene:
        while True:
            tell({"stage": "base", "done": 0, "total": 0})
            reached.set()
            time.sleep(0.01)

    with serving(endless, log=lines.append) as server:
        raw(server, get("/\x1b[31m\x07", host="localhost"))
        assert lines
        assert all(line.isprintable() for line in lines), lines
        job = send(server, photo).json["job"]
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


def test_where_nothing_can_listen_the_option_is_named(server: ViewerServer) -> None:
    for option, where in (
        (f"--port {server.port}: ", {"port": server.port}),
        ("--port -1: ", {"port": -1}),
        ("--port 65536: ", {"port": 65536}),
        ("--host 192.0.2.1: ", {"host": "192.0.2.1"}),
        ("--host no.such.host.invalid: ", {"host": "no.such.host.invalid"}),
    ):
        with pytest.raises(InputError) as caught:
            ViewerServer(PAGES, complete, **where)  # type: ignore[arg-type]
        assert str(caught.value).startswith(option)


def test_a_scene_is_downloaded_in_the_formats_that_it_offers_as_long_as_it_is_kept() -> None:
    with serving(bases=["auto", "lite"]) as server:
        scene = dataclasses.replace(a_scene(), downloads={".ply": lambda: b"ply"})
        description = ask(server, server.show(scene)).json
        place = description["downloads"][".ply"]
        assert (ask(server, place).status, ask(server, place).body) == (200, b"ply")
        assert ask(server, "/scene.json").json["upload"]["bases"] == ["auto", "lite"]
        for _ in range(QUICK.kept_scenes):
            server.show(a_scene())
        assert ask(server, place).status == 404


def test_a_photos_choices_and_its_depth_map_reach_what_completes_it(tmp_path: Path) -> None:
    heard: list[dict[str, Any]] = []

    def choosing(photo: Path, name: str, tell: Tell, **choices: Any) -> PageScene:
        read = {key: value.read_bytes() if isinstance(value, Path) else value for key, value in choices.items()}
        heard.append({**read, "photo": photo.read_bytes()})
        return a_scene(name)

    save_png(torch.rand(8, 8, 3), tmp_path / "a.png")
    photo, depth = (tmp_path / "a.png").read_bytes(), b"depth"
    with serving(choosing) as server:
        url = "/photos?name=a.png&base=lite&disparity=0.2&depth=.npy:"
        for wrong in ("0", "99999999", "x"):
            assert ask(server, url + wrong, "POST", photo + depth).status == 400
        events(server, ask(server, url + str(len(depth)), "POST", photo + depth).json["job"])
    assert heard == [{"base": "lite", "disparity": "0.2", "depth": depth, "photo": photo}]
