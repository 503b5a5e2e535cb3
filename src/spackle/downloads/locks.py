"""One at a time: a lock file that is free again when its holder ends, however it ends."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

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
    """Hold the lock file `path` during the block.

    The system keeps the lock, not the file's being there: one that a killed process left is free.

    Raises:
        BlockingIOError: somebody else holds it.
        OSError: the file cannot be created, or the file system has no locks.
    """
    file = _acquire(path)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows deletes no open file, and it may stay
            path.unlink()
        file.close()


def _acquire(path: Path) -> BinaryIO:
    while True:
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "ab"))
            _lock(file)
            # Its last holder may have removed it between these two steps: then what we hold has no name.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                    stack.pop_all()
                    return file
