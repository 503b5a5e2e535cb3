"""`spackle demo`, as the command line has it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import JsonOption, VerboseOption


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Folder for the results.")] = Path(
        "demo-output"
    ),
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Complete the Middlebury Motorcycle photo and compare with the true second photo (needs scikit-image)."""
    from spackle.jobs.demo import run_demo
    from spackle.progress import Reporter

    run_demo(output, Reporter(verbose, as_json=as_json))


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(short_help="The Middlebury Motorcycle, against its true second photo")(demo)
