"""The paper's own method: a residual network learns to complete cached samples, the base stays as it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors.torch import save
from torch import Tensor, nn

from spackle.files import write_whole
from spackle.folders import make_folder
from spackle.progress import Reporter
from spackle.render import Renderer, place_of, render_batch
from spackle.residual.compose import compose
from spackle.residual.network import ResidualNet, load_residual, network_input
from spackle.residual.view_features import ViewFeatures
from spackle.training.data import CACHE, Supply
from spackle.training.recipe import Recipe
from spackle.training.sample import Sample, load_sample
from spackle.training.task import PICTURE_SIDE, PICTURED, ViewBatch, ViewTask, sheet

MIN_AUX = 64  # aux Gaussians of a view, however small its holes (paper, "Training Details and Loss Weights")


def complete_samples(
    network: nn.Module | None, samples: Sequence[Sample], renderer: Renderer, precision: torch.dtype = torch.float32
) -> ViewBatch:
    """Run the network on samples of one size, and render them with what it adds; None adds the base values alone.

    The network, a `ResidualNet` by itself or wrapped, alone gets gradients; its convolutions compute in `precision`.
    What needs a look at numbers is done before samples travel to the renderer's device, which is waited for once.
    """
    place = place_of(renderer)
    cells = [training_cells(sample.cues).flatten().nonzero()[:, 0] for sample in samples]
    tiles = [sample.tiles for sample in samples]
    fields: Sequence[Tensor | None] = [None] * len(samples)
    if network is not None:
        features = torch.cat([network_input(sample.cues, sample.seeds, sample.rim) for sample in samples])
        features = features.to(next(network.parameters()).device)
        with torch.autocast(features.device.type, precision, enabled=precision != torch.float32):
            deltas = network(features.contiguous(memory_format=torch.channels_last))
        fields = list(deltas.float().to(place))
    samples = [sample.to(place) for sample in samples]
    scenes = []
    for sample, field, chosen in zip(samples, fields, cells, strict=True):
        index = chosen.to(place, non_blocking=True)
        deltas = None if field is None else field.flatten(1).T[index]
        scenes.append([sample.base, compose(sample.seeds.select(index), deltas, sample.camera)])
    cameras, onto = [sample.camera for sample in samples], [sample.rendering for sample in samples]
    views = render_batch(renderer, scenes, cameras, tiles=tiles, onto=onto)
    return ViewBatch(
        rgb=torch.stack([view.rgb for view in views]),
        alpha=torch.stack([view.alpha for view in views]),
        base_rgb=torch.stack([sample.rendering.rgb for sample in samples]),
        target=torch.stack([sample.target for sample in samples]),
        hole=torch.stack([sample.hole for sample in samples]),
    )


def training_cells(cues: ViewFeatures, least: int = MIN_AUX) -> Tensor:
    """[h, w] bool: the masked cells, and where they are fewer than `least` the most transparent others."""
    missing = least - int(cues.mask.sum())
    if missing <= 0:
        return cues.mask
    rest = torch.where(cues.mask, torch.inf, cues.alpha).flatten()
    cells = cues.mask.flatten().clone()
    cells[rest.topk(min(missing, int((~cells).sum())), largest=False).indices] = True
    return cells.view_as(cues.mask)


class ResidualTask(ViewTask):
    """Items are samples, of one size; all of a step go through the network together."""

    name: ClassVar[str] = "residual"

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        """Find a recipe's files, make no sample yet; InputError where they cannot be used."""
        super().__init__(recipe, device)
        if recipe.init is not None:
            network = load_residual(recipe.init)
        else:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(recipe.run.seed)
                network = ResidualNet()
        self.network = network.requires_grad_()
        self.supply = Supply.of(recipe.data, self.renderer)
        self.digest, self.items_a_step = self.supply.digest, recipe.optim.batch

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Make the samples that are missing."""
        data, skipped = self.recipe.data, Counter[str]()

        def skip(reason: str) -> None:
            if not skipped[reason]:
                reporter.log(f"passed over: {reason}")
            skipped[reason] += 1

        folder = data.cache or output / CACHE
        make_folder(folder)
        reporter.log(f"samples of {data.views + data.validation_views} views in {folder}")
        with reporter.stage("samples") as step:
            self.learned, self.validation = self.supply.samples(folder, step, skip)
        if skipped:
            reporter.log(f"{skipped.total()} views were passed over, for {len(skipped)} reasons (above)")
        self.items, self.validation_items = len(self.learned), len(self.validation)
        reporter.log(f"{self.items} samples to learn from, {self.validation_items} to be judged by")
        return self.facts(self.network)

    def batch(self, step: int | None, items: Sequence[int]) -> list[Sample]:
        """Samples; InputError where one cannot be read."""
        files = self.validation if step is None else self.learned
        return [load_sample(files[item]) for item in items]

    def complete(self, network: nn.Module | None, batch: Sequence[Sample]) -> ViewBatch:
        return complete_samples(network, batch, self.renderer, self.precision)

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB, a row for each of some samples."""
        items = range(0, self.validation_items, max(1, self.validation_items // PICTURED))[:PICTURED]
        batch = self.batch(None, items)
        done, plain = self.complete(network, batch), self.complete(None, batch)
        return sheet(list(zip(done.base_rgb, plain.rgb, done.rgb, done.target, strict=True)), PICTURE_SIDE)

    def names(self, step: int, items: Sequence[int]) -> list[str]:
        return [self.learned[item].name for item in items]

    def export(self, network: nn.Module, path: Path) -> None:
        """Weights in half precision, for `spackle predict --residual`."""
        tensors = {name: tensor.detach().half().cpu().contiguous() for name, tensor in network.state_dict().items()}
        write_whole(path, save(tensors))
