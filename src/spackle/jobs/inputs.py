"""Which files a command means, and where its results go."""

from __future__ import annotations

import contextlib
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from spackle.downloads.locks import hold
from spackle.errors import InputError
from spackle.formats import check_writable
from spackle.image import PHOTO_SUFFIXES

LOCK = ".lock"
LEFTOVER = re.compile(r"\.(.+)\.[0-9a-f]{12}(\.\w+)")  # how `atomic_path` calls its temporary files


def find_photos(path: Path) -> list[tuple[Path, str]]:
    """A photo, or the photos of a folder in order of their names, each with the name of its results.

    Raises:
        InputError: nothing there, or a folder without photos.
    """
    if not os.path.isdir(path):
        return [(path, path.stem if path.stem.strip(".") else path.name)]  # "...png" has the stem ".."
    try:
        files = (p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
        photos = sorted(p for p in files if p.suffix.lower() in PHOTO_SUFFIXES)
    except OSError as error:
        raise InputError(f"{path}: cannot read the folder: {error.strerror}") from error
    if not photos:
        raise InputError(f"{path}: no photos in this folder (looked for {', '.join(PHOTO_SUFFIXES)})")
    # a.jpg and a.png must not write over each other, nor over a.jpg.png.
    stems = Counter(photo.stem.casefold() for photo in photos)
    names = {photo.name.casefold() for photo in photos}
    taken = {stem for stem, count in stems.items() if count > 1 or stem in names}
    return [(photo, photo.name if photo.stem.casefold() in taken else photo.stem) for photo in photos]


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
