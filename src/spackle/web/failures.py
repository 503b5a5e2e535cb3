"""What clients learn of work that failed: a status, and a line without names of folders."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator

from starlette.exceptions import HTTPException

from spackle.runtime.errors import InputError, printable_line, reason_in_a_line
from spackle.runtime.task_process import TaskFailure, machine_fault

RETRY_AFTER_S = 10  # seconds after which a client may try again if the queue was full
# The folders of an absolute path, on any system, but not the middle of an address or a fraction.
FOLDERS = re.compile(r"(?<![\w.:/\\…-])(?:[A-Za-z]:)?(?:[/\\][^\s/\\:*?\"'<>|]+)*[/\\](?=[^\s/\\])")


def without_folders(line: str) -> str:
    """The line with the last part alone of each absolute path: "/home/a/b.png: …" → "b.png: …".

    Where the scenes of a server lie is nobody's business.
    """
    return FOLDERS.sub("", line)


def full_queue(what: str) -> HTTPException:
    """The refusal when too many photos or files wait, which says when to ask again."""
    return HTTPException(
        429,
        f"too many {what} are waiting: try again in {RETRY_AFTER_S} seconds",
        {"Retry-After": str(RETRY_AFTER_S)},
    )


def refusal_of(failure: TaskFailure, input_status: int) -> HTTPException:
    """The answer to a client whose file was not decoded, or not made.

    Args:
        failure: the reason.
        input_status: the status if what the client has sent, or asked for, is the reason.
    """
    line = printable_line(without_folders(failure.line))
    if failure.kind == "machine":
        return no_space(failure.line)
    if failure.kind == "cancelled":
        return HTTPException(404, "this scene has been deleted")
    return HTTPException(500 if failure.kind == "bug" else input_status, line)


def no_space(reason: str) -> HTTPException:
    """The answer if this machine's disk is full or broken: nothing is wrong with the request."""
    return HTTPException(
        507,
        f"the server cannot store this now ({without_folders(reason)}): try again later",
        {"Retry-After": str(RETRY_AFTER_S)},
    )


@contextlib.contextmanager
def as_no_space() -> Iterator[None]:
    """Turn errors of a full or broken disk in the block into an HTTPException 507."""
    try:
        yield
    except (OSError, InputError) as error:
        fault = machine_fault(error)
        if fault is None:
            raise
        raise no_space(reason_in_a_line(fault)) from error
