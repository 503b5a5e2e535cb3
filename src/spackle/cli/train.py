"""`spackle train`: train the residual network or SHARP's decoder."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from spackle.cli.options import INTERRUPTED, VerboseOption


def train(
    recipe: Annotated[
        Path,
        typer.Option(
            "--recipe",
            metavar="RECIPE",
            help="Training data and settings: quick, cpu, paper, reverse_view, direct_ft, or a "
            "YAML file.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="Folder for the results; an unfinished run in it resumes.",
        ),
    ],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KEY=VALUE]...",
            help="Values that replace the recipe's, such as optim.steps=100.",
        ),
    ] = None,
    method: Annotated[
        Literal["residual", "direct-ft"],
        typer.Option(
            help="What to train: the residual network, or (direct-ft) SHARP's decoder, for "
            "comparison."
        ),
    ] = "residual",
    checkpoint: Annotated[
        Path | None,
        typer.Option("-c", "--checkpoint", metavar="FILE", help="Weights of SHARP, for direct-ft."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Delete a run in OUT and start anew.")
    ] = False,
    logger: Annotated[
        str | None,
        typer.Option(
            metavar="MODULE:FUNCTION",
            help="A function of yours that gets each logged step and its values by name, for "
            "instance for Weights & Biases.",
        ),
    ] = None,
    verbose: VerboseOption = False,
) -> None:
    """Train the residual network or SHARP's decoder.

    Writes best.safetensors, last.safetensors, run.json, metrics.jsonl, pictures and logs.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.paper.training.direct_ft import DirectFt
    from spackle.paper.training.recipe import Recipe, load_recipe
    from spackle.paper.training.residual import ResidualTask
    from spackle.paper.training.train import train
    from spackle.runtime.errors import InputError
    from spackle.runtime.plugins import load_function

    # The residual learns from finished training data, in which the base's work is already done.
    if method == "residual" and checkpoint is not None:
        raise InputError(
            f"`checkpoint` {checkpoint}: `method` residual learns without a base: "
            "leave the option out"
        )
    task = ResidualTask if method == "residual" else partial(DirectFt, checkpoint=checkpoint)
    ended = train(
        load_recipe(Recipe, recipe, overrides or ()),
        task,
        output,
        CommandReporter(verbose),
        overwrite,
        logger=None if logger is None else load_function(logger, "logger"),
    )
    # Ctrl-C or SIGTERM: the run is saved, and the same command resumes it.
    if ended == "stopped":
        raise typer.Exit(INTERRUPTED)
