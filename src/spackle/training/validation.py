"""The loss, and how good a network is on views that it has not learned from."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spackle.render import Renderer
from spackle.residual.cues import hole_area_ratio
from spackle.training.distance import hole_psnr
from spackle.training.features import FeatureNet
from spackle.training.losses import total_loss
from spackle.training.method import Method, chunks
from spackle.training.ranks import Ranks
from spackle.training.recipe import LossRecipe
from spackle.training.sample import Sample
from spackle.training.step import Batch, complete_samples

PICTURED = 6  # views in the picture
DECIBELS = ("hole_psnr", "seen_psnr")
NUMBERS = ("loss", "color", "alpha", "preserve", "perceptual", *DECIBELS, "har_before", "har_after")


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
def validate(network: nn.Module, method: Method, judge: Judge, ranks: Ranks) -> dict[str, float]:
    """Means over the judged views, each in its own right; the same in all processes.

    Args:
        network: the averaged one.
        method: whose views count.
        judge: the loss.
        ranks: the processes that share the work.

    Returns:
        loss and its terms; hole_psnr and seen_psnr in dB, inside of the holes against the target and outside of them
        against the base, of the views in which they are not infinite; har_before and har_after, the share of hole
        pixels.

    Raises:
        InputError: an item that cannot be read.
    """
    totals, counts = dict.fromkeys(NUMBERS, 0.0), dict.fromkeys(NUMBERS, 0)
    mine = range(ranks.rank, method.judged_items, ranks.count)
    for part in chunks(mine, method.at_once):
        done = method.complete_judged(network, part)
        loss, terms = judge.total(done)
        means = {name: float(value) for name, value in {"loss": loss, **terms}.items()}
        found = {name: [value] * len(done.rgb) for name, value in means.items()}
        for name, values in {**found, **_of_images(done)}.items():
            finite = [value for value in values if math.isfinite(value)] if name in DECIBELS else values
            totals[name] += sum(finite)
            counts[name] += len(finite)
    sums = ranks.sum([*totals.values(), *counts.values()], judge.device)
    pairs = zip(NUMBERS, sums[: len(NUMBERS)], sums[len(NUMBERS) :], strict=True)
    return {name: total / count for name, total, count in pairs if count}


def _of_images(batch: Batch) -> dict[str, list[float]]:
    """What is measured of each completed view."""
    views = list(zip(batch.rgb, batch.target, batch.hole & batch.valid, strict=True))
    seen = zip(batch.rgb, batch.base_rgb, ~batch.hole, strict=True)
    return {
        "hole_psnr": [hole_psnr(rgb, target, hole) for rgb, target, hole in views],
        "seen_psnr": [hole_psnr(rgb, base, rest) for rgb, base, rest in seen],
        "har_before": [float(hole.double().mean()) for hole in batch.hole],
        "har_after": [hole_area_ratio(alpha) for alpha in batch.alpha],
    }
