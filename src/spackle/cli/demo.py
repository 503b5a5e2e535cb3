"""`spackle demo`: complete one photo, and compare with its true second view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import JsonOption, VerboseOption


def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="Folder for the results.")
    ] = Path("demo-output"),
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Complete Middlebury's Motorcycle photo and compare with the true second photo.

    Needs scikit-image.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.paper.demo import run_demo

    run_demo(output, CommandReporter(verbose, as_json=as_json))
