"""The training loop with everything that it talks to: bars, logs, signals and run.json."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

from spackle.jobs.report import write_report
from spackle.jobs.train.plan import Place, Start
from spackle.machine import hardware, versions, without_nan
from spackle.signals import asked_to_stop
from spackle.training.checkpoint import LOGS, RUN, Checkpoint, Progress
from spackle.training.learner import Learner
from spackle.training.logs import NoLogs, open_logs
from spackle.training.loop import Trainer
from spackle.training.method import Method
from spackle.training.recipe import AnyRecipe, plain
from spackle.training.watch import Watch

_END = {
    "steps": "all steps are done",
    "patience": "no improvement any more",
    "stopped": "stopped; the same command goes on from here",
}


def run_training(place: Place[AnyRecipe], begin: Start, checkpoint: Checkpoint | None) -> str:
    """Train, from the first step or from a checkpoint's; returns why it ended, as `Trainer.run` has it.

    Raises:
        InputError: an item that cannot be read, a loss that is no number, a file that cannot be written.
    """
    recipe, ranks, say = place.recipe, place.ranks, place.reporter.say
    start = checkpoint.progress.step if checkpoint else 0
    facts = _facts(place, begin)
    logs = open_logs(place.output / LOGS, start, say) if ranks.first else NoLogs()

    def write(progress: Progress, ended: str | None = None) -> None:
        write_report(without_nan({**facts, "ended": ended, **dataclasses.asdict(progress)}), place.output / RUN)

    def validated(progress: Progress) -> None:
        say(_summary(progress, begin.method))
        write(progress)

    with (
        contextlib.closing(logs),
        place.reporter.steps("train", start, recipe.optim.steps) as tell,
        asked_to_stop(alone=ranks.count == 1) as stop,
    ):
        watch = Watch(lambda step, numbers: tell(step, f"loss {numbers['loss']:.4f}"), validated, write, stop)
        learner = Learner(begin.network, recipe.optim, place.device, ranks, begin.pace)
        trainer = Trainer(recipe, begin.method, learner, place.output, logs, watch, ranks)
        if checkpoint:
            trainer.resume(checkpoint)
        why = trainer.run()
    if ranks.first:
        write(trainer.progress, why)
        say(f"{_END[why]}, step {trainer.progress.step} -> {place.output}")
    return why


def _facts(place: Place[AnyRecipe], begin: Start) -> dict[str, Any]:
    """What run.json says of a run whatever becomes of it."""
    facts = {"method": begin.method.name, "aim": begin.method.aim, **begin.facts}
    facts |= {"precision": str(place.precision).removeprefix("torch."), "processes": place.ranks.count}
    return facts | {"recipe": plain(place.recipe), "versions": versions(), "hardware": hardware(place.device)}


def _summary(progress: Progress, method: Method) -> str:
    """The last validation in a line."""
    found = progress.history[-1]
    best = "the best so far" if progress.stale == 0 else f"best {progress.best:.4f} at step {progress.best_step}"
    return f"step {progress.step}: validation {method.aim} {found[method.aim]:.4f} ({best}){method.words(found)}"
