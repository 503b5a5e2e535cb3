"""The training loop: items in, weights out; whatever stops it, it goes on from its last checkpoint."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path

from spackle.errors import InputError
from spackle.formats import save_png
from spackle.training.checkpoint import BAD, BEST, LAST, PICTURES, Checkpoint, Progress, save_checkpoint
from spackle.training.learner import Learner
from spackle.training.logs import Logs
from spackle.training.method import Method, chunks
from spackle.training.ranks import Ranks
from spackle.training.recipe import AnyRecipe, plain
from spackle.training.schedule import samples_of_step
from spackle.training.validation import validate
from spackle.training.watch import Means, Watch


class Trainer:
    """One run in one process; all processes of a run do the same steps."""

    def __init__(
        self,
        recipe: AnyRecipe,
        method: Method,
        learner: Learner,
        folder: Path,
        logs: Logs,
        watch: Watch,
        ranks: Ranks,
    ) -> None:
        """A run at its first step.

        Args:
            recipe: optim and run count here.
            method: what to learn, and from what.
            learner: the first weights; trained in place.
            folder: for results; exists.
            logs: for the curves.
            watch: told what goes on.
            ranks: this process; the first one writes.
        """
        self.recipe, self.method, self.learner, self.folder = recipe, method, learner, folder
        self.logs, self.watch, self.ranks = logs, watch, ranks
        self.progress, self.on_disk = Progress(), -1  # the step of the newest checkpoint

    def resume(self, checkpoint: Checkpoint) -> None:
        """Go on where a checkpoint was written; InputError where it is of another network."""
        self.learner.resume(checkpoint, self.folder)
        self.progress, self.on_disk = checkpoint.progress, checkpoint.progress.step

    def run(self) -> str:
        """Train until the steps are done ("steps"), nothing improves ("patience") or `watch.stop` ("stopped").

        Raises:
            InputError: an item that cannot be read, a loss that is no number, a file that cannot be written.
        """
        run, since, numbers = self.recipe.run, time.perf_counter(), Means()
        start = self.progress.seconds
        while (why := self._ended(numbers.stopped)) is None:
            numbers.add(self.step(self.progress.step))
            step = self.progress.step + 1
            self.progress = dataclasses.replace(self.progress, step=step, seconds=start + time.perf_counter() - since)
            if step % run.log_every == 0 or step == self.recipe.optim.steps:
                self._tell(numbers.take())
            if step % run.validate_every == 0 or step == self.recipe.optim.steps:
                self.judge_average()
            if step % run.save_every == 0:
                self.save()
        self.save()
        return why

    def step(self, step: int) -> dict[str, float]:
        """One step; returns its numbers as means over the processes: loss, terms, gradient, lr, and stop above 0."""
        method, ranks = self.method, self.ranks
        items = samples_of_step(step, method.items, method.items_a_step, self.recipe.run.seed, ranks.rank, ranks.count)
        mine = self._find_gradients(step, items)
        mine["stop"] = float(self.watch.stop())
        means = ranks.mean(list(mine.values()), self.learner.device)
        numbers = dict(zip(mine, means, strict=True))
        if not (math.isfinite(numbers["loss"]) and math.isfinite(numbers["gradient"])):
            self._reject(step, items, mine["loss"], numbers)
        return {**numbers, "lr": self.learner.update(step)}

    def _find_gradients(self, step: int, items: Sequence[int]) -> dict[str, float]:
        """Leave a step's gradients in the network; returns its loss and terms, and the length of the gradient."""
        numbers: dict[str, float] = {}
        parts = list(chunks(items, self.method.at_once))
        self.learner.forget_gradients()
        for part in parts:
            share = len(part) / len(items)
            with self.learner.adding_up(last=part is parts[-1]):
                loss, terms = self.method.loss(self.learner.wrapped, step, part)
                (share * loss).backward()  # type: ignore[no-untyped-call]
            for name, value in {"loss": loss.detach(), **terms}.items():
                numbers[name] = numbers.get(name, 0.0) + share * float(value)
        return {**numbers, "gradient": float(self.learner.clip())}

    def judge_average(self) -> None:
        """Validate the averaged weights, keep them where they are the best so far, and draw what they do."""
        average = self.learner.average
        found = validate(average, self.method, self.learner.device, self.ranks)
        step = self.progress.step
        self.progress = self.progress.judged({"step": step, **found}, self.method.aim, self.recipe.run.min_delta)
        if not self.ranks.first:
            return
        self.logs.numbers("validation", found, step)
        sheet = self.method.picture(average)
        self.logs.picture(self.method.columns, sheet, step)
        (self.folder / PICTURES).mkdir(exist_ok=True)
        save_png(sheet, self.folder / PICTURES / f"{step:07d}.png")
        if self.progress.stale == 0:
            self.method.export(average, self.folder / BEST)
        self.watch.validated(self.progress)

    def save(self) -> None:
        """Write a checkpoint and the averaged weights; the first process alone does."""
        if not self.ranks.first or self.on_disk == self.progress.step:
            return
        save_checkpoint(self.checkpoint(), self.folder)
        self.method.export(self.learner.average, self.folder / LAST)
        self.on_disk = self.progress.step
        self.watch.saved(self.progress)

    def checkpoint(self) -> Checkpoint:
        """All of the run's state."""
        return Checkpoint(
            progress=self.progress,
            recipe=plain(self.recipe),
            digest=self.method.digest,
            method=self.method.name,
            **self.learner.state(),
        )

    def _ended(self, stopped: bool) -> str | None:
        if self.progress.step >= self.recipe.optim.steps:
            return "steps"
        if self.progress.stale >= self.recipe.run.patience:
            return "patience"
        return "stopped" if stopped else None

    def _tell(self, numbers: dict[str, float]) -> None:
        if self.ranks.first:
            self.logs.numbers("train", numbers, self.progress.step)
            self.watch.step(self.progress.step, numbers)

    def _reject(self, step: int, items: Sequence[int], loss: float, numbers: dict[str, float]) -> None:
        """Keep what made a loss that is no number, and end the run; nothing has learned from it."""
        place = self.folder / BAD
        place.mkdir(exist_ok=True)
        if not math.isfinite(loss) or math.isfinite(numbers["loss"]):  # else it is another process that has them
            self.method.keep(step, items, place)
        self.ranks.wait()
        if not self.ranks.first:
            raise InputError("")  # one process speaks for all
        save_checkpoint(self.checkpoint(), place)
        bad = ", ".join(name for name, value in numbers.items() if not math.isfinite(value))
        raise InputError(
            f"{place}: step {step} gave numbers that are not finite ({bad}): its samples and the weights before it "
            f"are there; lower optim.lr, or {self.method.remedy}"
        )
