"""Where a run takes place, and what each method needs before its first step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import nn
from torch.optim import Optimizer

from spackle.device import pick_dtype
from spackle.progress import Reporter
from spackle.render import get_renderer
from spackle.training.features import load_features
from spackle.training.method import Method, Objective
from spackle.training.ranks import Ranks
from spackle.training.recipe import AnyRecipe, Recipe

CACHE = "cache"  # in the output, where the recipe names no other place
R_co = TypeVar("R_co", bound=AnyRecipe, covariant=True)


@dataclasses.dataclass(frozen=True)
class RunContext(Generic[R_co]):
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
    optimizer: Optimizer | None = None  # in place of the trainer's own


@dataclasses.dataclass(frozen=True)
class Plan:
    """What can be refused at once has been; the long work is still to come."""

    method: str  # its name
    digest: str  # as `Method.digest` will have it
    start: Callable[[], Start]  # the long work; every process does it, InputError for files that cannot be used


def load_objective(context: RunContext[Recipe]) -> Objective:
    """The recipe's loss; InputError where its feature network cannot be read."""
    loss = context.recipe.loss
    features = load_features(loss.features if loss.perceptual else "none", loss.features_path, context.device)
    return Objective(loss, features, get_renderer(), context.precision, context.device)


def parameters(network: nn.Module) -> dict[str, int]:
    """How many weights of a whole network learn and how many stay, for run.json."""
    counts = {"learn": 0, "stay": 0}
    for weight in network.parameters():
        counts["learn" if weight.requires_grad else "stay"] += weight.numel()
    return counts
