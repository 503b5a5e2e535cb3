"""Published weights and their downloads from a misbehaving server on this machine."""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.command import Run, run
from helpers.sites import Site, serve
from helpers.stand_in import SHARP_FILE, publish

from spackle.runtime.errors import InputError
from spackle.runtime.progress import Progress
from spackle.weights import PUBLISHED_WEIGHTS, installed_weights, weights_folder
from spackle.weights import download as module
from spackle.weights.download import download

CONTENT = random.Random(5).randbytes(1_000_003)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
BREAK = 400_000  # bytes before a connection breaks
CLOSED = "http://127.0.0.1:1/weights.pt"  # a port at which nobody listens


@pytest.fixture(autouse=True)
def _without_network_habits(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "https_proxy", "all_proxy", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.delenv("HF_ENDPOINT", raising=False)


@pytest.fixture
def site() -> Iterator[Site]:
    with serve(CONTENT) as served:
        yield served


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "weights.pt"


def fetch(url: str, target: Path, progress: Progress | None = None) -> None:
    download(url, target, len(CONTENT), SHA256, progress)


def fetches(url: str, target: Path, progress: Progress | None = None) -> None:
    fetch(url, target, progress)
    assert target.read_bytes() == CONTENT
    assert os.listdir(target.parent) == [target.name]


def refused(url: str, target: Path, *parts: str) -> None:
    with pytest.raises(InputError) as caught:
        fetch(url, target)
    assert len(str(caught.value).splitlines()) == 1
    assert all(part in str(caught.value) for part in parts), caught.value
    assert not os.path.isfile(target)


def ranges(site: Site) -> list[str | None]:
    return [asked.get("Range") for asked in site.requests]


def test_an_older_file_or_a_link_stays_until_the_new_one_is_whole(
    site: Site, tmp_path: Path
) -> None:
    (tmp_path / "real").mkdir()
    link = tmp_path / "link.pt"
    real = tmp_path / "real" / "weights.pt"
    link.symlink_to(real)
    real.write_bytes(b"old")
    site.status = 404
    with pytest.raises(InputError):
        fetch(site.url, link)
    assert real.read_bytes() == b"old"
    site.status = 200
    site.headers = {"Content-Length": None}
    fetch(site.url, link)
    assert link.is_symlink()
    assert real.read_bytes() == CONTENT


@pytest.mark.parametrize("knows_ranges", [True, False])
def test_a_later_call_requests_only_the_rest(site: Site, target: Path, knows_ranges: bool) -> None:
    site.drops = [BREAK]
    site.ranges = knows_ranges
    refused(site.url, target, f"{len(CONTENT) - BREAK:,} bytes early")
    assert os.listdir(target.parent) == ["weights.pt.part"]
    steps: list[tuple[int, int]] = []
    fetches(site.url, target, lambda done, total: steps.append((done, total)))
    assert ranges(site) == [None, f"bytes={BREAK}-"]
    assert site.requests[0]["Accept-Encoding"] == "identity"
    assert steps == sorted(set(steps))
    assert (steps[0], steps[-1]) == (
        (BREAK * knows_ranges, len(CONTENT)),
        (len(CONTENT), len(CONTENT)),
    )


@pytest.mark.parametrize("size", [BREAK, len(CONTENT) + 1])
def test_a_part_of_another_file_is_discarded(site: Site, target: Path, size: int) -> None:
    target.with_name("weights.pt.part").write_bytes(random.Random(6).randbytes(size))
    fetches(site.url, target)
    assert ranges(site)[-1] is None


@pytest.mark.parametrize(
    ("server", "words"),
    [
        ({"status": 404}, ("HTTP 404", "check the address, or try again later")),
        ({"content": CONTENT + b"more"}, ("the file has 1,000,007 bytes instead of 1,000,003",)),
        ({"content": CONTENT[::-1]}, ("SHA-256 is not", SHA256, "another address")),
        ({"drops": [len(CONTENT) - 10]}, ("10 bytes early", "try again")),
        (
            {"headers": {"Content-Type": "text/html; charset=utf-8"}},
            ("the server's answer is not a file",),
        ),
        ({"status": 302, "headers": {"Location": "file:///etc/hostname"}}, ("HTTP 302",)),
    ],
)
def test_answers_other_than_the_file_are_refused(
    site: Site, target: Path, server: dict[str, Any], words: tuple[str, ...]
) -> None:
    for name, value in server.items():
        setattr(site, name, value)
    refused(site.url, target, site.url, *words)
    assert bool(os.listdir(target.parent)) is (
        "10 bytes early" in words
    )  # the received bytes are kept


def test_a_full_disk_is_refused(site: Site, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1))
    refused(site.url, target, str(target.parent), "make room")
    assert os.listdir(target.parent) == []


def test_servers_that_hang_are_refused(
    site: Site, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "TIMEOUT_S", 0.2)
    site.hang_after = 200_000
    refused(site.url, target, site.url, "no connection (timed out)")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        refused(
            f"http://127.0.0.1:{silent.getsockname()[1]}/", target.with_name("other"), "timed out"
        )
    refused(site.url.replace("http:", "https:"), target, "SSL")


@pytest.mark.parametrize(
    "url", ["", "a.pt", "file:///a", "ftp://a/b", "http://", "https://[/", "http://a:b/"]
)
def test_other_addresses_and_passwords_are_refused(target: Path, url: str) -> None:
    refused(url, target, url)
    with pytest.raises(InputError, match="password") as caught:
        fetch(f"http://me:secret@127.0.0.1:1/{url}", target)
    assert "secret" not in str(caught.value)


def test_the_entries_of_published_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    for entry in PUBLISHED_WEIGHTS.values():
        assert re.fullmatch("[0-9a-f]{64}", entry.sha256)
        assert re.fullmatch(f"https://.*{re.escape(Path(entry.file).name)}", entry.url)
        assert all((entry.purpose, entry.licence, entry.notice, entry.option))
        assert entry.address == entry.url
    monkeypatch.setenv("HF_ENDPOINT", "https://mirror.example/hub/")
    assert PUBLISHED_WEIGHTS["depth"].address.startswith(
        "https://mirror.example/hub/Ruicheng/moge-2-vits-normal/resolve/"
    )
    assert PUBLISHED_WEIGHTS["sharp"].address == PUBLISHED_WEIGHTS["sharp"].url


def test_the_folder_of_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("USERPROFILE" if os.name == "nt" else "HOME", str(tmp_path))
    for name in ("SPACKLE_WEIGHTS", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for variable, value, folder in (
        (
            "XDG_CACHE_HOME",
            "relative",
            ".cache/spackle/weights",
        ),  # ignored, as the XDG standard demands
        ("XDG_CACHE_HOME", str(tmp_path / "cache"), "cache/spackle/weights"),
        ("SPACKLE_WEIGHTS", "~/mine", "mine"),
    ):
        monkeypatch.setenv(variable, value)
        assert weights_folder() == tmp_path / folder


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of weights, which is not there yet; the site's content counts as Apple's."""
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    publish(monkeypatch, "sharp", CONTENT)
    return tmp_path / "weights"


def get(*arguments: object) -> Run:
    return run("weights", "get", *arguments)


def gets(*arguments: object) -> Run:
    result = get(*arguments)
    assert result.code == 0, result.err
    return result


def test_get_shows_the_terms_once_and_does_nothing_twice(site: Site, weights: Path) -> None:
    file = weights / SHARP_FILE
    assert installed_weights("sharp") is None
    first = gets("sharp", "--url", site.url)
    assert installed_weights("sharp") == file
    assert os.listdir(weights) == [SHARP_FILE]
    assert first.err.count("research only") == first.err.count("LICENSE_MODEL") == 1
    assert all(part in first.lines[-1] for part in ("1.0 MB", SHA256, str(file)))
    again = gets("sharp", "--url", site.url)
    assert len(again.lines) == len(site.requests) == 1
    assert all(part in again.err for part in ("already", "intact", str(file)))
    file.write_bytes(CONTENT[::-1])
    assert f"{file}: damaged, or a file of yours" in get("sharp", "--url", site.url).err
    forced = gets("sharp", "--url", site.url, "--force", "--json")
    told = {
        "name": "sharp",
        "file": str(file),
        "bytes": len(CONTENT),
        "sha256": SHA256,
        "downloaded": True,
    }
    assert json.loads(forced.out) == told
    assert file.read_bytes() == CONTENT


def test_get_without_a_network_prints_one_line(weights: Path) -> None:
    offline = get("sharp", "--url", CLOSED)
    assert (offline.code, len(offline.lines)) == (2, 1), offline.err


def test_get_to_another_folder_or_file(site: Site, weights: Path, tmp_path: Path) -> None:
    for output, path in (("a/b", f"a/b/{SHARP_FILE}"), ("a/c.pt", "a/c.pt"), ("a/d.PT", "a/d.PT")):
        assert "--checkpoint" in gets("sharp", "--url", site.url, "-o", tmp_path / output).err
        assert (tmp_path / path).read_bytes() == CONTENT
    assert not weights.exists()


def test_list_tells_which_weights_are_on_this_machine(weights: Path) -> None:
    weights.mkdir()
    for content, said in ((None, "not here"), (CONTENT, "whole 1.0 MB"), (CONTENT[:-1], "damaged")):
        if content is not None:
            (weights / SHARP_FILE).write_bytes(content)
        result = run("weights", "list")
        words = ("research only", "photo to Gaussians", str(weights))
        assert (result.code, result.err) == (0, "")
        assert all(part in " ".join(result.out.split()) for part in (said, *words))
