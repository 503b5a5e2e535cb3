"""Messages as the command line shows them: options are named as flags.

The library names an option in backticks by its Python name, such as `depth_kind`. Whoever calls the
library from Python knows it by this name; whoever types a command knows it as `--depth-kind`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException
from typer.main import get_command

from spackle.runtime.errors import unknown_name
from spackle.runtime.progress import Reporter
from spackle.runtime.suggestions import closest_name, question

# The application whose commands' options are known; `spackle.cli` adds it once all commands exist.
applications: list[typer.Typer] = []

QUOTED_COMMA = "', '"  # between the choices that typer lists
# All other flags are the Python name with hyphens, such as --depth-kind for `depth_kind`.
FLAGS_WITH_ANOTHER_NAME = {"windows_per_batch": "--sharp-windows", "from_camera": "--from"}


def with_flags(message: str) -> str:
    """The message, with every option in backticks replaced by its flag: `fov` becomes --fov.

    A name in backticks that no command has as an option stays as it is.
    """

    def flag_of(match: re.Match[str]) -> str:
        """The flag of the name in backticks, or the text as it is for any other name."""
        name = match[1]
        flag = FLAGS_WITH_ANOTHER_NAME.get(name, "--" + name.replace("_", "-"))
        return flag if flag in _known_flags() else match[0]

    # A Python name in lower case; the group in parentheses is the name without backticks.
    return re.sub(r"`([a-z][a-z0-9_]*)`", flag_of, message)


def with_suggestion(error: TyperException) -> str:
    """The message of an error in the options, with the option or value that was probably meant.

    It has the form of the library's messages about unknown names.
    """
    # pydantic's first words, which typer keeps, say nothing to a user.
    message = error.format_message().replace("Value error, ", "")
    # Typer finds similar options, but names all of them.
    possible_options: Sequence[str] = getattr(error, "possibilities", None) or ()
    if possible_options and hasattr(error, "option_name"):
        return f"{error.message}{question(closest_name(error.option_name, possible_options))}"

    # "Invalid value for '--mode': 'veiw' is not one of 'scene', 'view', 'paper'."
    choice = re.fullmatch(r"Invalid value for '(.+)': '(.*)' is not one of '(.*)'\.", message)
    if choice is None:
        return message
    quoted_option, value, quoted_names = choice.groups()
    option = quoted_option.replace("'", "")  # an option with a short form is '-b' / '--background'
    return f"{option} {value} is {unknown_name(value, quoted_names.split(QUOTED_COMMA))}"


@functools.cache
def _known_flags() -> set[str]:
    """All long flags, such as --fov, of all commands and of their subcommands."""
    flags: set[str] = set()
    # A list that grows: a command with subcommands, such as `weights`, adds them.
    commands = [get_command(application) for application in applications]
    while commands:
        command = commands.pop()
        for parameter in command.params:
            names = [*parameter.opts, *parameter.secondary_opts]  # --render and --no-render
            flags.update(name for name in names if name.startswith("--"))
        if isinstance(command, TyperGroup):
            commands.extend(command.commands.values())
    return flags


class CommandReporter(Reporter):
    """Reports progress, messages and results of a command; messages name options as flags."""

    def log(self, line: str) -> None:
        """Print a line."""
        super().log(with_flags(line))

    def result(self, values: Mapping[str, object]) -> None:
        """Print a result as a line of JSON if the user asked for JSON; an error names flags."""
        error = values.get("error")
        if isinstance(error, str):
            values = {**values, "error": with_flags(error)}
        super().result(values)
