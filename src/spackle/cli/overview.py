"""What `spackle --help` says: a screen of it."""

from __future__ import annotations

import typer
from typer.core import TyperGroup

EXAMPLES = (
    ("spackle predict -i photo.jpg -o out", "a scene, a video, a report"),
    ("spackle view photo.jpg", "look at it in the browser"),
    ("spackle export out/photo/scene.ply -o photo.html", "one file to send"),
)
OPTIONS = (
    ("--install-completion", "Completion for the shell that this is"),
    ("--version", "Which version this is"),
    ("-h, --help", "This; after a command, what it takes"),
)
WIDTH = 80


class Overview(TyperGroup):
    """A group of commands whose help is one line each, below examples."""

    def format_help(self, ctx: typer.Context, formatter: object) -> None:  # type: ignore[override]
        """Write it; whatever the terminal's height, 24 lines of 80 characters show all."""
        write = formatter.write  # type: ignore[attr-defined]
        rows = [(name, command) for name in self.list_commands(ctx) if (command := self.get_command(ctx, name))]
        indent = max(len(name) for name, _ in rows) + 4
        write(f"{self.help}\n\n")
        for line, meaning in EXAMPLES:
            write(f"  {line:<50}{meaning}\n")
        write("\nCommands:\n")
        for name, command in rows:
            write(f"  {name:<{indent - 2}}{command.get_short_help_str(WIDTH - indent)}\n")
        write("\nOptions:\n")
        for name, meaning in OPTIONS:
            write(f"  {name:<22}{meaning}\n")
