"""Options of commands, Python and HTTP are those of one declaration, with each exception listed."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest

import spackle
from spackle.bases import DEFAULT_MAX_DISPARITY, lite
from spackle.cli import options as cli_options
from spackle.cli.predict import predict as predict_command
from spackle.runtime.declared_options import DECLARATIONS
from spackle.web.work import SceneOptions

SURFACES = ("command", "python", "http")
THE_MACHINE = "the server's machine and files are chosen by who runs the server"
A_FILE = "a file of the server's machine, which a client cannot name"
SCENE_DOES = "the scene's own methods do it: `path`, `along`, `render`, `frames`"
VIDEO_OF_HTTP = "a server makes plain MP4s; whoever wants others renders the scene that it sends"
LOADED_BASE = "a base is loaded with its weights in Python, such as `SharpBase.load`"

# Declared options that a way to use Spackle lacks, and why.
ABSENT = {
    "python": {
        "near": "`load_depth` takes it",
        "far": "`load_depth` takes it",
        "calib": "`load_depth` takes it",
        "checkpoint": LOADED_BASE,
        "precision": LOADED_BASE,
        "windows_per_batch": LOADED_BASE,
        "residual_network": "a network is loaded and given as `residual`",
        "path": SCENE_DOES,
        "cameras": SCENE_DOES,
    },
    "http": {
        "near": "for files on one's own machine, where a map can be looked at and tried again",
        "far": "as `near`",
        "calib": A_FILE,
        "checkpoint": THE_MACHINE,
        "precision": THE_MACHINE,
        "windows_per_batch": THE_MACHINE,
        "device": THE_MACHINE,
        "residual": A_FILE,
        "residual_network": "code of another package is never named over HTTP",
        "mode": "the files of a scene have room for one set of Gaussians",
        "path": A_FILE,
        "cameras": "the request `/fill` takes cameras",
        "seconds": "`frames` says the same at 30 a second",
        **dict.fromkeys(
            ("overscan", "format", "fps", "loop", "size", "fit", "show", "stereo", "ipd"),
            VIDEO_OF_HTTP,
        ),
        "convergence": VIDEO_OF_HTTP,
    },
}
# Options that only one way has, because they are no property of a scene or its video.
UNDECLARED = {
    "command": {
        "photos": "the input",
        "posed": "the input",
        "depth": "an input, not an option",
        "output": "where the files go",
        "recursive": "which photos are taken",
        "outputs": "which files are written",
        "tar": "which files are written",
        "render": "which files are written",
        "keep_base": "which files are written",
        "depth_out": "which files are written",
        "overwrite": "what happens to earlier files",
        "workers": "processes of a command",
        "threads": "processes of a command",
        "ray": "processes of a command",
        "as_json": "what the command prints",
        "verbose": "what the command prints",
        "help_all": "what the command prints",
    },
    "python": {
        "photo": "the input",
        "depth": "an input, not an option",
        "target": "where the file goes",
        "renderer": "a loaded object",
        "progress": "a function of the program",
        "cancel": "an object of the program",
        "compare": "of `spackle render`, too, which has base and scene apart",
    },
    "http": {"files": "which files are made"},
}
# Defaults that differ, and why.
OTHER_DEFAULTS = {
    ("command", "trajectory"): "None, to see whether it was given beside `path`",
    ("python", "fps"): "a plain number, which editors show",
    ("http", "base"): "None is the server's own base",
    ("http", "frames"): "4 seconds, as a plain number",
}
# Names in a command that differ from those in Python, where they would be no good names.
COMMAND_NAMES = {"sharp_windows": "windows_per_batch", "video_format": "format"}


def parts(annotation: Any) -> set[object]:
    """What an option can be: types, and the words of a choice."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        return parts(typing.get_args(annotation)[0])
    if origin is Literal:
        return set(typing.get_args(annotation))
    if origin in (typing.Union, types.UnionType):
        return {part for one in typing.get_args(annotation) for part in parts(one)}
    return {annotation} - {type(None)}


def options_of(*functions: Callable[..., Any]) -> dict[str, tuple[set[object], Any]]:
    """What each option of functions can be, and its default."""
    found: dict[str, tuple[set[object], Any]] = {}
    for function in functions:
        hints = typing.get_type_hints(function, include_extras=True)
        for name, parameter in inspect.signature(function).parameters.items():
            if name != "self":
                found.setdefault(
                    COMMAND_NAMES.get(name, name), (parts(hints[name]), parameter.default)
                )
    return found


def surfaces() -> dict[str, dict[str, tuple[set[object], Any]]]:
    return {
        "command": options_of(predict_command),
        "python": options_of(spackle.predict, spackle.Scene.save_video),
        "http": {
            name: (parts(field.annotation), field.get_default(call_default_factory=True))
            for name, field in SceneOptions.model_fields.items()
        },
    }


@pytest.mark.parametrize("surface", SURFACES)
def test_each_option_is_declared_or_its_absence_has_a_reason(surface: str) -> None:
    names = set(surfaces()[surface])
    absent = set(ABSENT.get(surface, {}))
    undeclared = set(UNDECLARED[surface])
    assert names - undeclared == set(DECLARATIONS) - absent
    # An exception that is none any more goes.
    assert undeclared <= names - set(DECLARATIONS)
    assert absent <= set(DECLARATIONS)


@pytest.mark.parametrize("surface", SURFACES)
def test_types_and_choices_are_those_of_the_declaration(surface: str) -> None:
    for name, (possible, _) in surfaces()[surface].items():
        if name in UNDECLARED[surface]:
            continue
        wanted = parts(DECLARATIONS[name].type)
        words = {word for word in wanted if isinstance(word, str)}
        has_all_words = words <= possible or str in possible
        # Python takes more types than a text, such as a loaded base; HTTP only the built-in names.
        is_fill_of_http = (surface, name) == ("http", "fill")
        assert has_all_words, name
        assert wanted - words <= possible or is_fill_of_http, (name, possible)
        extra_words = {word for word in possible if isinstance(word, str)} - words
        assert not extra_words or is_fill_of_http, (name, extra_words)


@pytest.mark.parametrize("surface", SURFACES)
def test_defaults_are_those_of_the_declaration(surface: str) -> None:
    other = set()
    for name, (_, default) in surfaces()[surface].items():
        if name not in UNDECLARED[surface] and default != DECLARATIONS[name].default:
            other.add((surface, name))
    assert other == {key for key in OTHER_DEFAULTS if key[0] == surface}


def test_help_of_commands_and_http_is_that_of_the_declaration() -> None:
    hints = typing.get_type_hints(predict_command, include_extras=True)
    for name, hint in hints.items():
        declaration = DECLARATIONS.get(COMMAND_NAMES.get(name, name))
        if declaration is None:
            continue
        option = typing.get_args(hint)[-1]
        assert option.help.startswith(cli_options._with_flags(declaration.help)), name
        assert "`" not in option.help.replace("`spackle weights get lama`", ""), name
        if isinstance(option.show_default, str) and name != "disparity":
            unset = declaration.unset or str(declaration.default)
            assert option.show_default == cli_options._with_flags(unset), name
    for name, field in SceneOptions.model_fields.items():
        declaration = DECLARATIONS.get(name)
        if declaration is not None and name not in ("base", "frames"):
            assert field.description is not None
            assert field.description.startswith(declaration.help), name


def test_limits_of_http_are_those_of_the_declaration() -> None:
    properties = SceneOptions.model_json_schema()["properties"]
    words = {
        "ge": "minimum",
        "le": "maximum",
        "gt": "exclusiveMinimum",
        "lt": "exclusiveMaximum",
    }
    for name, schema in properties.items():
        declaration = DECLARATIONS.get(name)
        for limit, value in ({} if declaration is None else declaration.limits).items():
            kinds = [schema, *schema.get("anyOf", [])]
            assert value in [kind.get(words[limit]) for kind in kinds], (name, limit)


def test_python_describes_each_of_its_options() -> None:
    for function in (spackle.predict, spackle.Scene.save_video, spackle.predict_posed):
        described = inspect.getdoc(function) or ""
        for name in inspect.signature(function).parameters:
            assert name == "self" or f"\n    {name}: " in described, (function, name)


def test_help_does_not_wait_for_torch() -> None:
    source = Path(inspect.getfile(type(next(iter(DECLARATIONS.values()))))).read_text()
    imports = [line for line in source.splitlines() if line.startswith(("import", "from"))]
    assert not [line for line in imports if "torch" in line or "spackle" in line]


def test_the_texts_name_the_limits_of_the_movement() -> None:
    with_lite, otherwise = f"{lite.MAX_DISPARITY:g}", f"{DEFAULT_MAX_DISPARITY:g}"
    unset = DECLARATIONS["disparity"].unset
    assert unset is not None
    assert f"at most {with_lite} with lite, else {otherwise}" in unset
    documentation = " ".join((inspect.getdoc(spackle.predict) or "").split())
    assert f"limit of {with_lite} for lite and {otherwise} for other bases" in documentation
