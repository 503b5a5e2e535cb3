"""A file whose size and SHA-256 are known, from a web server: whole or not there, and continued after a break."""

from __future__ import annotations

import os
import re
import shutil
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from email.message import Message
from http.client import HTTPException, HTTPResponse, responses
from pathlib import Path
from typing import IO
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from spackle.errors import InputError, reason_in_a_line
from spackle.files import check_writable, sha256_of
from spackle.folders import hold

TIMEOUT = 30.0  # seconds without a byte
PAUSES = (1.0, 2.0, 4.0, 8.0)  # seconds before each further try of a connection that broke
CHUNK = 1 << 18  # bytes at most that are taken at once

Progress = Callable[[int, int], None]  # (bytes done, of how many)


class Dropped(Exception):
    """No connection, or no longer; `begun`: the server had begun to send the file."""

    def __init__(self, reason: str, begun: bool) -> None:
        super().__init__(reason)
        self.begun = begun


def download(url: str, path: str | os.PathLike[str], size: int, sha256: str, progress: Progress | None = None) -> None:
    """Fetch `url` (http or https, without a password) to `path` in a folder that exists.

    A file that is there is replaced at the end; until then what has come lies in NAME.part. After a break, a kill or
    Ctrl-C the next call asks for the rest only. `progress` gets the bytes done, those of earlier calls among them.

    Raises:
        InputError: the file cannot be had or not be written, is another one, or another process is at it.
    """
    check_url(url)
    target = check_writable(path)
    part, lock = (target.with_name(target.name + suffix) for suffix in (".part", ".lock"))
    try:
        with hold(lock):
            for continued in (part.exists(), False):  # what an earlier call left may be of another file
                _receive(url, part, size, progress or (lambda done, total: None))
                with open(part, "rb") as file:
                    found = sha256_of(file)
                if found == sha256:
                    os.replace(part, target)
                    return
                part.unlink()
                if not continued:
                    raise InputError(f"{url}: what came has not the SHA-256 {sha256}: take another address")
    except BlockingIOError as error:
        raise InputError(f"{path}: another process is downloading this file: wait until it is done") from error
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot write: {reason}: make room or choose another folder") from error


def check_url(url: str) -> None:
    """InputError for anything but http:// and https://, such as file://, and for a password in it."""
    try:
        parts = urlsplit(url)
        host = parts.hostname if parts.port != 0 else None  # a port that is no number is a ValueError
        good = parts.scheme in ("http", "https") and bool(host) and url.isprintable() and " " not in url
        named = parts.netloc if good else url
    except ValueError:
        good, named = False, url
    if "@" in named:
        raise InputError(
            "an address with a user name or password in it (not shown): spackle logs in nowhere, nor by ~/.netrc: "
            "give an address that works without"
        )
    if not good:
        raise InputError(f"{url!r}: not an address to download from: give one that begins with https:// or http://")


def _receive(url: str, part: Path, size: int, progress: Progress) -> None:
    """Bring `part` to `size` bytes; a connection that breaks is tried again, one that never came about is not.

    Raises:
        InputError: the file cannot be had; what has come stays in `part`.
        OSError: `part` cannot be written.
    """
    begun, pauses = False, list(PAUSES)
    while (done := part.stat().st_size if part.exists() else 0) != size:
        try:
            _receive_once(url, part, done if done < size else 0, size, progress)
        except Dropped as error:
            begun = begun or error.begun
            if not (begun and pauses):
                done = part.stat().st_size if part.exists() else 0
                kept = f" (what has come is kept: {done:,} bytes)" if done else ""
                raise InputError(f"{url}: {error}{kept}") from error
            time.sleep(pauses.pop(0))


def _receive_once(url: str, part: Path, done: int, size: int, progress: Progress) -> None:
    with _connect(url, done) as response:
        done = _first_byte(url, response, done, size)
        usage = shutil.disk_usage(part.parent)
        free = usage.free + (part.stat().st_size if done == 0 and part.exists() else 0)  # the old part makes way
        if usage.total and free < size - done:  # some network folders say 0 of 0
            gigabytes = f"{(size - done) / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free"
            raise InputError(f"{part.parent}: {gigabytes}: make room or choose another folder")
        with open(part, "ab") as file:
            file.truncate(done)
            progress(done, size)
            for block in _blocks(response, size - done):
                file.write(block)
                file.flush()
                done += len(block)
                progress(done, size)
            os.fsync(file.fileno())  # the file's name will promise that it is whole


def _connect(url: str, done: int) -> HTTPResponse:
    """Ask for the bytes from `done` on, through the environment's proxies (https_proxy, no_proxy) and redirects.

    Raises Dropped where the server cannot be reached, and InputError where it does not give the file.
    """
    headers = {"User-Agent": "spackle", "Accept-Encoding": "identity"} | ({"Range": f"bytes={done}-"} if done else {})
    try:
        response: HTTPResponse = build_opener(_SafeRedirects).open(Request(url, headers=headers), timeout=TIMEOUT)
        return response
    except HTTPError as error:
        with error:
            status = f"HTTP {error.code} {responses.get(error.code, '')}".rstrip()
        if error.code >= 500 or error.code == 429:
            raise Dropped(f"the server answers {status}: try again later", begun=False) from error
        raise InputError(f"{url}: the server answers {status}: check the address, or give another") from error
    except (OSError, HTTPException) as error:
        raise Dropped(reason_of(error), begun=False) from error


class _SafeRedirects(HTTPRedirectHandler):
    """Follows redirects, but not from https to http, and to nothing that we would not take as an address."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: Message, newurl: str
    ) -> Request | None:
        try:
            check_url(newurl)
            if req.full_url.startswith("https:") and not newurl.startswith("https:"):
                raise InputError(f"{newurl}, which is not https: give another address")
        except InputError as error:
            fp.close()
            raise InputError(f"{req.full_url}: the server sends on to {error}") from error
        return super().redirect_request(req, fp, code, msg, headers, newurl)  # type: ignore[arg-type]


def _first_byte(url: str, response: HTTPResponse, done: int, size: int) -> int:
    """Where in the file an answer begins: at `done`, or at 0 where the server gives the whole.

    InputError where it is no file, or not one of `size` bytes.
    """
    rest = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers["Content-Range"] or "")
    if response.status == 206 and rest and int(rest[1]) == done:
        total = int(rest[2])
    elif response.status == 200 and response.headers.get_content_type() != "text/html":
        done, total = 0, size if response.length is None else response.length
    else:
        raise InputError(f"{url}: the server answers with something else than a file: check the address in a browser")
    coding = response.headers["Content-Encoding"] or "identity"
    if coding.strip().lower() != "identity":  # its bytes and its length would be those of the packed file
        named = reason_in_a_line(coding)
        raise InputError(f"{url}: the server packs the file ({named}), which was not asked for: give another address")
    if total != size:
        raise InputError(f"{url}: another file: {total:,} bytes, {size:,} were published: give another address")
    return done


def _blocks(response: HTTPResponse, left: int) -> Iterator[bytes]:
    while left > 0:
        try:
            block = response.read1(min(CHUNK, left))  # what is there: read() would lose it where the rest fails
        except (OSError, HTTPException) as error:
            raise Dropped(reason_of(error), begun=True) from error
        if not block:
            raise Dropped(f"the connection ended {left:,} bytes early", begun=True)
        left -= len(block)
        yield block


def reason_of(error: Exception) -> str:
    """Why there is no connection, and what to do."""
    cause = error.reason if isinstance(error, URLError) else error
    if isinstance(cause, socket.gaierror):
        return "the server's name is not known here: check that you are online, and https_proxy if you need a proxy"
    if isinstance(cause, ssl.SSLCertVerificationError):
        return f"the server's certificate is not trusted ({cause.verify_message}): check the clock and SSL_CERT_FILE"
    if isinstance(cause, TimeoutError):
        return f"no answer within {TIMEOUT:g} seconds: check the connection and try again"
    return f"no connection ({reason_in_a_line(cause)}): check the network and try again"
