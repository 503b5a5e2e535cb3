"""The paper's own method: a residual network learns to complete cached samples, the base stays as it is."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

from spackle.gaussians import Gaussians
from spackle.output_folder import make_folder
from spackle.progress import Reporter
from spackle.render import Renderer
from spackle.residual.compose import compose
from spackle.residual.hole_features import Cues
from spackle.residual.network import ResidualNet, load_residual, network_input
from spackle.training.checkpoint import export_weights
from spackle.training.data import SampleFiles, Supply
from spackle.training.method import (
    CACHE,
    PICTURED,
    Objective,
    Plan,
    RunContext,
    Start,
    ViewBatch,
    ViewMethod,
    load_objective,
    parameters,
)
from spackle.training.recipe import Recipe
from spackle.training.sample import Sample, load_sample

MIN_AUX = 64  # aux Gaussians of a view, however small its holes (paper, "Training Details and Loss Weights")


def complete_samples(
    network: nn.Module, samples: Sequence[Sample], renderer: Renderer, precision: torch.dtype = torch.float32
) -> ViewBatch:
    """Run the network on samples of one size, and render them with what it adds.

    Args:
        network: a `ResidualNet`, by itself or wrapped, on any device; the only thing that gets gradients.
        samples: of the same height and width.
        renderer: draws base and aux Gaussians together, in the tiles that aux Gaussians can touch.
        precision: what the network's convolutions compute in.
    """
    features = torch.cat([network_input(sample.cues, sample.seeds, sample.rim) for sample in samples])
    place, features = features.device, features.to(next(network.parameters()).device)
    with torch.autocast(features.device.type, precision, enabled=precision != torch.float32):
        deltas = network(features.contiguous(memory_format=torch.channels_last))
    views = [
        renderer.render([sample.base, aux_of(sample, field)], sample.camera, tiles=sample.tiles, onto=sample.rendering)
        for sample, field in zip(samples, deltas.float().to(place), strict=True)
    ]
    return ViewBatch(
        rgb=torch.stack([view.rgb for view in views]),
        alpha=torch.stack([view.alpha for view in views]),
        base_rgb=torch.stack([sample.rendering.rgb for sample in samples]),
        target=torch.stack([sample.target for sample in samples]),
        hole=torch.stack([sample.hole for sample in samples]),
        valid=torch.stack([sample.valid for sample in samples]),
    )


def aux_of(sample: Sample, deltas: Tensor) -> Gaussians:
    """The aux Gaussians that deltas [14, h, w] make of a sample's seeds."""
    cells = training_cells(sample.cues)
    return compose(sample.seeds.select(cells), deltas.permute(1, 2, 0)[cells], sample.camera)


def training_cells(cues: Cues, least: int = MIN_AUX) -> Tensor:
    """[h, w] bool: the masked cells, and where they are fewer than `least` the most transparent others."""
    missing = least - int(cues.mask.sum())
    if missing <= 0:
        return cues.mask
    rest = torch.where(cues.mask, torch.inf, cues.alpha).flatten()
    cells = cues.mask.flatten().clone()
    cells[rest.topk(min(missing, int((~cells).sum())), largest=False).indices] = True
    return cells.view_as(cues.mask)


class ResidualMethod(ViewMethod):
    """Items are samples, of one size; all of a step go through the network together."""

    name: ClassVar[str] = "residual"
    columns: ClassVar[str] = "base, seeds, completed, truth"
    remedy: ClassVar[str] = "delete the samples in the cache and run again"

    def __init__(self, samples: SampleFiles, objective: Objective, batch: int, processes: int = 1) -> None:
        """`batch` samples make a step of all `processes` together."""
        super().__init__(objective)
        self.samples, self.digest = samples, samples.digest
        self.items, self.validation_items = len(samples.train), len(samples.validation)
        self.items_a_step, self.at_once = batch, batch // processes

    def complete(self, network: nn.Module, step: int, items: Sequence[int]) -> ViewBatch:
        """Samples to learn from, completed; InputError where one cannot be read."""
        return self._complete(network, [load_sample(self.samples.train[item]) for item in items])

    def complete_validation(self, network: nn.Module, items: Sequence[int]) -> ViewBatch:
        """Validation samples, likewise."""
        return self._complete(network, [load_sample(self.samples.validation[item]) for item in items])

    def _complete(self, network: nn.Module, samples: Sequence[Sample]) -> ViewBatch:
        return complete_samples(network, samples, self.objective.renderer, self.objective.precision)

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[n·H, 4·W, 3] sRGB: for each sample the base, the seeds alone, the completed view and the truth."""
        files, rows = self.samples.validation, []
        samples = [load_sample(file) for file in files[:: max(1, len(files) // PICTURED)][:PICTURED]]
        for sample, rgb in zip(samples, self._complete(network, samples).rgb, strict=True):
            seeds = compose(sample.seeds.select(sample.cues.mask), None, sample.camera)
            sets = [sample.base, seeds]
            alone = self.objective.renderer.render(sets, sample.camera, tiles=sample.tiles, onto=sample.rendering)
            rows.append(torch.cat([sample.rendering.rgb, alone.rgb, rgb.cpu(), sample.target], dim=1))
        return torch.cat(rows)

    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Copy samples to a folder."""
        for item in items:
            shutil.copy(self.samples.train[item], folder / self.samples.train[item].name)

    def export(self, network: nn.Module, path: Path) -> None:
        """Weights in half precision, for `spackle predict --residual`."""
        export_weights(network, path)


def plan_residual(context: RunContext[Recipe]) -> Plan:
    """Find a recipe's files, make no sample yet; InputError where they cannot be used."""
    objective = load_objective(context)
    network = _first_network(context.recipe).requires_grad_()
    supply = Supply.of(context.recipe.data, objective.renderer)

    def start() -> Start:
        samples = _make_samples(context, supply)
        method = ResidualMethod(samples, objective, context.recipe.optim.batch, context.ranks.count)
        counts = {"train": method.items, "validation": method.validation_items, "digest": samples.digest}
        features = objective.features.name if objective.features else "none"
        return Start(method, network, {"features": features, "samples": counts, "parameters": parameters(network)})

    return Plan(ResidualMethod.name, supply.digest, start)


def _first_network(recipe: Recipe) -> ResidualNet:
    """The weights that a run starts from, by its seed or from a file."""
    if recipe.init is not None:
        return load_residual(recipe.init)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.run.seed)
        return ResidualNet()


def _make_samples(context: RunContext[Recipe], supply: Supply) -> SampleFiles:
    """The first process makes the samples, the others find them."""
    reporter, folder = context.reporter, context.recipe.data.cache or context.output / CACHE
    skipped = _Skipped(reporter)
    if not context.ranks.first:
        context.ranks.wait()
        return supply.samples(folder, lambda done, total: None, skipped.add)
    make_folder(folder)
    reporter.say(f"samples of {supply.data.views + supply.data.validation_views} views in {folder}")
    with reporter.stage("samples", {}) as step:
        samples = supply.samples(folder, step, skipped.add)
    if skipped.views:
        reporter.say(f"{skipped.views} views were passed over, for {len(skipped.reasons)} reasons (above)")
    reporter.say(f"{len(samples.train)} samples to learn from, {len(samples.validation)} to be judged by")
    context.ranks.wait()
    return samples


class _Skipped:
    """Views that could not be made; each reason is reported once."""

    def __init__(self, reporter: Reporter) -> None:
        self.reporter, self.views, self.reasons = reporter, 0, set[str]()

    def add(self, line: str) -> None:
        reason = line.partition("passed over: ")[2]
        self.views += 1
        if reason not in self.reasons:
            self.reasons.add(reason)
            self.reporter.say(f"passed over: {reason}")
