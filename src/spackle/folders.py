"""Folders for results: locked by one run, filled with complete sets of files, recognised by digests."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from spackle.errors import InputError, reading, reason_in_a_line
from spackle.files import LEFTOVER, check_writable, fingerprint, sha256_of

LOCK, NEW = ".lock", ".new"

if sys.platform == "win32":
    import msvcrt

    def _lock(file: BinaryIO) -> None:
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError as error:
            raise BlockingIOError(*error.args) from error
else:
    import fcntl

    def _lock(file: BinaryIO) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def hold(path: Path) -> Iterator[None]:
    """Lock the file `path` during the block; a killed process leaves it unlocked.

    Raises:
        BlockingIOError: another process has locked it.
        OSError: the file cannot be created, or the file system has no locks.
    """
    file = _acquire(path)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows deletes no open file; the lock file may stay
            path.unlink()
        file.close()


def _acquire(path: Path) -> BinaryIO:
    while True:
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "ab"))
            _lock(file)
            # Its last holder may have deleted it between these two steps: then we have locked a file without a name.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                    stack.pop_all()
                    return file


@contextlib.contextmanager
def results_folder(path: Path, files: Sequence[str] = (), *, alone: bool = False) -> Iterator[None]:
    """Create a folder for results; it is removed if the block leaves it empty.

    InputError, before any long work, if the `files` of the block cannot be written. Temporary files that a killed run
    left are deleted. `alone` locks the folder during the block; InputError if another run has locked it.
    """
    missing = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        with contextlib.ExitStack() as stack:
            make_folder(path)
            if alone:
                stack.enter_context(_alone_in(path))
            for name in files:
                check_writable(path / name)
            with contextlib.suppress(OSError):
                remove_half_written(path, files=files)
            yield
    finally:
        for folder in missing:
            with contextlib.suppress(OSError):  # it is not empty
                folder.rmdir()


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Lock the folder during the block; the kernel frees the lock of a killed run."""
    with contextlib.ExitStack() as stack:
        try:
            while True:
                with contextlib.suppress(FileNotFoundError):  # another run has just removed the empty folder
                    stack.enter_context(hold(folder / LOCK))
                    break
                make_folder(folder)
        except BlockingIOError as error:
            raise InputError(
                f"{folder}: another run is at work in this folder: wait for it, end it, or choose another with -o"
            ) from error
        except OSError as error:
            raise InputError(f"{folder / LOCK}: cannot write: {reason_in_a_line(error)}") from error
        yield


@contextlib.contextmanager
def whole_set(folder: Path, last: str) -> Iterator[Path]:
    """Yield a new folder for a set of files; if the block succeeds, the files move to `folder`.

    If it raises, an older set is kept. The presence of the file `last` means that the others are complete, so it is
    deleted first and moved last. The caller must have locked the folder (`alone`), see `results_folder`.
    """
    new = folder / NEW
    try:
        with reading(new, "cannot write: {reason}", OSError):
            if os.path.lexists(new):  # left by a killed run
                shutil.rmtree(new)
            new.mkdir()
        yield new
        (folder / last).unlink(missing_ok=True)
        files = [file.relative_to(new) for file in sorted(new.rglob("*")) if file.is_file()]
        for name in sorted(files, key=lambda name: name == Path(last)):
            os.replace(new / name, folder / name)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def file_records(folder: Path, files: Iterable[Path]) -> dict[str, dict[str, object]]:
    """Size in bytes and SHA-256 of files in a folder, by name, for a report."""
    records: dict[str, dict[str, object]] = {}
    for path in files:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            records[path.relative_to(folder).as_posix()] = {"bytes": size, "sha256": sha256_of(file)}
    return records


def as_recorded(folder: Path, report: str, records: object) -> bool:
    """Whether a folder still holds the files that a report lists with their `file_records`.

    Sizes and times are compared; a file newer than the report, as in a copied folder, is read.
    """
    if not isinstance(records, Mapping) or not records:
        return False
    try:
        written = (folder / report).stat().st_mtime_ns
        for name, record in records.items():
            facts = (folder / name).stat()
            newer = max(facts.st_mtime_ns, facts.st_ctime_ns) > written
            if facts.st_size != record["bytes"] or (newer and file_records(folder, [folder / name])[name] != record):
                return False
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return True


def photo_digest(path: Path) -> str:
    """The digest of a photo; "none" if it is missing, which is reported when its turn comes."""
    with contextlib.suppress(InputError):
        return fingerprint(path, "photo")
    return "none"


def remove_half_written(*folders: Path, files: Sequence[str] | None = None) -> None:
    """Delete the temporary files that killed runs left for `files`; None: for any file, in locked folders."""
    for folder in folders:
        for file in folder.iterdir():
            match = LEFTOVER.fullmatch(file.name)
            if match and (files is None or match[1] + match[2] in files):
                file.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Create a folder for results, or check that it is writable; InputError if this is impossible."""
    with reading(path, "cannot create this output folder: {reason}; choose another with -o", OSError, ValueError):
        path.mkdir(parents=True, exist_ok=True)
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: this output folder is not writable; choose another with -o")


def digest_of(value: object) -> str:
    """SHA-256 of a value as JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def differences(old: Mapping[str, Any], new: Mapping[str, Any], where: str = "") -> list[str]:
    """The differences of two configurations, as "key: old -> new"."""

    def short(value: object) -> str:
        text = json.dumps(value)
        return text if len(text) <= 40 else text[:12] + "…"

    found: list[str] = []
    for key in sorted({*old, *new}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            found += differences(a, b, f"{where}{key}.")
        elif a != b:
            found.append(f"{where}{key}: {short(a)} -> {short(b)}")
    return found
