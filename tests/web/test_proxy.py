"""The server behind a reverse proxy: a small one with nginx's defaults, and nginx itself."""

from __future__ import annotations

import contextlib
import re
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import ROOT
from helpers.command import refuses, run
from helpers.web_client import SCENES, Served, answer_of, eventually, form, request, served

from spackle.runtime.errors import InputError
from spackle.web.local_server import ServerAddress
from spackle.web.public_address import PublicAddress

SITE = "photos.example.com"
DOCS = (ROOT / "docs" / "http.md").read_text("utf-8")


def whole_request(connection: socket.socket) -> bytes:
    """A request's head and body; on a busy machine they arrive in several pieces."""
    with connection.makefile("rb") as stream:
        head = b"".join(iter(stream.readline, b"\r\n"))
        length = re.search(rb"^content-length: *(\d+)\r$", head, re.IGNORECASE | re.MULTILINE)
        return head + b"\r\n" + stream.read(int(length.group(1)) if length else 0)


@contextlib.contextmanager
def small_proxy(server: Served, forwarded_host: str | None) -> Iterator[Served]:
    """A proxy that asks for the server by its address, as nginx does unless told otherwise.

    It answers one connection after the other, and writes `forwarded_host` into X-Forwarded-Host.
    """
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def forward_all() -> None:
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:  # the test is over
                    return
                with connection:
                    connection.settimeout(5)
                    head, _, body = whole_request(connection).partition(b"\r\n\r\n")
                    lines = head.split(b"\r\n")
                    # The body may come later than the head.
                    for line in lines:
                        if line.lower().startswith(b"content-length:"):
                            while len(body) < int(line.partition(b":")[2]):
                                body += connection.recv(1 << 20)
                    lines = [line for line in lines if not line.lower().startswith(b"host:")]
                    lines.insert(1, f"Host: 127.0.0.1:{server.port}".encode())
                    lines.insert(2, b"Connection: close")
                    if forwarded_host is not None:
                        lines.append(f"X-Forwarded-Host: {forwarded_host}".encode())
                    with server.dial(b"\r\n".join(lines) + b"\r\n\r\n" + body) as upstream:
                        connection.sendall(answer_of(upstream))

        thread = threading.Thread(target=forward_all, daemon=True)
        thread.start()
        yield Served(listener.getsockname()[1], server.root)
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()


def status_of(server: Served, host: str, *headers: str, path: str = "/s3cret/") -> int:
    return server.raw(request(path, *headers, host=host))[0]


def test_only_named_hosts_are_accepted_besides_the_machines_own(tmp_path: Path) -> None:
    public = PublicAddress(allowed_hosts=("Photos.example.com",), url="https://example.org:8443/a/")
    with served(tmp_path, public=public) as server:
        assert status_of(server, SITE, f"Origin: https://{SITE}") == 200
        assert status_of(server, f"{SITE}:8080") == 200
        assert status_of(server, "example.org:8443", "Origin: https://example.org:8443") == 200
        assert status_of(server, "localhost") == 200
        for stranger in ("evil.example", f"{SITE}.evil.example", f"x.{SITE}", "10.0.0.7", "org"):
            assert status_of(server, stranger) == 403, stranger
        # A page of another site may not send a browser here, whatever name it uses.
        assert status_of(server, SITE, "Origin: https://evil.example") == 403
        assert status_of(server, SITE, "Sec-Fetch-Site: cross-site") == 403


def test_a_page_behind_a_proxy_that_says_nothing_is_the_public_one(tmp_path: Path) -> None:
    own_page = f"Origin: https://{SITE}"
    with served(tmp_path / "bare") as bare, small_proxy(bare, None) as proxy:
        assert status_of(proxy, SITE, own_page) == 403
    public = PublicAddress(url=f"https://{SITE}/studio")
    with served(tmp_path / "named", public=public) as server, small_proxy(server, None) as proxy:
        assert status_of(proxy, SITE, own_page) == 200
        assert status_of(proxy, SITE, "Origin: https://evil.example") == 403
        sent = proxy.ask(SCENES, "POST", form(), Origin=f"https://{SITE}")
        assert sent.status == 202
        # The proxy takes /studio away, so the server puts it back.
        assert sent.headers["location"] == f"/studio/s3cret{SCENES}/{sent.json['id']}"


def test_a_forwarded_host_is_believed_from_named_proxies_alone(tmp_path: Path) -> None:
    strangers = PublicAddress(allowed_hosts=(SITE,), proxies=("10.1.0.0/16",))
    known = PublicAddress(allowed_hosts=(SITE,), proxies=("127.0.0.1",))
    own_page = f"Origin: https://{SITE}"
    with served(tmp_path / "a", public=strangers) as server, small_proxy(server, SITE) as proxy:
        # The header of a stranger counts for nothing: Host is 127.0.0.1, and the origin is not.
        assert status_of(proxy, SITE, own_page) == 403
    with served(tmp_path / "b", public=known) as server:
        with small_proxy(server, SITE) as proxy:
            assert status_of(proxy, SITE, own_page) == 200
        with small_proxy(server, "evil.example") as proxy:
            assert status_of(proxy, SITE) == 403
        # A client's own header is before that of the proxy.
        with small_proxy(server, f"localhost, {SITE}") as proxy:
            assert status_of(proxy, SITE, own_page) == 200
        with small_proxy(server, f"{SITE}, evil.example") as proxy:
            assert status_of(proxy, SITE) == 403


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"allowed_hosts": ("*",)}, "`allowed_host` *: no host name"),
        ({"allowed_hosts": ("http://a.example",)}, "no host name"),
        ({"url": "photos.example.com"}, "`public_url` photos.example.com: no address of a page"),
        ({"url": "https://a.example:port/"}, "no address of a page"),
        ({"url": "https://user@a.example/"}, "no address of a page"),
        ({"url": "https://a.example/?token=1"}, "no address of a page"),
        ({"proxies": ("nginx",)}, "`proxy` nginx: no address"),
    ],
)
def test_a_public_address_that_is_none_is_refused(options: dict[str, str], says: str) -> None:
    with pytest.raises(InputError, match=re.escape(says)):
        PublicAddress(**options)


def test_the_command_refuses_in_its_own_words(tmp_path: Path) -> None:
    refuses(run("serve", "-o", tmp_path, "--allowed-host", "*"), "--allowed-host *")
    refuses(run("serve", "-o", tmp_path, "--public-url", "a"), "--public-url a")
    refuses(run("serve", "-o", tmp_path, "--proxy", "a"), "--proxy a")


def test_the_printed_address_is_the_public_one() -> None:
    public = PublicAddress(url=f"https://{SITE}/studio/")
    address = ServerAddress(host="127.0.0.1", port=1, token="s3cret", public=public)
    assert address.public_url == f"https://{SITE}/studio/s3cret/"


def docs_block(language: str) -> str:
    """The only example in a configuration language in the page on HTTP."""
    blocks = re.findall(rf"```{language}\n(.*?)```", DOCS, re.DOTALL)
    assert len(blocks) == 1
    return str(blocks[0])


def test_the_examples_name_what_the_command_is_told() -> None:
    for language in ("nginx", "caddyfile"):
        block = docs_block(language)
        assert SITE in block
        assert "127.0.0.1:8080" in block
    assert f"spackle serve --port 8080 --public-url https://{SITE}" in DOCS


@pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed")
def test_photos_travel_through_nginx_as_the_docs_set_it_up(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    public = PublicAddress(url=f"https://{SITE}")
    with served(tmp_path / "scenes", public=public) as server:
        block = docs_block("nginx").replace("127.0.0.1:8080", f"127.0.0.1:{server.port}")
        # Without a certificate there is no TLS.
        block = re.sub(r"listen [^;]+;", f"listen 127.0.0.1:{port};", block)
        block = re.sub(r"\n *ssl_[^\n]*", "", block)
        paths = "\n".join(
            f"{name}_temp_path {tmp_path}/{name};"
            for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        config = tmp_path / "nginx.conf"
        config.write_text(
            f"daemon off; pid {tmp_path}/pid; error_log {tmp_path}/error.log;\n"
            f"events {{}}\nhttp {{ access_log off; {paths}\n{block} }}\n"
        )
        nginx = subprocess.Popen(["nginx", "-p", tmp_path, "-c", config])
        try:
            outside = Served(port, server.root)
            eventually(lambda: is_open(port))
            assert status_of(outside, SITE, f"Origin: https://{SITE}") == 200
            assert status_of(outside, "evil.example") == 403
            sent = outside.ask(SCENES, "POST", form(), Host=SITE, Origin=f"https://{SITE}")
            assert sent.status == 202
            scene = f"{SCENES}/{sent.json['id']}"
            events = outside.ask(f"{scene}/events", Host=SITE).body
            assert b'"state":"done"' in events.replace(b": ", b":")
            assert outside.ask(scene, "DELETE", Host=SITE).status == 204
        finally:
            nginx.terminate()
            nginx.wait()


def is_open(port: int) -> bool:
    """Whether somebody listens at a port of this machine."""
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        return True
    return False
