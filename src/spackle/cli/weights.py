"""`spackle weights`: get, make, list."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from spackle.cli.options import JsonOption

weights = typer.Typer(help="Weights that others publish: fetch them, list them.", no_args_is_help=True)


@weights.command("get")
def weights_get(
    name: Annotated[str, typer.Argument(help="Which weights: sharp, depth, lama or features.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="OUT", help="A folder, or a file name; default: the weights' folder."),
    ] = None,
    url: Annotated[str | None, typer.Option(help="Download from this mirror.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Download what is there already.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Download weights and record their SHA-256; a broken download goes on where it stopped."""
    from spackle.app.weights import get_weights
    from spackle.progress import Reporter

    get_weights(name, output, Reporter(as_json=as_json), url=url, force=force)


@weights.command("make")
def weights_make(
    output: Annotated[Path, typer.Argument(metavar="FILE", help="A name that ends in .pt or .safetensors.")],
    size: Annotated[
        Literal["full", "tiny", "lama"], typer.Option(help="SHARP's published size, one for tests, or LaMa's.")
    ] = "full",
) -> None:
    """Make random weights of SHARP's or LaMa's shape, the same each time, to try everything without theirs."""
    from spackle.app.weights import make_weights
    from spackle.progress import Reporter

    make_weights(output, size, Reporter())


@weights.command("list")
def weights_list(as_json: JsonOption = False) -> None:
    """Say which weights are known, and which of them are here."""
    from rich.console import Console

    from spackle.app.weights import list_weights
    from spackle.progress import Reporter

    list_weights(Reporter(as_json=as_json), Console(highlight=False))
