"""Files: checked before they are read, written whole or not at all, and recognised by their digests."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from spackle.errors import InputError, reading, reason_in_a_line

LEFTOVER = re.compile(r"\.(.+)\.[0-9a-f]{12}(\.\w+)")  # pattern of the temporary names that `atomic_path` gives
MAX_HASHED = 200_000_000  # bytes; a larger file is recognised by its size and modification time
BLOCK = 1 << 20  # bytes that are hashed at once


def check_file(path: str | os.PathLike[str], kind: str) -> int:
    """Return the size in bytes of a plain, non-empty file; for anything else raise an InputError that names `kind`."""
    with reading(repr(str(path)), "cannot be read: {reason}", OSError, ValueError):
        if not os.path.exists(path):
            raise InputError(f"{path}: no such {kind}: check the name")
        if not os.path.isfile(path):
            raise InputError(f"{path}: not a plain file: give the name of a {kind}")
        size = os.path.getsize(path)
        with open(path, "rb"):
            pass
    if size == 0:
        raise InputError(f"{path}: the file is empty: give another {kind}")
    return size


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name in the same folder; rename the file to `path` if the block succeeds.

    If the block raises, the temporary file is deleted and an older file at `path` is kept. The temporary name has the
    suffix of `path`, because some writers choose a format by the suffix.

    Raises:
        InputError: the file cannot be written, or the disk fills up.
    """
    target = check_writable(path)
    temporary = target.with_name(f".{target.stem[:50]}.{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        if error.filename not in (None, str(temporary)):
            raise  # the error concerns another file, such as an input that the block reads
        raise InputError(f"{path}: cannot write: {reason_in_a_line(error)}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


Target = str | os.PathLike[str] | BinaryIO  # a path, or a file that is open for writing bytes


def write_whole(target: Target, content: bytes) -> None:
    """Write to a path, whole or not at all (see `atomic_path`), or to an open file."""
    if not isinstance(target, str | os.PathLike):
        target.write(content)
        return
    with atomic_path(target) as temporary:
        temporary.write_bytes(content)


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Check, before long work, that a file can be written; return its path with links resolved.

    Raises:
        InputError: the folder is missing or not writable, or `path` exists and is not a plain file.
    """
    with reading(repr(str(path)), "cannot write: {reason}", OSError, ValueError):
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file():
            kind = "a folder" if target.is_dir() else "not a plain file"
            raise InputError(f"{path}: cannot write: this is {kind}; give a file name")
        if not target.parent.is_dir():
            raise InputError(f"{path}: cannot write: the folder {target.parent} does not exist; create it first")
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise InputError(f"{path}: cannot write: the folder {target.parent} is not writable")
    return target


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write a JSON object, whole or not at all."""
    write_whole(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def files_in(folder: Path, endings: tuple[str, ...], *, below: bool = False) -> list[Path]:
    """List, sorted, a folder's visible files whose names end in one of `endings`; `below` adds those in subfolders."""
    with reading(folder, "cannot read the folder: {reason}", OSError):
        os.scandir(folder).close()
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if below and not name.startswith(".")]
        found += [Path(place) / name for name in names if name.lower().endswith(endings) and not name.startswith(".")]
    return sorted(file for file in found if file.is_file())


def sha256_of(file: BinaryIO) -> str:
    """SHA-256, in hexadecimal digits, of an open file from its current position on."""
    sha256 = hashlib.sha256()
    while block := file.read(BLOCK):
        sha256.update(block)
    return sha256.hexdigest()


def fingerprint(file: Path, kind: str) -> str:
    """A text that changes with the file; an InputError that names `kind` if the file is missing."""
    size = check_file(file, kind)
    if size > MAX_HASHED:
        return f"{size} bytes of {file.stat().st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()
