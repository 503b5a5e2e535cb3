"""Folders for results: made, checked and held before long work, and left without half-written files."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from spackle.downloads import hold
from spackle.downloads.transfer import digest
from spackle.errors import InputError
from spackle.formats import atomic_path, check_writable

LOCK, NEW = ".lock", ".new"
LEFTOVER = re.compile(r"\.(.+)\.[0-9a-f]{12}(\.\w+)")  # how `atomic_path` calls its temporary files


@contextlib.contextmanager
def results_folder(path: Path, files: Sequence[str] = (), *, alone: bool = False) -> Iterator[None]:
    """Create a folder for results; where the block puts nothing into it, it goes again.

    The block writes `files`: InputError before long work if it cannot. Deletes what a killed run left of them. With
    `alone` nobody else works in the folder during the block: InputError if somebody does.
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
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the kernel takes from a killed run."""
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
            raise InputError(f"{folder / LOCK}: cannot write: {error.strerror or error}") from error
        yield


def mark(folder: Path) -> str:
    """Mark a folder that the caller is `alone` in, until then; `check_mark` knows it again on another machine."""
    word = secrets.token_hex(8)
    (folder / LOCK).write_text(word)
    return word


def check_mark(folder: Path, word: str) -> None:
    """InputError where `folder` is not the one that was given this mark."""
    try:
        if (folder / LOCK).read_text() == word:
            return
    except (OSError, ValueError):
        pass
    raise InputError(f"{folder}: not this command's folder for results: it must lie on a disk that all nodes share")


@contextlib.contextmanager
def whole_set(folder: Path, last: str) -> Iterator[Path]:
    """Yield a new folder for a set of files; where the block succeeds, they take their places in `folder`.

    Where it raises, an older set stays as it was. The file `last` vouches for the others, so that it leaves first and
    comes last. The caller is `alone` there (`results_folder`).
    """
    new = folder / NEW
    try:
        try:
            if os.path.lexists(new):  # of a killed run
                shutil.rmtree(new)
            new.mkdir()
        except OSError as error:
            raise InputError(f"{new}: cannot write: {error.strerror or error}") from error
        yield new
        (folder / last).unlink(missing_ok=True)
        files = [file.relative_to(new) for file in sorted(new.rglob("*")) if file.is_file()]
        for name in sorted(files, key=lambda name: name == Path(last)):
            os.replace(new / name, folder / name)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def file_records(folder: Path, files: Iterable[Path]) -> dict[str, dict[str, object]]:
    """Bytes and SHA-256 of files in a folder, by name, for a report that vouches for them."""
    records: dict[str, dict[str, object]] = {}
    for path in files:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            records[path.relative_to(folder).as_posix()] = {"bytes": size, "sha256": digest(file).hexdigest()}
    return records


def as_recorded(folder: Path, report: str, records: object) -> bool:
    """Whether a folder still holds the files that a report in it vouches for by `file_records`.

    Size and times tell; a file that is newer than the report, as in a copied folder, is read.
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


def remove_half_written(*folders: Path, files: Sequence[str] | None = None) -> None:
    """Delete what killed runs left of `files`; of any file if None, where the caller is `alone`."""
    for folder in folders:
        for file in folder.iterdir():
            match = LEFTOVER.fullmatch(file.name)
            if match and (files is None or match[1] + match[2] in files):
                file.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Create a folder for results, or check that it can be written to; InputError where it cannot."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot create this output folder: {reason}; choose another with -o") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: this output folder is not writable; choose another with -o")


def write_report(report: dict[str, Any], path: Path) -> None:
    """Write a report as JSON, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
