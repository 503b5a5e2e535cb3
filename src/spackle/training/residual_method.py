"""The paper's own method: a residual network learns to complete cached samples, the base stays as it is."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from safetensors.torch import save
from torch import Tensor, nn

from spackle.files import atomic_path, make_folder
from spackle.render import Renderer, place_of, render_batch
from spackle.residual.compose import compose
from spackle.residual.hole_features import Cues
from spackle.residual.network import ResidualNet, load_residual, network_input
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
    facts_of,
    load_objective,
)
from spackle.training.recipe import Recipe
from spackle.training.sample import Sample, load_sample

MIN_AUX = 64  # aux Gaussians of a view, however small its holes (paper, "Training Details and Loss Weights")


def complete_samples(
    network: nn.Module, samples: Sequence[Sample], renderer: Renderer, precision: torch.dtype = torch.float32
) -> ViewBatch:
    """Run the network on samples of one size, and render them with what it adds.

    The network, a `ResidualNet` by itself or wrapped, alone gets gradients; its convolutions compute in `precision`.
    What needs a look at numbers is done before samples travel to the renderer's device, which is waited for once.
    """
    place = place_of(renderer)
    cells = [training_cells(sample.cues).flatten().nonzero()[:, 0] for sample in samples]
    tiles = [sample.tiles for sample in samples]
    features = torch.cat([network_input(sample.cues, sample.seeds, sample.rim) for sample in samples])
    samples = [sample.to(place) for sample in samples]
    features = features.to(next(network.parameters()).device)
    with torch.autocast(features.device.type, precision, enabled=precision != torch.float32):
        deltas = network(features.contiguous(memory_format=torch.channels_last))
    scenes = []
    for sample, field, chosen in zip(samples, deltas.float().to(place), cells, strict=True):
        index = chosen.to(place, non_blocking=True)
        aux = compose(sample.seeds.select(index), field.flatten(1).T[index], sample.camera)
        scenes.append([sample.base, aux])
    cameras, onto = [sample.camera for sample in samples], [sample.rendering for sample in samples]
    views = render_batch(renderer, scenes, cameras, tiles=tiles, onto=onto)
    return ViewBatch(
        rgb=torch.stack([view.rgb for view in views]),
        alpha=torch.stack([view.alpha for view in views]),
        base_rgb=torch.stack([sample.rendering.rgb for sample in samples]),
        target=torch.stack([sample.target for sample in samples]),
        hole=torch.stack([sample.hole for sample in samples]),
    )


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

    def complete(self, network: nn.Module, items: Sequence[int], step: int | None = None) -> ViewBatch:
        """Completed samples; InputError where one cannot be read."""
        files = self.samples.validation if step is None else self.samples.train
        samples = [load_sample(files[item]) for item in items]
        return complete_samples(network, samples, self.objective.renderer, self.objective.precision)

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[n·H, 4·W, 3] sRGB: for each sample the base, the seeds alone, the completed view and the truth."""
        items, rows = range(0, self.validation_items, max(1, self.validation_items // PICTURED))[:PICTURED], []
        for item, rgb in zip(items, self.complete(network, items).rgb, strict=True):
            sample = load_sample(self.samples.validation[item])
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
        tensors = {name: tensor.detach().half().cpu().contiguous() for name, tensor in network.state_dict().items()}
        with atomic_path(path) as temporary:
            temporary.write_bytes(save(tensors))


def plan_residual(context: RunContext[Recipe]) -> Plan:
    """Find a recipe's files, make no sample yet; InputError where they cannot be used."""
    objective, recipe, ranks, log = load_objective(context), context.recipe, context.ranks, context.reporter.log
    if recipe.init is not None:
        network = load_residual(recipe.init)
    else:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.run.seed)
            network = ResidualNet()
    network.requires_grad_()
    supply = Supply.of(recipe.data, objective.renderer)

    def start() -> Start:
        if not ranks.first:  # the first process makes the samples, the others find them
            ranks.wait()
        folder, skipped = recipe.data.cache or context.output / CACHE, Counter[str]()

        def skip(reason: str) -> None:
            if not skipped[reason]:
                log(f"passed over: {reason}")
            skipped[reason] += 1

        make_folder(folder)
        log(f"samples of {recipe.data.views + recipe.data.validation_views} views in {folder}")
        with context.reporter.stage("samples") as step:
            samples = supply.samples(folder, step, skip)
        if skipped:
            log(f"{skipped.total()} views were passed over, for {len(skipped)} reasons (above)")
        log(f"{len(samples.train)} samples to learn from, {len(samples.validation)} to be judged by")
        if ranks.first:
            ranks.wait()
        method = ResidualMethod(samples, objective, recipe.optim.batch, ranks.count)
        return Start(method, network, facts_of(method, network))

    return Plan(ResidualMethod.name, supply.digest, start)
