"""What the training loop sees of what learns: batches in, losses out. `ViewTask` is for completed views."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from spackle.device import pick_dtype
from spackle.formats.png import thumbnail
from spackle.progress import Reporter
from spackle.render import get_renderer
from spackle.residual.mask import hole_area_ratio
from spackle.training.features import load_features
from spackle.training.losses import hole_psnr, total_loss
from spackle.training.recipe import Recipe

PICTURED = 6  # views in the picture
PICTURE_SIDE = 512  # pixels of a picture's longer side


class Task(abc.ABC):
    """What learns, and from which items; they are counted from 0.

    To make one is quick, and refuses with an InputError what cannot be used. `prepare` gives it the rest of its values.
    """

    name: ClassVar[str]  # as `--method` and checkpoints have it
    aim: ClassVar[str] = "loss"  # the measure that chooses the best weights: the lower the better
    at_once: ClassVar[int | None] = None  # items that go through the network together; None: all of a process's step
    digest: str  # of everything that decides what is learned from, but not of where it lies
    items_a_step: int  # of all processes together
    network: nn.Module  # its weights that ask for gradients learn, in place
    measures: Sequence[str]  # names of what `measure` finds
    items: int  # to learn from; an epoch has each once
    validation_items: int

    @abc.abstractmethod
    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Do the long work, in every process; returns facts for run.json. InputError for files that cannot be used."""

    def groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups of weights; "lr_scale" in one is a factor on the learning rate."""
        return [{"params": [weight for weight in self.network.parameters() if weight.requires_grad]}]

    @abc.abstractmethod
    def batch(self, step: int | None, items: Sequence[int]) -> Any:
        """Items that a step learns from, or validation items (None), by nothing but the arguments; in any thread.

        InputError for one that cannot be read.
        """

    @abc.abstractmethod
    def loss(self, network: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of a batch, with gradients, and its terms []."""

    @abc.abstractmethod
    def measure(self, network: nn.Module, batch: Any) -> dict[str, list[float]]:
        """How good a network is on a batch of validation items: each measure's values."""

    @abc.abstractmethod
    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: a few validation items; see `sheet`."""

    @abc.abstractmethod
    def names(self, step: int, items: Sequence[int]) -> list[str]:
        """What a step's items are called, for a person who looks for a bad one."""

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


class ViewTask(Task):
    """A task whose batches become completed views, with the loss of eq. 6."""

    measures = ("loss", "color", "alpha", "preserve", "perceptual", "hole_psnr", "seen_psnr", "har_before", "har_after")

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        """Load the feature network; InputError where it cannot be read."""
        self.recipe, self.device, self.renderer = recipe, device, get_renderer()
        self.precision = pick_dtype(recipe.optim.precision, device)
        features = recipe.loss.features if recipe.loss.perceptual else "none"
        self.features = load_features(features, recipe.loss.features_file, device)

    @abc.abstractmethod
    def complete(self, network: nn.Module, batch: Any) -> ViewBatch:
        """The views of a batch, completed."""

    def total(self, views: ViewBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The recipe's loss [] of completed views, and its terms [] unweighted, on the task's device."""
        loss = self.recipe.loss
        return total_loss(
            **{name: tensor.to(self.device) for name, tensor in vars(views).items()},
            features=self.features,
            weights=vars(loss),
            dilation=loss.dilation,
            size=loss.feature_size,
            blur=loss.color_blur,
            gram=loss.gram,
        )

    def loss(self, network: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        return self.total(self.complete(network, batch))

    def measure(self, network: nn.Module, batch: Any) -> dict[str, list[float]]:
        """Of each view: loss and its terms; hole_psnr and seen_psnr in dB, inside of the hole against the target and
        outside of it against the base, where they are not infinite; har_before and har_after, the share of hole pixels.
        """
        views = self.complete(network, batch)
        loss, terms = self.total(views)
        decibels = {
            "hole_psnr": map(hole_psnr, views.rgb, views.target, views.hole),
            "seen_psnr": map(hole_psnr, views.rgb, views.base_rgb, ~views.hole),
        }
        return {
            **{name: [float(value)] * len(views.rgb) for name, value in {"loss": loss, **terms}.items()},
            **{name: [value for value in values if math.isfinite(value)] for name, values in decibels.items()},
            "har_before": [float(hole.double().mean()) for hole in views.hole],
            "har_after": [hole_area_ratio(alpha) for alpha in views.alpha],
        }

    def facts(self, network: nn.Module) -> dict[str, Any]:
        """For run.json: what is learned from, and how much of a whole network learns."""
        return {
            "features": self.features.name if self.features else "none",
            "samples": {"train": self.items, "validation": self.validation_items, "digest": self.digest},
            "parameters": parameters(network),
            "precision": str(self.precision).removeprefix("torch."),
        }


def parameters(network: nn.Module) -> dict[str, int]:
    """How many weights of a network learn and how many stay, for run.json."""
    counts = {"learn": 0, "stay": 0}
    for weight in network.parameters():
        counts["learn" if weight.requires_grad else "stay"] += weight.numel()
    return counts


def sheet(rows: Sequence[Sequence[Tensor]], side: int) -> Tensor:
    """[H, W, 3]: rows of pictures [h, w, 3], each at most `side` long; narrower rows are black at their end."""
    shown = [torch.cat([thumbnail(picture.cpu(), side) for picture in row], dim=1) for row in rows]
    widest = max(row.shape[1] for row in shown)
    return torch.cat([pad(row, (0, 0, 0, widest - row.shape[1])) for row in shown])
