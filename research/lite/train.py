"""Train the network of the lite base: depth from one photo, learned from synthetic scenes and
measured frames.

    python research/lite/train.py --recipe research/lite/lite.yaml -o OUT \\
        data.photos=PHOTOS data.stereo=PAIRS ...

OUT gets the same files as from `spackle train`; the same command resumes a run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from recipe import LiteRecipe
from task import LiteTask

from spackle.paper.training.recipe import load_recipe
from spackle.paper.training.train import train
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Reporter

INTERRUPTED = 130  # the exit status of a run that was stopped by a signal


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recipe", type=Path, required=True, help="a YAML file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="a folder; a run in it goes on"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="start anew where the folder holds a run"
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="KEY=VALUE",
        help="in place of the recipe's: optim.steps=100",
    )
    options = parser.parse_intermixed_args(arguments)
    try:
        recipe = load_recipe(LiteRecipe, options.recipe, options.overrides)
        ended = train(recipe, LiteTask, options.output, Reporter(), options.overwrite)
    except InputError as error:
        if str(error):  # empty if another process reports the error
            print(f"error: {error}", file=sys.stderr)
        return 2
    return INTERRUPTED if ended == "stopped" else 0


if __name__ == "__main__":
    sys.exit(main())
