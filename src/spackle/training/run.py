"""`spackle train`: a recipe to weights, whichever method learns."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from rich.console import Console
from torch import Tensor

from spackle.device import pick_device
from spackle.errors import InputError, reason_in_a_line
from spackle.files import NEW, results_folder, write_json
from spackle.machine import hardware, versions, without_nan
from spackle.progress import Reporter
from spackle.signals import asked_to_stop
from spackle.training.checkpoint import (
    BEST,
    LAST,
    LOGS,
    NEWEST,
    PREVIOUS,
    RUN,
    Checkpoint,
    Progress,
    check_same_run,
    holds_run,
    load_checkpoint,
    replace_run,
)
from spackle.training.direct_ft import plan_direct_ft
from spackle.training.method import Plan, RunContext, Start
from spackle.training.ranks import joined_ranks
from spackle.training.recipe import AnyRecipe, Recipe, load_recipe, plain
from spackle.training.residual_method import plan_residual
from spackle.training.trainer import Callbacks, Trainer

R = TypeVar("R", bound=AnyRecipe)
MethodName = Literal["residual", "direct-ft"]
_END = {
    "steps": "all steps are done",
    "patience": "no improvement any more",
    "stopped": "stopped; the same command goes on from here",
}


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
    """Train the residual, or SHARP's own decoder, as a recipe says; returns as `train` does.

    Args:
        path: the recipe, a file or a packaged one's name.
        overrides: `key=value` on top of it.
        output, reporter, overwrite: as for `train`.
        method: what learns.
        checkpoint: weights of SHARP, where it is SHARP that learns.

    InputError for a recipe, file or folder that cannot be used, and for a loss that is not finite.
    """
    if method != "direct-ft" and checkpoint is not None:
        raise InputError(f"-c {checkpoint}: --method {method} learns without a base: leave the option out")
    recipe = load_recipe(Recipe, path, overrides)
    if method == "direct-ft":
        return train(recipe, lambda context: plan_direct_ft(context, checkpoint), output, reporter, overwrite)
    return train(recipe, plan_residual, output, reporter, overwrite)


def train(
    recipe: R, make_plan: Callable[[RunContext[R]], Plan], output: Path, reporter: Reporter, overwrite: bool = False
) -> str:
    """Train by a plan, or go on with a run; one of several processes where torchrun started them.

    Args:
        recipe: what to do.
        make_plan: refuses at once what cannot be used, and does no long work yet.
        output: a folder for all results.
        reporter: the first process speaks through it.
        overwrite: start anew where `output` holds a run; the samples in it stay, and so does the old run until the new
            one, in `output`/.new, has ended.

    Returns:
        Why the run ended: "steps", "patience" or "stopped", as `Trainer.run` has it.

    Raises:
        InputError: a file or folder that cannot be used, a loss that is no number.
    """
    kind = pick_device(None if recipe.run.device == "auto" else recipe.run.device).type
    with joined_ranks(kind) as ranks, contextlib.ExitStack() as stack:
        if recipe.optim.batch % ranks.count:
            raise InputError(f"optim.batch={recipe.optim.batch} cannot be divided between {ranks.count} processes")
        device = torch.device(kind, ranks.local) if kind == "cuda" else torch.device(kind)
        if ranks.first:  # which alone writes
            stack.enter_context(results_folder(output, (NEWEST, PREVIOUS, BEST, LAST, RUN), alone=True))
        else:
            reporter = Reporter(console=Console(quiet=True))
        context = RunContext(recipe, output, reporter, ranks, device)
        plan = make_plan(context)
        place = output / NEW if overwrite and holds_run(output) else output
        found, problem = None, None
        try:
            found, problem = load_checkpoint(place)
            if found:
                check_same_run(found, plan.method, recipe, plan.digest, output)
        except InputError:
            if place == output:
                raise
            found = None  # begun by another recipe, or damaged
        if found:
            if problem:
                reporter.log(f"{problem}: going on from the one before it")
            reporter.log(f"{place}: going on from step {found.progress.step}")
        start = plan.start()
        ranks.wait()  # nobody looks for checkpoints any more
        if place != output and ranks.first:
            if found is None:
                shutil.rmtree(place, ignore_errors=True)
            place.mkdir(exist_ok=True)
        return _run(context, place, start, found)


class Logs:
    """TensorBoard's event files in a folder; without a folder, nothing."""

    def __init__(self, folder: Path | None = None, purge_step: int = 0) -> None:
        """ImportError where tensorboard is not installed; what an earlier start logged after a step is hidden."""
        self.folder, self.writer = folder, None
        if folder is not None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of protobuf's, about itself
                import tensorboard  # noqa: F401  # torch's own import of it fails with other words
                from torch.utils.tensorboard import SummaryWriter
            self.writer = SummaryWriter(str(folder), purge_step=purge_step)

    def numbers(self, group: str, values: Mapping[str, float], step: int) -> None:
        """Points of the curves GROUP/NAME."""
        for name, value in values.items():
            self.write("add_scalar", f"{group}/{name}", value, step)

    def write(self, method: str, *arguments: object, **options: object) -> None:
        """Call a method of torch's writer, if there is one; InputError for a disk that is full."""
        if self.writer is None:
            return
        try:
            getattr(self.writer, method)(*arguments, **options)
        except OSError as error:  # raised where the next number comes, for its thread cannot
            raise InputError(f"{self.folder}: cannot write the logs: {reason_in_a_line(error)}") from error

    def close(self) -> None:
        """Write what is still in memory."""
        self.write("close")


def _run(context: RunContext[Any], place: Path, start: Start, checkpoint: Checkpoint | None) -> str:
    """The training loop with everything that it talks to: bars, logs, signals and run.json.

    It writes to `place`, which takes the place of the older run in the output at the end, if it is not that itself.
    """
    recipe, ranks, log, output = context.recipe, context.ranks, context.reporter.log, context.output
    method, first = start.method, checkpoint.progress.step if checkpoint else 0
    logs = Logs()
    if ranks.first:
        try:
            logs = Logs(place / LOGS, first)
        except ImportError:
            log("no TensorBoard logs: pip install 'spackle-nvs[train]'")
    facts = {
        "method": method.name,
        "aim": method.aim,
        **start.facts,
        "precision": str(context.precision).removeprefix("torch."),
        "processes": ranks.count,
        "recipe": plain(recipe),
        "versions": versions(),
        "hardware": hardware(context.device),
    }

    def write(progress: Progress, ended: str | None = None) -> None:
        write_json(without_nan({**facts, "ended": ended, **dataclasses.asdict(progress)}), place / RUN)

    def stepped(step: int, numbers: Mapping[str, float]) -> None:
        logs.numbers("train", numbers, step)
        tell(step, f"loss {numbers['loss']:.4f}")

    def validated(progress: Progress, sheet: Tensor) -> None:
        found, aim = progress.history[-1], method.aim
        logs.numbers("validation", {name: value for name, value in found.items() if name != "step"}, progress.step)
        logs.write("add_image", method.columns, sheet.clamp(0, 1), progress.step, dataformats="HWC")
        best = "the best so far" if progress.stale == 0 else f"best {progress.best:.4f} at step {progress.best_step}"
        log(f"step {progress.step}: validation {aim} {found[aim]:.4f} ({best}){method.describe(found)}")
        write(progress)

    with (
        contextlib.closing(logs),
        context.reporter.steps("train", first, recipe.optim.steps) as tell,
        asked_to_stop(alone=ranks.count == 1) as stop,
    ):
        callbacks = Callbacks(stepped, validated, write, stop)
        trainer = Trainer(recipe, method, start.network, context.device, place, callbacks, ranks, start.optimizer)
        if checkpoint:
            trainer.resume(checkpoint)
        why = trainer.run()
    if ranks.first:
        write(trainer.progress, why)
        if place != output and why != "stopped":
            replace_run(output, place)
            place = output
        log(f"{_END[why]}, step {trainer.progress.step} -> {place}")
    return why
