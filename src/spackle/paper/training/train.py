"""The training loop: batch, forward, losses, step, validate, save.

A `Task` defines the network, the data and the loss. Several processes, started by torchrun, train one network together.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import math
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW

from spackle.formats import save_png
from spackle.paper.training.checkpoint import (
    BEST_WEIGHTS,
    LAST_WEIGHTS,
    PICTURES_FOLDER,
    RUN_FILES,
    RUN_REPORT,
    Checkpoint,
    TrainingProgress,
    find_checkpoint,
    open_logs,
    remove_run,
    save_checkpoint,
)
from spackle.paper.training.recipe import AnyRecipe, OptimRecipe
from spackle.runtime.device import hardware_facts, package_versions, pick_device
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import results_folder, write_json
from spackle.runtime.progress import Reporter, catch_stop_signals

EMA_WARMUP_STEPS = (
    10  # the early decay is (step + 1) / (step + 10): the average soon forgets the initial weights
)
MAX_WAIT_FOR_RANKS = timedelta(
    hours=24
)  # a process waits so long for other processes, which may still make samples
END_MESSAGES = {
    "steps": "all steps are done",
    "patience": "the validation no longer improves",
    "stopped": "stopped; the same command resumes the run",
}
R = TypeVar("R", bound=AnyRecipe)
K = TypeVar("K")
V = TypeVar("V")


class Task(Protocol):
    """A network to train, and the items of its training data, numbered from 0.

    The constructor is quick and raises InputError for unusable input; `prepare` sets the last two attributes.
    """

    name: ClassVar[str]  # in `--method` and in checkpoints
    selection_measure: ClassVar[str] = (
        "loss"  # the measure by which the best weights are chosen; lower is better
    )
    micro_batch: ClassVar[int | None] = (
        None  # items in one pass through the network; None: all items of a step
    )
    digest: str  # identifies the training data by content, not by paths
    items_per_step: int  # over all processes
    network: nn.Module  # weights with requires_grad are trained in place
    measures: Sequence[str]  # names of the values that `measure` returns
    items: int  # number of training items; an epoch has each item once
    validation_items: int

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Do all long preparations; returns facts for run.json. Every process calls this."""

    def parameter_groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups of weights; a group's "lr_scale" is a factor on the learning rate."""
        return [
            {"params": [weight for weight in self.network.parameters() if weight.requires_grad]}
        ]

    def load_batch(self, step: int | None, items: Sequence[int]) -> Any:
        """Load items of a training step, or validation items if `step` is None; InputError if an item cannot be read.

        The result depends on the arguments alone; any thread may call this.
        """

    def loss(self, network: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of a batch, with gradients, and the loss's terms []."""

    def measure(self, network: nn.Module, batch: Any) -> dict[str, list[float]]:
        """Measure a network on a batch of validation items; returns the values of each measure by name."""

    def draw_picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: results of the network for a few validation items."""

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the weights in the format that the package reads; InputError if that fails."""


def train(
    recipe: R,
    open_task: Callable[[R, torch.device], Task],
    output: Path,
    reporter: Reporter,
    overwrite: bool = False,
) -> str:
    """Train a network, or resume a run; under torchrun, as one of several processes.

    Args:
        recipe: the settings of the run.
        open_task: creates the task on a device.
        output: a folder for all results.
        reporter: used by the first process.
        overwrite: delete an older run in `output`, but keep its samples.

    Returns:
        Why the run ended: "steps" (all steps are done), "patience" (no improvement) or "stopped" (by a signal).

    Raises:
        InputError: a file or folder cannot be used, or the loss is not finite.
    """
    kind = pick_device(None if recipe.run.device == "auto" else recipe.run.device).type
    with joined_ranks(kind) as device, contextlib.ExitStack() as stack:
        if rank() == 0:  # the only process that writes
            stack.enter_context(results_folder(output, RUN_FILES, locked=True))
        else:
            reporter = Reporter(console=Console(quiet=True))
        task = open_task(recipe, device)
        if task.items_per_step % rank_count():
            raise InputError(
                f"optim.batch={recipe.optim.batch} cannot be divided between {rank_count()} processes"
            )
        checkpoint = (
            None
            if overwrite
            else find_checkpoint(output, task.name, recipe, task.digest, reporter.log)
        )
        facts = task.prepare(output, reporter)
        wait_for_ranks()  # all processes have looked for a checkpoint, so an old run may be deleted
        stack.enter_context(as_input_error(output, "cannot write: {reason}", OSError))
        if overwrite and rank() == 0:
            remove_run(output)

        optim, run = recipe.optim, recipe.run
        network: nn.Module = task.network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        average = copy.deepcopy(network).requires_grad_(False)
        wrapped = DistributedDataParallel(network) if rank_count() > 1 else network
        optimizer = AdamW(
            task.parameter_groups(), optim.lr, betas=optim.betas, weight_decay=optim.weight_decay
        )
        progress, stopped = TrainingProgress(), False
        if checkpoint:
            with as_input_error(
                output,
                "the checkpoint has another network ({reason}): choose another -o, or --overwrite",
            ):
                network.load_state_dict(checkpoint.network)
                average.load_state_dict(checkpoint.average)
                optimizer.load_state_dict(checkpoint.optimizer)
            progress = checkpoint.progress
        facts |= {
            "method": task.name,
            "aim": task.selection_measure,
            "recipe": recipe.model_dump(mode="json"),
        }
        facts |= {
            "processes": rank_count(),
            "versions": package_versions(),
            "hardware": hardware_facts(device),
        }

        def ended() -> str:
            """Why the run ends now; empty if the run continues."""
            if progress.step >= optim.steps:
                return "steps"
            return "patience" if progress.stale >= run.patience else "stopped" if stopped else ""

        def report(ended: str | None = None) -> None:
            if rank() == 0:
                write_json(
                    {**facts, "ended": ended, **dataclasses.asdict(progress)}, output / RUN_REPORT
                )

        def parts(step: int) -> list[list[int]]:
            """The items of this process at a step, divided into passes through the network."""
            items = samples_of_step(
                step, task.items, task.items_per_step, run.seed, rank(), rank_count()
            )
            size = task.micro_batch or len(items)
            return [items[start : start + size] for start in range(0, len(items), size)]

        def curves(group: str, values: Mapping[str, float]) -> None:
            for name, value in values.items():
                if logs is not None:
                    logs.add_scalar(f"{group}/{name}", value, progress.step)

        readers = 1 if device.type == "cpu" else max(1, (os.cpu_count() or 1) // (2 * rank_count()))
        todo = ((step, part) for step in range(progress.step, optim.steps) for part in parts(step))
        with (
            open_logs(output, progress.step, reporter.log)
            if rank() == 0
            else contextlib.nullcontext() as logs,
            contextlib.closing(
                prefetch(lambda key: task.load_batch(*key), todo, readers)
            ) as batches,
            reporter.steps("train", progress.step, optim.steps) as tell,
            catch_stop_signals(single_process=rank_count() == 1) as asked,
        ):
            begun, before, recent = time.perf_counter(), progress.seconds, list[dict[str, float]]()
            while not ended():
                step = progress.step

                # Forward and backward: parts add up gradients; after the last part, processes average gradients
                optimizer.zero_grad(set_to_none=True)
                sums: dict[str, Tensor] = {}
                for number, part in enumerate(split := parts(step), 1):
                    share = len(part) * rank_count() / task.items_per_step
                    alone = rank_count() > 1 and number < len(split)
                    with wrapped.no_sync() if alone else contextlib.nullcontext():  # type: ignore[operator]
                        loss, terms = task.loss(wrapped, next(batches))
                        (share * loss).backward()  # type: ignore[no-untyped-call]
                    for name, value in {"loss": loss.detach(), **terms}.items():
                        sums[name] = sums.get(name, 0.0) + share * value.double()
                sums["gradient"] = clip_grad_norm_(network.parameters(), optim.clip).double()
                mine = dict(zip(sums, torch.stack(list(sums.values())).tolist(), strict=True))
                totals = sum_of_ranks({**mine, "stop": float(asked())}, device)
                stopped = totals.pop("stop") > 0
                numbers = {name: total / rank_count() for name, total in totals.items()}
                if bad := [name for name, value in numbers.items() if not math.isfinite(value)]:
                    raise InputError(
                        f"{output}: step {step}: {', '.join(bad)} not finite: lower optim.lr"
                    )

                # Step
                rate = learning_rate(step, optim)
                for group in optimizer.param_groups:
                    group["lr"] = group.get("lr_scale", 1.0) * rate
                optimizer.step()
                with torch.no_grad():
                    for mean, weight in zip(
                        average.parameters(), network.parameters(), strict=True
                    ):
                        mean.lerp_(weight, 1 - ema_decay(step, optim.ema))
                progress.step, progress.seconds = step + 1, before + time.perf_counter() - begun
                recent.append({**numbers, "lr": rate})
                last = progress.step == optim.steps

                # Log
                if progress.step % run.log_every == 0 or last:
                    numbers = {
                        name: sum(each[name] for each in recent) / len(recent) for name in recent[0]
                    }
                    curves("train", numbers)
                    tell(progress.step, f"loss {numbers['loss']:.4f}")
                    recent = []

                # Validate the averaged weights, and export them if they are the best so far
                if progress.step % run.validate_every == 0 or last:
                    measures = validate(task, average, device)
                    best = progress.record_validation(
                        measures, task.selection_measure, run.min_delta
                    )
                    if rank() == 0:
                        sheet = task.draw_picture(average)
                        (output / PICTURES_FOLDER).mkdir(exist_ok=True)
                        save_png(sheet, output / PICTURES_FOLDER / f"{progress.step:07d}.png")
                        if best:
                            task.export(average, output / BEST_WEIGHTS)
                        curves("validation", measures)
                        if logs is not None:
                            logs.add_image(
                                "views", sheet.clamp(0, 1), progress.step, dataformats="HWC"
                            )
                        values = ", ".join(
                            f"{name} {value:.4f}" for name, value in measures.items()
                        )
                        reporter.log(
                            f"step {progress.step}: validation {values} (best step: {progress.best_step})"
                        )
                        report()

                # Save
                if rank() == 0 and (progress.step % run.save_every == 0 or ended()):
                    task.export(average, output / LAST_WEIGHTS)
                    states = network.state_dict(), average.state_dict(), optimizer.state_dict()
                    save_checkpoint(
                        Checkpoint(progress, *states, facts["recipe"], task.digest, task.name),
                        output,
                    )
                    report()
        report(ended())
        reporter.log(f"{END_MESSAGES[ended()]}, step {progress.step} -> {output}")
        return ended()


@torch.no_grad()
def validate(task: Task, network: nn.Module, device: torch.device) -> dict[str, float]:
    """Means of a task's measures over all validation items; values that are not finite are left out.

    The processes divide the items, and each process gets the same means.
    """
    totals, counts = dict.fromkeys(task.measures, 0.0), dict.fromkeys(task.measures, 0.0)
    mine, size = (
        range(rank(), task.validation_items, rank_count()),
        task.micro_batch or task.items_per_step // rank_count(),
    )
    for start in range(0, len(mine), size):
        for name, values in task.measure(
            network, task.load_batch(None, mine[start : start + size])
        ).items():
            finite = [value for value in values if math.isfinite(value)]
            totals[name] += sum(finite)
            counts[name] += len(finite)
    totals, counts = sum_of_ranks(totals, device), sum_of_ranks(counts, device)
    return {name: total / counts[name] for name, total in totals.items() if counts[name]}


def prefetch(make: Callable[[K], V], keys: Iterable[K], threads: int) -> Generator[V, None, None]:
    """Yield `make(key)` for each key, in order; each thread computes one value in advance."""
    with ThreadPoolExecutor(threads, thread_name_prefix="batches") as workers:
        begun = deque[Future[V]]()
        for key in keys:
            begun.append(workers.submit(make, key))
            if len(begun) > threads:
                yield begun.popleft().result()
        yield from (last.result() for last in begun)


def learning_rate(step: int, optim: OptimRecipe) -> float:
    """The learning rate at a step: linear warm-up, then a cosine to `min_lr` ("Training Details and Loss Weights")."""
    if step < optim.warmup:
        return optim.lr * (step + 1) / optim.warmup
    done = min(1.0, (step - optim.warmup) / max(1, optim.steps - optim.warmup))
    return optim.min_lr + (optim.lr - optim.min_lr) * (1 + math.cos(math.pi * done)) / 2


def ema_decay(step: int, decay: float) -> float:
    """The share of the old average at a step; the new weights get the rest."""
    return min(decay, (step + 1) / (step + EMA_WARMUP_STEPS))


def samples_of_step(
    step: int, count: int, batch: int, seed: int, rank: int = 0, ranks: int = 1
) -> list[int]:
    """Indices, below `count`, of the samples that one process uses at a step.

    Every epoch is a permutation of all samples, chosen by `seed`; a batch may extend into the next epoch. `ranks`
    processes divide each batch evenly.
    """
    share = batch // ranks
    first = step * batch + rank * share
    return [
        int(order_of_epoch(seed, place // count, count)[place % count])
        for place in range(first, first + share)
    ]


@functools.lru_cache(maxsize=2)
def order_of_epoch(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch]).permutation(count)


# Several processes --------------------------------------------------------------------------------


@contextlib.contextmanager
def joined_ranks(kind: str) -> Iterator[torch.device]:
    """Join the processes of this run by torchrun's environment variables; yields the device of this process.

    `kind` "cuda" communicates by NCCL, "cpu" by Gloo. InputError if the processes cannot join.
    """
    local = 0
    if "WORLD_SIZE" in os.environ:
        with as_input_error(
            "RANK and WORLD_SIZE are set", "but the processes cannot join: {reason}"
        ):
            local = int(os.environ.get("LOCAL_RANK", "0"))
            dist.init_process_group(
                "nccl" if kind == "cuda" else "gloo", timeout=MAX_WAIT_FOR_RANKS
            )
    if kind == "cuda":
        torch.cuda.set_device(
            local
        )  # also for renderers and features, which use the current device
    try:
        yield torch.device(kind, local) if kind == "cuda" else torch.device(kind)
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()


def rank() -> int:
    """The number of this process among all training processes; process 0 writes and reports."""
    return dist.get_rank() if dist.is_initialized() else 0


def rank_count() -> int:
    """The number of processes that train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def wait_for_ranks() -> None:
    """Wait until all processes have reached this call."""
    if rank_count() > 1:
        dist.barrier()


def sum_of_ranks(numbers: Mapping[str, float], device: torch.device) -> dict[str, float]:
    """The sum of each number over all processes, in float64."""
    tensor = torch.tensor(list(numbers.values()), dtype=torch.float64, device=device)
    if rank_count() > 1:
        dist.all_reduce(tensor)
    return dict(zip(numbers, tensor.tolist(), strict=True))
