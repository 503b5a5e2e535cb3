"""The training loop: samples in, weights out; whatever stops it, it goes on from its last checkpoint."""

from __future__ import annotations

import dataclasses
import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import clip_grad_norm_

from spackle.errors import InputError
from spackle.formats import save_png
from spackle.residual.network import ResidualNet
from spackle.training.cache import load_sample
from spackle.training.checkpoint import (
    BAD,
    BEST,
    LAST,
    PICTURES,
    Checkpoint,
    Progress,
    export_weights,
    save_checkpoint,
)  # fmt: skip
from spackle.training.data import SampleFiles
from spackle.training.logs import Logs
from spackle.training.ranks import Ranks
from spackle.training.recipe import Recipe, plain
from spackle.training.schedule import ema_decay, learning_rate, samples_of_step
from spackle.training.validation import PICTURED, Judge, picture, validate


@dataclasses.dataclass(frozen=True)
class Watch:
    """How a run talks to whoever started it."""

    step: Callable[[int, dict[str, float]], None]  # steps done, and their mean numbers since it was last called
    validated: Callable[[Progress], None]
    saved: Callable[[Progress], None]  # a checkpoint is on the disk
    stop: Callable[[], bool]  # whether somebody wants it to end after this step


class Trainer:
    """One run in one process; all processes of a run do the same steps."""

    def __init__(
        self,
        recipe: Recipe,
        samples: SampleFiles,
        network: ResidualNet,
        judge: Judge,
        folder: Path,
        logs: Logs,
        watch: Watch,
        ranks: Ranks,
    ) -> None:
        """A run at its first step.

        Args:
            recipe: optim and run count here.
            samples: what to learn from.
            network: the first weights; trained in place.
            judge: the loss.
            folder: for results; exists.
            logs: for the curves.
            watch: told what goes on.
            ranks: this process; the first one writes.
        """
        self.recipe, self.samples, self.judge, self.folder = recipe, samples, judge, folder
        self.logs, self.watch, self.ranks = logs, watch, ranks
        self.network = network.to(judge.device, memory_format=torch.channels_last).requires_grad_()  # type: ignore[call-overload]
        self.average = ResidualNet().to(judge.device, memory_format=torch.channels_last).requires_grad_(False)  # type: ignore[call-overload]
        self.average.load_state_dict(network.state_dict())
        optim = recipe.optim
        self.optimizer = torch.optim.AdamW(
            network.parameters(), optim.lr, betas=optim.betas, weight_decay=optim.weight_decay
        )
        self.progress, self.on_disk = Progress(), -1  # the step of the newest checkpoint
        # Gradients are averaged over the processes while they are computed.
        self.wrapped: nn.Module = DistributedDataParallel(network) if ranks.count > 1 else network

    def resume(self, checkpoint: Checkpoint) -> None:
        """Go on where a checkpoint was written."""
        self.network.load_state_dict(checkpoint.network)
        self.average.load_state_dict(checkpoint.average)
        self.optimizer.load_state_dict(checkpoint.optimizer)
        self.progress, self.on_disk = checkpoint.progress, checkpoint.progress.step

    def run(self) -> str:
        """Train until the steps are done ("steps"), nothing improves ("patience") or `watch.stop` ("stopped").

        Raises:
            InputError: a sample that cannot be read, a loss that is no number, a file that cannot be written.
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
        optim = self.recipe.optim
        picks = samples_of_step(
            step, len(self.samples.train), optim.batch, self.recipe.run.seed, self.ranks.rank, self.ranks.count
        )
        files = [self.samples.train[pick] for pick in picks]
        batch = self.judge.complete(self.wrapped, [load_sample(file) for file in files])
        loss, terms = self.judge.total(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        gradient = clip_grad_norm_(self.network.parameters(), optim.clip)
        mine = {name: float(value) for name, value in {"loss": loss.detach(), **terms, "gradient": gradient}.items()}
        mine["stop"] = float(self.watch.stop())
        means = self.ranks.mean(list(mine.values()), self.judge.device)
        numbers = dict(zip(mine, means, strict=True))
        if not (math.isfinite(numbers["loss"]) and math.isfinite(numbers["gradient"])):
            self._reject(step, files, mine["loss"], numbers)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(step, optim)
        self.optimizer.step()
        decay = ema_decay(step, optim.ema)
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weight, 1 - decay)
        return {**numbers, "lr": self.optimizer.param_groups[0]["lr"]}

    def judge_average(self) -> None:
        """Validate the averaged weights, keep them where they are the best so far, and draw what they do."""
        share = self.recipe.optim.batch // self.ranks.count
        found = validate(self.average, self.samples.validation, self.judge, share, self.ranks)
        step = self.progress.step
        self.progress = self.progress.judged({"step": step, **found}, self.recipe.run.min_delta)
        if not self.ranks.first:
            return
        self.logs.numbers("validation", found, step)
        some = self.samples.validation[:: max(1, len(self.samples.validation) // PICTURED)][:PICTURED]
        sheet = picture(self.average, [load_sample(file) for file in some], self.judge)
        self.logs.picture("base, seeds, completed, truth", sheet, step)
        (self.folder / PICTURES).mkdir(exist_ok=True)
        save_png(sheet, self.folder / PICTURES / f"{step:07d}.png")
        if self.progress.stale == 0:
            export_weights(self.average, self.folder / BEST)
        self.watch.validated(self.progress)

    def save(self) -> None:
        """Write a checkpoint and the averaged weights; the first process alone does."""
        if not self.ranks.first or self.on_disk == self.progress.step:
            return
        save_checkpoint(self.checkpoint(), self.folder)
        export_weights(self.average, self.folder / LAST)
        self.on_disk = self.progress.step
        self.watch.saved(self.progress)

    def checkpoint(self) -> Checkpoint:
        """All of the run's state."""
        return Checkpoint(
            progress=self.progress,
            network=self.network.state_dict(),
            average=self.average.state_dict(),
            optimizer=self.optimizer.state_dict(),
            recipe=plain(self.recipe),
            digest=self.samples.digest,
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

    def _reject(self, step: int, files: list[Path], loss: float, numbers: dict[str, float]) -> None:
        """Keep what made a loss that is no number, and end the run; nothing has learned from it."""
        place = self.folder / BAD
        place.mkdir(exist_ok=True)
        if not math.isfinite(loss) or math.isfinite(numbers["loss"]):  # else it is another process that has them
            for file in files:
                shutil.copy(file, place / file.name)
        self.ranks.wait()
        if not self.ranks.first:
            raise InputError("")  # one process speaks for all
        save_checkpoint(self.checkpoint(), place)
        bad = ", ".join(name for name, value in numbers.items() if not math.isfinite(value))
        raise InputError(
            f"{place}: step {step} gave numbers that are not finite ({bad}): its samples and the weights before it "
            "are there; lower optim.lr, or delete the samples in the cache and run again"
        )


class Means:
    """Numbers of several steps, on their way to a line."""

    def __init__(self) -> None:
        self.sums: dict[str, float] = {}
        self.count = 0
        self.stopped = False

    def add(self, numbers: dict[str, float]) -> None:
        """One more step."""
        self.stopped = numbers.pop("stop") > 0
        self.count += 1
        for name, value in numbers.items():
            self.sums[name] = self.sums.get(name, 0.0) + value

    def take(self) -> dict[str, float]:
        """The means, and an end to them."""
        means = {name: total / self.count for name, total in self.sums.items()}
        self.sums, self.count = {}, 0
        return means
