"""Where a run takes place, and what each method of `spackle train` needs before its first step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import nn

from spackle.device import pick_dtype
from spackle.progress import Reporter
from spackle.training.learner import even
from spackle.training.method import Method, MethodName
from spackle.training.ranks import Ranks
from spackle.training.recipe import AnyRecipe

R_co = TypeVar("R_co", bound=AnyRecipe, covariant=True)


@dataclasses.dataclass(frozen=True)
class Place(Generic[R_co]):
    """A recipe and where it is followed."""

    recipe: R_co
    output: Path
    reporter: Reporter  # silent but in the first process
    ranks: Ranks
    device: torch.device  # of the networks

    @property
    def precision(self) -> torch.dtype:
        """What the networks compute in."""
        return pick_dtype(self.recipe.optim.precision, self.device)


@dataclasses.dataclass(frozen=True)
class Start:
    """A method with the weights that it begins with."""

    method: Method
    network: nn.Module
    facts: dict[str, Any]  # about it, for run.json
    pace: Callable[[str], float] = even  # of each weight, see `Learner`


class Plan(Protocol):
    """What can be refused at once has been; the long work is still to come."""

    @property
    def place(self) -> Place[AnyRecipe]:
        """Of the run."""

    @property
    def name(self) -> MethodName:
        """The method's."""

    @property
    def digest(self) -> str:
        """As `Method.digest` will have it."""

    def start(self) -> Start:
        """The long work; every process does it.

        Raises:
            InputError: a file or folder that cannot be used.
        """


def parameters(network: nn.Module) -> dict[str, int]:
    """How many weights of a whole network learn and how many stay, for run.json."""
    counts = {"learn": 0, "stay": 0}
    for weight in network.parameters():
        counts["learn" if weight.requires_grad else "stay"] += weight.numel()
    return counts
