"""Download a file of known size and SHA-256: complete or not at all, and resumed after an interruption."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from http.client import HTTPException, HTTPResponse, responses
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import Request, build_opener

from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.files import check_writable
from spackle.runtime.progress import Progress

TIMEOUT = 30.0  # seconds without a byte
CHUNK = 1 << 18  # most bytes that are read at once
AGAIN = "try again, and the download resumes where it stopped"


def download(
    url: str, path: str | os.PathLike[str], size: int, sha256: str, progress: Progress | None = None
) -> None:
    """Fetch `url` to `path` in an existing folder.

    The bytes are collected in NAME.part; the complete file then replaces an existing file. After a broken connection, a
    kill or Ctrl-C the next call requests only the missing bytes. `progress` counts the bytes of earlier calls too.
    InputError if the file cannot be fetched or written, or has other content.
    """
    if re.match("[^/]*//[^/]*@", url):
        raise InputError(
            "an address with a user name or password (not shown): give one that needs no login"
        )
    if not re.match("https?://", url):
        raise InputError(
            f"{url!r}: not an address to download from: give one that begins with https:// or http://"
        )
    target = check_writable(path)
    part = target.with_name(f"{target.name}.part")
    try:
        for continued in (part.exists(), False):  # an existing part may belong to another file
            _receive(url, part, size, progress or (lambda done, total: None))
            with open(part, "rb") as file:
                found = sha256_of(file)
            if found == sha256:
                os.replace(part, target)
                return
            part.unlink()
            if not continued:
                raise InputError(
                    f"{url}: the content's SHA-256 is not {sha256}: give another address"
                )
    except OSError as error:
        reason = reason_in_a_line(error)
        raise InputError(
            f"{path}: cannot write: {reason}: make room or choose another folder"
        ) from error


def _receive(url: str, part: Path, size: int, progress: Progress) -> None:
    """Complete `part` to `size` bytes; follows redirects, and obeys https_proxy and no_proxy."""
    present = part.stat().st_size if part.exists() else 0
    if present == size:
        return
    headers = {"User-Agent": "spackle", "Accept-Encoding": "identity"}
    if 0 < present < size:
        headers["Range"] = f"bytes={present}-"
    with _network(url):
        response: HTTPResponse = build_opener().open(Request(url, headers=headers), timeout=TIMEOUT)
    with response:
        done = _first_byte(url, response, present, size)
        if (
            0 < shutil.disk_usage(part.parent).free < size - present
        ):  # some network folders report 0
            raise InputError(
                f"{part.parent}: {size / 1e9:.1f} GB are needed: make room or choose another folder"
            )
        with open(part, "ab") as file:
            file.truncate(done)
            progress(done, size)
            while done < size:
                with _network(url):
                    block = response.read1(
                        min(CHUNK, size - done)
                    )  # read() would lose the bytes before a break
                if not block:
                    raise InputError(
                        f"{url}: the connection ended {size - done:,} bytes early: {AGAIN}"
                    )
                file.write(block)
                file.flush()
                done += len(block)
                progress(done, size)
            os.fsync(file.fileno())  # before the file gets its final name


@contextlib.contextmanager
def _network(url: str) -> Iterator[None]:
    """InputError if the server cannot be reached, or does not give the file."""
    try:
        yield
    except HTTPError as error:
        with error:
            status = (
                f"the server answers HTTP {error.code} {responses.get(error.code, '')}".rstrip()
            )
        raise InputError(f"{url}: {status}: check the address, or try again later") from error
    except (OSError, HTTPException, ValueError) as error:  # ValueError: no address
        reason = reason_in_a_line(error.reason if isinstance(error, URLError) else error)
        problem = f"no connection ({reason}): check address, network and https_proxy"
        raise InputError(f"{url}: {problem}, then {AGAIN}") from error


def _first_byte(url: str, response: HTTPResponse, present: int, size: int) -> int:
    """The offset at which an answer begins: 0 if the server sends the whole file; InputError for another answer."""
    if response.headers.get_content_type() == "text/html":
        raise InputError(
            f"{url}: the server's answer is not a file: check the address in a browser"
        )
    rest = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers["Content-Range"] or "")
    done, total = 0, size if response.length is None else response.length
    if response.status == 206 and rest and int(rest[1]) == present:
        done, total = present, int(rest[2])
    if total != size:
        raise InputError(
            f"{url}: the file has {total:,} bytes instead of {size:,}: give another address"
        )
    return done
