"""The training loop: items in, weights out; whatever stops it, it goes on from its last checkpoint."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
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
from spackle.training.method import Method
from spackle.training.ranks import Ranks
from spackle.training.recipe import AnyRecipe, OptimRecipe, plain


@dataclasses.dataclass(frozen=True)
class Callbacks:
    """Functions that the trainer calls."""

    step: Callable[[int, dict[str, float]], None]  # steps done, and their mean numbers since it was last called
    validated: Callable[[Progress, Tensor], None]  # and a picture [H, W, 3] sRGB of what the weights do
    saved: Callable[[Progress], None]  # a checkpoint is on the disk
    stop: Callable[[], bool]  # whether somebody wants it to end after this step


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
            ranks: this process among those that share the gradients; the first one writes.
            optimizer: of the network's weights; a group's "lr_scale" is a factor on the learning rate. None: AdamW.
        """
        self.recipe, self.method, self.folder, self.device = recipe, method, folder, device
        self.callbacks, self.ranks = callbacks, ranks or Ranks()
        self.network: nn.Module = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        # Gradients are averaged over the processes while they are computed.
        self.wrapped: nn.Module = DistributedDataParallel(network) if self.ranks.count > 1 else network
        self.optimizer = optimizer or adamw([{"params": [w for w in network.parameters() if w.requires_grad]}], recipe)
        self.progress, self.on_disk = Progress(), -1  # the step of the newest checkpoint
        # A fused optimizer leaves the weights alone where a flag says so: then numbers may be looked at later.
        self.late = self.ranks.count == 1 and bool(self.optimizer.defaults.get("fused"))
        self._sound = torch.ones((), dtype=torch.bool).to(device)  # whether all numbers were finite so far
        self._unread: list[tuple[int, dict[str, Tensor]]] = []

    def resume(self, checkpoint: Checkpoint) -> None:
        """Go on where a checkpoint was written; InputError, naming the folder, where it is of another network."""
        for group in checkpoint.optimizer["param_groups"]:
            group["fused"] = self.optimizer.defaults.get("fused")  # of this device, not of the one that wrote it
        try:
            self.network.load_state_dict(checkpoint.network)
            self.average.load_state_dict(checkpoint.average)
            self.optimizer.load_state_dict(checkpoint.optimizer)
        except (RuntimeError, ValueError) as error:
            raise InputError(
                f"{self.folder}: its checkpoint is of another network ({reason_in_a_line(error)}): "
                "choose another with -o, or --overwrite to start anew"
            ) from error
        self.progress, self.on_disk = checkpoint.progress, checkpoint.progress.step

    def run(self) -> str:
        """Train until the steps are done ("steps"), nothing improves ("patience") or a callback asks ("stopped").

        InputError for an item that cannot be read, a loss that is not finite, a file that cannot be written.
        """
        run, last, since = self.recipe.run, self.recipe.optim.steps, time.perf_counter()
        before, stopped, recent = self.progress.seconds, False, list[dict[str, float]]()
        while self.progress.step < last and self.progress.stale < run.patience and not stopped:
            for numbers in self.step(self.progress.step):
                stopped = numbers.pop("stop") > 0 or stopped
                recent.append(numbers)
            step, seconds = self.progress.step + 1, before + time.perf_counter() - since
            self.progress = dataclasses.replace(self.progress, step=step, seconds=seconds)
            if step % run.log_every == 0 or step == last:
                means = {name: sum(each[name] for each in recent) / len(recent) for name in recent[0]}
                self.callbacks.step(step, means)
                recent = []
            if step % run.validate_every == 0 or step == last:
                self.validate()
            if step % run.save_every == 0:
                self.save()
        self.save()
        if self.progress.step >= last:
            return "steps"
        return "patience" if self.progress.stale >= run.patience else "stopped"

    def step(self, step: int) -> list[dict[str, float]]:
        """One step; returns its numbers as means over the processes: loss, terms, gradient, lr, and stop above 0.

        A GPU that works alone is not waited for at each step: numbers come together, once something depends on them.
        """
        method, ranks, optim = self.method, self.ranks, self.recipe.optim
        items = self._items(step)
        found: dict[str, Tensor] = {}
        parts = [items[start : start + method.at_once] for start in range(0, len(items), method.at_once)]
        self.optimizer.zero_grad(set_to_none=True)
        for part in parts:
            share = len(part) / len(items)
            # Processes put their gradients together in the last part of a step alone.
            later = ranks.count > 1 and part is not parts[-1]
            with self.wrapped.no_sync() if later else contextlib.nullcontext():  # type: ignore[operator]
                loss, terms = method.loss(self.wrapped, step, part)
                (share * loss).backward()  # type: ignore[no-untyped-call]
            for name, value in {"loss": loss.detach(), **terms}.items():
                found[name] = found.get(name, 0.0) + share * value.double()
        found["gradient"] = clip_grad_norm_(self.network.parameters(), optim.clip).double()
        self._unread.append((step, found))
        numbers = [] if self.late else self._read()
        if self.late:
            self._sound = self._sound & found["loss"].isfinite() & found["gradient"].isfinite()
            self.optimizer.found_inf = (~self._sound).float()  # type: ignore[attr-defined]  # as torch's GradScaler does

        rate = learning_rate(step, optim)
        for group in self.optimizer.param_groups:
            group["lr"] = group.get("lr_scale", 1.0) * rate
        self.optimizer.step()
        with torch.no_grad():
            share = 1 - ema_decay(step, optim.ema)
            for mean, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weight, share * self._sound.to(mean.dtype) if self.late else share)
        return self._read() if self.late and self._due(step + 1) else numbers

    def _due(self, step: int) -> bool:
        """Whether something depends on the numbers of all steps so far."""
        run = self.recipe.run
        often = any(step % every == 0 for every in (run.log_every, run.validate_every, run.save_every))
        return often or step == self.recipe.optim.steps or self.callbacks.stop()

    def _read(self) -> list[dict[str, float]]:
        """The numbers of all steps since the last look, for which a GPU is waited for once; none that is not finite."""
        ranks, read = self.ranks, list[dict[str, float]]()
        table = torch.stack([torch.stack(list(found.values())) for _, found in self._unread]).tolist()
        unread, self._unread = self._unread, []
        for (step, found), row in zip(unread, table, strict=True):
            mine = {**dict(zip(found, row, strict=True)), "stop": float(self.callbacks.stop())}
            sums = ranks.sum(list(mine.values()), self.device)
            numbers = {name: total / ranks.count for name, total in zip(mine, sums, strict=True)}
            if not (math.isfinite(numbers["loss"]) and math.isfinite(numbers["gradient"])):
                self._reject(step, mine["loss"], numbers)
            read.append({**numbers, "lr": learning_rate(step, self.recipe.optim)})
        return read

    def _items(self, step: int) -> list[int]:
        """What this process learns from at a step."""
        method, ranks = self.method, self.ranks
        return samples_of_step(step, method.items, method.items_a_step, self.recipe.run.seed, ranks.rank, ranks.count)

    def _reject(self, step: int, loss: float, numbers: dict[str, float]) -> None:
        """Keep what made a loss that is no number, and end the run; nothing has learned from it."""
        items, self.progress = self._items(step), dataclasses.replace(self.progress, step=step)
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

    def validate(self) -> None:
        """Validate the averaged weights, keep them where they are the best so far, and draw what they do."""
        found, step = self._measured(), self.progress.step
        self.progress = self.progress.validated({"step": step, **found}, self.method.aim, self.recipe.run.min_delta)
        if not self.ranks.first:
            return
        sheet = self.method.picture(self.average)
        (self.folder / PICTURES).mkdir(exist_ok=True)
        save_png(sheet, self.folder / PICTURES / f"{step:07d}.png")
        if self.progress.stale == 0:
            self.method.export(self.average, self.folder / BEST)
        self.callbacks.validated(self.progress, sheet)

    @torch.no_grad()
    def _measured(self) -> dict[str, float]:
        """Means of the method's measures over its validation items, the same in all processes, which share the items.

        A measure that no item has is missing.
        """
        method, ranks = self.method, self.ranks
        totals, counts = dict.fromkeys(method.measures, 0.0), dict.fromkeys(method.measures, 0)
        mine = range(ranks.rank, method.validation_items, ranks.count)
        for start in range(0, len(mine), method.at_once):
            for name, values in method.measure(self.average, mine[start : start + method.at_once]).items():
                totals[name] += sum(values)
                counts[name] += len(values)
        sums = ranks.sum([*totals.values(), *counts.values()], self.device)
        pairs = zip(totals, sums[: len(totals)], sums[len(totals) :], strict=True)
        return {name: total / count for name, total, count in pairs if count}

    def save(self) -> None:
        """Write a checkpoint and the averaged weights; the first process alone does."""
        if not self.ranks.first or self.on_disk == self.progress.step:
            return
        self.method.export(self.average, self.folder / LAST)
        save_checkpoint(self.checkpoint(), self.folder)  # at the end: a run that is killed before it exports again
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
    weights: list[Tensor] = [weight for group in groups for weight in group["params"]]  # type: ignore[attr-defined]
    fused = all(weight.is_cuda for weight in weights) or None
    return AdamW(groups, optim.lr, betas=optim.betas, weight_decay=optim.weight_decay, fused=fused)


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
