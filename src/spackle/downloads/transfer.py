"""One file's bytes from a web server into NAME.part, from the start or from where an earlier try broke off."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import shutil
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from email.message import Message
from http.client import HTTPException, HTTPResponse, InvalidURL, responses
from pathlib import Path
from typing import IO, Any, BinaryIO
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from spackle.errors import InputError, reason_in_a_line

TIMEOUT = 30.0  # seconds without a byte


class Dropped(Exception):
    """No connection, or no longer; `begun`: the server had begun to send the file."""

    def __init__(self, reason: str, begun: bool) -> None:
        super().__init__(reason)
        self.begun = begun


class Changed(Exception):
    """The server no longer has the file of which the rest was asked for."""


def check_url(url: str) -> None:
    """InputError for anything but http:// and https://, such as file://, and for a password in it."""
    try:
        parts = urlsplit(url)
        host = parts.hostname if parts.port != 0 else None  # a port that is no number is a ValueError
        good = parts.scheme in ("http", "https") and bool(host) and url.isprintable() and " " not in url
    except ValueError:
        good = False
    if not good:
        raise InputError(
            f"{_shown(url)}: not an address to download from: give one that begins with https:// or http://"
        )
    if "@" in parts.netloc:
        raise InputError(
            f"an address at {host} with a user name or password in it: spackle logs in nowhere (nor by ~/.netrc): "
            "give an address that works without"
        )


def _shown(url: str) -> str:
    """An address for a message; one that is none may hold a password all the same, where nobody can tell."""
    return "an address (not shown, its @ may follow a password)" if "@" in url else repr(url)


def connect(url: str, headers: dict[str, str]) -> HTTPResponse:
    """Send a request through the environment's proxies (https_proxy, no_proxy), and follow redirects.

    Raises Dropped where the server cannot be reached, Changed where it lacks the Range of the headers, and InputError
    where it does not give the file.
    """
    request = Request(url, headers={"User-Agent": "spackle", "Accept-Encoding": "identity", **headers})
    try:
        response: HTTPResponse = build_opener(_SafeRedirects).open(request, timeout=TIMEOUT)
        return response
    except InputError:
        raise
    except HTTPError as error:
        with error:
            status = f"HTTP {error.code} {responses.get(error.code, '')}".rstrip()
        if error.code == 416 and request.has_header("Range"):
            raise Changed from error
        if error.code >= 500 or error.code == 429:
            raise Dropped(f"the server answers {status}: try again later", begun=False) from error
        raise InputError(f"{url}: the server answers {status}: check the address, or give another") from error
    except (InvalidURL, ValueError) as error:  # a port that is no number, a space
        raise InputError(f"{url!r}: not an address to download from: {error}") from error
    except (OSError, HTTPException) as error:
        raise Dropped(reason_of(error), begun=False) from error


class _SafeRedirects(HTTPRedirectHandler):
    """Follows redirects, but not from https to http, and to nothing that we would not take as an address."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: Message, newurl: str
    ) -> Request | None:
        if urlsplit(newurl).scheme not in ("https", urlsplit(req.full_url).scheme):
            fp.close()
            raise InputError(
                f"{req.full_url}: the server sends on to {_shown(newurl)}, which is not https: give another address"
            )
        try:
            check_url(newurl)
        except InputError as error:
            fp.close()
            raise InputError(f"{req.full_url}: the server sends on to {error}") from error
        return super().redirect_request(req, fp, code, msg, headers, newurl)  # type: ignore[arg-type]


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


CHUNK = 1 << 18  # bytes at most that are taken at once


@dataclasses.dataclass(frozen=True)
class Version:
    """What tells one state of a remote file from a later one."""

    url: str
    size: int  # bytes
    etag: str | None
    modified: str | None  # Last-Modified, as the server spells it

    @property
    def validator(self) -> str | None:
        """What If-Range takes: a weak ETag does not promise the same bytes."""
        return self.etag if self.etag and not self.etag.startswith("W/") else self.modified


def _version(response: HTTPResponse, url: str, begun: Version | None, offset: int) -> Version:
    """The version that the server sends: `begun` itself for its rest from `offset` on, or that of a whole file."""
    rest = begun if response.status == 206 else None
    if not rest and (response.status != 200 or response.headers.get_content_type() == "text/html"):
        raise InputError(f"{url}: the server answers with something else than a file: check the address in a browser")
    coding = response.headers["Content-Encoding"] or "identity"
    if coding.strip().lower() != "identity":  # its bytes and its length would be those of the packed file
        named = reason_in_a_line(coding)
        raise InputError(f"{url}: the server packs the file ({named}), which was not asked for: give another address")
    if rest:
        if not _continues(response, rest, offset):
            raise Changed
        return rest
    if not response.length:
        empty = response.length == 0
        problem = "is empty there" if empty else "comes without its length, so a part could pass for the whole"
        raise InputError(f"{url}: the file {problem}: give another address")
    return Version(url, response.length, response.headers["ETag"], response.headers["Last-Modified"])


def _continues(response: HTTPResponse, begun: Version, offset: int) -> bool:
    """Whether these are the bytes from `offset` on of that version: some servers do not know If-Range."""
    found = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers["Content-Range"] or "")
    etag, modified = response.headers["ETag"], response.headers["Last-Modified"]
    return (
        found is not None
        and (int(found[1]), int(found[2])) == (offset, begun.size)
        and etag in (None, begun.etag)
        and modified in (None, begun.modified)
    )


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


PAUSES = (1.0, 2.0, 4.0, 8.0)  # seconds before each further try of a connection that broke
BLOCK = 1 << 20  # bytes of a file read at once

Progress = Callable[[int, int], None]  # (bytes done, of how many)


def receive(url: str, part: Path, progress: Progress) -> tuple[int, str]:
    """Bring `part` to the end of the file at `url`; returns its bytes and their SHA-256.

    A connection that breaks is tried again a few times, one that never came about is not.

    Raises:
        InputError: the file cannot be had; what has come stays in `part`.
        OSError: `part` cannot be written.
    """
    begun, pauses = False, list(PAUSES)
    while True:
        try:
            return _receive_once(url, part, progress)
        except Changed:
            forget(part)
        except Dropped as error:
            begun = begun or error.begun
            if not (begun and pauses):
                size = part.stat().st_size if part.exists() else 0
                kept = f" (what has come is kept: {size:,} bytes)" if size else ""
                raise InputError(f"{url}: {error}{kept}") from error
            time.sleep(pauses.pop(0))


def forget(part: Path) -> None:
    """Remove an unfinished download."""
    version_file(part).unlink(missing_ok=True)  # first: bytes without a version are never gone on with
    part.unlink(missing_ok=True)


def version_file(part: Path) -> Path:
    """Where the remote file's version lies while `part` grows."""
    return part.with_name(part.name + ".json")


def _receive_once(url: str, part: Path, progress: Progress) -> tuple[int, str]:
    begun, headers = _begun(url, part), {}
    done = part.stat().st_size if begun else 0
    if begun and begun.validator:
        if done == begun.size:  # killed before it was given its name
            with open(part, "rb") as file:
                return done, digest(file).hexdigest()
        headers = {"Range": f"bytes={done}-", "If-Range": begun.validator}
    with connect(url, headers) as response:
        version = _version(response, url, begun, done)
        done = done if version is begun else 0
        _check_room(version.size, done, part)  # first: a file that is refused leaves nothing
        if done == 0:
            forget(part)
            part.touch()
            write_json(dataclasses.asdict(version), version_file(part))
        with open(part, "r+b") as file:
            sha256 = digest(file)
            progress(done, version.size)
            for block in _blocks(response, version.size - done):
                file.write(block)
                file.flush()
                sha256.update(block)
                done += len(block)
                progress(done, version.size)
            os.fsync(file.fileno())  # the file's name will promise that it is whole
    return done, sha256.hexdigest()


def _begun(url: str, part: Path) -> Version | None:
    """The version of which `part` is the beginning; None where there is nothing to go on with."""
    try:
        version = Version(**(read_json(version_file(part)) or {}))
        sensible = isinstance(version.size, int) and all(
            isinstance(sign, str | None) for sign in (version.etag, version.modified)
        )
        usable = sensible and version.url == url and version.validator and 0 < part.stat().st_size <= version.size
    except (TypeError, ValueError, FileNotFoundError):
        return None
    return version if usable else None


def _check_room(size: int, done: int, part: Path) -> None:
    usage = shutil.disk_usage(part.parent)
    needed, free = size - done, usage.free
    if done == 0 and part.exists():  # it makes way
        free += part.stat().st_size
    if usage.total and free < needed:  # some network folders say 0 of 0
        gigabytes = f"{needed / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free"
        raise InputError(f"{part.parent}: {gigabytes}: make room or choose another folder")


def digest(file: BinaryIO) -> hashlib._Hash:
    """SHA-256 of the rest of an open file."""
    sha256 = hashlib.sha256()
    while block := file.read(BLOCK):
        sha256.update(block)
    return sha256


def read_json(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file, None where there is none; ValueError for what is no JSON that we can read."""
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except RecursionError as error:  # brackets in brackets, thousands deep
        raise ValueError("nested too deep") from error
    return fields if isinstance(fields, dict) else None


def write_json(fields: dict[str, Any], path: Path) -> None:
    """Write fields to a file, whole or not at all. One process at a time."""
    temporary = path.with_name(path.name + ".new")
    with open(temporary, "w", encoding="utf-8") as file:
        file.write(json.dumps(fields, indent=2) + "\n")
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
