"""`InputError`, the one exception for bad input, and helpers for its messages; `Cancelled`."""

from __future__ import annotations

import contextlib
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

from spackle.runtime.suggestions import closest_name, closest_suffix, question

Result = TypeVar("Result")

MAX_MESSAGE_LENGTH = 300  # characters of a message that may quote a program's values
MAX_REASON_LENGTH = 200  # characters of a library's message that ours quotes
MAX_VALUE_LENGTH = 60  # characters of a value that a message quotes

# Torch reports a shortage of memory by RuntimeErrors, whose messages contain one of these phrases.
SHORTAGE_PHRASES = (
    "DefaultCPUAllocator",
    "not enough memory",
    "allocate memory",
    "out of memory",
    "_ALLOC_FAILED",
)

_value_repr = reprlib.Repr()
_value_repr.maxlevel = 2  # of nested lists and dictionaries
_value_repr.maxstring = MAX_VALUE_LENGTH
_value_repr.maxother = MAX_VALUE_LENGTH


class InputError(ValueError):
    """Bad input from a user; its text is a line that says what is wrong and what to do."""


class NotEnoughMemory(InputError):
    """Too little memory was free; a later attempt may succeed."""


class Cancelled(Exception):
    """The end of work that the caller's `cancel` has asked for; nothing half-written is left."""


def is_memory_shortage(error: BaseException | None) -> bool:
    """Whether an exception of Python, NumPy or torch means that the memory is too small."""
    if isinstance(error, MemoryError):
        return True
    # Judged by the text, because those who ask shall not have to load torch.
    is_known_phrase = any(phrase in str(error) for phrase in SHORTAGE_PHRASES)
    return isinstance(error, RuntimeError) and is_known_phrase


def reason_in_a_line(error: object) -> str:
    """The text of a library's exception, at most 200 characters, for the middle of a message."""
    is_pydantic = callable(getattr(error, "errors", None))
    if is_pydantic:
        return first_validation_problem(error)
    # An error of the operating system also has a text without error number and file name, which is
    # better here, because the caller's message names the file.
    text = str(getattr(error, "strerror", None) or error)
    without_line_breaks = " ".join(text.split())
    return printable_line(without_line_breaks)[:MAX_REASON_LENGTH] or type(error).__name__


def first_validation_problem(error: Any) -> str:
    """The key of the first value that pydantic refuses, and what the value must be.

    For example "optim.steps: input should be greater than 0, not -1".

    Args:
        error: pydantic's ValidationError, or FastAPI's RequestValidationError.
    """
    first = error.errors()[0]
    if first["type"] == "extra_forbidden":
        problem = "there is no such key"
    else:
        # Pydantic puts this prefix before the message of a validator of our own.
        message = first["msg"].removeprefix("Value error, ")
        problem = f"{message[0].lower()}{message[1:]}"
        # In these cases, pydantic's "input" is the whole object instead of the refused value.
        if first["type"] not in ("missing", "json_invalid", "too_long", "too_short"):
            problem += f", not {short_repr(first['input'])}"
        if first["type"] == "literal_error":
            problem += _suggested_value(first)

    key = ".".join(str(name)[:MAX_VALUE_LENGTH] for name in first["loc"])
    return f"{key}: {problem}" if key else problem


def _suggested_value(problem: Any) -> str:
    """A question such as ": did you mean resnet50?" about a text that is none of a few values.

    It is empty if no value is similar. `problem` is an entry of pydantic's list of errors.
    """
    # Pydantic gives the values as a text: "'resnet50', 'squeezenet' or 'none'".
    values = re.findall(r"'([^']*)'", problem["ctx"]["expected"])
    return question(closest_name(str(problem["input"]), values))


@contextlib.contextmanager
def as_input_error(what: object, problem: str, *errors: type[Exception]) -> Iterator[None]:
    """Turn an exception that a library raises in the block into the InputError "{what}: {problem}".

    Args:
        what: subject of the message, usually the file that the block reads.
        problem: what is wrong and what to do; the text "{reason}" in it is replaced by the
            library's message.
        errors: exceptions that mean bad input; by default all, because libraries that decode
            untrusted bytes can raise any exception.
    """
    bad_input = errors or (Exception,)
    try:
        yield
    except (InputError, Cancelled):  # one has its message already, the other is no error
        raise
    except bad_input as error:
        explained = problem.replace("{reason}", reason_in_a_line(error))
        raise InputError(f"{what}: {explained}") from error


def with_detached_errors(read: Callable[[], Result]) -> Result:
    """`read()`; an InputError that it raises is raised anew, without its traceback.

    The traceback refers to the decoder that found the problem. The decoder's threads and memory
    would live as long as the error, which a server may keep.
    """
    try:
        return read()
    except InputError as error:
        message = str(error)
        cause = error.__cause__

    if cause is not None:
        cause = cause.with_traceback(None)
    raise InputError(message) from cause


@contextlib.contextmanager
def shorten_input_errors() -> Iterator[None]:
    """Shorten the message of an InputError from the block to 300 characters.

    A program may pass a value that is megabytes long, which the message then quotes.
    """
    try:
        yield
    except InputError as error:
        message = str(error)
        if len(message) <= MAX_MESSAGE_LENGTH:
            raise
        # The beginning names the value, and the end says what to do, so both are kept. The " … "
        # between them takes three characters.
        part_length = MAX_MESSAGE_LENGTH // 2 - 2
        raise InputError(f"{message[:part_length]} … {message[-part_length:]}") from error


def printable_line(text: str) -> str:
    """The text in one line, its control characters escaped.

    File names can contain escape codes, which would command the user's terminal.
    """
    line = " ".join(text.splitlines())
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in line
    )


def short_repr(value: object) -> str:
    """A value from a file as Python writes it, at most 60 characters, for a message."""
    return _value_repr.repr(value)[:MAX_VALUE_LENGTH]


def check_name(option: str, name: str, known: Iterable[str]) -> None:
    """Raise an InputError for an unknown name; the message suggests the most similar known name.

    Args:
        option: Python name of the option whose value is `name`, such as "depth_kind".
        name: the user's value.
        known: the values that the option can have.
    """
    names = list(known)
    if name in names:
        return
    raise InputError(f"`{option}` {name} is {unknown_name(name, names)}")


def unknown_name(name: str, known: Sequence[str]) -> str:
    """What a message says of a name that is none of the known ones, with what was probably meant.

    For example "unknown: did you mean sharp? There are sharp, moge, lite".
    """
    suggestion = closest_name(name, known)
    if suggestion is None:
        return f"unknown: there are {', '.join(known)}"
    return f"unknown{question(suggestion)} There are {', '.join(known)}"


def unknown_suffix(file: object, problem: str, known: Sequence[str]) -> InputError:
    """The error for a file's name whose suffix says no kind of file that can be written.

    Args:
        file: the file, which the message begins with.
        problem: what is wrong, such as "not a name for a video".
        known: the suffixes that can be written.
    """
    meant = question(closest_suffix(str(file), known))
    advice = f"end the name with {', '.join(known)}"
    if not meant:
        return InputError(f"{file}: {problem}: {advice}")
    return InputError(f"{file}: {problem}{meant} Else {advice}")
