"""The paper's own method: a residual network learns to complete cached samples; the base does not change.

`ViewTask`, which direct FT also uses, computes the loss of eq. 12 and the measures.
"""

from __future__ import annotations

import abc
import dataclasses
import math
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from rich.filesize import decimal
from safetensors.torch import save
from torch import Tensor, nn

from spackle.device import pick_dtype
from spackle.errors import InputError
from spackle.files import write_whole
from spackle.folders import make_folder
from spackle.formats.png import sheet
from spackle.network_file import load_strict, read_tensors
from spackle.progress import Reporter
from spackle.render import Renderer, device_of, get_renderer, render_batch
from spackle.render.protocol import Rendering
from spackle.residual.architectures import NOTE, SharpDecoder, decoder_size, load_residual, open_residual
from spackle.residual.complete import compose
from spackle.residual.network import ResidualNet, network_input
from spackle.residual.view_features import CELL, ViewFeatures, hole_area_ratio
from spackle.training.losses import hole_psnr, load_features, total_loss
from spackle.training.recipe import Recipe
from spackle.training.samples import Sample, digest_of_samples, disk_needed, load_sample, make_samples
from spackle.training.sources import find_sources
from spackle.training.train import Task, rank

MIN_AUX = 64  # least number of aux Gaussians in a view (paper, "Training Details and Loss Weights")
PICTURED = 6  # views in the picture
PICTURE_SIDE = 512  # pixels of a picture's longer side
CACHE = "cache"  # in the output, unless the recipe names another folder


@dataclasses.dataclass(frozen=True)
class ViewBatch:
    """Completed views and their truth, stacked."""

    rgb: Tensor  # [B, H, W, 3] sRGB of base and aux Gaussians, with gradients
    alpha: Tensor  # [B, H, W] likewise
    base_rgb: Tensor  # [B, H, W, 3] sRGB of the base alone
    target: Tensor  # [B, H, W, 3]
    hole: Tensor  # [B, H, W] bool

    @staticmethod
    def of(
        drawn: Sequence[Rendering], base: Sequence[Tensor], target: Sequence[Tensor], hole: Sequence[Tensor]
    ) -> ViewBatch:
        """Stack renderings and the other images, on the renderings' device."""
        rgb, alpha = [view.rgb for view in drawn], [view.alpha for view in drawn]
        return ViewBatch(*(torch.stack(list(images)).to(rgb[0].device) for images in (rgb, alpha, base, target, hole)))


class ViewTask(Task):
    """A task that completes batches of views, with the loss of eq. 12."""

    measures = ("loss", "color", "alpha", "preserve", "perceptual", "hole_psnr", "seen_psnr", "har_before", "har_after")

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        """Load the feature network; InputError if it cannot be read."""
        self.recipe, self.device, self.renderer = recipe, device, get_renderer()
        self.precision = pick_dtype(recipe.optim.precision, device)
        features = recipe.loss.features if recipe.loss.perceptual else "none"
        self.features = load_features(features, recipe.loss.features_file, device)

    @abc.abstractmethod
    def complete(self, network: nn.Module, batch: Any) -> ViewBatch:
        """Complete the views of a batch."""

    def total(self, views: ViewBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of completed views, and its unweighted terms [], computed on the task's device."""
        tensors = {name: tensor.to(self.device) for name, tensor in vars(views).items()}
        return total_loss(**tensors, recipe=self.recipe.loss, features=self.features)

    def loss(self, network: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        return self.total(self.complete(network, batch))

    def measure(self, network: nn.Module, batch: Any) -> dict[str, list[float]]:
        """Measure each view.

        These are the loss and its terms (means over the batch); hole_psnr and seen_psnr in dB, if finite: inside the
        hole against the target, and outside against the base; har_before and har_after, the share of hole pixels.
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
        """Facts for run.json: the feature network, the samples, the trained weights, the precision."""
        return {
            "features": self.features.name if self.features else "none",
            "samples": {"train": self.items, "validation": self.validation_items, "digest": self.digest},
            "parameters": parameters(network),
            "precision": str(self.precision).removeprefix("torch."),
        }


def parameters(network: nn.Module) -> dict[str, int]:
    """How many weights of a network are trained and how many are frozen, for run.json."""
    counts = {"learn": 0, "stay": 0}
    for weight in network.parameters():
        counts["learn" if weight.requires_grad else "stay"] += weight.numel()
    return counts


def complete_samples(
    network: nn.Module | None, samples: Sequence[Sample], renderer: Renderer, precision: torch.dtype = torch.float32
) -> ViewBatch:
    """Run the network on samples of one size, and render them with its Gaussians; without one, with the seeds.

    Gradients reach only the network, a `ResidualNet` or a wrapper of one; its convolutions compute in `precision`.
    Steps that read values run before the samples move to the renderer's device, so that the host waits for it once.
    """
    device = device_of(renderer)
    cells = [training_cells(sample.features).flatten().nonzero()[:, 0] for sample in samples]
    tiles = [sample.tiles for sample in samples]
    fields: Sequence[Tensor | None] = [None] * len(samples)
    if network is not None:
        inputs = torch.cat([network_input(sample.features, sample.seeds, sample.rim) for sample in samples])
        inputs = inputs.to(next(network.parameters()).device)
        with torch.autocast(inputs.device.type, precision, enabled=precision != torch.float32):
            deltas = network(inputs.contiguous(memory_format=torch.channels_last))
        fields = list(deltas.float().to(device))
    samples = [sample.to(device) for sample in samples]
    scenes = []
    for sample, field, chosen in zip(samples, fields, cells, strict=True):
        index = chosen.to(device, non_blocking=True)
        deltas = None if field is None else field.flatten(1).T[index]
        scenes.append([sample.base, compose(sample.seeds.select(index), deltas, sample.camera)])
    cameras, onto = [sample.camera for sample in samples], [sample.rendering for sample in samples]
    views = render_batch(renderer, scenes, cameras, tiles=tiles, onto=onto)
    return ViewBatch.of(
        views, [s.rendering.rgb for s in samples], [s.target for s in samples], [s.hole for s in samples]
    )


def training_cells(features: ViewFeatures, least: int = MIN_AUX) -> Tensor:
    """[h, w] bool: the masked cells; if they are fewer than `least`, the most transparent others are added."""
    missing = least - int(features.mask.sum())
    if missing <= 0:
        return features.mask
    rest = torch.where(features.mask, torch.inf, features.alpha).flatten()
    cells = features.mask.flatten().clone()
    cells[rest.topk(min(missing, int((~cells).sum())), largest=False).indices] = True
    return cells.view_as(features.mask)


def first_network(name: str, init: Path | None = None) -> ResidualNet:
    """The network that a run starts from: untrained, or from a file.

    The file holds weights of the same network; for "sharp-decoder" it may also be SHARP's checkpoint, whose decoder is
    taken and whose stem and heads are not. InputError if the file is missing, broken or foreign.
    """
    if init is None:
        return open_residual(name)
    tensors, prefix = read_tensors(init, "give init=FILE"), "feature_model."
    if name == SharpDecoder.name and "prediction_head.geometry_prediction_head.weight" in tensors:
        sharp = SharpDecoder(decoder_size(tensors))
        decoder = {key.removeprefix(prefix): tensor for key, tensor in tensors.items() if key.startswith(prefix)}
        load_strict(sharp.feature_model, decoder, init, "give SHARP's checkpoint as it was downloaded")
        return sharp
    network = load_residual(init)
    if network.name != name:
        raise InputError(f"{init}: weights of the network {network.name}: give network={network.name}, or another init")
    return network


class ResidualTask(ViewTask):
    """Its items are samples of one size; a step's samples go through the network together."""

    name: ClassVar[str] = "residual"

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        """Find a recipe's files, without making samples; InputError if they cannot be used."""
        super().__init__(recipe, device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.run.seed)
            self.network = first_network(recipe.network, recipe.init).requires_grad_()
        self.sources = [find_sources(recipe.data, self.renderer, validation=which) for which in (False, True)]
        self.digest, self.items_a_step = digest_of_samples(recipe.data, self.sources[0]), recipe.optim.batch

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Make the missing samples; InputError also if the disk lacks room for them."""
        data, skipped = self.recipe.data, Counter[str]()

        def skip(reason: str) -> None:
            if not skipped[reason]:
                reporter.log(f"passed over: {reason}")
            skipped[reason] += 1

        folder = data.cache or output / CACHE
        make_folder(folder)
        # No view is in both parts: their seeds differ, and they use different photos of a dataset.
        parts = (
            ("validation", self.sources[True], 2 * data.seed + 1, data.validation_views),
            ("train", self.sources[False], 2 * data.seed, data.views),
        )
        needed = sum(disk_needed(data, of, folder / self.digest / name, views) for name, of, _, views in parts)
        free = shutil.disk_usage(folder).free
        if needed > free:
            raise InputError(
                f"{folder}: the samples may take {decimal(needed)}, and {decimal(free)} are free: "
                "give data.cache=FOLDER on another disk, or fewer data.views"
            )
        reporter.log(f"samples of {data.views + data.validation_views} views in {folder}, at most {decimal(needed)}")
        with reporter.stage("samples") as step:
            self.validation, self.learned = (
                make_samples(data, of, folder / self.digest / name, seed, views, step, skip)
                for name, of, seed, views in parts
            )
        if skipped:
            reporter.log(f"{skipped.total()} views were passed over, for {len(skipped)} reasons (see above)")
        self.items, self.validation_items = len(self.learned), len(self.validation)
        reporter.log(f"{self.items} training samples, {self.validation_items} validation samples")
        limits = self.limits() if rank() == 0 else {}  # for run.json, which the first process writes
        for name, decibels in limits.items():
            reporter.log(f"{decibels:.2f} dB in the holes of the validation samples: {name}")
        return {**self.facts(self.network), "hole_psnr": limits}

    @torch.no_grad()
    def limits(self) -> dict[str, float]:
        """The range in which training can improve: mean hole_psnr in dB of the validation samples, without a network
        and with the seeds in the targets' own colours.
        """
        found: dict[str, list[float]] = {"untrained": [], "colours of the targets": []}
        for item in range(self.validation_items):
            (sample,) = self.batch(None, [item])
            height, width = sample.features.mask.shape
            colors = sample.target.view(height, CELL, width, CELL, 3).mean((1, 3))
            told = dataclasses.replace(sample, seeds=dataclasses.replace(sample.seeds, rgb=colors))
            for decibels, known in zip(found.values(), (sample, told), strict=True):
                views = self.complete(None, [known])
                decibels.append(hole_psnr(views.rgb[0], views.target[0], views.hole[0]))
        return {name: sum(decibels) / len(decibels) for name, decibels in found.items()}

    def batch(self, step: int | None, items: Sequence[int]) -> list[Sample]:
        """Read samples; InputError if one cannot be read."""
        files = self.validation if step is None else self.learned
        return [load_sample(files[item]) for item in items]

    def complete(self, network: nn.Module | None, batch: Sequence[Sample]) -> ViewBatch:
        return complete_samples(network, batch, self.renderer, self.precision)

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB, a row for each of some samples: base, without a network, with it, target."""
        items = range(0, self.validation_items, max(1, self.validation_items // PICTURED))[:PICTURED]
        batch = self.batch(None, items)
        done, plain = self.complete(network, batch), self.complete(None, batch)
        return sheet(list(zip(done.base_rgb, plain.rgb, done.rgb, done.target, strict=True)), PICTURE_SIDE)

    def names(self, step: int, items: Sequence[int]) -> list[str]:
        return [self.learned[item].name for item in items]

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the weights in half precision, for `spackle predict --residual`."""
        tensors = {name: tensor.detach().half().cpu().contiguous() for name, tensor in network.state_dict().items()}
        write_whole(path, save(tensors, {NOTE: self.recipe.network}))
