"""Download a file of known size and SHA-256: complete or not at all, and resumed after an interruption."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from http.client import HTTPException, HTTPResponse, responses
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import Request, build_opener

from spackle.errors import InputError, reason_in_a_line
from spackle.files import check_writable, sha256_of
from spackle.folders import hold

TIMEOUT = 30.0  # seconds without a byte
PAUSES = (1.0, 2.0, 4.0, 8.0)  # seconds before each further try of a connection that broke
CHUNK = 1 << 18  # most bytes that are read at once

Progress = Callable[[int, int], None]  # (bytes done, of how many)


class Dropped(Exception):
    """There is no connection, or it broke."""


def download(url: str, path: str | os.PathLike[str], size: int, sha256: str, progress: Progress | None = None) -> None:
    """Fetch `url` (http or https, without a password) to `path` in a folder that exists.

    An existing file is replaced at the end; until then the received bytes are in NAME.part. After a break, a kill or
    Ctrl-C the next call asks for the rest only. `progress` gets the bytes received so far, including those of earlier
    calls.

    Raises:
        InputError: the file cannot be fetched or written, has other content, or is being downloaded by another process.
    """
    check_url(url)
    target = check_writable(path)
    part, lock = (target.with_name(target.name + suffix) for suffix in (".part", ".lock"))
    try:
        with hold(lock):
            for continued in (part.exists(), False):  # the part of an earlier call may be of another file
                _receive(url, part, size, progress or (lambda done, total: None))
                with open(part, "rb") as file:
                    found = sha256_of(file)
                if found == sha256:
                    os.replace(part, target)
                    return
                part.unlink()
                if not continued:
                    raise InputError(f"{url}: wrong content, not the SHA-256 {sha256}: give another address")
    except BlockingIOError as error:
        raise InputError(f"{path}: another process is downloading this file: wait until it is done") from error
    except OSError as error:
        reason = reason_in_a_line(error)
        raise InputError(f"{path}: cannot write: {reason}: make room or choose another folder") from error


def check_url(url: str) -> None:
    """InputError unless `url` begins with http:// or https:// and has no password."""
    with contextlib.suppress(ValueError):  # a port that is no number
        parts = urlsplit(url)
        good = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
        if good and "@" not in parts.netloc and url.isprintable() and " " not in url:
            return
    if "@" in url:
        raise InputError(
            "an address with a user name or password in it (not shown): spackle does not log in, not even with "
            "~/.netrc: give an address that needs no login"
        )
    raise InputError(f"{url!r}: not an address to download from: give one that begins with https:// or http://")


def _receive(url: str, part: Path, size: int, progress: Progress) -> None:
    """Complete `part` to `size` bytes; retries a connection that broke, but not one that could not be opened.

    Raises:
        InputError: the file cannot be fetched; the received bytes stay in `part`.
        OSError: `part` cannot be written.
    """
    kept, pauses = _size(part), list(PAUSES)
    while _size(part) != size:
        try:
            _receive_rest(url, part, size, progress)
        except Dropped as error:
            done = _size(part)
            if not pauses or done == kept:
                remark = f" ({done:,} bytes have arrived and are kept)" if done else ""
                raise InputError(f"{url}: {error}{remark}") from error
            time.sleep(pauses.pop(0))


def _size(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _receive_rest(url: str, part: Path, size: int, progress: Progress) -> None:
    """Request the missing rest of `part`; follows redirects and the settings https_proxy and no_proxy."""
    there = _size(part)
    headers = {"User-Agent": "spackle", "Accept-Encoding": "identity"}
    if 0 < there < size:
        headers["Range"] = f"bytes={there}-"
    with _network(url):
        response: HTTPResponse = build_opener().open(Request(url, headers=headers), timeout=TIMEOUT)
    with response:
        done = _first_byte(url, response, there, size)
        usage = shutil.disk_usage(part.parent)
        if usage.total and (free := usage.free + there) < size:  # some network folders report 0 bytes
            gigabytes = f"{size / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free"
            raise InputError(f"{part.parent}: {gigabytes}: make room or choose another folder")
        with open(part, "ab") as file:
            file.truncate(done)
            progress(done, size)
            while done < size:
                with _network(url):
                    block = response.read1(min(CHUNK, size - done))  # read() would lose what arrived before a break
                if not block:
                    raise Dropped(f"the connection ended {size - done:,} bytes early")
                file.write(block)
                file.flush()
                done += len(block)
                progress(done, size)
            os.fsync(file.fileno())  # before the rename says that it is complete


@contextlib.contextmanager
def _network(url: str) -> Iterator[None]:
    """Raises Dropped if the server cannot be reached, InputError if it does not give the file."""
    try:
        yield
    except HTTPError as error:
        with error:
            status = f"the server answers HTTP {error.code} {responses.get(error.code, '')}".rstrip()
        if error.code >= 500 or error.code == 429:
            raise Dropped(f"{status}: try again later") from error
        raise InputError(f"{url}: {status}: check the address, or give another") from error
    except (OSError, HTTPException) as error:
        reason = reason_in_a_line(error.reason if isinstance(error, URLError) else error)
        raise Dropped(f"no connection ({reason}): check network, https_proxy and clock, and try again") from error


def _first_byte(url: str, response: HTTPResponse, there: int, size: int) -> int:
    """The offset at which an answer begins: after the existing bytes, or 0 if the server sends the whole file.

    InputError if the answer is not a file, or not one of `size` bytes.
    """
    rest = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers["Content-Range"] or "")
    if response.status == 206 and rest and int(rest[1]) == there:
        done, total = there, int(rest[2])
    elif response.status == 200 and response.headers.get_content_type() != "text/html":
        done, total = 0, size if response.length is None else response.length
    else:
        raise InputError(f"{url}: the server's answer is not a file: check the address in a browser")
    if total != size:
        raise InputError(f"{url}: another file: {total:,} bytes, {size:,} were published: give another address")
    return done
