"""The training loop.

`train` prepares a run, `run_steps` is the loop; its parts are `train_step`, `validate_and_report`
and `save_if_due`.

A `Task` (task.py) defines the network, the data and the loss. Several processes, started by
torchrun, train one network together (ranks.py): each step is divided between them, and process 0
writes all files.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from rich.console import Console
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_

from spackle.formats import save_png
from spackle.paper.training.checkpoint import (
    BEST_WEIGHTS,
    LAST_WEIGHTS,
    PICTURES_FOLDER,
    RUN_FILES,
    Checkpoint,
    find_checkpoint,
    remove_run,
    save_checkpoint,
)
from spackle.paper.training.ranks import (
    joined_ranks,
    rank,
    rank_count,
    sum_of_ranks,
    wait_for_ranks,
)
from spackle.paper.training.recipe import AnyRecipe
from spackle.paper.training.run import TrainingRun, open_run
from spackle.paper.training.run_logs import Logger, open_logs
from spackle.paper.training.schedule import ema_decay, learning_rate, prefetch, samples_of_step
from spackle.paper.training.task import Task
from spackle.runtime.device import pick_device
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import remove_half_written
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter, catch_stop_signals

# Why a run ended, and the line that says so.
END_MESSAGES = {
    "steps": "all steps are done",
    "patience": "the validation no longer improves",
    "stopped": "stopped; the same command resumes the run",
}
R = TypeVar("R", bound=AnyRecipe)


def train(
    recipe: R,
    open_task: Callable[[R, torch.device], Task],
    output: Path,
    reporter: Reporter,
    overwrite: bool = False,
    logger: Logger | None = None,
) -> str:
    """Train a network, or resume a run; under torchrun, as one of several processes.

    Args:
        recipe: the settings of the run.
        open_task: creates the task (the network, its data and its loss) on a device.
        output: a folder for all results.
        reporter: shows progress; used by the first process.
        overwrite: delete an older run in `output`, but keep its samples.
        logger: called by the first process with the number of a step and its values by name,
            which are those of the step's line in metrics.jsonl.

    Returns:
        Why the run ended: "steps" (all steps are done), "patience" (no improvement) or "stopped"
            (by a signal).

    Raises:
        InputError: a file or folder cannot be used, or the loss is not finite.
    """
    requested_device = None if recipe.run.device == "auto" else recipe.run.device
    device_kind = pick_device(requested_device).type
    with joined_ranks(device_kind) as device, contextlib.ExitStack() as stack:
        # Only the first process writes and reports, so only this process locks the folder.
        if rank() == 0:
            stack.enter_context(results_folder(output, RUN_FILES, locked=True))
        else:
            reporter = Reporter(console=Console(quiet=True))

        task = open_task(recipe, device)
        if task.items_per_step % rank_count():
            raise InputError(
                f"optim.batch={recipe.optim.batch} cannot be divided between {rank_count()} "
                "processes"
            )
        checkpoint = None
        if not overwrite:
            checkpoint = find_checkpoint(output, task.name, recipe, task.digest, reporter.log)
        facts = task.prepare(output, reporter)

        # All processes have looked for a checkpoint, so an older run may be deleted.
        wait_for_ranks()
        # From here on, a full disk or a missing permission ends the run with one line.
        stack.enter_context(as_input_error(output, "cannot write: {reason}", OSError))
        if overwrite and rank() == 0:
            remove_run(output)
        # A run that was killed may have left half a picture; the lock keeps others away.
        pictures = output / PICTURES_FOLDER
        if rank() == 0 and pictures.is_dir():
            remove_half_written(pictures)

        run = open_run(recipe, task, device, output, reporter, facts)
        if checkpoint is not None:
            run.resume(checkpoint)
        end_reason = run_steps(run, logger)
        run.write_report(end_reason)
        reporter.log(f"{END_MESSAGES[end_reason]}, step {run.progress.step} -> {output}")
        return end_reason


def run_steps(run: TrainingRun, logger: Logger | None = None) -> str:
    """The loop: train step by step, validate, log and save, until the run ends.

    Args:
        run: the run, at its first step or resumed.
        logger: a function that gets the values of each logged step.

    Returns:
        Why it ended: "steps" (all steps are done), "patience" (no improvement) or "stopped" (by a
            signal).
    """
    progress = run.progress
    optim = run.recipe.optim
    settings = run.recipe.run
    # All passes through the network that are left, in order: each one's step and numbers of items.
    passes = (
        (step, items)
        for step in range(progress.step, optim.steps)
        for items in items_of_passes(run, step)
    )

    def load_pass(step_and_items: tuple[int, list[int]]) -> Any:
        """The batch of a pass, which `prefetch` loads in a thread."""
        step, items = step_and_items
        return run.task.load_batch(step, items)

    with contextlib.ExitStack() as stack:
        if rank() == 0:
            run.logs = stack.enter_context(
                open_logs(run.output, progress.step, run.reporter.log, logger)
            )
        batches = stack.enter_context(
            contextlib.closing(prefetch(load_pass, passes, reader_thread_count(run.device)))
        )
        show_progress = stack.enter_context(run.reporter.steps("train", progress.step, optim.steps))
        stop_requested = stack.enter_context(catch_stop_signals(single_process=rank_count() == 1))

        start_time = time.perf_counter()
        earlier_seconds = progress.seconds  # of the runs that this one resumes
        while run.end_reason() is None:
            # Loss and other numbers of the step wait until they are logged.
            progress.unlogged.append(train_step(run, batches, stop_requested))
            progress.seconds = earlier_seconds + time.perf_counter() - start_time

            values: dict[str, float] = {}  # what is logged of this step
            is_last_step = progress.step == optim.steps
            if progress.step % settings.log_every == 0 or is_last_step:
                means = mean_of_steps(progress.unlogged)
                progress.unlogged.clear()
                values |= {f"train/{name}": mean for name, mean in means.items()}
                show_progress(progress.step, f"loss {means['loss']:.4f}")
            if progress.step % settings.validate_every == 0 or is_last_step:
                measures = validate_and_report(run)
                values |= {f"validation/{name}": mean for name, mean in measures.items()}

            # The checkpoint comes after the logs: a run that is killed between the two repeats the
            # step, and then cuts its line off.
            if values and run.logs is not None:
                run.logs.add(progress.step, progress.seconds, values)
            save_if_due(run)

    end_reason = run.end_reason()
    assert end_reason is not None  # the loop ends for a reason
    return end_reason


def reader_thread_count(device: torch.device) -> int:
    """The number of threads that read batches in advance in this process.

    On a CPU the network itself needs the cores, so one thread reads. Beside GPUs the processes
    divide half of the cores among them for reading.
    """
    if device.type == "cpu":
        return 1
    return max(1, (os.cpu_count() or 1) // (2 * rank_count()))


def train_step(
    run: TrainingRun, batches: Iterator[Any], stop_requested: Callable[[], bool]
) -> dict[str, float]:
    """Do the next step: forward, backward, update of the weights and of their average.

    Args:
        run: the run, whose weights and step number change.
        batches: yields the batches of this process, one for each pass through the network.
        stop_requested: whether this process has received Ctrl-C or SIGTERM. The run ends if any
            process has.

    Returns:
        The loss, its terms, the norm of the gradient ("gradient") and the learning rate ("lr"):
        means over the items of all processes.

    Raises:
        InputError: one of these numbers is not finite; the weights have not changed then.
    """
    step = run.progress.step
    run.optimizer.zero_grad(set_to_none=True)
    own_means = accumulate_gradients(run, batches)  # of this process alone
    gradient_norm = clip_grad_norm_(run.network.parameters(), run.recipe.optim.clip)
    own_means["gradient"] = gradient_norm.double()

    # One transfer from the GPU, and one message between processes, for all numbers together.
    own_values = torch.stack(list(own_means.values())).tolist()
    own_numbers = dict(zip(own_means, own_values, strict=True))
    totals = sum_of_ranks({**own_numbers, "stop": float(stop_requested())}, run.device)
    run.is_stopped = totals.pop("stop") > 0
    numbers = {name: total / rank_count() for name, total in totals.items()}
    not_finite = [name for name, value in numbers.items() if not math.isfinite(value)]
    if not_finite:
        raise InputError(
            f"{run.output}: step {step}: {', '.join(not_finite)} not finite: lower optim.lr"
        )

    numbers["lr"] = update_weights(run, step)
    run.progress.step = step + 1
    return numbers


def accumulate_gradients(run: TrainingRun, batches: Iterator[Any]) -> dict[str, Tensor]:
    """Add the gradients of a step's loss to the network's weights, pass by pass.

    A pass is one run through the network with as many items as fit into memory. Each pass has a
    weight proportional to its number of items, so that the sum is the gradient of the mean loss
    over all items.

    Returns:
        The mean loss of this process ("loss") and the means of its terms by name: scalar tensors
            in float64.
    """
    means: dict[str, Tensor] = {}
    passes = items_of_passes(run, run.progress.step)
    for number, items in enumerate(passes, 1):
        weight = len(items) * rank_count() / run.task.items_per_step

        # `run.wrapped` is the network in a wrapper that averages the gradients of all processes.
        # Once a step is enough, so only the last pass lets them communicate.
        communication: contextlib.AbstractContextManager[Any] = contextlib.nullcontext()
        if rank_count() > 1 and number < len(passes):
            communication = run.wrapped.no_sync()  # type: ignore[operator]
        with communication:
            loss, terms = run.task.loss(run.wrapped, next(batches))
            (weight * loss).backward()  # type: ignore[no-untyped-call]

        for name, value in {"loss": loss.detach(), **terms}.items():
            means[name] = means.get(name, 0.0) + weight * value.double()
    return means


def items_of_passes(run: TrainingRun, step: int) -> list[list[int]]:
    """Numbers of this process's items at a step, divided into passes through the network."""
    task = run.task
    items = samples_of_step(
        step,
        count=task.items,
        batch=task.items_per_step,
        seed=run.recipe.run.seed,
        rank=rank(),
        ranks=rank_count(),
    )
    pass_size = task.micro_batch or len(items)  # None: all items in one pass
    return [items[start : start + pass_size] for start in range(0, len(items), pass_size)]


def update_weights(run: TrainingRun, step: int) -> float:
    """Let the optimiser change the weights, then update their average.

    Returns the learning rate of the step.
    """
    optim = run.recipe.optim
    rate = learning_rate(step, optim)
    # A group of weights may have a factor of its own, such as a pretrained part of the network.
    for group in run.optimizer.param_groups:
        group["lr"] = group.get("lr_scale", 1.0) * rate
    run.optimizer.step()

    # average ← decay · average + (1 - decay) · weights
    decay = ema_decay(step, optim.ema)
    pairs = zip(run.average.parameters(), run.network.parameters(), strict=True)
    with torch.no_grad():
        for average, weight in pairs:
            average.lerp_(weight, 1 - decay)
    return rate


def mean_of_steps(steps: list[dict[str, float]]) -> dict[str, float]:
    """The mean of each number over some steps; every step has the same names."""
    return {name: sum(numbers[name] for numbers in steps) / len(steps) for name in steps[0]}


def validate_and_report(run: TrainingRun) -> dict[str, float]:
    """Validate the averaged weights; returns the means of the measures by name.

    All processes validate; process 0 writes the results.
    """
    measures = validate(run.task, run.average, run.device)
    is_best = run.progress.record_validation(
        measures, run.task.selection_measure, run.recipe.run.min_delta
    )
    if rank() == 0:
        report_validation(run, measures, is_best)
    return measures


def save_if_due(run: TrainingRun) -> None:
    """After a step: let process 0 write the weights and a checkpoint, if it is time.

    It is time every `run.save_every` steps of the recipe, and when the run ends. It may end before
    its last step, because validations no longer improve.
    """
    is_due = run.progress.step % run.recipe.run.save_every == 0 or run.end_reason() is not None
    if rank() != 0 or not is_due:
        return
    run.task.export(run.average, run.output / LAST_WEIGHTS)
    checkpoint = Checkpoint(
        progress=run.progress,
        network=run.network.state_dict(),
        average=run.average.state_dict(),
        optimizer=run.optimizer.state_dict(),
        recipe=run.facts["recipe"],
        digest=run.task.digest,
        method=run.task.name,
    )
    save_checkpoint(checkpoint, run.output)
    run.write_report()


def report_validation(run: TrainingRun, measures: Mapping[str, float], is_best: bool) -> None:
    """Write the results of a validation: a picture, a line of the log and run.json.

    If the averaged weights are the best so far, they are exported.

    `measures` are the means over all validation items by name.
    """
    step = run.progress.step
    picture = run.task.draw_picture(run.average)
    (run.output / PICTURES_FOLDER).mkdir(exist_ok=True)
    save_png(picture, run.output / PICTURES_FOLDER / f"{step:07d}.png")
    if is_best:
        run.task.export(run.average, run.output / BEST_WEIGHTS)

    if run.logs is not None:
        run.logs.add_picture(step, picture)
    values = ", ".join(f"{name} {value:.4f}" for name, value in measures.items())
    run.reporter.log(f"step {step}: validation {values} (best step: {run.progress.best_step})")
    run.write_report()


@torch.no_grad()
def validate(task: Task, network: nn.Module, device: torch.device) -> dict[str, float]:
    """Means of a task's measures over all validation items, by name.

    Values that are not finite do not count, and a measure without any finite value is left out. The
    processes divide the items, and each process gets the same means.
    """
    own_items = range(rank(), task.validation_items, rank_count())
    # As many items at a time as in training. `micro_batch` is their number; if it is None, a
    # process takes all its items of a step at once.
    pass_size = task.micro_batch or task.items_per_step // rank_count()
    totals = dict.fromkeys(task.measures, 0.0)
    counts = dict.fromkeys(task.measures, 0.0)
    for start in range(0, len(own_items), pass_size):
        items = own_items[start : start + pass_size]
        batch = task.load_batch(step=None, items=items)  # None: validation items
        for name, values in task.measure(network, batch).items():
            # PSNR, for example, is NaN for a view without a hole, and infinite for equal images.
            finite = [value for value in values if math.isfinite(value)]
            totals[name] += sum(finite)
            counts[name] += len(finite)

    totals = sum_of_ranks(totals, device)
    counts = sum_of_ranks(counts, device)
    return {name: total / counts[name] for name, total in totals.items() if counts[name]}
