"""The training loop: items in, weights out; whatever stops it, it goes on from its last checkpoint."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW, Optimizer

from spackle.errors import InputError, reason_in_a_line
from spackle.formats import save_png
from spackle.training.checkpoint import BAD, BEST, LAST, PICTURES, Checkpoint, Progress, save_checkpoint
from spackle.training.method import Method, chunks, validate
from spackle.training.ranks import Ranks
from spackle.training.recipe import AnyRecipe, OptimRecipe, plain


@dataclasses.dataclass(frozen=True)
class Callbacks:
    """Functions that the trainer calls."""

    step: Callable[[int, dict[str, float]], None]  # steps done, and their mean numbers since it was last called
    validated: Callable[[Progress], None]
    saved: Callable[[Progress], None]  # a checkpoint is on the disk
    stop: Callable[[], bool]  # whether somebody wants it to end after this step


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
            self._write("add_scalar", f"{group}/{name}", value, step)

    def picture(self, name: str, rgb: Tensor, step: int) -> None:
        """An image [H, W, 3] sRGB."""
        self._write("add_image", name, rgb.clamp(0, 1), step, dataformats="HWC")

    def close(self) -> None:
        """Write what is still in memory."""
        self._write("close")

    def _write(self, method: str, *arguments: object, **options: object) -> None:
        if self.writer is None:
            return
        try:
            getattr(self.writer, method)(*arguments, **options)
        except OSError as error:  # raised where the next number comes, for its thread cannot
            raise InputError(f"{self.folder}: cannot write the logs: {reason_in_a_line(error)}") from error


def open_logs(folder: Path, step: int, say: Callable[[str], None]) -> Logs:
    """Logs in a folder, from a step on; says so where tensorboard is missing, and keeps none."""
    try:
        return Logs(folder, step)
    except ImportError:
        say("no TensorBoard logs: pip install 'spackle-nvs[train]'")
        return Logs()


EMA_START = 10  # the average forgets the first, bad weights this quickly: decay (s + 1) / (s + 10)


class Trainer:
    """One run in one process; all processes of a run do the same steps."""

    def __init__(
        self,
        recipe: AnyRecipe,
        method: Method,
        network: nn.Module,
        device: torch.device,
        folder: Path,
        callbacks: Callbacks,
        logs: Logs | None = None,
        ranks: Ranks | None = None,
        optimizer: Optimizer | None = None,
    ) -> None:
        """A run at its first step.

        Args:
            recipe: optim and run count here.
            method: what to learn, and from what.
            network: the first weights; those that ask for gradients are trained in place.
            device: where it learns.
            folder: for results; exists.
            callbacks: called as the run goes on.
            logs: for the curves.
            ranks: this process among those that share the gradients; the first one writes.
            optimizer: of the network's weights; a group's "lr_scale" is a factor on the learning rate. None: AdamW.
        """
        self.recipe, self.method, self.folder, self.device = recipe, method, folder, device
        self.callbacks, self.logs, self.ranks = callbacks, logs or Logs(), ranks or Ranks()
        self.network: nn.Module = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        # Gradients are averaged over the processes while they are computed.
        self.wrapped: nn.Module = DistributedDataParallel(network) if self.ranks.count > 1 else network
        self.optimizer = optimizer or adamw([{"params": [w for w in network.parameters() if w.requires_grad]}], recipe)
        self.progress, self.on_disk = Progress(), -1  # the step of the newest checkpoint

    def resume(self, checkpoint: Checkpoint) -> None:
        """Go on where a checkpoint was written; InputError, naming the folder, where it is of another network."""
        expected = {name: tensor.shape for name, tensor in self.network.state_dict().items()}
        for tensors in (checkpoint.network, checkpoint.average):
            found = {name: tensor.shape for name, tensor in tensors.items()}
            if wrong := sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name)):
                raise InputError(
                    f"{self.folder}: its checkpoint is of another network ({len(wrong)} tensors differ, e.g. "
                    f"{wrong[0]}): choose another with -o, or --overwrite to start anew"
                )
        self.network.load_state_dict(checkpoint.network)
        self.average.load_state_dict(checkpoint.average)
        self.optimizer.load_state_dict(checkpoint.optimizer)
        self.progress, self.on_disk = checkpoint.progress, checkpoint.progress.step

    def run(self) -> str:
        """Train until the steps are done ("steps"), nothing improves ("patience") or a callback asks ("stopped").

        Raises:
            InputError: an item that cannot be read, a loss that is no number, a file that cannot be written.
        """
        run, last, since = self.recipe.run, self.recipe.optim.steps, time.perf_counter()
        before, stopped, recent = self.progress.seconds, False, list[dict[str, float]]()
        while (why := self._ended(stopped)) is None:
            numbers = self.step(self.progress.step)
            stopped = numbers.pop("stop") > 0
            recent.append(numbers)
            step, seconds = self.progress.step + 1, before + time.perf_counter() - since
            self.progress = dataclasses.replace(self.progress, step=step, seconds=seconds)
            if step % run.log_every == 0 or step == last:
                self._log(recent)
                recent = []
            if step % run.validate_every == 0 or step == last:
                self.validate()
            if step % run.save_every == 0:
                self.save()
        self.save()
        return why

    def _ended(self, stopped: bool) -> str | None:
        if self.progress.step >= self.recipe.optim.steps:
            return "steps"
        if self.progress.stale >= self.recipe.run.patience:
            return "patience"
        return "stopped" if stopped else None

    def step(self, step: int) -> dict[str, float]:
        """One step; returns its numbers as means over the processes: loss, terms, gradient, lr, and stop above 0."""
        method, ranks, optim = self.method, self.ranks, self.recipe.optim
        items = samples_of_step(step, method.items, method.items_a_step, self.recipe.run.seed, ranks.rank, ranks.count)
        mine: dict[str, float] = {}
        parts = list(chunks(items, method.at_once))
        self.optimizer.zero_grad(set_to_none=True)
        for part in parts:
            share = len(part) / len(items)
            with self._adding_up(last=part is parts[-1]):
                loss, terms = method.loss(self.wrapped, step, part)
                (share * loss).backward()  # type: ignore[no-untyped-call]
            for name, value in {"loss": loss.detach(), **terms}.items():
                mine[name] = mine.get(name, 0.0) + share * float(value)
        mine["gradient"] = float(clip_grad_norm_(self.network.parameters(), optim.clip))
        mine["stop"] = float(self.callbacks.stop())
        numbers = dict(zip(mine, ranks.mean(list(mine.values()), self.device), strict=True))
        if not (math.isfinite(numbers["loss"]) and math.isfinite(numbers["gradient"])):
            self._reject(step, items, mine["loss"], numbers)

        rate = learning_rate(step, optim)
        for group in self.optimizer.param_groups:
            group["lr"] = group.get("lr_scale", 1.0) * rate
        self.optimizer.step()
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weight, 1 - ema_decay(step, optim.ema))
        return {**numbers, "lr": rate}

    def _adding_up(self, last: bool) -> contextlib.AbstractContextManager[None]:
        """Around each part of a step: the processes put their gradients together in the last one alone."""
        if last or not isinstance(self.wrapped, DistributedDataParallel):
            return contextlib.nullcontext()
        return self.wrapped.no_sync()

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

    def _log(self, recent: Sequence[dict[str, float]]) -> None:
        if self.ranks.first:
            means = {name: sum(numbers[name] for numbers in recent) / len(recent) for name in recent[0]}
            self.logs.numbers("train", means, self.progress.step)
            self.callbacks.step(self.progress.step, means)

    def validate(self) -> None:
        """Validate the averaged weights, keep them where they are the best so far, and draw what they do."""
        found = validate(self.average, self.method, self.device, self.ranks)
        step = self.progress.step
        self.progress = self.progress.validated({"step": step, **found}, self.method.aim, self.recipe.run.min_delta)
        if not self.ranks.first:
            return
        self.logs.numbers("validation", found, step)
        sheet = self.method.picture(self.average)
        self.logs.picture(self.method.columns, sheet, step)
        (self.folder / PICTURES).mkdir(exist_ok=True)
        save_png(sheet, self.folder / PICTURES / f"{step:07d}.png")
        if self.progress.stale == 0:
            self.method.export(self.average, self.folder / BEST)
        self.callbacks.validated(self.progress)

    def save(self) -> None:
        """Write a checkpoint and the averaged weights; the first process alone does."""
        if not self.ranks.first or self.on_disk == self.progress.step:
            return
        save_checkpoint(self.checkpoint(), self.folder)
        self.method.export(self.average, self.folder / LAST)
        self.on_disk = self.progress.step
        self.callbacks.saved(self.progress)

    def checkpoint(self) -> Checkpoint:
        """All of the run's state."""
        return Checkpoint(
            progress=self.progress,
            network=self.network.state_dict(),
            average=self.average.state_dict(),
            optimizer=self.optimizer.state_dict(),
            recipe=plain(self.recipe),
            digest=self.method.digest,
            method=self.method.name,
        )


def adamw(groups: Sequence[dict[str, object]], recipe: AnyRecipe) -> AdamW:
    """The recipe's optimizer of groups of weights, each with "params" and perhaps "lr_scale"."""
    optim = recipe.optim
    return AdamW(groups, optim.lr, betas=optim.betas, weight_decay=optim.weight_decay)


def learning_rate(step: int, optim: OptimRecipe) -> float:
    """Linear warm-up, then a cosine down to `min_lr` ("Training Details and Loss Weights"); steps count from 0."""
    if step < optim.warmup:
        return optim.lr * (step + 1) / optim.warmup
    done = min(1.0, (step - optim.warmup) / max(1, optim.steps - optim.warmup))
    return optim.min_lr + (optim.lr - optim.min_lr) * (1 + math.cos(math.pi * done)) / 2


def ema_decay(step: int, decay: float) -> float:
    """How much of the average stays at a step."""
    return min(decay, (step + 1) / (step + EMA_START))


def samples_of_step(step: int, count: int, batch: int, seed: int, rank: int = 0, ranks: int = 1) -> list[int]:
    """Which of `count` samples a process sees at a step: nothing but the arguments decides.

    Every epoch is a permutation of all samples by `seed`; a batch may end one and begin the next. All `ranks` processes
    share the same global batch; ValueError where it cannot be divided between them.
    """
    share, rest = divmod(batch, ranks)
    if rest:
        raise ValueError(f"a batch of {batch} cannot be divided between {ranks} processes")
    first = step * batch + rank * share
    return [int(_epoch(seed, place // count, count)[place % count]) for place in range(first, first + share)]


@functools.lru_cache(maxsize=2)
def _epoch(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch]).permutation(count)
