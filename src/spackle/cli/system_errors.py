"""What a command says, in one line, if memory, a disk or a pipe fails."""

from __future__ import annotations

import errno

from spackle.runtime.errors import is_memory_shortage, reason_in_a_line

MEMORY_ADVICE = "close other programs, or give something smaller"

# What happens to the standard output: nobody reads it any more, or its disk is full.
OUTPUT_ERRORS = (errno.EPIPE, errno.ENOSPC, errno.EDQUOT)


def problem_of_system(error: BaseException) -> str | None:
    """The line about a failure of the system that no part of Spackle has put into words.

    None for any other exception: it is a fault of Spackle, whose traceback the user can report.
    """
    if is_memory_shortage(error):
        return _memory_problem(error)
    if not isinstance(error, OSError):
        return None

    reason = reason_in_a_line(error)
    if error.filename is not None:
        return f"{_name_of(error.filename)}: cannot be read or written: {reason}"
    # Files that are written have a name, so without one it is the standard output that is full.
    if error.errno in OUTPUT_ERRORS:
        return f"cannot write to the standard output: {reason}"
    return f"a file cannot be read or written: {reason}"


def _memory_problem(error: BaseException) -> str:
    """The line about a shortage of memory; NumPy says how much was asked for."""
    reason = reason_in_a_line(error)
    has_reason = isinstance(error, MemoryError) and str(error) != ""
    amount = f" ({reason})" if has_reason else ""
    return f"not enough memory{amount}: {MEMORY_ADVICE}"


def _name_of(filename: object) -> str:
    """A file's name as an exception has it: a text, bytes, or a file's number."""
    if isinstance(filename, bytes):
        return filename.decode(errors="replace")
    return str(filename)
