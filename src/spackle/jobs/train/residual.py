"""`spackle train --method residual`: samples that are made once, and a network that is new or from a file."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from spackle.jobs.train.judge import feature_name, judge_of
from spackle.jobs.train.plan import Place, Start, parameters
from spackle.output_folder import make_folder
from spackle.progress import Reporter
from spackle.residual.network import ResidualNet, load_residual
from spackle.training.data import SampleFiles, Supply
from spackle.training.method import MethodName
from spackle.training.recipe import Recipe
from spackle.training.residual_method import ResidualMethod
from spackle.training.validation import Judge

CACHE = "cache"  # in the output, where the recipe names no other place


@dataclasses.dataclass(frozen=True)
class ResidualPlan:
    """Files were found, no sample is made."""

    place: Place[Recipe]
    judge: Judge
    network: ResidualNet
    supply: Supply

    name: ClassVar[MethodName] = "residual"

    @staticmethod
    def of(place: Place[Recipe]) -> ResidualPlan:
        """Look for a recipe's files; InputError where they cannot be used."""
        judge = judge_of(place)
        network = _first_network(place.recipe).requires_grad_()
        return ResidualPlan(place, judge, network, Supply.of(place.recipe.data, judge.renderer))

    @property
    def digest(self) -> str:
        """The samples'."""
        return self.supply.digest

    def start(self) -> Start:
        """Make the samples that are missing."""
        samples, place = self._samples(), self.place
        method = ResidualMethod(samples, self.judge, place.recipe.optim.batch, place.ranks.count)
        counts = {"train": len(samples.train), "validation": len(samples.validation), "digest": samples.digest}
        facts = {"features": feature_name(self.judge), "samples": counts, "parameters": parameters(self.network)}
        return Start(method, self.network, facts)

    def _samples(self) -> SampleFiles:
        """Made by the first process, found by the others."""
        place, supply = self.place, self.supply
        folder = place.recipe.data.cache or place.output / CACHE
        passed = _PassedOver(place.reporter)
        if not place.ranks.first:
            place.ranks.wait()
            return supply.samples(folder, _nothing, _nothing, passed.add)
        make_folder(folder)
        seconds: dict[str, float] = {}
        place.reporter.say(f"samples of {supply.data.views + supply.data.validation_views} views in {folder}")
        with place.reporter.stage("samples", seconds) as step:
            samples = supply.samples(folder, step, step, passed.add)
        passed.sum_up()
        place.reporter.say(f"{len(samples.train)} samples to learn from, {len(samples.validation)} to be judged by")
        place.ranks.wait()
        return samples


class _PassedOver:
    """Views that could not be made: each reason is said once."""

    def __init__(self, reporter: Reporter) -> None:
        self.reporter, self.views, self.reasons = reporter, 0, set[str]()

    def add(self, line: str) -> None:
        reason = line.partition("passed over: ")[2]
        self.views += 1
        if reason not in self.reasons:
            self.reasons.add(reason)
            self.reporter.say(f"passed over: {reason}")

    def sum_up(self) -> None:
        if self.views:
            self.reporter.say(f"{self.views} views were passed over, for {len(self.reasons)} reasons (above)")


def _first_network(recipe: Recipe) -> ResidualNet:
    """The weights that a run starts from, by its seed or from a file."""
    if recipe.init is not None:
        return load_residual(recipe.init)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.run.seed)
        return ResidualNet()


def _nothing(done: int, total: int) -> None:
    """Nobody is told."""
