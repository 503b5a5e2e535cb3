"""`TrainingRun`: a run in progress, with its network, optimiser and progress."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.optim import AdamW

from spackle.paper.training.checkpoint import RUN_REPORT, Checkpoint, TrainingProgress
from spackle.paper.training.ranks import rank, rank_count
from spackle.paper.training.recipe import AnyRecipe
from spackle.paper.training.run_logs import RunLogs
from spackle.paper.training.task import Task
from spackle.runtime.device import hardware_facts, package_versions
from spackle.runtime.errors import as_input_error
from spackle.runtime.files import write_json
from spackle.runtime.progress import Reporter


@dataclasses.dataclass
class TrainingRun:
    """A run in progress: its settings, and everything that a step changes."""

    recipe: AnyRecipe
    task: Task
    device: torch.device
    output: Path
    reporter: Reporter
    facts: dict[str, Any]  # for run.json: settings, data, versions, hardware
    network: nn.Module  # the weights that the optimiser changes
    average: nn.Module  # moving average of these weights, which is validated and exported
    optimizer: AdamW
    progress: TrainingProgress = dataclasses.field(default_factory=TrainingProgress)
    is_stopped: bool = False  # whether any process has received Ctrl-C or SIGTERM
    logs: RunLogs | None = None  # None before the first step, and in processes other than 0

    def __post_init__(self) -> None:
        """Let several processes average their gradients, by a wrapper around the network."""
        self.wrapped = self.network
        if rank_count() > 1:
            self.wrapped = DistributedDataParallel(self.network)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint of this run; InputError if its network is another one."""
        problem = (
            "the checkpoint has another network ({reason}): choose another `output`, or `overwrite`"
        )
        with as_input_error(self.output, problem):
            self.network.load_state_dict(checkpoint.network)
            self.average.load_state_dict(checkpoint.average)
            self.optimizer.load_state_dict(checkpoint.optimizer)
        self.progress = checkpoint.progress

    def end_reason(self) -> str | None:
        """Why the run ends now: "steps", "patience" or "stopped"; None if it continues.

        All steps are done, the validation has not improved for long, or a signal has come.
        """
        if self.progress.step >= self.recipe.optim.steps:
            return "steps"
        if self.progress.stale >= self.recipe.run.patience:
            return "patience"
        return "stopped" if self.is_stopped else None

    def write_report(self, ended: str | None = None) -> None:
        """Write run.json: the facts of the run, why it ended, and its progress.

        `ended` is None while the run goes on.
        """
        if rank() == 0:
            progress = dataclasses.asdict(self.progress)
            del progress["unlogged"]  # says nothing to a reader
            write_json({**self.facts, "ended": ended, **progress}, self.output / RUN_REPORT)


def open_run(
    recipe: AnyRecipe,
    task: Task,
    device: torch.device,
    output: Path,
    reporter: Reporter,
    facts: Mapping[str, Any],
) -> TrainingRun:
    """A run at step 0: the network on its device, a copy for the average, and the optimiser.

    `facts`, from the task's preparation, come first in run.json; settings, versions and hardware
    follow.
    """
    # Convolutions are faster if the channels of a pixel lie beside each other in memory.
    network: nn.Module = task.network.to(
        device,
        memory_format=torch.channels_last,  # type: ignore[call-overload]
    )
    optim = recipe.optim
    optimizer = AdamW(
        task.parameter_groups(), optim.lr, betas=optim.betas, weight_decay=optim.weight_decay
    )
    return TrainingRun(
        recipe=recipe,
        task=task,
        device=device,
        output=output,
        reporter=reporter,
        facts={
            **facts,
            "method": task.name,
            "aim": task.selection_measure,  # what decides which weights are the best
            "recipe": recipe.model_dump(mode="json"),
            "processes": rank_count(),
            "versions": package_versions(),
            "hardware": hardware_facts(device),
        },
        network=network,
        average=copy.deepcopy(network).requires_grad_(False),
        optimizer=optimizer,
    )
