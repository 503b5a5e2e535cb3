"""Check what a user's file says against a model of pydantic, with messages that suggest a key."""

from __future__ import annotations

import types
import typing
from collections.abc import Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from spackle.runtime.errors import MAX_VALUE_LENGTH, InputError, first_validation_problem
from spackle.runtime.suggestions import closest_key, question

Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], content: Any, where: object) -> Model:
    """The content of a file as a model; InputError, which begins with `where`, if it is none.

    The message is that of `validation_problem`.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{where}: {validation_problem(model, error)}") from error


def validation_problem(model: type[BaseModel], error: ValidationError) -> str:
    """The first wrong key of what was checked against a model, and what is wrong with it.

    For an unknown key it suggests the known one that was probably meant, or else lists what there
    is in its section.
    """
    problems = error.errors()
    # A key with a typing error also lacks where it should be; the error tells more.
    unknown_keys = [one for one in problems if one["type"] == "extra_forbidden"]
    first = problems[0]
    if first["type"] == "missing" and unknown_keys:
        first = unknown_keys[0]
    if first["type"] == "extra_forbidden":
        return _unknown_key(model, first["loc"], first["input"])
    return first_validation_problem(error)


def _unknown_key(model: type[BaseModel], location: Sequence[int | str], value: Any) -> str:
    """The key of an unknown entry, and what to write instead.

    Args:
        model: what the file should hold.
        location: where the entry is, as a path of names and of places in lists.
        value: what the file has there.
    """
    # If a whole section is unknown, such as "train" with "lr" in it, its first key tells more.
    path = [str(part)[:MAX_VALUE_LENGTH] for part in location]
    while isinstance(value, dict) and value:
        name, value = next(iter(value.items()))
        path.append(str(name)[:MAX_VALUE_LENGTH])
    problem = f"{'.'.join(path)}: there is no such key"

    known_keys = _dotted_keys(model, location)
    sections = [
        name for name, field in model.model_fields.items() if _model_in(field.annotation)[0]
    ]
    suggestion = closest_key(".".join(path), known_keys) or closest_key(".".join(path), sections)
    if suggestion is not None:
        return f"{problem}{question(suggestion)}"
    # Otherwise what there is in the section: its own keys, and the names of the sections in it.
    section = "".join(f"{part}." for part in location[:-1])
    neighbours = [key.removeprefix(section) for key in known_keys if key.startswith(section)]
    names = dict.fromkeys(key.partition(".")[0] for key in neighbours)
    return f"{problem}: there are {', '.join(names)}"


def _dotted_keys(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    """All keys of a model and of the models in it, such as "optim.lr".

    Keys in a list have an index, as in "data.rgbd.0.folder": that of `location`, if it leads into
    the list, else 0.
    """
    keys = []
    for name, field in model.model_fields.items():
        inner_model, is_list = _model_in(field.annotation)
        if inner_model is None:
            keys.append(name)
            continue
        prefix = name
        rest = location[1:] if location and location[0] == name else ()
        if is_list:
            prefix += f".{rest[0] if rest else 0}"
            rest = rest[1:]
        keys += [f"{prefix}.{key}" for key in _dotted_keys(inner_model, rest)]
    return keys


def _model_in(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """The model that a field holds, and whether it holds a list of them; None for other fields."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    origin = typing.get_origin(annotation)
    is_list = origin in (list, tuple)
    if is_list or origin in (typing.Union, types.UnionType, typing.Annotated):
        for argument in typing.get_args(annotation):
            inner_model, is_inner_list = _model_in(argument)
            if inner_model is not None:
                return inner_model, is_list or is_inner_list
    return None, False
