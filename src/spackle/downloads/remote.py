"""One request for a file on a web server: from its start, or from where an earlier one broke off."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Iterator
from http.client import HTTPException, HTTPResponse

from spackle.downloads.connect import Changed, Dropped, connect, reason_of
from spackle.errors import InputError, reason_in_a_line

BLOCK = 1 << 18  # bytes at most that are taken at once


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


@dataclasses.dataclass(frozen=True)
class Answer:
    """A file on its way."""

    version: Version
    start: int  # the byte of the file with which `blocks` begin
    blocks: Iterator[bytes]  # to the file's end, or as far as the server got


@contextlib.contextmanager
def ask(url: str, begun: Version | None = None, offset: int = 0) -> Iterator[Answer]:
    """Ask for a file, or for its bytes from `offset` on if it is still the version `begun`.

    Raises:
        Dropped: the server cannot be reached, or (from the blocks) the connection broke.
        Changed: the rest of `begun` cannot be had.
        InputError: the server does not give the file.
    """
    headers = {}
    if begun is not None and begun.validator is not None:
        headers = {"Range": f"bytes={offset}-", "If-Range": begun.validator}
    with connect(url, headers) as response:
        yield _answer(response, url, begun, offset)


def _answer(response: HTTPResponse, url: str, begun: Version | None, offset: int) -> Answer:
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
        return Answer(rest, offset, _blocks(response, rest.size - offset))
    size = response.length
    if not size:
        problem = "is empty there" if size == 0 else "comes without its length, so a part could pass for the whole"
        raise InputError(f"{url}: the file {problem}: give another address")
    version = Version(url, size, response.headers["ETag"], response.headers["Last-Modified"])
    return Answer(version, 0, _blocks(response, size))


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
            block = response.read1(min(BLOCK, left))  # what is there: read() would lose it where the rest fails
        except (OSError, HTTPException) as error:
            raise Dropped(reason_of(error), begun=True) from error
        if not block:
            raise Dropped(f"the connection ended {left:,} bytes early", begun=True)
        left -= len(block)
        yield block
