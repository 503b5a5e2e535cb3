"""`InputError`, the one exception for bad input, and helpers for its messages."""

from __future__ import annotations

import contextlib
import difflib
import reprlib
from collections.abc import Iterable, Iterator
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 2, 60, 60


class InputError(ValueError):
    """Bad input from a user: one line that names the file or value, what is wrong and what to do."""


def reason_in_a_line(error: object) -> str:
    """The text of a library's exception, at most 200 characters, for the middle of a message."""
    if callable(getattr(error, "errors", None)):  # of pydantic
        return first_validation_problem(error)
    text = (
        getattr(error, "strerror", None) or error
    )  # the system's text, without error number and file name
    return printable_line(" ".join(str(text).split()))[:200] or type(error).__name__


def first_validation_problem(error: Any) -> str:
    """The key of the first value that pydantic refuses, and what the value must be."""
    first = error.errors()[0]
    if first["type"] == "extra_forbidden":
        problem = "there is no such key"
    else:
        message = first["msg"].removeprefix("Value error, ")
        quoted = first["type"] not in ("missing", "json_invalid", "too_long", "too_short")
        problem = (
            f"{message[0].lower()}{message[1:]}" + f", not {short_repr(first['input'])}" * quoted
        )
    return ": ".join(filter(None, (".".join(str(name)[:60] for name in first["loc"]), problem)))


@contextlib.contextmanager
def as_input_error(what: object, problem: str, *errors: type[Exception]) -> Iterator[None]:
    """Turn an exception that a library raises in the block into the InputError "{what}: {problem}".

    Args:
        what: subject of the message, usually the file that the block reads.
        problem: what is wrong and what to do; "{reason}" stands for the library's message.
        errors: exceptions that mean bad input; by default all, because untrusted bytes can raise any exception.
    """
    caught = errors or (Exception,)
    try:
        yield
    except InputError:
        raise
    except caught as error:
        raise InputError(
            f"{what}: {problem.replace('{reason}', reason_in_a_line(error))}"
        ) from error


@contextlib.contextmanager
def shorten_input_errors() -> Iterator[None]:
    """Shorten an InputError's message to 300 characters, because it may quote a program's values."""
    try:
        yield
    except InputError as error:
        message = str(error)
        if len(message) <= 300:
            raise
        raise InputError(f"{message[:148]} … {message[-148:]}") from error


def printable_line(text: str) -> str:
    """The text with control characters escaped, because file names can contain a terminal's escape codes."""
    line = " ".join(text.splitlines())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


def short_repr(value: object) -> str:
    """A value from a file, shortened to 60 characters, for the middle of a message."""
    return _SHORT.repr(value)[:60]


def check_name(option: str, name: str, known: Iterable[str]) -> None:
    """Raise an InputError for an unknown name; the message suggests the most similar known name.

    `option` is the Python name of the option whose value is `name`, such as "depth_kind".
    """
    names = list(known)
    if name in names:
        return
    near = difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.5)
    advice = f"did you mean {near[0]}? There" if near else "there"
    raise InputError(f"`{option}` {name} is unknown: {advice} are {', '.join(names)}")
