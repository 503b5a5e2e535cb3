"""Train the residual network on stored samples; the base does not change."""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors.torch import save
from torch import Tensor, nn

from spackle.formats.png import contact_sheet
from spackle.paper.training.feature_networks import load_features
from spackle.paper.training.losses import hole_psnr, total_loss
from spackle.paper.training.ranks import rank
from spackle.paper.training.recipe import Recipe
from spackle.paper.training.samples import Sample, digest_of_samples, load_sample, make_samples
from spackle.paper.training.sources import find_sources
from spackle.paper.training.task import Task
from spackle.render import Renderer, get_renderer
from spackle.render.protocol import Rendering
from spackle.residual.architectures import NOTE, load_residual, open_residual
from spackle.residual.completion import MIN_AUX_GAUSSIANS
from spackle.residual.features import CELL, hole_area_ratio
from spackle.residual.network import ResidualNet
from spackle.residual.sharp_decoder import SharpDecoder
from spackle.runtime.device import pick_dtype
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import make_folder
from spackle.runtime.progress import Reporter
from spackle.weights.checkpoints import load_strict, read_tensors

PICTURED = 6  # number of views in a picture
PICTURE_SIDE = 512  # pixels of a picture's longer side
CACHE = "cache"  # default folder of the samples, in the output


@dataclasses.dataclass(frozen=True)
class ViewBatch:
    """Stacked images of completed views, and their targets."""

    rgb: Tensor  # [B, H, W, 3] sRGB of base and aux Gaussians, with gradients
    alpha: Tensor  # [B, H, W] of base and aux Gaussians, with gradients
    base_rgb: Tensor  # [B, H, W, 3] sRGB of the base alone
    target: Tensor  # [B, H, W, 3]
    hole: Tensor  # [B, H, W] bool

    @staticmethod
    def of(images: Iterable[tuple[Rendering, Tensor, Tensor, Tensor]]) -> ViewBatch:
        """Stack completed views, base views, targets and holes on the device of the completed
        views.
        """
        fields = zip(*((view.rgb, view.alpha, *others) for view, *others in images), strict=True)
        return ViewBatch(
            *(torch.stack([tensor.to(field[0].device) for tensor in field]) for field in fields)
        )


class ViewTask(Task):
    """Completes batches of views, with the loss of eq. 12."""

    measures = (
        "loss",
        "color",
        "alpha",
        "preserve",
        "perceptual",
        "hole_psnr",
        "seen_psnr",
        "har_before",
        "har_after",
    )

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        """Load the feature network; InputError if it cannot be read."""
        self.recipe, self.device, self.renderer = recipe, device, get_renderer()
        self.precision = pick_dtype(recipe.optim.precision, device)
        features = recipe.loss.features if recipe.loss.perceptual else "none"
        self.features = load_features(features, recipe.loss.features_file, device)

    @abc.abstractmethod
    def complete(self, network: nn.Module, batch: Any) -> ViewBatch:
        """Complete the views of a batch."""

    def loss(self, network: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        return self._loss_of(self.complete(network, batch))

    def _loss_of(self, views: ViewBatch) -> tuple[Tensor, dict[str, Tensor]]:
        tensors = {name: tensor.to(self.device) for name, tensor in vars(views).items()}
        return total_loss(**tensors, recipe=self.recipe.loss, features=self.features)

    def measure(self, network: nn.Module, batch: Any) -> dict[str, list[float]]:
        """Values for each view: the loss and its terms (means of the batch), and the share of hole
        pixels before and after completion. PSNR in dB compares the hole with the target, and the
        other pixels with the base.
        """
        views = self.complete(network, batch)
        loss, terms = self._loss_of(views)
        return {
            **{
                name: [float(value)] * len(views.rgb)
                for name, value in {"loss": loss, **terms}.items()
            },
            "hole_psnr": list(map(hole_psnr, views.rgb, views.target, views.hole)),
            "seen_psnr": list(map(hole_psnr, views.rgb, views.base_rgb, ~views.hole)),
            "har_before": [float(hole.double().mean()) for hole in views.hole],
            "har_after": [hole_area_ratio(alpha) for alpha in views.alpha],
        }

    @torch.no_grad()
    def draw_picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB, one row per validation item: base, completed view, target."""
        items = range(0, self.validation_items, max(1, self.validation_items // PICTURED))[
            :PICTURED
        ]
        views = [self.complete(network, self.load_batch(None, [item])) for item in items]
        return contact_sheet(
            [(view.base_rgb[-1], view.rgb[-1], view.target[-1]) for view in views], PICTURE_SIDE
        )


def complete_samples(
    network: nn.Module,
    inputs: tuple[str, ...],
    samples: Sequence[Sample],
    renderer: Renderer,
    precision: torch.dtype = torch.float32,
) -> ViewBatch:
    """Complete samples of one size; only the network gets gradients.

    Args:
        network: f_res, or a wrapper that distributes it over processes.
        inputs: the names of the network's inputs.
        samples: views with holes, on the CPU.
        renderer: draws the completed views; its device does the rest of the work, too.
        precision: of the network's convolutions.
    """
    device = renderer.device
    # Masks are read before the samples move to the renderer's device: reading them later would wait
    # for a GPU.
    cells = [
        sample.view.cells(MIN_AUX_GAUSSIANS).flatten().nonzero()[:, 0].to(device, non_blocking=True)
        for sample in samples
    ]
    tiles = [sample.tiles for sample in samples]

    features = torch.cat([sample.network_input(inputs) for sample in samples])
    features = features.to(next(network.parameters()).device)
    with torch.autocast(features.device.type, precision, enabled=precision != torch.float32):
        deltas = network(features.contiguous(memory_format=torch.channels_last))  # [B, 14, h, w]
    deltas = deltas.float().to(device)

    samples = [sample.to(device) for sample in samples]
    scenes = []
    for sample, sample_deltas, index in zip(samples, deltas, cells, strict=True):
        aux = sample.view.gaussians(index, sample_deltas.permute(1, 2, 0))
        scenes.append([sample.base, aux])

    views = renderer.render_batch(
        scenes,
        [sample.camera for sample in samples],
        tiles=tiles,
        previous_renderings=[sample.rendering for sample in samples],
    )
    return ViewBatch.of(
        (view, sample.rendering.rgb, sample.target, sample.hole)
        for view, sample in zip(views, samples, strict=True)
    )


def first_network(name: str, init: Path | None = None) -> ResidualNet:
    """The initial network of a run: untrained, or read from the file `init`.

    The file holds weights of the same network. For "sharp-decoder", SHARP's checkpoint is also
    accepted: the decoder is read, stem and heads stay untrained. InputError if the file is missing,
    broken or of another network.
    """
    if init is None:
        return open_residual(name)
    tensors, prefix = read_tensors(init, "give init=FILE"), "feature_model."
    if name == SharpDecoder.name and "prediction_head.geometry_prediction_head.weight" in tensors:
        sharp = SharpDecoder.untrained_for(tensors)
        decoder = {
            key.removeprefix(prefix): tensor
            for key, tensor in tensors.items()
            if key.startswith(prefix)
        }
        load_strict(
            sharp.feature_model, decoder, init, "give SHARP's checkpoint as it was downloaded"
        )
        return sharp
    network = load_residual(init)
    if network.name != name:
        raise InputError(
            f"{init}: has weights of network {network.name}: set network={network.name} or another init"
        )
    return network


class ResidualTask(ViewTask):
    """Trains the residual network; its items are samples of one size."""

    name: ClassVar[str] = "residual"

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        """Find the files of a recipe, without making samples; InputError if they cannot be used."""
        super().__init__(recipe, device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.run.seed)
            self.network = first_network(recipe.network, recipe.init).requires_grad_()
        self.sources = [
            find_sources(recipe.data, self.renderer, validation=which) for which in (False, True)
        ]
        self.digest, self.items_per_step = (
            digest_of_samples(recipe.data, self.sources[0]),
            recipe.optim.batch,
        )

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Make the missing samples."""
        data = self.recipe.data
        skip = functools.cache(
            lambda reason: reporter.log(f"skipped: {reason}")
        )  # each reason is logged once
        folder = data.cache or output / CACHE
        make_folder(folder)
        # Training and validation use different seeds, and different photos of a dataset.
        parts = (
            ("validation", self.sources[True], 2 * data.seed + 1, data.validation_views),
            ("train", self.sources[False], 2 * data.seed, data.views),
        )
        reporter.log(f"samples of {data.views + data.validation_views} views in {folder}")
        with reporter.stage("samples") as step:
            self.validation_files, self.training_files = (
                make_samples(data, of, folder / self.digest / name, seed, views, step, skip)
                for name, of, seed, views in parts
            )
        self.items, self.validation_items = len(self.training_files), len(self.validation_files)
        reporter.log(f"{self.items} training samples, {self.validation_items} validation samples")
        samples = {"train": self.items, "validation": self.validation_items, "digest": self.digest}
        return {
            "samples": samples,
            "hole_psnr": self.limits() if rank() == 0 else {},
        }  # only rank 0 writes run.json

    @torch.no_grad()
    def limits(self) -> dict[str, float]:
        """Mean hole PSNR in dB of validation samples: untrained, then with seeds in the targets'
        colours.

        A run can raise PSNR only from the first value towards the second.
        """
        with torch.random.fork_rng(devices=[]):
            network = open_residual(self.recipe.network).to(self.renderer.device)
        decibels: dict[str, list[float]] = {"untrained": [], "colours of the targets": []}
        for item in range(self.validation_items):
            (sample,) = self.load_batch(None, [item])
            height, width = sample.features.mask.shape
            colors = sample.target.view(height, CELL, width, CELL, 3).mean((1, 3))
            best = dataclasses.replace(
                sample, initial=dataclasses.replace(sample.initial, rgb=colors)
            )
            for values, case in zip(decibels.values(), (sample, best), strict=True):
                views = self.complete(network, [case])
                values.append(hole_psnr(views.rgb[0], views.target[0], views.hole[0]))
        return {name: sum(values) / len(values) for name, values in decibels.items()}

    def load_batch(self, step: int | None, items: Sequence[int]) -> list[Sample]:
        """Read samples; InputError if one cannot be read."""
        files = self.validation_files if step is None else self.training_files
        samples = [load_sample(files[item]) for item in items]
        for sample in samples:
            _ = (
                sample.network_input(self.network.inputs),
                sample.tiles,
            )  # computed in this thread, so that the training loop does not wait for them
        return samples

    def complete(self, network: nn.Module, batch: Sequence[Sample]) -> ViewBatch:
        return complete_samples(network, self.network.inputs, batch, self.renderer, self.precision)

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the weights in half precision, for `spackle predict --residual`."""
        tensors = {
            name: tensor.detach().half().cpu().contiguous()
            for name, tensor in network.state_dict().items()
        }
        write_atomic(path, save(tensors, {NOTE: self.recipe.network}))
