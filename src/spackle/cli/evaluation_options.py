"""Options that `spackle evaluate`, `bench` and `tables` share, each declared once."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import DATASET_BASES, DATASETS

# Runs of characters that a folder's name should not have.
UNSAFE_IN_FOLDER_NAMES = re.compile(r"[^\w.-]+")

LimitOption = Annotated[
    int | None,
    typer.Option(min=1, max=1_000_000, help="Number of images, spread over the dataset."),
]
DatasetNameOption = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help=f"Dataset: {DATASETS}; or package.module:NAME.",
    ),
]
FolderArgument = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Folder of the unpacked dataset.")
]
BaseNameOption = Annotated[
    str, typer.Option(metavar="NAME", help=f"Base: {DATASET_BASES} (the dataset's own).")
]
BaseWeightsOption = Annotated[
    Path | None, typer.Option("-c", "--checkpoint", help="Weights of the base.")
]
ResidualOption = Annotated[
    str | None,
    typer.Option(
        metavar="PATH|initial",
        help="Weights of the residual; default: those in the package, else initial.",
    ),
]
ResidualNetworkOption = Annotated[
    str | None,
    typer.Option(
        metavar="MODULE:CLASS", help="The network of --residual, if another package defines it."
    ),
]
SideOption = Annotated[
    int | None,
    typer.Option(
        min=16,
        max=8192,
        help="Long side of the views. [default: 1280; near-view: 1536]",
        show_default=False,
    ),
]
DisparitiesOption = Annotated[
    str,
    typer.Option(
        metavar="A,B,…",
        help="Disparities of the large views, with commas (default: the paper's S1, S2, S3).",
    ),
]
ResultsOption = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        metavar="OUT",
        help="Folder for the results; an unfinished run resumes. "
        "[default: named by dataset and protocol]",
    ),
]
HtmlOption = Annotated[
    bool, typer.Option("--html", help="Also write report.html, one page with all results.")
]


def results_name(*words: str) -> Path:
    """The default name of a folder of results: the words with hyphens between them.

    The slash and the colon of a word such as hf:OWNER/NAME become hyphens, too.
    """
    return Path(UNSAFE_IN_FOLDER_NAMES.sub("-", "-".join(words)))
