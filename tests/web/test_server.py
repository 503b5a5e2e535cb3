"""The server's answers to programs, browsers, strangers and broken clients, over sockets of this
machine.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import socket
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from helpers import ROOT
from helpers.photo_files import (
    ADOBE_RGB_BY_EXIF,
    PATCHES,
    as_pq,
    avif,
    colors_of,
    exif,
    jpeg,
    nclx,
    squares,
)
from helpers.photos import metres
from helpers.systems import needs_proc
from helpers.web_client import (
    MAX_BYTES,
    PHOTO,
    SCENES,
    Served,
    answer_of,
    eventually,
    form,
    post,
    request,
    saved,
    served,
)
from PIL import Image

from spackle.core.photo import load_photo
from spackle.runtime.errors import InputError
from spackle.runtime.task_process import WORKER_DIED
from spackle.web.decoding import check_photo
from spackle.web.jobs import RetentionLimits
from spackle.web.uploads import safe_display_name


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("scenes")) as server:
        yield server


def test_a_photo_becomes_a_scene(server: Served) -> None:
    reply = server.send(
        name="my photo.png", depth=("d.npy", b"depth"), options='{"base": "auto", "frames": 3}'
    )
    id = reply.json["id"]
    expected = (202, f"/s3cret{SCENES}/{id}", "my photo.png")
    assert (reply.status, reply.headers["location"], reply.json["name"]) == expected
    told = server.events(id)
    assert (told[-1]["state"], told[-1]["error"], told[-1]["line"]) == (
        "done",
        None,
        "focal length <50> px",
    )
    assert server.events(id) == told[-1:]  # for a page that asks later
    state = server.ask(f"{SCENES}/{id}").json
    assert (state["state"], state["error"], state["share"], "source" in state) == (
        "done",
        None,
        None,
        False,
    )
    assert state["files"] == ["photo.jpg"]  # without page.json
    page = server.ask(f"{SCENES}/{id}/files/page.json").json
    assert (page["depth"], page["options"]) == ("depth", {"base": "auto", "frames": 3})
    assert server.ask(f"{SCENES}/{id}/files/base.splats").body == PHOTO
    assert server.ask(f"{SCENES}/{id}/files/photo.jpg").headers["content-type"] == "image/jpeg"
    video = server.ask(f"{SCENES}/{id}/files/swipe.mp4")  # made as it is asked for
    assert (video.body, video.headers["content-type"]) == (b"swipe.mp4", "video/mp4")
    folder = server.jobs.folder / id
    assert not list(folder.glob("source*")) + list(folder.glob("depth*"))
    assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
    assert (server.ask(f"{SCENES}/{id}").status, folder.exists()) == (404, False)


def test_the_interface_is_described(server: Served) -> None:
    paths = server.ask("/api/v1/openapi.json").json["paths"]
    parts = ("events", "files/{file}", "fill", "link", "remove")
    below = ("", "/{id}", *(f"/{{id}}/{part}" for part in parts))
    assert set(paths) == {*(f"{SCENES}{path}" for path in below), "/healthz", "/readyz", "/metrics"}
    docs = server.ask("/docs").body.decode()
    assert all(word in docs for word in ("DELETE", "keep_frame", "scene.spz", "mask", "cameras"))
    assert "http" not in docs.lower().replace(
        "http interface", ""
    )  # nothing is fetched from elsewhere
    assert Served(server.port).ask("/healthz").json == {"status": "ok"}


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("{", "options: invalid JSON"),
        ('{"disparity": 3}', "disparity"),
        ('{"files": ["../../etc/passwd"]}', "files.0: input should be 'scene.ply'"),
        ('{"path": 1}', "path: there is no such key"),
        ('{"base": "hf:/etc"}', "base hf:/etc on this server: unknown"),
        ('{"base": "sharp"}', "`spackle weights get sharp`"),
    ],
)
def test_options_are_checked(server: Served, options: str, why: str) -> None:
    reply = server.send(options=options)
    assert (reply.status, why in reply.json["error"]) == (422, True), reply.body


def test_every_answer_has_the_security_headers(server: Served) -> None:
    wanted = {
        "x-content-type-options": "nosniff",
        "referrer-policy": "no-referrer",
        "cache-control": "no-store",
    }
    wanted |= {"cross-origin-resource-policy": "same-origin", "server": "spackle"}  # no versions
    for reply in (
        server.ask(),
        server.ask("/no"),
        server.ask("/", "PUT"),
        server.ask(Host="evil.example"),
    ):
        assert wanted.items() <= reply.headers.items()
        policy = reply.headers["content-security-policy"]
        assert all(part in policy for part in ("default-src 'none'", "frame-ancestors 'none'"))
        assert not any(loose in policy for loose in ("unsafe-inline", "*"))
        assert "access-control-allow-origin" not in reply.headers


UNKNOWN = [
    "/none",
    "/../../etc/passwd",
    "//etc/passwd",
    "/..\\..\\etc\\passwd",
    "/viewer.js%00",
    f"{SCENES}/0123456789abcdef/files/scene.ply",
    *(f"{SCENES}/{id}/files/scene.ply" for id in ("..", "%2e%2e", ".new-1")),
    *(
        f"{SCENES}/0123456789abcdef/files/{name}"
        for name in ("..%2fetc%2fpasswd", "%252e%252e%252fpasswd", "job.json")
    ),
]
HOSTS = ["evil.example", "localhost.evil.example", "10.0.0.7", "localhost:x", "[::1"]
PAGES = [f"Origin: {page}" for page in ("http://evil.example", "null", "http://localhost:1", "")]
SITES = [f"Sec-Fetch-Site: {site}" for site in ("cross-site", "same-site")]
SENT = form()
REFUSED = [
    *((request(f"/s3cret{target}"), 404) for target in UNKNOWN),
    *((request("/s3cret/", host=host), 403) for host in HOSTS),
    *((post(len(SENT)).replace(b"localhost", host.encode()) + SENT, 403) for host in HOSTS),
    *((request("/s3cret/", header), 403) for header in PAGES + SITES),
    *((post(len(SENT), header) + SENT, 403) for header in PAGES + SITES),
    *(
        (request(f"/s3cret{path}", method=method), 405)
        for method, path in (("PUT", "/"), ("FOO", SCENES))
    ),
]
MALFORMED = [
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",  # TLS
    b"GET / HTTP/1.1 and more\r\n\r\n",
    b"GET /" + 70_000 * b"a" + b" HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n",  # no host
    *(request("/", header) for header in ("Host: evil.example", "no colon")),
    *(post(5, header) for header in ("Content-Length: 6", "Transfer-Encoding: chunked, chunked")),
    *(post(0).replace(b"Length: 0", f"Length: {text}".encode()) for text in ("-1", "x", "9" * 30)),
]


@pytest.mark.parametrize(("data", "status"), REFUSED, ids=lambda value: repr(value)[:60])
def test_foreign_requests_and_unknown_paths_are_refused(
    server: Served, data: bytes, status: int
) -> None:
    answer, body = server.raw(data)
    assert (answer, set(json.loads(body))) == (status, {"error"})


@pytest.mark.parametrize("data", MALFORMED, ids=lambda value: repr(value)[:60])
def test_malformed_requests_are_refused(server: Served, data: bytes) -> None:
    assert server.raw(data)[0] == 400
    assert server.ask().status == 200


def test_names_of_this_machine_are_accepted(server: Served, tmp_path: Path) -> None:
    for host in ("127.0.0.1", "LOCALHOST:9", "[::1]:9000"):
        assert server.raw(request("/s3cret/", host=host))[0] == 200
    with served(tmp_path, host="0.0.0.0") as wide:  # open to the network
        for host, status in {
            "10.0.0.7:80": 200,
            socket.gethostname(): 200,
            "evil.example": 403,
        }.items():
            assert wide.raw(request("/s3cret/", host=host))[0] == status


def test_a_token_is_asked_for_on_every_request(server: Served, tmp_path: Path) -> None:
    bare, id = Served(server.port), server.send().json["id"]
    paths = [
        "/",
        "/viewer.js",
        "/page.json",
        "/docs",
        "/api/v1/openapi.json",
        SCENES,
        f"{SCENES}/{id}",
    ]
    for path in paths:
        for prefix in ("", "/", "/x", "/S3CRET", "/x/s3cret"):
            assert bare.ask(prefix + path).status == 401, prefix + path
        assert (
            bare.ask(f"{path}?token=s3cret", Cookie="s3cret", Authorization="Bearer s3cre").status
            == 401
        )
    assert (
        bare.ask(SCENES, "POST", form()).status
        == bare.ask(f"{SCENES}/{id}", "DELETE").status
        == 401
    )
    assert bare.ask(f"{SCENES}/{id}", Authorization="Bearer s3cret").status == 200
    assert bare.ask(SCENES, "POST", form(), Authorization="Bearer s3cret").status == 202
    with served(
        tmp_path, token=None
    ) as free:  # everybody on this machine may read, nobody may write
        assert (free.ask().status, free.ask("/page.json").json, free.send().status) == (
            200,
            {"upload": None},
            401,
        )


def test_one_photo_of_a_known_kind_and_usable_size_is_accepted(server: Served) -> None:
    # The content decides, not the name.
    for name in ("photo.jfif", "photo.HIF", "photo", ".png/"):
        assert server.send(name=name).status == 202
    tiny = io.BytesIO()
    Image.new("RGB", (1, 1)).save(tiny, "PNG")
    reply = server.send(tiny.getvalue())
    assert (reply.status, "photo.png: 1×1 is too small" in reply.json["error"]) == (415, True), (
        reply.body
    )
    assert server.send(b"").status == server.send(depth=("d.npy", b"")).status == 400
    two = form().rsplit(b"--", 2)[0] + form(name="b.png")
    assert server.ask(SCENES, "POST", two).status == 422


def test_an_upload_is_bounded_while_it_comes(server: Served) -> None:
    waiting = set(server.jobs.folder.iterdir())
    assert server.send(bytes(MAX_BYTES + 1)).status == 413
    with server.dial(
        post(0).replace(b"Content-Length: 0", b"Transfer-Encoding: chunked")
    ) as endless:
        with contextlib.suppress(OSError):
            endless.sendall(b"5a\r\n" + form()[:90] + b"\r\n")
            for _ in range(40):
                endless.sendall(b"4000\r\n" + bytes(0x4000) + b"\r\n")
        assert answer_of(endless)[9:12] in (b"413", b"")  # it sends on, and may be hung up on
    assert server.ask(SCENES, "POST", form(more=("a", b""), another=("b", b""))).status == 400
    assert set(server.jobs.folder.iterdir()) == waiting


def test_a_slow_or_vanished_client_frees_its_place(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(server.jobs.folder.iterdir())
    part_of_upload = post(90_000) + form()[:90]
    with server.dial(part_of_upload) as vanished:
        eventually(lambda: set(server.jobs.folder.iterdir()) != before)
        # Without lingering, closing resets the connection, as a client does that has crashed.
        vanished.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        vanished.close()
        eventually(lambda: set(server.jobs.folder.iterdir()) == before)
    monkeypatch.setattr("spackle.web.app.MAX_UPLOAD_S", 0.5)
    with server.dial(part_of_upload) as slow:
        assert answer_of(slow).split()[1] == b"408"
        eventually(lambda: set(server.jobs.folder.iterdir()) == before)


def test_the_connection_of_a_silent_or_deaf_client_is_closed(
    server: Served, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("spackle.web.app.MAX_HEAD_S", 0.3)
        with server.dial(b"GET / HTTP/1.1\r\nHost: local") as silent:
            assert answer_of(silent) == b""
    content = bytes(30_000_000)  # more than the socket's buffers hold
    id = server.send().json["id"]
    assert server.events(id)
    (server.jobs.folder / id / "results" / "base.splats").write_bytes(content)
    with (
        monkeypatch.context() as patch,
        caplog.at_level("DEBUG", "spackle.web"),
        server.dial(request(f"/s3cret{SCENES}/{id}/files/base.splats")) as deaf,
    ):
        patch.setattr("spackle.web.guard.MAX_SEND_S", 0.5)
        deaf.recv(12)
        eventually(lambda: "does not read its answer" in caplog.text)
        assert len(answer_of(deaf)) < len(content)
    assert len(server.ask(f"{SCENES}/{id}/files/base.splats").body) == len(content)


@needs_proc
def test_jobs_leave_no_thread_no_file_and_no_memory_behind(server: Served) -> None:
    def done(photos: int) -> list[int]:
        for k in range(photos):
            id = server.send(name="bad.png" if k % 3 == 0 else "photo.png").json["id"]
            assert server.events(id)[-1]["ended"]
            assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
        eventually(lambda: len(os.listdir("/proc/self/fd")) <= files)
        return [
            len(os.listdir("/proc/self/task")),
            int(Path("/proc/self/statm").read_text().split()[1]) >> 8,
        ]

    files = 1000
    threads, megabytes = done(6)
    files = len(os.listdir("/proc/self/fd"))
    more, now = done(9)
    # The server's pool may start another thread whenever requests overlap on a busy machine. A
    # leak would leave one for each photo, or at least for each of the three bad ones.
    assert (more < threads + 3, now < megabytes + 20) == (True, True), (
        threads,
        more,
        megabytes,
        now,
    )


def png_claiming(width: int, height: int) -> bytes:
    """A PNG whose header states this size."""
    head = b"IHDR" + struct.pack(">II", width, height) + PHOTO[24:29]
    return PHOTO[:12] + head + struct.pack(">I", zlib.crc32(head)) + PHOTO[33:]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"<script>alert(1)</script>", "not an image"),
        (png_claiming(30_000, 30_000), "100 megapixels"),
        (png_claiming(4000, 4000), "damaged or cut off"),
        (saved("EPS"), "a PostScript file"),  # Pillow would have another program read it
        (b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom", "a video file"),
        *((kind, None) for kind in ("JPEG", "HEIF")),
    ],
    ids=lambda value: repr(value)[:20],
)
def test_photos_are_recognised_by_decoding(
    server: Served, content: bytes | str, why: str | None
) -> None:
    pillow_heif.register_heif_opener()
    if isinstance(content, str):
        assert server.send(saved(content), "a.heic").status == 202
        return
    reply = server.send(content, "holiday.png")
    assert (reply.status, reply.json["error"].startswith("holiday.png: ")) == (415, True)
    assert why in reply.json["error"]
    assert str(server.jobs.folder) not in reply.json["error"]


def test_a_name_is_safe_to_show() -> None:
    assert safe_display_name("../../etc/passwd.png") == "passwd.png"
    assert safe_display_name("\x1b[31m\r\na\u202e.png") == "[31ma.png"
    assert len(safe_display_name(f"{200 * 'a'}.png")) == 80


@pytest.mark.parametrize(
    ("how", "error"),
    [
        ("bad", "bad.png: no depth at all"),
        ("bug", "internal error: KeyError: 'oh'"),
        ("die", WORKER_DIED),
    ],
)
def test_an_error_is_one_line(server: Served, how: str, error: str) -> None:
    id = server.send(name=f"{how}.png").json["id"]
    assert server.events(id)[-1]["error"] == error
    assert server.ask(f"{SCENES}/{id}").json["error"] == error
    assert server.ask(f"{SCENES}/{id}/files/scene.ply").json["error"] == error
    assert server.events(server.send().json["id"])[-1]["state"] == "done"  # another photo may do


def test_photos_wait_and_go_on_after_a_restart(tmp_path: Path) -> None:
    with served(tmp_path, keep=RetentionLimits(waiting=2)) as server:
        slow = server.send(name="slow.png").json["id"]
        eventually(lambda: server.ask(f"{SCENES}/{slow}").json["stage"] == "base")
        waiting = [server.send(name=f"{k}.png").json["id"] for k in range(2)]
        full = server.send()
        assert (full.status, int(full.headers["retry-after"]) > 0) == (429, True)
        with pytest.raises(InputError, match="another"):
            served(tmp_path).__enter__()
    (tmp_path / ".new-of-a-killed-server").mkdir()
    with served(tmp_path) as server:
        eventually(lambda: server.ask(f"{SCENES}/{slow}").json["stage"] == "base")
        assert server.ask(f"{SCENES}/{slow}", "DELETE").status == 204
        assert [server.events(id)[-1]["state"] for id in waiting] == ["done", "done"]
        server.jobs.limits = RetentionLimits(seconds=0)
        server.jobs.remove_expired()
        assert {path.name for path in tmp_path.iterdir()} == {".lock"}


def test_a_photo_at_work_can_be_removed(server: Served) -> None:
    id = server.send(name="slow.png").json["id"]
    with server.dial(request(f"/s3cret{SCENES}/{id}/events")) as listener:
        heard = b""
        while b"base" not in heard:  # events come as they are made
            heard += (part := listener.recv(1000))
            assert part, heard
        assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
        assert b"no such scene" in answer_of(listener)
    assert server.events(server.send().json["id"])[-1]["state"] == "done"


def test_the_example_mounts_the_app(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    def listens() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    with subprocess.Popen(
        [sys.executable, ROOT / "examples" / "11_server.py", tmp_path, str(port)]
    ) as service:
        try:
            mine = Served(port, "/spackle")
            eventually(listens)
            assert mine.ask("/healthz").json["status"] == "ok"
            depth = io.BytesIO()
            np.save(depth, metres())
            sent = mine.send(
                depth=("depth.npy", depth.getvalue()),
                options='{"frames": 2, "files": ["scene.spz"]}',
            ).json
            assert mine.events(sent["id"])[-1]["state"] == "done"
            assert mine.ask(f"{SCENES}/{sent['id']}/files/scene.spz").body[:2] == b"\x1f\x8b"
        finally:
            service.terminate()


def test_the_preview_of_a_photo_has_its_colours(tmp_path: Path) -> None:
    files = {
        "hdr": avif(as_pq(squares(PATCHES)), nclx(9, 16, 9)),
        "adobe": jpeg(squares(PATCHES).astype(np.uint8), exif=exif({0x0112: 3}, ADOBE_RGB_BY_EXIF)),
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        check_photo(tmp_path / name, name, tmp_path / "preview.jpg")
        expected = load_photo(tmp_path / name).rgb.numpy() * 255
        with Image.open(tmp_path / "preview.jpg") as preview:
            assert abs(colors_of(np.asarray(preview).astype(float) - expected)).max() < 8, name
