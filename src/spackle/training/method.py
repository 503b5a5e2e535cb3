"""What is trained, and on what, as the trainer sees it: it knows of items and losses, not of Gaussians.

`Plan` and `Start` are what each method needs before its first step, `RunContext` where a run takes place.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from spackle.device import pick_dtype
from spackle.progress import Reporter
from spackle.render import Renderer, get_renderer
from spackle.residual.hole_features import hole_area_ratio
from spackle.training.features import FeatureNet, load_features
from spackle.training.losses import hole_psnr, total_loss
from spackle.training.ranks import Ranks
from spackle.training.recipe import AnyRecipe, LossRecipe, Recipe

PICTURED = 6  # views in the picture
DECIBELS = {"hole_psnr": "in the hole", "seen_psnr": "to the base outside of it"}
MEASURES = ("loss", "color", "alpha", "preserve", "perceptual", *DECIBELS, "har_before", "har_after")


class Method(abc.ABC):
    """A network's task: items, which are counted from 0, in; a loss out."""

    name: ClassVar[str]  # as `--method` and checkpoints have it
    columns: ClassVar[str]  # what the pictures show from left to right
    remedy: ClassVar[str]  # what to do about items that make a loss that is no number
    aim: ClassVar[str] = "loss"  # which measure says what weights are best: the lower the better
    measures: Sequence[str]  # what `measure` finds, by name
    digest: str  # of everything that decides what is learned from, but not of where it lies
    items: int  # to learn from; an epoch has each once
    validation_items: int
    items_a_step: int  # of all processes together
    at_once: int  # go through the network together; a step with more adds up their gradients

    @abc.abstractmethod
    def loss(self, network: nn.Module, step: int, items: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of items to learn from, with gradients, and its terms []; InputError for one that is broken.

        The same for the same step.
        """

    @abc.abstractmethod
    def measure(self, network: nn.Module, items: Sequence[int]) -> dict[str, list[float]]:
        """How good a network is on validation items: values of each measure; InputError likewise."""

    @abc.abstractmethod
    def describe(self, found: Mapping[str, float]) -> str:
        """What a line about a validation says behind its aim: the means of the measures, from a comma on."""

    @abc.abstractmethod
    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: rows of a few validation items in `columns`; InputError likewise."""

    @abc.abstractmethod
    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Copy items to learn from, or their names, to a folder."""

    @abc.abstractmethod
    def export(self, network: nn.Module, path: Path) -> None:
        """Write weights as the rest of the package reads them; InputError where that cannot be."""


@dataclasses.dataclass(frozen=True)
class ViewBatch:
    """Completed views and their truth, stacked."""

    rgb: Tensor  # [B, H, W, 3] sRGB of base and aux Gaussians, with gradients
    alpha: Tensor  # [B, H, W] likewise
    base_rgb: Tensor  # [B, H, W, 3] of the base alone
    target: Tensor  # [B, H, W, 3]
    hole: Tensor  # [B, H, W] bool


@dataclasses.dataclass(frozen=True)
class Objective:
    """The loss of completed views (eq. 6), with all that it needs besides them."""

    loss: LossRecipe
    features: FeatureNet | None
    renderer: Renderer
    precision: torch.dtype
    device: torch.device  # of the networks

    def total(self, batch: ViewBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [], and its terms [] unweighted; where the feature network is."""
        views = {name: tensor.to(self.device) for name, tensor in vars(batch).items()}
        loss = self.loss
        return total_loss(
            **views,
            features=self.features,
            weights=vars(loss),
            dilation=loss.dilation,
            size=loss.feature_size,
            blur=loss.color_blur,
            gram=loss.gram,
        )


class ViewMethod(Method):
    """A method whose items become completed views: one loss, and one way to measure them."""

    measures: Sequence[str] = MEASURES

    def __init__(self, objective: Objective) -> None:
        self.objective = objective

    @abc.abstractmethod
    def complete(self, network: nn.Module, items: Sequence[int], step: int | None = None) -> ViewBatch:
        """Views of the items that a step learns from, or of validation items (no step); InputError as for `loss`."""

    def loss(self, network: nn.Module, step: int, items: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] and its terms []; InputError where an item cannot be read."""
        return self.objective.total(self.complete(network, items, step))

    def measure(self, network: nn.Module, items: Sequence[int]) -> dict[str, list[float]]:
        """Of each view: loss and its terms; hole_psnr and seen_psnr in dB, inside of the hole against the target and
        outside of it against the base, where they are not infinite; har_before and har_after, the share of hole pixels.
        """
        done = self.complete(network, items)
        loss, terms = self.objective.total(done)
        decibels = {
            "hole_psnr": map(hole_psnr, done.rgb, done.target, done.hole),
            "seen_psnr": map(hole_psnr, done.rgb, done.base_rgb, ~done.hole),
        }
        return {
            **{name: [float(value)] * len(done.rgb) for name, value in {"loss": loss, **terms}.items()},
            **{name: [value for value in values if math.isfinite(value)] for name, values in decibels.items()},
            "har_before": [float(hole.double().mean()) for hole in done.hole],
            "har_after": [hole_area_ratio(alpha) for alpha in done.alpha],
        }

    def describe(self, found: Mapping[str, float]) -> str:
        """Decibels, where there are any, and holes."""
        psnr = "".join(f", {found[name]:.2f} dB {place}" for name, place in DECIBELS.items() if name in found)
        return f"{psnr}, holes {found['har_before']:.1%} -> {found['har_after']:.2%}"


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
    features = load_features(loss.features if loss.perceptual else "none", loss.features_file, context.device)
    return Objective(loss, features, get_renderer(), context.precision, context.device)


def facts_of(method: ViewMethod, network: nn.Module) -> dict[str, Any]:
    """What it learns from and how much of `network`, the whole, learns, for run.json."""
    features = method.objective.features
    samples = {"train": method.items, "validation": method.validation_items, "digest": method.digest}
    return {"features": features.name if features else "none", "samples": samples, "parameters": parameters(network)}


def parameters(network: nn.Module) -> dict[str, int]:
    """How many weights of a whole network learn and how many stay, for run.json."""
    counts = {"learn": 0, "stay": 0}
    for weight in network.parameters():
        counts["learn" if weight.requires_grad else "stay"] += weight.numel()
    return counts
