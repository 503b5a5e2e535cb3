"""Whole files or none: written beside their name, renamed into place."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from spackle.errors import InputError


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str], *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary name in the same folder; rename it to `path` where the block succeeds.

    Where the block raises, the temporary file goes and an older file at `path` stays as it was. The
    temporary name keeps the suffix, because some writers choose a format by it. Only a
    `durable` file is synced to the disk: a killed process leaves whole files, a power cut need not.

    Raises:
        InputError: where nothing can be written there, or the disk fills up.
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
            _sync(target.parent)  # its name, too
    except OSError as error:
        if error.filename not in (None, str(temporary)):
            raise  # about another file, such as an input that the block reads
        raise InputError(f"{path}: cannot write: {error.strerror or error}") from error
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


def check_writable(path: str | os.PathLike[str]) -> Path:
    """The file that a write to `path` would replace, links followed.

    Worth calling before long work whose result goes there.

    Raises:
        InputError: where the folder is missing or closed to us, or the name is taken by something
            that is not a plain file (replacing /dev/null would be a surprise).
    """
    try:
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file():
            kind = "a folder" if target.is_dir() else "not a plain file"
            raise InputError(f"{path}: cannot write: this is {kind}; give a file name")
        if not target.parent.is_dir():
            raise InputError(f"{path}: cannot write: the folder {target.parent} does not exist; create it first")
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise InputError(f"{path}: cannot write: the folder {target.parent} is not writable")
    except (OSError, ValueError) as error:  # a name too long, a zero byte in it, a loop of links
        if isinstance(error, InputError):
            raise
        raise InputError(f"{str(path)!r}: cannot write: {error}") from error
    return target
