"""Download a file of known size and SHA-256: complete or not at all, and resumed after a break."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from http.client import HTTPException, HTTPResponse, responses
from pathlib import Path
from typing import BinaryIO
from urllib.error import HTTPError, URLError
from urllib.request import Request, build_opener

from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.files import check_writable
from spackle.runtime.progress import Progress

TIMEOUT_S = 30.0  # without a byte
MAX_READ_BYTES = 1 << 18  # at once
PARTIAL_CONTENT = 206  # HTTP's status of an answer with a part of a file
RETRY_ADVICE = "try again, and the download resumes where it stopped"


def download(
    url: str, path: str | os.PathLike[str], size: int, sha256: str, progress: Progress | None = None
) -> None:
    """Fetch a file; the complete file then replaces an older one.

    The bytes are collected in NAME.part. After a broken connection, a kill or Ctrl-C, the next
    call requests only the missing bytes.

    Args:
        url: an address with http or https, without a password.
        path: the file, in an existing folder.
        size: of the file in bytes.
        sha256: of the file, as 64 hexadecimal digits.
        progress: called with how many bytes have been collected, in earlier calls too, and `size`.

    Raises:
        InputError: the file cannot be fetched or written, or has other content.
    """
    # A user name stands before an @, in the part of the address after the two slashes.
    if re.match("[^/]*//[^/]*@", url):
        problem = "an address with a user name or password (not shown)"
        raise InputError(f"{problem}: give one that needs no login")
    if not re.match("https?://", url):
        problem = "not an address to download from"
        raise InputError(f"{url!r}: {problem}: give one that begins with https:// or http://")

    target = check_writable(path)
    part = target.with_name(f"{target.name}.part")
    try:
        # The bytes of an earlier call may belong to another file: if they do, begin anew once.
        was_resumed = part.exists()
        has_right_content = _complete_part(url, part, size, sha256, progress)
        if was_resumed and not has_right_content:
            has_right_content = _complete_part(url, part, size, sha256, progress)
        if not has_right_content:
            problem = f"the content's SHA-256 is not {sha256}"
            raise InputError(f"{url}: {problem}: give another address")
        os.replace(part, target)
    except OSError as error:
        reason = reason_in_a_line(error)
        advice = "make room or choose another folder"
        raise InputError(f"{path}: cannot write: {reason}: {advice}") from error


def _complete_part(url: str, part: Path, size: int, sha256: str, progress: Progress | None) -> bool:
    """Fetch the bytes that are missing in the file `part`, and check its content.

    Args:
        url: the address of the whole file.
        part: the file that collects the bytes; need not exist.
        size: of the whole file in bytes.
        sha256: of the whole file, as 64 hexadecimal digits.
        progress: called with how many bytes `part` has, and `size`.

    Returns:
        Whether the content is right; if not, `part` is deleted.
    """
    _receive_missing_bytes(url, part, size, progress)
    with open(part, "rb") as file:
        digest = sha256_of(file)
    if digest == sha256:
        return True
    part.unlink()
    return False


def _receive_missing_bytes(url: str, part: Path, size: int, progress: Progress | None) -> None:
    """Complete the file `part` to `size` bytes, if the server has a file of this size.

    Follows redirects, and obeys the variables https_proxy and no_proxy.

    Raises:
        InputError: the server cannot be reached, answers with something else or stops early, or
            the disk is too small.
    """
    present_bytes = part.stat().st_size if part.exists() else 0
    if present_bytes == size:
        return
    # "identity": a compressed answer would have another size.
    headers = {"User-Agent": "spackle", "Accept-Encoding": "identity"}
    if 0 < present_bytes < size:
        headers["Range"] = f"bytes={present_bytes}-"

    with _network_errors(url):
        request = Request(url, headers=headers)
        response: HTTPResponse = build_opener().open(request, timeout=TIMEOUT_S)
    with response:
        start = _start_of_answer(url, response, present_bytes, size)
        free_bytes = shutil.disk_usage(part.parent).free
        # Some network folders report 0 free bytes.
        if 0 < free_bytes < size - present_bytes:
            problem = f"{size / 1e9:.1f} GB are needed"
            raise InputError(f"{part.parent}: {problem}: make room or choose another folder")
        with open(part, "ab") as file:
            # The answer begins at `start`; older bytes from there on will come again.
            file.truncate(start)
            _copy_answer(url, response, file, start, size, progress)
            # The bytes must be on the disk before the caller gives the file its final name;
            # otherwise, a crash of the machine could leave a broken file of that name.
            os.fsync(file.fileno())


def _copy_answer(
    url: str,
    response: HTTPResponse,
    file: BinaryIO,
    start: int,
    size: int,
    progress: Progress | None,
) -> None:
    """Append the bytes of an answer to a file, until the file has `size` bytes.

    Args:
        url: the address, for messages.
        response: the server's answer.
        file: is open for appending.
        start: how many bytes the file has.
        size: how many bytes the file will have.
        progress: called with the file's bytes and `size`.

    Raises:
        InputError: the connection breaks; the bytes that came are kept.
    """
    received_bytes = start
    if progress is not None:
        progress(received_bytes, size)
    while received_bytes < size:
        with _network_errors(url):
            # read() would lose the bytes before a break of the connection.
            block = response.read1(min(MAX_READ_BYTES, size - received_bytes))
        if not block:
            missing_bytes = size - received_bytes
            problem = f"the connection ended {missing_bytes:,} bytes early"
            raise InputError(f"{url}: {problem}: {RETRY_ADVICE}")
        file.write(block)
        file.flush()
        received_bytes += len(block)
        if progress is not None:
            progress(received_bytes, size)


@contextlib.contextmanager
def _network_errors(url: str) -> Iterator[None]:
    """Raise an InputError in place of an error in the block, which talks to the server of `url`.

    One message is for an error that the server answers, another for a connection that fails.
    """
    try:
        yield
    except HTTPError as error:
        with error:  # closes the connection at the end
            name = responses.get(error.code, "")
            status = f"the server answers HTTP {error.code} {name}".rstrip()
        raise InputError(f"{url}: {status}: check the address, or try again later") from error
    # The library raises a ValueError for a text that is no address.
    except (OSError, HTTPException, ValueError) as error:
        reason = reason_in_a_line(error.reason if isinstance(error, URLError) else error)
        problem = f"no connection ({reason}): check address, network and https_proxy"
        raise InputError(f"{url}: {problem}, then {RETRY_ADVICE}") from error


def _start_of_answer(url: str, response: HTTPResponse, present_bytes: int, size: int) -> int:
    """Return the offset in the file at which a server's answer begins.

    Args:
        url: the address, for messages.
        response: the server's answer.
        present_bytes: the offset that was asked for.
        size: the size in bytes that the file must have.

    Returns:
        `present_bytes`, or 0 if the server sends the whole file.

    Raises:
        InputError: the answer is a web page, or the file has another size.
    """
    if response.headers.get_content_type() == "text/html":
        problem = "the server's answer is not a file"
        raise InputError(f"{url}: {problem}: check the address in a browser")

    start = 0
    # An answer without a length is taken to have the right one; the file's digest is checked later.
    total_bytes = size if response.length is None else response.length
    if response.status == PARTIAL_CONTENT:
        # "bytes FIRST-LAST/TOTAL"
        content_range = response.headers["Content-Range"] or ""
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", content_range)
        if match is not None and int(match[1]) == present_bytes:
            start = present_bytes
            total_bytes = int(match[2])

    if total_bytes != size:
        problem = f"the file has {total_bytes:,} bytes instead of {size:,}"
        raise InputError(f"{url}: {problem}: give another address")
    return start
