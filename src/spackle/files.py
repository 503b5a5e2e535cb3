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

LEFTOVER = re.compile(r"\.(.+)\.[0-9a-f]{12}(\.\w+)")  # how `atomic_path` names its temporary files
MAX_HASHED = 200_000_000  # bytes of the largest file that is hashed to tell whether it has changed
BLOCK = 1 << 20  # bytes of a file that are hashed at once


def check_file(path: str | os.PathLike[str], kind: str) -> int:
    """The size in bytes of a plain, non-empty file; InputError otherwise. Messages call the file `kind`."""
    with reading(repr(str(path)), "cannot be read: {reason}", OSError, ValueError):
        if re.match(r"(https?|ftp|s3|gs):/", str(path)):  # a Path has lost the second slash
            address = re.sub(":/+", "://", str(path), count=1)
            raise InputError(f"{address}: an address, not a file: download it first and give the name of the {kind}")
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
def atomic_path(path: str | os.PathLike[str], *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary name in the same folder; rename it to `path` if the block succeeds.

    If the block raises, the temporary file is deleted and an older file at `path` is kept. The
    temporary name keeps the suffix, because some writers choose a format by it. Only a
    `durable` file is synced to the disk: without that, files survive a killed process, but maybe not a power cut.

    Raises:
        InputError: the file cannot be written, or the disk fills up.
    """
    target = check_writable(path)
    stem = os.fsdecode(os.fsencode(target.stem)[:100]) if len(os.fsencode(target.stem)) > 100 else target.stem
    temporary = target.with_name(f".{stem}.{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        if durable:
            _sync(temporary)
        os.replace(temporary, target)
        if durable and os.name == "posix":
            _sync(target.parent)  # for the file's name
    except OSError as error:
        if error.filename not in (None, str(temporary)):
            raise  # about another file, such as an input that the block reads
        raise InputError(f"{path}: cannot write: {reason_in_a_line(error)}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file whole or not at all; see `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


Target = str | os.PathLike[str] | BinaryIO  # where a result goes: a path, or a file that is open for writing bytes


def write_bytes(content: bytes, target: Target) -> None:
    """Write to a path, whole or not at all, or to an open file."""
    if isinstance(target, str | os.PathLike):
        write_whole(target, content)
    else:
        target.write(content)


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Check that `path` can be written; returns the path with its links resolved.

    Call it before long work whose result goes there.

    Raises:
        InputError: the folder is missing or not writable, or `path` exists and is not a plain file
            (replacing /dev/null would be a surprise).
    """
    # Errors for a name that is too long or has a zero byte, and for a loop of links.
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


def write_json(content: Mapping[str, Any], path: Path, *, durable: bool = False) -> None:
    """Write a JSON object, whole or not at all; see `atomic_path`."""
    with atomic_path(path, durable=durable) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def files_in(folder: Path, endings: tuple[str, ...], *, below: bool = False) -> list[Path]:
    """The files in a folder whose names end in one of `endings`, in any case; with `below` also in subfolders.

    Sorted; hidden files are left out. InputError if the folder cannot be read.
    """
    with reading(folder, "cannot read the folder: {reason}", OSError):
        os.scandir(folder).close()
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if below and not name.startswith(".")]
        found += [Path(place) / name for name in names if name.lower().endswith(endings) and not name.startswith(".")]
    return sorted(file for file in found if file.is_file())


def sha256_of(file: BinaryIO) -> str:
    """SHA-256 of the rest of an open file, as 64 hexadecimal digits."""
    sha256 = hashlib.sha256()
    while block := file.read(BLOCK):
        sha256.update(block)
    return sha256.hexdigest()


def fingerprint(file: Path, kind: str) -> str:
    """The digest of a file's content, or for a large file its size and modification time; InputError (naming `kind`)
    if it is missing.
    """
    size = check_file(file, kind)
    if size > MAX_HASHED:
        return f"{size} bytes of {file.stat().st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()
