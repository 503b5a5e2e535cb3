"""`spackle figures`: draw the paper's figures from several evaluations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def figures(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="OUT...", help="Folders that `spackle evaluate --disparity 0.6` wrote."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="F", help="Folder for the files.")
    ],
    rows: Annotated[
        int,
        typer.Option(
            min=1, max=100, help="Number of images in a figure, but at least one from each folder."
        ),
    ] = 6,
) -> None:
    """Draw the paper's figures of views: PDF, PNG, and captions in figures.tex."""
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.figures import make_figures

    make_figures(results, rows, output, CommandReporter())
