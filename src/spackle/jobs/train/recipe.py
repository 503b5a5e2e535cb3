"""`spackle train`: a recipe to weights."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from rich.console import Console

from spackle.errors import InputError
from spackle.jobs.train.direct import DirectPlan
from spackle.jobs.train.lite import LitePlan
from spackle.jobs.train.plan import Place, Plan
from spackle.jobs.train.residual import ResidualPlan
from spackle.jobs.train.run import run_training
from spackle.output_folder import alone_in, results_folder
from spackle.progress import Reporter
from spackle.training.checkpoint import (
    BEST,
    LAST,
    NEWEST,
    PREVIOUS,
    RUN,
    Checkpoint,
    check_same_run,
    load_checkpoint,
    remove_run,
)  # fmt: skip
from spackle.training.depth.recipe import LiteRecipe
from spackle.training.method import MethodName
from spackle.training.ranks import joined_ranks
from spackle.training.recipe import DeviceName, plain
from spackle.training.recipe_file import load_lite_recipe, load_recipe


def train_recipe(
    path: Path,
    overrides: Sequence[str],
    output: Path,
    reporter: Reporter,
    *,
    method: MethodName = "residual",
    checkpoint: Path | None = None,
    overwrite: bool = False,
) -> str:
    """Train as a recipe says, or go on with a run; one of several processes where torchrun started them.

    Args:
        path: the recipe.
        overrides: `key=value` on top of it.
        output: a folder for all results.
        reporter: the first process speaks through it.
        method: what learns: the residual, a base's own decoder, or the network of the lite base.
        checkpoint: weights of the base, where it is the base that learns.
        overwrite: start anew where `output` holds a run; the samples in it stay.

    Returns:
        Why the run ended: "steps", "patience" or "stopped", as `Trainer.run` has it.

    Raises:
        InputError: a recipe, file or folder that cannot be used, a loss that is no number.
    """
    if method != "direct-ft" and checkpoint is not None:
        raise InputError(f"-c {checkpoint}: --method {method} learns without a base: leave the option out")
    recipe = load_lite_recipe(path, overrides) if method == "lite" else load_recipe(path, overrides)
    kind = _device_kind(recipe.run.device)
    with joined_ranks(kind) as ranks:
        if recipe.optim.batch % ranks.count:
            raise InputError(f"optim.batch={recipe.optim.batch} cannot be divided between {ranks.count} processes")
        device = torch.device(kind, ranks.local) if kind == "cuda" else torch.device(kind)
        with _results(output) if ranks.first else contextlib.nullcontext():
            speaker = reporter if ranks.first else Reporter(console=Console(quiet=True))
            # Everything that can be refused is refused before long work begins.
            plan: Plan
            if isinstance(recipe, LiteRecipe):
                plan = LitePlan.of(Place(recipe, output, speaker, ranks, device))
            elif method == "direct-ft":
                plan = DirectPlan.of(Place(recipe, output, speaker, ranks, device), checkpoint)
            else:
                plan = ResidualPlan.of(Place(recipe, output, speaker, ranks, device))
            found = None if overwrite else _checkpoint(plan)
            start = plan.start()
            ranks.wait()  # nobody looks for checkpoints any more
            if overwrite and ranks.first:
                remove_run(output)
            return run_training(plan.place, start, found)


@contextlib.contextmanager
def _results(output: Path) -> Iterator[None]:
    """Of the first process, which alone writes."""
    with results_folder(output, (NEWEST, PREVIOUS, BEST, LAST, RUN)), alone_in(output, "training"):
        yield


def _checkpoint(plan: Plan) -> Checkpoint | None:
    """The one to go on from; InputError where the folder holds another run."""
    place = plan.place
    checkpoint, problem = load_checkpoint(place.output)
    if checkpoint is None:
        return None
    check_same_run(checkpoint, plan.name, plain(place.recipe), plan.digest, place.output)
    if problem:
        place.reporter.say(f"{problem}: going on from the one before it")
    place.reporter.say(f"{place.output}: going on from step {checkpoint.progress.step}")
    return checkpoint


def _device_kind(name: DeviceName) -> str:
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("run.device=cuda: torch finds no GPU here; use run.device=cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
