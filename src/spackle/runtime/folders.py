"""Folders for results: creation, locks, and sets of files that belong together.

Two runs never write into one folder, and a killed run leaves a whole set of files or none.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import filelock

from spackle.runtime.errors import InputError, as_input_error, reason_in_a_line
from spackle.runtime.files import check_writable, remove_half_written

LOCK_NAME = ".lock"  # the file in a folder for results that a run locks
NEW_SET_NAME = ".new"  # the folder in which a new set of files is written


def make_folder(path: Path) -> None:
    """Create a folder for results if it is missing.

    Raises:
        InputError: the folder cannot be created or written.
    """
    problem = "cannot create this output folder: {reason}; choose another `output`"
    with as_input_error(path, problem, OSError, ValueError):
        path.mkdir(parents=True, exist_ok=True)
    # Another run may have removed the folder just now; that is no reason to refuse it.
    if not os.access(path, os.W_OK | os.X_OK) and path.exists():
        raise InputError(f"{path}: this output folder is not writable; choose another `output`")


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Lock the file `path` during the block; the lock of a killed process is released.

    Raises:
        InputError: another process has locked the file, the file cannot be created, or the file
            system has no locks.
    """
    lock = filelock.FileLock(
        path,
        thread_local=False,  # a server may release it in another thread
        fallback_to_soft=False,  # a mere file as a lock would outlive a killed process
    )
    # The run that held the lock before may delete the file, or even the empty folder, between the
    # steps below; then they are tried again.
    while not lock.is_locked:
        make_folder(path.parent)
        try:
            lock.acquire(timeout=0)
        except FileNotFoundError:
            continue
        except filelock.Timeout:
            if path.exists():
                raise InputError(
                    f"{path.parent}: another run is at work in this folder: "
                    "wait for its end, end it, or choose another `output`"
                ) from None
        except OSError as error:
            raise InputError(f"{path}: cannot lock: {reason_in_a_line(error)}") from error
    try:
        yield
    finally:
        # The file is deleted before it is unlocked, because afterwards another run may have locked
        # it, and a third one would then lock a new file of the same name.
        with contextlib.suppress(OSError):
            path.unlink()
        lock.release()


@contextlib.contextmanager
def results_folder(
    path: Path, files: Sequence[str] = (), *, locked: bool = False
) -> Iterator[None]:
    """Create a folder for results; remove it again if the block writes no file into it.

    Args:
        path: the folder. Temporary files that killed runs left in it for `files` are deleted.
        files: names of files that the block will write.
        locked: let no other process use the folder during the block.

    Raises:
        InputError: `files` cannot be written, or another process has locked the folder.
    """
    # The folder and its parents, as far as they do not exist yet, from the innermost outwards.
    missing_folders = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        with contextlib.ExitStack() as stack:
            make_folder(path)
            if locked:
                stack.enter_context(file_lock(path / LOCK_NAME))
            for name in files:
                check_writable(path / name)
            # A temporary file that cannot be deleted is no reason to refuse the work.
            with contextlib.suppress(OSError):
                remove_half_written(path, files=files)
            yield
    finally:
        # Remove what was created, if it is still empty: a folder with files raises an OSError.
        for folder in missing_folders:
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextlib.contextmanager
def atomic_files(folder: Path, last: str) -> Iterator[Path]:
    """Yield a new folder for a set of files; if the block succeeds, they replace those in `folder`.

    The caller must have locked `folder`.

    Args:
        folder: where the set belongs.
        last: name of one file of the set. An old one is deleted before the other files are
            replaced, and the new one comes last, so that its presence means a complete set.

    Raises:
        InputError: the files cannot be written or moved.
    """
    new_folder = folder / NEW_SET_NAME
    try:
        with as_input_error(new_folder, "cannot write: {reason}", OSError):
            if new_folder.exists():  # from a killed run
                shutil.rmtree(new_folder)
            new_folder.mkdir()
        yield new_folder

        with as_input_error(folder, "cannot write: {reason}", OSError):
            _move_files(new_folder, folder, last)
    finally:
        shutil.rmtree(new_folder, ignore_errors=True)


def _move_files(new_folder: Path, folder: Path, last: str) -> None:
    """Move all files below `new_folder` to the same places in `folder`.

    `last` is the name of the file that comes last; an old one is deleted first.
    """
    (folder / last).unlink(missing_ok=True)
    files = [file for file in sorted(new_folder.rglob("*")) if file.is_file()]
    names = [file.relative_to(new_folder) for file in files]
    names.sort(key=lambda name: name == Path(last))  # True sorts last, so `last` comes last
    for name in names:
        os.replace(new_folder / name, folder / name)
