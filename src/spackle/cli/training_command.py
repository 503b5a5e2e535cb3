"""The command line of trainings beside `spackle train`, such as those of research/.

They have recipes and tasks of their own, and begin by `python FILE` instead of `spackle train`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from spackle.cli.options import INTERRUPTED
from spackle.cli.script_command import run_script

if TYPE_CHECKING:  # torch takes seconds to load
    import torch

    from spackle.paper.training.recipe import AnyRecipe
    from spackle.paper.training.task import Task

R = TypeVar("R", bound="AnyRecipe")


def run_training_command(
    recipe_kind: type[R],
    open_task: Callable[[R, torch.device], Task],
    arguments: Sequence[str] | None = None,
    *,
    description: str | None,
    recipe_help: str,
    overrides_help: str,
) -> int:
    """Train as a command line says; returns the exit code: 0, 2 for bad input, 130 if stopped.

    The command line is `--recipe RECIPE -o OUT [--overwrite] [KEY=VALUE]...`. Bad input prints one
    line. The same command resumes a run that Ctrl-C or SIGTERM has stopped.

    Args:
        recipe_kind: the class of the recipe, which says what keys there are.
        open_task: creates the task (the network, its data and its loss) on a device.
        arguments: the words of the command line; None: those of this process.
        description: what the help says of the command, in lines that stay as they are.
        recipe_help: what the help says of `--recipe`.
        overrides_help: what the help says of KEY=VALUE.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.paper.training.recipe import load_recipe
    from spackle.paper.training.train import train
    from spackle.runtime.progress import Reporter

    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recipe", type=Path, required=True, help=recipe_help)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="a folder; a run in it goes on"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="start anew where the folder holds a run"
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help=overrides_help)

    def train_as_told() -> int:
        """Read the command line, and train; the exit code tells whether the training has ended."""
        # Overrides may stand before, between and behind the options.
        options = parser.parse_intermixed_args(arguments)
        recipe = load_recipe(recipe_kind, options.recipe, options.overrides)
        end_reason = train(recipe, open_task, options.output, Reporter(), options.overwrite)
        return INTERRUPTED if end_reason == "stopped" else 0

    return run_script(train_as_told)
