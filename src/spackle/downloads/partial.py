"""A download as far as it got: NAME.part, and beside it what remote file that is the beginning of."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from spackle.downloads.connect import Changed, Dropped
from spackle.downloads.remote import Answer, Version, ask
from spackle.errors import InputError

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
    begun = _begun(url, part)
    offset = part.stat().st_size if begun else 0
    if begun and offset == begun.size:  # killed before it was given its name
        with open(part, "rb") as file:
            return offset, digest(file).hexdigest()
    with ask(url, begun, offset) as answer:
        _check_room(answer, part)  # first: a file that is refused leaves nothing
        if answer.start == 0:
            forget(part)
            part.touch()
            write_json(dataclasses.asdict(answer.version), version_file(part))
        return _append(answer, part, progress)


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


def _check_room(answer: Answer, part: Path) -> None:
    usage = shutil.disk_usage(part.parent)
    needed, free = answer.version.size - answer.start, usage.free
    if answer.start == 0 and part.exists():  # it makes way
        free += part.stat().st_size
    if usage.total and free < needed:  # some network folders say 0 of 0
        gigabytes = f"{needed / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free"
        raise InputError(f"{part.parent}: {gigabytes}: make room or choose another folder")


def _append(answer: Answer, part: Path, progress: Progress) -> tuple[int, str]:
    size, done = answer.version.size, answer.start
    with open(part, "r+b") as file:
        sha256 = digest(file)
        progress(done, size)
        for block in answer.blocks:
            file.write(block)
            file.flush()
            sha256.update(block)
            done += len(block)
            progress(done, size)
        os.fsync(file.fileno())  # the file's name will promise that it is whole
    return done, sha256.hexdigest()


def digest(file: BinaryIO) -> hashlib._Hash:
    """SHA-256 of the rest of an open file."""
    sha256 = hashlib.sha256()
    while block := file.read(BLOCK):
        sha256.update(block)
    return sha256


def read_json(path: Path) -> dict[str, Any] | None:
    """The fields in a file; None where there is no file, or something else in it.

    Raises:
        ValueError: this is no JSON, or none that we can read.
        OSError: it cannot be read.
    """
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
