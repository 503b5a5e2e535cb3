"""What the methods have in common whose items become completed views: one loss, and one way to judge them."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

from torch import Tensor, nn

from spackle.residual.hole_features import hole_area_ratio
from spackle.training.distance import hole_psnr
from spackle.training.step import Batch
from spackle.training.validation import Judge

DECIBELS = ("hole_psnr", "seen_psnr")
NUMBERS = ("loss", "color", "alpha", "preserve", "perceptual", *DECIBELS, "har_before", "har_after")
PLACES = {"hole_psnr": "in the hole", "seen_psnr": "to the base outside of it"}


class ViewMethod(abc.ABC):
    """The part of a `Method` that follows from how it completes views."""

    judge: Judge

    measures: ClassVar[Sequence[str]] = NUMBERS
    aim: ClassVar[str] = "loss"

    @abc.abstractmethod
    def complete(self, network: nn.Module, step: int, items: Sequence[int]) -> Batch:
        """Views of items to learn from, with gradients; the same for the same step.

        Raises:
            InputError: an item that cannot be read.
        """

    @abc.abstractmethod
    def complete_judged(self, network: nn.Module, items: Sequence[int]) -> Batch:
        """Views of items to be judged by; InputError likewise."""

    def loss(self, network: nn.Module, step: int, items: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] and its terms []; InputError where an item cannot be read."""
        return self.judge.total(self.complete(network, step, items))

    def judged(self, network: nn.Module, items: Sequence[int]) -> dict[str, list[float]]:
        """Of each view: loss and its terms; hole_psnr and seen_psnr in dB, inside of the hole against the target and
        outside of it against the base, where they are not infinite; har_before and har_after, the share of hole pixels.

        Raises:
            InputError: an item that cannot be read.
        """
        done = self.complete_judged(network, items)
        loss, terms = self.judge.total(done)
        means = {name: [float(value)] * len(done.rgb) for name, value in {"loss": loss, **terms}.items()}
        return {**means, **_of_images(done)}

    def words(self, found: Mapping[str, float]) -> str:
        """Decibels, where there are any, and holes."""
        psnr = "".join(f", {found[name]:.2f} dB {place}" for name, place in PLACES.items() if name in found)
        return f"{psnr}, holes {found['har_before']:.1%} -> {found['har_after']:.2%}"


def _of_images(batch: Batch) -> dict[str, list[float]]:
    """What is measured of each completed view."""
    views = list(zip(batch.rgb, batch.target, batch.hole & batch.valid, strict=True))
    seen = zip(batch.rgb, batch.base_rgb, ~batch.hole, strict=True)
    decibels = {
        "hole_psnr": [hole_psnr(rgb, target, hole) for rgb, target, hole in views],
        "seen_psnr": [hole_psnr(rgb, base, rest) for rgb, base, rest in seen],
    }
    return {
        **{name: [value for value in values if math.isfinite(value)] for name, values in decibels.items()},
        "har_before": [float(hole.double().mean()) for hole in batch.hole],
        "har_after": [hole_area_ratio(alpha) for alpha in batch.alpha],
    }
