"""The training loop with everything that it talks to: bars, logs, signals and run.json."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

from spackle.jobs.machine import hardware, versions, without_nan
from spackle.jobs.report import write_report
from spackle.jobs.stopping import asked_to_stop
from spackle.jobs.train_plan import Place, Start
from spackle.training.checkpoint import LOGS, RUN, Checkpoint, Progress
from spackle.training.logs import NoLogs, open_logs
from spackle.training.loop import Trainer
from spackle.training.recipe import plain
from spackle.training.watch import Watch

_END = {
    "steps": "all steps are done",
    "patience": "no improvement any more",
    "stopped": "stopped; the same command goes on from here",
}


def run_training(place: Place, begin: Start, checkpoint: Checkpoint | None) -> str:
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
        say(_summary(progress))
        write(progress)

    with (
        contextlib.closing(logs),
        place.reporter.steps("train", start, recipe.optim.steps) as tell,
        asked_to_stop(alone=ranks.count == 1) as stop,
    ):
        watch = Watch(lambda step, numbers: tell(step, f"loss {numbers['loss']:.4f}"), validated, write, stop)
        trainer = Trainer(recipe, begin.method, begin.network, place.judge, place.output, logs, watch, ranks)
        if checkpoint:
            trainer.resume(checkpoint)
        why = trainer.run()
    if ranks.first:
        write(trainer.progress, why)
        say(f"{_END[why]}, step {trainer.progress.step} -> {place.output}")
    return why


def _facts(place: Place, begin: Start) -> dict[str, Any]:
    """What run.json says of a run whatever becomes of it."""
    judge = place.judge
    features = judge.features.name if judge.features else "none"
    facts = {"method": begin.method.name, "features": features, **begin.facts}
    facts |= {"precision": str(judge.precision).removeprefix("torch."), "processes": place.ranks.count}
    return facts | {"recipe": plain(place.recipe), "versions": versions(), "hardware": hardware(place.device)}


def _summary(progress: Progress) -> str:
    """The last validation in a line."""
    found = progress.history[-1]
    best = "the best so far" if progress.stale == 0 else f"best {progress.best:.4f} at step {progress.best_step}"
    places = {"hole_psnr": "in the hole", "seen_psnr": "to the base outside of it"}
    psnr = "".join(f", {found[name]:.2f} dB {place}" for name, place in places.items() if name in found)
    return (
        f"step {progress.step}: validation loss {found['loss']:.4f} ({best}){psnr}, "
        f"holes {found['har_before']:.1%} -> {found['har_after']:.2%}"
    )
