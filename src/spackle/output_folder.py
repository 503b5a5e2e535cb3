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

    The block writes `files`: InputError before long work if it cannot. Deletes what a killed run left of them.
    """
    missing = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        make_folder(path)
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
def alone_in(folder: Path, work: str) -> Iterator[None]:
    """Keep others out of a folder while the block works there; InputError if somebody is, or it cannot be written."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(hold(folder / LOCK))
        except BlockingIOError as error:
            raise InputError(f"{folder}: another {work} is at work in this folder: wait for it, or end it") from error
        except OSError as error:
            raise InputError(f"{folder}: cannot write: {error.strerror or error}") from error
        yield


def remove_half_written(*folders: Path, files: Sequence[str] | None = None) -> None:
    """Delete what killed runs left of `files`; of any file if None, where nobody else is at work (see `alone_in`)."""
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
