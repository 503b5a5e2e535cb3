"""The loss, and how good a network is on views that it has not learned from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spackle.render import Renderer
from spackle.training.features import FeatureNet
from spackle.training.losses import total_loss
from spackle.training.method import Method, chunks
from spackle.training.ranks import Ranks
from spackle.training.recipe import LossRecipe
from spackle.training.sample import Sample
from spackle.training.step import Batch, complete_samples

PICTURED = 6  # views in the picture


@dataclasses.dataclass(frozen=True)
class Judge:
    """What the loss needs besides a batch."""

    loss: LossRecipe
    features: FeatureNet | None
    renderer: Renderer
    precision: torch.dtype
    device: torch.device  # of the networks

    def complete(self, network: nn.Module, samples: Sequence[Sample]) -> Batch:
        """Run the network on samples of one size."""
        return complete_samples(network, samples, self.renderer, self.precision)

    def total(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [], and its terms [] unweighted; where the feature network is."""
        rgb, alpha, base_rgb, target, hole, valid = (
            getattr(batch, field.name).to(self.device) for field in dataclasses.fields(batch)
        )
        recipe = self.loss
        return total_loss(
            rgb, alpha, target, base_rgb, hole, valid=valid,
            features=self.features, weights=recipe.weights, dilation=recipe.dilation, size=recipe.feature_size,
        )  # fmt: skip


@torch.no_grad()
def validate(network: nn.Module, method: Method, device: torch.device, ranks: Ranks) -> dict[str, float]:
    """Means over the judged items, each in its own right; the same in all processes.

    Args:
        network: the averaged one.
        method: whose items and measures count.
        device: where the processes' sums are added up.
        ranks: the processes that share the work.

    Returns:
        The method's measures, but those that no item has.

    Raises:
        InputError: an item that cannot be read.
    """
    totals, counts = dict.fromkeys(method.measures, 0.0), dict.fromkeys(method.measures, 0)
    mine = range(ranks.rank, method.judged_items, ranks.count)
    for part in chunks(mine, method.at_once):
        for name, values in method.judged(network, part).items():
            totals[name] += sum(values)
            counts[name] += len(values)
    sums = ranks.sum([*totals.values(), *counts.values()], device)
    pairs = zip(totals, sums[: len(totals)], sums[len(totals) :], strict=True)
    return {name: total / count for name, total, count in pairs if count}
