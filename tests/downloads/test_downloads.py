"""Downloads and their records, from a server on this machine that misbehaves in every way we know."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import io
import json
import os
import random
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from email.message import Message
from pathlib import Path
from types import SimpleNamespace
from urllib.error import URLError
from urllib.request import Request

import pytest
from command import Run, run
from sites import Site, serve

from spackle.downloads import (
    WEIGHTS,
    DownloadRecord,
    check_recorded,
    download,
    installed,
    known_weights,
    transfer,
    weights_folder,
)
from spackle.errors import InputError
from spackle.progress import Reporter

CONTENT = random.Random(5).randbytes(1_000_003)
FILE = WEIGHTS["sharp"].file
BREAK = 400_000  # bytes before a connection breaks


@pytest.fixture(autouse=True)
def _without_network_habits(monkeypatch: pytest.MonkeyPatch) -> None:
    """No proxy of this machine, and no waiting."""
    for name in ("http_proxy", "https_proxy", "all_proxy", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.setattr(transfer, "PAUSES", (0.0, 0.0))


@pytest.fixture
def site() -> Iterator[Site]:
    with serve(CONTENT) as served:
        yield served


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "weights.pt"


@pytest.fixture
def begun(site: Site, target: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A download that broke off after BREAK bytes."""
    site.drops = [BREAK]
    with monkeypatch.context() as patch:
        patch.setattr(transfer, "PAUSES", ())
        refused(site.url, target, "early", f"{BREAK:,} bytes")
    assert names_in(target) == {"weights.pt.part", "weights.pt.part.json"}
    site.requests.clear()
    return target


def names_in(target: Path) -> set[str]:
    return set(os.listdir(target.parent))


def refused(url: str, target: Path, *parts: str) -> None:
    """One line that says what is wrong, and no file."""
    with pytest.raises(InputError) as caught:
        download(url, target)
    assert len(str(caught.value).splitlines()) == 1
    for part in parts:
        assert part in str(caught.value)
    assert not os.path.isfile(target)


def is_whole(target: Path, site: Site, record: DownloadRecord) -> None:
    assert target.read_bytes() == site.content
    assert record == DownloadRecord(site.url, len(site.content), hashlib.sha256(site.content).hexdigest())
    assert check_recorded(target) == record
    assert names_in(target) == {"weights.pt", "weights.pt.json"}


def ranges(site: Site) -> list[str | None]:
    """The Range of each request."""
    return [asked.get("Range") for asked in site.requests]


# Whole files


def test_a_download_is_the_file_and_its_record(site: Site, target: Path) -> None:
    steps: list[tuple[int, int]] = []
    record = download(site.url, target, lambda done, total: steps.append((done, total)))
    is_whole(target, site, record)
    assert json.loads((target.parent / "weights.pt.json").read_text()) == dataclasses.asdict(record)
    assert steps == sorted(set(steps))
    assert (steps[0], steps[-1]) == ((0, len(CONTENT)), (len(CONTENT), len(CONTENT)))
    assert ranges(site) == [None]
    assert site.requests[0]["Accept-Encoding"] == "identity"


def test_an_older_file_stays_until_the_new_one_is_whole(site: Site, target: Path) -> None:
    target.write_bytes(b"old")
    site.status = 404
    with pytest.raises(InputError):
        download(site.url, target)
    assert target.read_bytes() == b"old"
    site.status = 200
    is_whole(target, site, download(site.url, target))


def test_a_link_stays_a_link(site: Site, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    link = tmp_path / "link.pt"
    link.symlink_to(tmp_path / "real" / "weights.pt")
    record = download(site.url, link)
    assert link.is_symlink()
    assert check_recorded(link) == record
    is_whole(tmp_path / "real" / "weights.pt", site, record)


# Going on


def test_a_broken_connection_goes_on_with_the_rest(site: Site, target: Path) -> None:
    site.drops = [BREAK, 100_000]
    is_whole(target, site, download(site.url, target))
    assert ranges(site) == [None, f"bytes={BREAK}-", f"bytes={BREAK + 100_000}-"]
    assert site.requests[1]["If-Range"] == site.tag


def test_a_later_call_goes_on_with_the_rest(site: Site, begun: Path) -> None:
    steps: list[int] = []
    is_whole(begun, site, download(site.url, begun, lambda done, total: steps.append(done)))
    assert ranges(site) == [f"bytes={BREAK}-"]
    assert (steps[0], steps[-1]) == (BREAK, len(CONTENT))


@pytest.mark.parametrize(
    ("headers", "sign"),
    [
        ({"ETag": None}, None),
        ({"ETag": 'W/"weak"'}, None),
        ({"ETag": None, "Last-Modified": "Mon, 15 Dec 2025 10:00:00 GMT"}, "Mon, 15 Dec 2025 10:00:00 GMT"),
    ],
)
def test_without_a_sign_of_the_version_it_starts_over(
    site: Site, target: Path, headers: dict[str, str | None], sign: str | None
) -> None:
    site.headers, site.drops = headers, [BREAK]
    is_whole(target, site, download(site.url, target))
    assert ranges(site) == [None, f"bytes={BREAK}-" if sign else None]
    assert site.requests[1].get("If-Range") == sign


@pytest.mark.parametrize("size", [len(CONTENT), BREAK, BREAK // 2, 2 * len(CONTENT)])
@pytest.mark.parametrize("if_range", [True, False], ids=["If-Range", "no If-Range"])
def test_a_file_that_changed_starts_over(site: Site, begun: Path, size: int, if_range: bool) -> None:
    site.content, site.if_range = random.Random(6).randbytes(size), if_range
    is_whole(begun, site, download(site.url, begun))
    assert ranges(site) == [f"bytes={BREAK}-", *([] if if_range else [None])]


SPOILT: dict[str, Callable[[Path, Path], object]] = {
    "no version": lambda part, version: version.unlink(),
    "cut off": lambda part, version: version.write_text("{"),
    "few fields": lambda part, version: version.write_text('{"size": "large"}'),
    "too deep": lambda part, version: version.write_text("[" * 100_000),
    "no tag": lambda part, version: version.write_text(re.sub('"etag": .*', '"etag": 5,', version.read_text())),
    "elsewhere": lambda part, version: version.write_text(version.read_text().replace("127.0.0.1", "127.0.0.2")),
    "no part": lambda part, version: part.unlink(),
    "too long": lambda part, version: part.write_bytes(b"x" * (len(CONTENT) + 1)),
}


@pytest.mark.parametrize("spoil", SPOILT)
def test_what_cannot_be_gone_on_with_is_dropped(site: Site, begun: Path, spoil: str) -> None:
    SPOILT[spoil](begun.with_name("weights.pt.part"), begun.with_name("weights.pt.part.json"))
    is_whole(begun, site, download(site.url, begun))
    assert ranges(site) == [None]


def test_ctrl_c_keeps_what_has_come(site: Site, target: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done >= BREAK:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download(site.url, target, interrupt)
    kept = target.with_name("weights.pt.part").stat().st_size
    assert names_in(target) == {"weights.pt.part", "weights.pt.part.json"}
    is_whole(target, site, download(site.url, target))
    assert ranges(site) == [None, f"bytes={kept}-"]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal here")
def test_a_killed_download_leaves_no_file_and_the_next_one_finishes(site: Site, target: Path) -> None:
    site.hang_after = BREAK
    part = target.with_name("weights.pt.part")
    code = f"from spackle.downloads import download; download({site.url!r}, {str(target)!r})"
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        try:
            deadline = time.monotonic() + 60
            while not (part.exists() and part.stat().st_size >= BREAK):
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.005)
            refused(site.url, target, "another process")
        finally:
            process.kill()
    kept = part.stat().st_size
    assert names_in(target) == {"weights.pt.part", "weights.pt.part.json", "weights.pt.lock"}
    site.hang_after = None
    site.go_on.set()
    is_whole(target, site, download(site.url, target))
    assert ranges(site) == [None, f"bytes={kept}-"]


# What goes wrong for good


@pytest.mark.parametrize(
    ("status", "headers", "words"),
    [
        (404, {}, ("HTTP 404", "check the address")),
        (416, {}, ("HTTP 416",)),
        (500, {}, ("HTTP 500", "later")),
        (206, {}, ("something else",)),
        (200, {"Content-Type": "text/html"}, ("something else",)),
        (200, {"Content-Encoding": "gzip"}, ("packs", "gzip", "another address")),
        (200, {"Content-Length": None}, ("length",)),
        (200, {"Content-Length": "0"}, ("empty",)),
        (200, {"Content-Length": str(len(CONTENT) + 10)}, ("10 bytes early",)),
        (302, {"Location": "file:///etc/hostname"}, ("HTTP 302",)),
        (302, {"Location": "ftp://127.0.0.1/a.pt"}, ("ftp://127.0.0.1/a.pt",)),
    ],
)
def test_answers_that_are_no_file(
    site: Site, target: Path, status: int, headers: dict[str, str | None], words: tuple[str, ...]
) -> None:
    site.status, site.headers = status, headers
    refused(site.url, target, site.url, *words)
    assert bool(names_in(target)) is ("10 bytes early" in words)  # all that came is kept


def test_a_server_that_hangs(site: Site, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "TIMEOUT", 0.2)
    site.hang_after = 200_000
    refused(site.url, target, site.url, "no answer within 0.2 seconds", f"{600_000:,} bytes")
    assert len(site.requests) == 3
    with socket.create_server(("127.0.0.1", 0)) as silent:
        refused(f"http://127.0.0.1:{silent.getsockname()[1]}/", target.with_name("other"), "no answer")


def closed() -> str:
    """An address where nobody listens: a port below 1024 that no service has."""
    return "http://127.0.0.1:1/weights.pt"


def test_certificates(site: Site, target: Path) -> None:
    refused(site.url.replace("http:", "https:"), target, "SSL")
    error = ssl.SSLCertVerificationError(1, "failed")
    error.verify_message = "self-signed certificate"
    assert "not trusted (self-signed certificate)" in transfer.reason_of(URLError(error))


def test_https_is_not_given_up_on_the_way() -> None:
    def redirect(old: str, new: str) -> Request | None:
        handler = transfer._SafeRedirects()
        return handler.redirect_request(Request(old), io.BytesIO(), 302, "Found", Message(), new)

    with pytest.raises(InputError, match="not https"):
        redirect("https://a.org/w.pt", "http://a.org/w.pt")
    for old, new in (("http://a.org", "https://b.org"), ("https://a.org", "https://b.org")):
        request = redirect(old, new)
        assert request is not None
        assert request.full_url == new


@pytest.mark.parametrize("url", ["", "a.pt", "file:///a", "http://", "https://[/", "http://a:b/", "http://a:0/"])
def test_addresses_that_are_none(target: Path, url: str) -> None:
    refused(url, target, repr(url))
    refused(f"{url}\n", target)


@pytest.mark.parametrize(
    "url",
    [
        "http://me:secret@127.0.0.1:1/w.pt",
        "ftp://me:secret@127.0.0.1:1/w.pt",
        "http://me:secret@[/w.pt",
        "http://me:secret/more@127.0.0.1:1/w.pt",
        "me:secret@127.0.0.1:1/w.pt",
    ],
)
def test_a_password_in_an_address_is_refused_and_not_shown(target: Path, url: str) -> None:
    with pytest.raises(InputError, match="password") as caught:
        download(url, target)
    assert "secret" not in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert names_in(target) == set()


@pytest.mark.parametrize(
    ("scheme", "place"), [("http", "127.0.0.1:1"), ("http", "127.0.0.1:port"), ("ftp", "127.0.0.1:1")]
)
def test_nor_is_one_that_a_server_sends_on_to(site: Site, target: Path, scheme: str, place: str) -> None:
    url = site.url.replace("weights.pt", "sharp@1.0/weights.pt")  # an @ in the path is no password
    assert download(url, target).url == url
    site.status, site.headers = 302, {"Location": f"{scheme}://me:secret@{place}/w.pt"}
    with pytest.raises(InputError, match="password") as caught:
        download(site.url, target)
    assert str(caught.value).startswith(f"{site.url}: the server sends on to ")
    assert "secret" not in str(caught.value)


def test_places_that_cannot_be_written(site: Site, tmp_path: Path) -> None:
    refused(site.url, tmp_path, str(tmp_path), "plain file")
    refused(site.url, tmp_path / "missing" / "a.pt", "a.pt", "No such file", "folder")
    refused(site.url, tmp_path / ("a" * 300), "too long")
    with pytest.raises(InputError):
        download(site.url, tmp_path / "a\0b")
    assert site.requests == []


def test_a_full_disk(site: Site, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(total=10, free=1))
        refused(site.url, target, str(target.parent), "make room")
        assert names_in(target) == set()

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        refused(site.url, target, "No space left on device: make room or choose")
    is_whole(target, site, download(site.url, target))


# Records


def damage(target: Path) -> None:
    content = bytearray(target.read_bytes())
    content[len(content) // 2] ^= 1
    target.write_bytes(content)


def test_damage_is_noticed(site: Site, target: Path) -> None:
    download(site.url, target)
    damage(target)
    with pytest.raises(InputError, match=r"weights\.pt: its SHA-256 .* delete it"):
        check_recorded(target)
    target.write_bytes(CONTENT[:-1])
    with pytest.raises(InputError, match=r"weights\.pt: 1,000,002 bytes, but 1,000,003 .* delete it"):
        check_recorded(target)
    target.unlink()
    with pytest.raises(InputError, match="No such file"):
        check_recorded(target)
    target.write_bytes(b"mine")
    for notes in ("[1]", '{"epochs": 3}'):  # of a person's own, beside a file of their own
        target.with_name("weights.pt.json").write_text(notes)
        assert check_recorded(target) is None


@pytest.mark.parametrize(
    "text",
    ["{", '{"sha256": "00"}', '{"sha256": "00", "url": "", "size": 1e400}', "[" * 100_000],
    ids=["cut off", "few fields", "endless", "too deep"],
)
def test_a_record_that_makes_no_sense_is_not_passed_over(target: Path, text: str) -> None:
    target.write_bytes(b"mine")
    target.with_name("weights.pt.json").write_text(text)
    with pytest.raises(InputError, match="delete it"):
        check_recorded(target)


# Where weights lie


def test_the_folder_of_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = "USERPROFILE" if os.name == "nt" else "HOME"
    monkeypatch.setenv(home, str(tmp_path))
    for name in ("SPACKLE_WEIGHTS", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert weights_folder() == tmp_path / ".cache" / "spackle" / "weights"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, says its standard
    assert weights_folder() == tmp_path / ".cache" / "spackle" / "weights"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert weights_folder() == tmp_path / "cache" / "spackle" / "weights"
    monkeypatch.setenv("SPACKLE_WEIGHTS", "~/mine")
    assert weights_folder() == tmp_path / "mine"


# The commands


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of weights, not there yet."""
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    return tmp_path / "weights"


def weights_command(*arguments: object) -> Run:
    return run("weights", *arguments)


def refuses(result: Run, *words: object) -> None:
    assert (result.code, result.out, len(result.err.splitlines())) == (2, "", 1), result.err
    assert result.err.startswith("error: ")
    for word in words:
        assert str(word) in result.err


def test_get_tells_scripts_where_the_file_lies(site: Site, weights: Path) -> None:
    known = hashlib.sha256(CONTENT).hexdigest()
    for digest, new in ((known, True), (known, False)):
        result = weights_command("get", "sharp", "--url", site.url, "--json")
        assert result.code == 0, result.err
        told = {"name": "sharp", "file": str(weights / FILE), "bytes": len(CONTENT)}
        assert json.loads(result.out) == {**told, "sha256": digest, "downloaded": new}
    failed = weights_command("get", "blunt", "--json")
    assert (failed.code, list(json.loads(failed.out))) == (2, ["error"])


def test_get_shows_the_terms_once_and_does_nothing_twice(site: Site, weights: Path) -> None:
    assert installed("sharp") is None
    first = weights_command("get", "sharp", "--url", site.url)
    assert first.code == 0, first.err
    assert installed("sharp") == weights / FILE
    assert set(os.listdir(weights)) == {FILE, f"{FILE}.json"}
    assert first.err.count("research only") == first.err.count("LICENSE_MODEL") == 1
    last = first.err.splitlines()[-1]
    assert all(part in last for part in ("1.0 MB", hashlib.sha256(CONTENT).hexdigest(), str(weights / FILE)))
    again = weights_command("get", "sharp", "--url", site.url)
    assert (again.code, len(again.err.splitlines())) == (0, 1)
    assert all(part in again.err for part in ("already", "intact", str(weights / FILE)))
    assert len(site.requests) == 1
    forced = weights_command("get", "sharp", "--url", site.url, "--force")
    assert forced.err.count("research only") == 1
    assert len(site.requests) == 2
    damage(weights / FILE)
    refuses(weights_command("get", "sharp", "--url", site.url), weights / FILE, "delete it")
    assert weights_command("get", "sharp", "--url", site.url, "--force").code == 0
    assert (weights / FILE).read_bytes() == CONTENT


def test_get_to_a_place_of_your_own(site: Site, weights: Path, tmp_path: Path) -> None:
    weights.mkdir()
    (weights / FILE).write_bytes(b"mine")
    result = weights_command("get", "sharp", "--url", closed())  # leaves a file of your own
    assert result.code == 0
    assert "unchecked" in result.err
    assert (weights / FILE).read_bytes() == b"mine"
    for output, path in (("a/b", f"a/b/{FILE}"), ("a/c.pt", "a/c.pt"), ("a/d.PT", "a/d.PT")):
        result = weights_command("get", "sharp", "--url", site.url, "-o", tmp_path / output)
        assert result.code == 0, result.err
        assert check_recorded(tmp_path / path)
        assert "--checkpoint" in result.err
    assert os.listdir(weights) == [FILE]


def test_get_in_one_line_where_it_fails(site: Site, weights: Path) -> None:
    refuses(weights_command("get", "nothing"), "nothing", "sharp")
    refuses(weights_command("get", "sharp", "--url", closed()), closed(), "check the network")
    refuses(
        weights_command("get", "sharp", "--url", "http://me:secret@127.0.0.1:1/"),
        "address at 127.0.0.1 with",
        "password",
    )
    site.status = 404
    refuses(weights_command("get", "sharp", "--url", site.url), site.url, "404")
    assert not weights.exists()


@pytest.mark.parametrize("name", ["lama", "features"])
def test_get_refuses_another_file_than_the_published_one(site: Site, weights: Path, name: str) -> None:
    result, published = weights_command("get", name, "--url", site.url), known_weights(name).published
    assert result.code == 2
    assert published is not None
    assert all(part in result.err.splitlines()[-1] for part in (site.url, published))
    assert not weights.exists() or os.listdir(weights) == []


@pytest.mark.parametrize("kind", ["md5", "sha256"])
def test_a_file_with_its_published_digest_is_taken(site: Site, target: Path, kind: str) -> None:
    digits = hashlib.new(kind, CONTENT).hexdigest()
    for published in (f"{kind}:{digits}", f"{kind}:{digits[:8]}"):
        is_whole(target, site, download(site.url, target, published=published))


def test_get_warns_of_an_address_that_is_not_encrypted(
    site: Site, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "not encrypted" not in weights_command("get", "sharp", "--url", site.url).err  # it is this machine
    monkeypatch.setenv("http_proxy", site.url)
    result = weights_command("get", "sharp", "--force", "--url", "http://mirror.example/w.pt")
    assert result.code == 0, result.err
    assert "warning: http:// is not encrypted" in result.err


def test_an_interrupted_get_says_that_it_goes_on(site: Site, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*args: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(
            Reporter, "log", lambda self, line: interrupt() if "1.0 MB" in line else print(line, file=sys.stderr)
        )
        result = weights_command("get", "sharp", "--url", site.url)
    assert result.code == 130
    assert "goes on from there" in result.err
    assert weights_command("get", "sharp", "--url", site.url).code == 0
    assert ranges(site)[1] is not None


def test_list_says_what_is_here(site: Site, weights: Path) -> None:
    def listed() -> str:
        result = weights_command("list")
        assert (result.code, result.err) == (0, "")
        assert all(part in result.out for part in ("sharp", FILE, "research only", str(weights)))
        return result.out

    assert "not here" in listed()
    assert weights_command("get", "sharp", "--url", site.url).code == 0
    assert "1.0 MB, whole" in listed()
    (weights / FILE).write_bytes(CONTENT[:-1])
    assert "damaged" in listed()
    (weights / f"{FILE}.json").unlink()
    assert "no record" in listed()
