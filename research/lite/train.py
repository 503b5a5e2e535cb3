"""Train the network of the lite base: depth from one photo, learned from synthetic scenes and
measured frames.

    python research/lite/train.py --recipe research/lite/lite.yaml -o OUT \\
        data.photos=PHOTOS data.stereo=PAIRS ...

OUT gets the same files as from `spackle train`; the same command resumes a run.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from recipe import LiteRecipe
from task import LiteTask

from spackle.cli.training_command import run_training_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status: 0, 2 for bad input, 130 for a stopped run."""
    return run_training_command(
        LiteRecipe,
        LiteTask,
        arguments,
        description=__doc__,
        recipe_help="a YAML file",
        overrides_help="in place of the recipe's: optim.steps=100",
    )


if __name__ == "__main__":
    sys.exit(main())
