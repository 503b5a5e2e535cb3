"""Folders for results: made, checked and held before long work, and left without half-written files."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from spackle.downloads import hold
from spackle.errors import InputError
from spackle.formats import atomic_path, check_writable

LOCK = ".lock"
LEFTOVER = re.compile(r"\.(.+)\.[0-9a-f]{12}(\.\w+)")  # how `atomic_path` calls its temporary files


@contextlib.contextmanager
def results_folder(path: Path, files: Sequence[str] = ()) -> Iterator[None]:
    """Create a folder for results; where the block puts nothing into it, it goes again.

    Args:
        path: the folder.
        files: what the block is going to write there. That none of it can be is known at once rather
            than after long work, and what a killed run left of it half-written goes.

    Raises:
        InputError: where the folder cannot be created, or one of the files not be written.
    """
    missing = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        make_folder(path)
        for name in files:
            check_writable(path / name)
        _remove_leftovers(path, files)
        yield
    finally:
        for folder in missing:
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()


@contextlib.contextmanager
def alone_in(folder: Path, work: str) -> Iterator[None]:
    """Keep others out of a folder while the block works there: they would take each other's files away.

    Raises:
        InputError: somebody else is at work, or nothing can be written.
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(hold(folder / LOCK))
        except BlockingIOError as error:
            raise InputError(f"{folder}: another {work} is at work in this folder: wait for it, or end it") from error
        except OSError as error:
            raise InputError(f"{folder}: cannot write: {error.strerror or error}") from error
        yield


def remove_half_written(*folders: Path) -> None:
    """Delete what killed runs left of any file; for folders in which nobody else is at work (see `alone_in`)."""
    for folder in folders:
        for file in folder.iterdir():
            if LEFTOVER.fullmatch(file.name):
                file.unlink(missing_ok=True)


def _remove_leftovers(folder: Path, files: Sequence[str]) -> None:
    """Delete temporary files of these names; others may belong to a run that is still at work."""
    wanted = set(files)
    with contextlib.suppress(OSError):
        for file in folder.iterdir():
            match = LEFTOVER.fullmatch(file.name)
            if match and match[1] + match[2] in wanted:
                file.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Create a folder for results, or check that it can be written to.

    Raises:
        InputError: where it cannot.
    """
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
