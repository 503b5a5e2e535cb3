"""The command line: one thin function a command, one file a group."""

from __future__ import annotations

import json
import os
import sys
from typing import Annotated, NoReturn

import typer
from typer.exceptions import TyperException

from spackle.cli import dataset, demo, evaluate, export, predict, render, train, view, weights
from spackle.cli.options import INTERRUPTED
from spackle.cli.overview import Overview
from spackle.errors import InputError

app = typer.Typer(
    name="spackle",
    cls=Overview,
    help="One photo in, a 3D Gaussian scene out that survives a large camera move.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its panels leave a third of the width to the words
    context_settings={"help_option_names": ["-h", "--help"]},
)


for group in (predict, render, view, export, demo, train, evaluate, dataset, weights):
    group.register(app)


def _version(asked: bool) -> None:
    if asked:
        from spackle import __version__

        print(f"spackle {__version__}")
        raise typer.Exit()


@app.callback()
def everywhere(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Which version this is.")
    ] = False,
) -> None:
    """What all commands have in common."""


def main() -> None:
    """Entry point: bad input is one line and exit code 2."""
    # Read when torch is loaded. Its idle threads would otherwise spin: where other programs want the cores too,
    # that makes completion three to five times slower.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        code = app(standalone_mode=False)
    except InputError as error:
        _fail(str(error))
    except TyperException as error:  # an unknown option, a number that is none
        _fail(error.format_message())
    if code == INTERRUPTED:
        print("interrupted", file=sys.stderr)
    sys.exit(code)


def _fail(message: str) -> NoReturn:
    if "\n\n" in message:  # the help, where nothing was asked for
        print(message, file=sys.stderr)
        sys.exit(2)
    line = " ".join(message.splitlines())
    print(f"error: {line}", file=sys.stderr)
    if "--json" in sys.argv:
        print(json.dumps({"error": line}))
    sys.exit(2)
