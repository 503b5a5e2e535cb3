"""The one exception that means "your input, not our bug"."""

from __future__ import annotations

import contextlib
import difflib
import functools
import reprlib
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

LONGEST = 300  # characters of a message
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 2, 60, 60


class InputError(ValueError):
    """Bad input from a person: the message names the file or value, what is wrong and what to do.

    The command line prints the message as one line and exits with code 2.
    """


def reason_in_a_line(error: object) -> str:
    """The text of a library's exception, at most 200 characters, for the middle of a message."""
    said = getattr(error, "strerror", None) or error  # the system's words, without its number and the file's name
    return one_line(" ".join(str(said).split()))[:200] or type(error).__name__


@contextlib.contextmanager
def reading(what: object, problem: str, *errors: type[Exception]) -> Iterator[None]:
    """Turn what a library raises in the block into the InputError "{what}: {problem}".

    Args:
        what: the file that is read, or what else the message is about.
        problem: what is wrong and what to do; "{reason}" in it becomes what the library says.
        errors: types that mean bad input; by default every exception, as a stranger's bytes can raise anything.
            An InputError passes as it is.
    """
    caught = errors or (Exception,)
    try:
        yield
    except InputError:
        raise
    except caught as error:
        raise InputError(f"{what}: {problem.replace('{reason}', reason_in_a_line(error))}") from error


def one_line(text: str) -> str:
    """A text without control characters, safe for a terminal or a log: names of files can hold escape codes."""
    line = " ".join(text.splitlines())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


def shown(value: object) -> str:
    """A value from a file, at most 60 characters of it, for the middle of a message."""
    return _SHORT.repr(value)[:60]


def renamed(**names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a function take arguments by the names that they had in the release before, with a DeprecationWarning."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def called(*arguments: P.args, **named: P.kwargs) -> R:
            for old, new in names.items():
                if old in named:
                    warnings.warn(f"{function.__name__}({old}=) is called {new}= now", DeprecationWarning, stacklevel=2)
                    named[new] = named.pop(old)
            return function(*arguments, **named)

        return called

    return decorate


@contextlib.contextmanager
def short_messages() -> Iterator[None]:
    """Leave the middle out of messages of more than 300 characters, which can quote values of a program."""
    try:
        yield
    except InputError as error:
        message, half = str(error), LONGEST // 2 - 2
        if len(message) <= LONGEST:
            raise
        raise InputError(f"{message[:half]} … {message[-half:]}") from error


def check_name(option: str, name: str, known: Iterable[str]) -> None:
    """Raise InputError for an unknown name, and name the nearest known one."""
    names = list(known)
    if name in names:
        return
    near = difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.5)
    advice = f"did you mean {near[0]}? There" if near else "there"
    raise InputError(f"{option} {name}: unknown: {advice} are {', '.join(names)}")
