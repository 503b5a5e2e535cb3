"""`spackle tables`: merge several evaluations into the same tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.evaluation_options import HtmlOption


def tables(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="OUT...", help="Folders that `spackle evaluate` and `spackle bench` wrote."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="T", help="Folder for the files.")
    ],
    html: HtmlOption = False,
) -> None:
    """Put several evaluations and benchmarks into the same tables: tables.md and tables.tex."""
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.evaluate import merge_tables

    merge_tables(results, output, CommandReporter(), html)
