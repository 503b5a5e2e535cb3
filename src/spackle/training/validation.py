"""How good a network is on samples that it has not seen, in numbers and in pictures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from spackle.render import Renderer
from spackle.residual.compose import compose
from spackle.residual.cues import hole_area_ratio
from spackle.training.cache import load_sample
from spackle.training.distance import hole_psnr
from spackle.training.features import FeatureNet
from spackle.training.losses import total_loss
from spackle.training.ranks import Ranks
from spackle.training.recipe import LossRecipe
from spackle.training.sample import Sample
from spackle.training.step import Batch, complete_samples

PICTURED = 6  # samples in the picture
NUMBERS = ("loss", "color", "alpha", "preserve", "perceptual", "hole_psnr", "har_before", "har_after")


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
def validate(network: nn.Module, files: Sequence[Path], judge: Judge, batch: int, ranks: Ranks) -> dict[str, float]:
    """Means over the samples, each in its own right; the same in all processes.

    Args:
        network: the averaged one.
        files: the validation samples, of one size.
        judge: the loss.
        batch: samples at a time.
        ranks: the processes that share the work.

    Returns:
        loss and its terms; hole_psnr in dB, of the samples whose holes are not met exactly; har_before and har_after,
        the share of hole pixels.

    Raises:
        InputError: a sample that cannot be read.
    """
    totals, counts = dict.fromkeys(NUMBERS, 0.0), dict.fromkeys(NUMBERS, 0)
    for part in _batches(files[ranks.rank :: ranks.count], batch):
        samples = [load_sample(file) for file in part]
        done = judge.complete(network, samples)
        loss, terms = judge.total(done)
        means = {name: float(value) for name, value in {"loss": loss, **terms}.items()}
        found = {name: [value] * len(samples) for name, value in means.items()}
        for name, values in {**found, **_of_images(done)}.items():
            finite = [value for value in values if math.isfinite(value)] if name == "hole_psnr" else values
            totals[name] += sum(finite)
            counts[name] += len(finite)
    sums = ranks.sum([*totals.values(), *counts.values()], judge.device)
    pairs = zip(NUMBERS, sums[: len(NUMBERS)], sums[len(NUMBERS) :], strict=True)
    return {name: total / count for name, total, count in pairs if count}


def _of_images(batch: Batch) -> dict[str, list[float]]:
    """What is measured of each completed view."""
    views = list(zip(batch.rgb, batch.target, batch.hole & batch.valid, strict=True))
    return {
        "hole_psnr": [hole_psnr(rgb, target, hole) for rgb, target, hole in views],
        "har_before": [float(hole.double().mean()) for hole in batch.hole],
        "har_after": [hole_area_ratio(alpha) for alpha in batch.alpha],
    }


@torch.no_grad()
def picture(network: nn.Module, samples: Sequence[Sample], judge: Judge) -> Tensor:
    """[n·H, 4·W, 3] sRGB: a row for each sample, with the base, the seeds alone, the completed view and the truth."""
    rows = []
    completed = judge.complete(network, samples)
    for sample, rgb in zip(samples, completed.rgb, strict=True):
        seeds = compose(sample.seeds.select(sample.cues.mask), None, sample.camera)
        alone = judge.renderer.render([sample.base, seeds], sample.camera, tiles=sample.tiles, onto=sample.rendering)
        rows.append(torch.cat([sample.rendering.rgb, alone.rgb, rgb.cpu(), sample.target], dim=1))
    return torch.cat(rows)


def _batches(files: Sequence[Path], size: int) -> Iterator[Sequence[Path]]:
    for start in range(0, len(files), size):
        yield files[start : start + size]
