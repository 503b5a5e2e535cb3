"""Messages as the command line shows them: options are named as flags.

The library names an option in backticks by its Python name, such as `depth_kind`. Whoever calls the
library from Python knows it by this name; whoever types a command knows it as `--depth-kind`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping

import typer
from typer.core import TyperGroup
from typer.main import get_command

from spackle.runtime.progress import Reporter

# The application whose commands' options are known; `spackle.cli` adds it once all commands exist.
applications: list[typer.Typer] = []

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
