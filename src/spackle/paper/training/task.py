"""`Task`: what the training loop needs to know of a network, its data and its loss."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch.nn as nn
from torch import Tensor

from spackle.runtime.progress import Reporter


class Task(Protocol):
    """A network to train, and the items of its training data, numbered from 0.

    An item is what the network learns from at once, such as a part of a view with its target. The
    constructor of a task is quick and raises InputError for unusable input; `prepare` does the long
    work, and sets `items` and `validation_items`.
    """

    #: Name in the option `method` and in checkpoints.
    name: ClassVar[str]
    #: The measure by which the best weights are chosen; lower is better.
    selection_measure: ClassVar[str] = "loss"
    #: Items in one pass through the network; the gradients of passes add up. None: all of a step.
    micro_batch: int | None = None
    #: Identifies the training data by content, not by paths.
    digest: str
    #: Items of a training step, over all processes.
    items_per_step: int
    #: The network; weights with requires_grad are trained in place.
    network: nn.Module
    #: Names of the values that `measure` returns.
    measures: Sequence[str]
    #: Number of training items; an epoch has each item once.
    items: int
    #: Number of validation items.
    validation_items: int

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Do all long preparations; returns facts about the data for run.json.

        Every process of a run calls this.
        """

    def parameter_groups(self) -> list[dict[str, Any]]:
        """The groups of weights that the optimiser trains: one, all that have requires_grad.

        A group is {"params": [weights]}, and may have an "lr_scale", a factor on the learning rate.
        """
        trained = [weight for weight in self.network.parameters() if weight.requires_grad]
        return [{"params": trained}]

    def load_batch(self, step: int | None, items: Sequence[int]) -> Any:
        """Load items of a training step, or validation items if `step` is None, by their numbers.

        The result depends on the arguments alone; any thread may call this. InputError if an item
        cannot be read.
        """

    def loss(self, network: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch, a scalar with gradients, and the loss's terms by name."""

    def measure(self, network: nn.Module, batch: Any) -> dict[str, list[float]]:
        """Measure a network on validation items; returns the values of each measure by name."""

    def draw_picture(self, network: nn.Module) -> Tensor:
        """A picture [H, W, 3] sRGB of the network's results for a few validation items."""

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the weights in the format that the package reads; InputError if that fails."""
