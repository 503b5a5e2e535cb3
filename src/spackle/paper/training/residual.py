"""Train the residual network, on whole views or on crops; the base does not change."""

from __future__ import annotations

import abc
import copy
import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
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
from spackle.paper.training.sample_factory import digest_of_samples, make_samples
from spackle.paper.training.samples import Sample, load_sample
from spackle.paper.training.sources import find_sources
from spackle.paper.training.task import Task
from spackle.paper.training.whole_views import WholeViews, find_whole_views
from spackle.render import Renderer, get_renderer
from spackle.render.protocol import Rendering
from spackle.residual.architectures import (
    ARCHITECTURE_KEY,
    load_residual,
    network_class,
    open_residual,
)
from spackle.residual.completion import CellChoice
from spackle.residual.features import CELL, hole_area_ratio
from spackle.residual.network import ResidualNet
from spackle.residual.sharp_decoder import SharpDecoder
from spackle.runtime.device import pick_dtype
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import make_folder
from spackle.runtime.parallel_kernels import device_for_kernels
from spackle.runtime.progress import Reporter
from spackle.weights.checkpoints import load_strict, read_tensors

MAX_PICTURED_ITEMS = 6  # rows of the picture that shows results of a run
PICTURE_SIDE_PX = 512  # longer side of that picture
CACHE = "cache"  # default folder of the samples, in the output
SHARP_TENSOR = "prediction_head.geometry_prediction_head.weight"  # only SHARP's checkpoints have it
SHARP_DECODER_PREFIX = "feature_model."  # of the names of the decoder's tensors there


@dataclasses.dataclass(frozen=True)
class ViewBatch:
    """Stacked images of completed views, and their targets."""

    rgb: Tensor  # [B, H, W, 3] sRGB of base and added Gaussians, with gradients
    alpha: Tensor  # [B, H, W] opacity of base and added Gaussians, with gradients
    base_rgb: Tensor  # [B, H, W, 3] sRGB of the base alone
    target: Tensor  # [B, H, W, 3] sRGB of what the view should look like
    hole: Tensor  # [B, H, W] bool
    # [B, H, W] bool: where the loss compares with the target. Elsewhere the view should stay as the
    # base shows it.
    supervised: Tensor

    @staticmethod
    def of(
        images: Iterable[tuple[Rendering, Tensor, Tensor, Tensor]],
        fully_supervised: Sequence[int] = (),
    ) -> ViewBatch:
        """Stack images of B views, on the device of the completed views.

        Args:
            images: four things for each view, in this order: the rendering of the completed view,
                sRGB [H, W, 3] of the base alone, the target [H, W, 3], and the hole [H, W] bool.
            fully_supervised: indices of the views in which the target counts in every pixel; in
                the others it counts in the hole.
        """
        renderings, base_images, targets, hole_masks = zip(*images, strict=True)
        device = renderings[0].rgb.device
        holes = torch.stack([hole.to(device) for hole in hole_masks])
        # Where the target counts.
        supervised = holes.clone()
        for index in fully_supervised:
            supervised[index] = True
        return ViewBatch(
            rgb=torch.stack([rendering.rgb for rendering in renderings]),
            alpha=torch.stack([rendering.alpha for rendering in renderings]),
            base_rgb=torch.stack([base_rgb.to(device) for base_rgb in base_images]),
            target=torch.stack([target.to(device) for target in targets]),
            hole=holes,
            supervised=supervised,
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
        """Load the network of the perceptual loss; InputError if it cannot be read."""
        self.recipe = recipe
        self.device = device
        self.renderer = get_renderer()
        self.precision = pick_dtype(recipe.optim.precision, device)
        # A perceptual loss of weight 0 needs no network.
        feature_network = recipe.loss.features if recipe.loss.perceptual else "none"
        self.features = load_features(feature_network, recipe.loss.features_file, device)

    @abc.abstractmethod
    def complete(self, network: nn.Module, batch: Any) -> ViewBatch:
        """Complete the views of a batch by the network that is trained."""

    def loss(self, network: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch, a scalar with gradients, and its terms by name, detached scalars."""
        return self._loss_of(self.complete(network, batch))

    def _loss_of(self, views: ViewBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of completed views, and its terms by name; all of them are scalar tensors."""
        return total_loss(
            rgb=views.rgb.to(self.device),
            alpha=views.alpha.to(self.device),
            target=views.target.to(self.device),
            base_rgb=views.base_rgb.to(self.device),
            hole=views.supervised.to(self.device),
            recipe=self.recipe.loss,
            features=self.features,
        )

    def measure(self, network: nn.Module, batch: Any) -> dict[str, list[float]]:
        """The values of each measure for the B views of a batch, by the measure's name.

        The loss and its terms are means of the batch. PSNR in dB compares the hole with the target
        ("hole_psnr"), and the other pixels with the base ("seen_psnr"). HAR is the fraction of hole
        pixels before and after completion.
        """
        views = self.complete(network, batch)
        loss, terms = self._loss_of(views)
        values: dict[str, list[float]] = {}
        for name, mean in {"loss": loss, **terms}.items():
            values[name] = [float(mean)] * len(views.rgb)

        values["hole_psnr"] = []
        values["seen_psnr"] = []
        for rgb, target, base_rgb, hole in zip(
            views.rgb, views.target, views.base_rgb, views.hole, strict=True
        ):
            values["hole_psnr"].append(hole_psnr(rgb, target, hole))
            values["seen_psnr"].append(hole_psnr(rgb, base_rgb, ~hole))
        values["har_before"] = [float(hole.double().mean()) for hole in views.hole]
        values["har_after"] = [hole_area_ratio(alpha) for alpha in views.alpha]
        return values

    @torch.no_grad()
    def draw_picture(self, network: nn.Module) -> Tensor:
        """A picture [H, W, 3] sRGB with a row for each of a few validation items.

        A row shows the view of the base alone, the completed view and the target.
        """
        # Evenly spaced items, because neighbours are often views of one photo.
        spacing = max(1, self.validation_items // MAX_PICTURED_ITEMS)
        items = range(0, self.validation_items, spacing)[:MAX_PICTURED_ITEMS]
        rows = []
        for item in items:
            batch = self.load_batch(step=None, items=[item])  # None: a validation item
            views = self.complete(network, batch)
            # A batch may hold all views of a photo. The last one is shown, because the first one is
            # the photo's own view, which has the smallest holes.
            rows.append((views.base_rgb[-1], views.rgb[-1], views.target[-1]))
        return contact_sheet(rows, PICTURE_SIDE_PX)


def complete_samples(
    network: nn.Module,
    inputs: tuple[str, ...],
    samples: Sequence[Sample],
    renderer: Renderer,
    precision: torch.dtype = torch.float32,
    cell_choice: CellChoice = "masked",
) -> ViewBatch:
    """Complete samples of one size; only the network gets gradients.

    Args:
        network: the residual network, or a wrapper that distributes it over processes. It predicts
            deltas, changes of the Gaussians that fill each hole cell (2×2 pixels).
        inputs: the names of the network's inputs.
        samples: views with holes.
        renderer: draws the completed views; its device does the rest of the work, too.
        precision: of the network's convolutions.
        cell_choice: which cells get a new Gaussian: those in holes, or all.
    """
    device = renderer.device

    samples = [sample.to(device) for sample in samples]
    tiles = [sample.tiles if cell_choice == "masked" else None for sample in samples]  # None: all

    # One pass of the network for all samples.
    features = torch.cat([sample.network_input(inputs) for sample in samples])
    features = features.to(next(network.parameters()).device)
    with torch.autocast(features.device.type, precision, enabled=precision != torch.float32):
        deltas = network(features.contiguous(memory_format=torch.channels_last))
    deltas = deltas.float().to(device)  # [B, 14, h, w]: 14 parameters of each cell's Gaussian

    # The scene of a sample is its base and the Gaussians that fill its hole.
    scenes = []
    for sample, sample_deltas in zip(samples, deltas, strict=True):
        index = sample.chosen_cells(cell_choice)
        aux = sample.view.gaussians(index, sample_deltas.permute(1, 2, 0))
        scenes.append([sample.base, aux])

    # Only the tiles near holes are drawn; the rest is copied from the base's rendering.
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
    """The network with which a run begins: untrained, or read from the file `init`.

    The file holds weights of the network `name`. For "sharp-decoder", SHARP's checkpoint is also
    accepted: the decoder is read, while the layers before and after it stay untrained.

    Raises:
        InputError: the file is missing, broken or of another network.
    """
    if init is None:
        return open_residual(name)
    # If another package defines the network, this imports the package. Otherwise `load_residual`
    # would not accept the weights.
    network_class(name)
    if name == SharpDecoder.name:
        tensors = read_tensors(init, "give init=FILE")
        if SHARP_TENSOR in tensors:
            return _with_sharps_decoder(tensors, init)

    network = load_residual(init)
    if network.name != name:
        raise InputError(
            f"{init}: has weights of network {network.name}: set network={network.name} or another "
            "init"
        )
    return network


def _with_sharps_decoder(tensors: Mapping[str, Tensor], path: Path) -> SharpDecoder:
    """The residual network "sharp-decoder", whose decoder has the weights of SHARP's decoder.

    The layers before and after it are untrained.

    Args:
        tensors: of SHARP's checkpoint.
        path: the checkpoint's file, for messages.

    Raises:
        InputError: the decoder's tensors are not as they should be.
    """
    network = SharpDecoder.untrained_for(tensors)
    decoder = {
        name.removeprefix(SHARP_DECODER_PREFIX): tensor
        for name, tensor in tensors.items()
        if name.startswith(SHARP_DECODER_PREFIX)
    }
    advice = "give SHARP's checkpoint as it was downloaded"
    load_strict(network.feature_model, decoder, path, advice)
    return network


@dataclasses.dataclass(frozen=True)
class StoredCrops:
    """Crops of views, each in a file of its own."""

    files: Sequence[Path]

    def __len__(self) -> int:
        """The number of crops."""
        return len(self.files)

    def load(self, item: int) -> Sample:
        """Read a crop, by its number; InputError if that fails."""
        return load_sample(self.files[item])


class ResidualTask(ViewTask):
    """Trains the residual network.

    Its items are whole views of photos, one at a time because photos differ in size, or crops of
    views, all of one size.
    """

    name: ClassVar[str] = "residual"

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        """Find the files of a recipe, without making samples; InputError if they cannot be used."""
        super().__init__(recipe, device)
        # The run's seed alone decides about the initial weights. Random numbers of the caller go on
        # afterwards as if nothing had been drawn here.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.run.seed)
            self.network = first_network(recipe.network, recipe.init).requires_grad_()
        self.items_per_step = recipe.optim.batch

        self.datasets: Sequence[Mapping[str, Any]]  # that the samples come from, for run.json
        self.training: WholeViews | StoredCrops
        self.validation: WholeViews | StoredCrops
        if recipe.data.crops is None:
            # Views of different photos differ in size, so each passes through the network alone.
            self.micro_batch = 1
            whole_views = find_whole_views(recipe.data, self.network, self.renderer)
            self.training = whole_views.training
            self.validation = whole_views.validation
            self.digest = whole_views.digest
            self.datasets = whole_views.datasets
        else:
            # A crop keeps only the Gaussians of the base near its holes.
            if recipe.cells != "masked":
                raise InputError(f"cells={recipe.cells}: needs whole views: set data.crops=null")
            self.training_sources = find_sources(recipe.data, self.renderer, validation=False)
            self.validation_sources = find_sources(recipe.data, self.renderer, validation=True)
            self.digest = digest_of_samples(recipe.data, self.training_sources)
            self.datasets = [facts for source in self.training_sources for facts in source.datasets]

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Make the crops that do not exist yet; returns facts about all samples for run.json.

        Whole views need no preparation. The facts are how many samples there are, and the PSNR of
        an untrained and of an ideal network.
        """
        if self.recipe.data.crops is not None:
            self._make_crops(output, reporter)
        self.items = len(self.training)
        self.validation_items = len(self.validation)
        kind = "whole views" if self.recipe.data.crops is None else "crops"
        reporter.log(f"{kind}: {self.items} for training, {self.validation_items} for validation")
        return {
            "samples": {
                "kind": kind,
                "train": self.items,
                "validation": self.validation_items,
                "digest": self.digest,
            },
            "datasets": self.datasets,
            # Only the process of rank 0 writes run.json, so the others need not measure.
            "hole_psnr": self.reachable_psnr() if rank() == 0 else {},
        }

    def _make_crops(self, output: Path, reporter: Reporter) -> None:
        """Make the files of the crops that do not exist yet, with the other processes of a run."""
        data = self.recipe.data
        folder = data.cache or output / CACHE
        make_folder(folder)
        reporter.log(f"samples of {data.views + data.validation_views} views in {folder}")

        @functools.cache
        def log_once(reason: str) -> None:
            """Report why a view is missing; the cache keeps each reason from being repeated."""
            reporter.log(f"skipped: {reason}")

        # Training has even seeds and validation odd ones, so that no view is in both.
        with reporter.stage("samples") as progress:
            validation_files = make_samples(
                data=data,
                sources=self.validation_sources,
                folder=folder / self.digest / "validation",
                seed=2 * data.seed + 1,
                views=data.validation_views,
                progress=progress,
                warn=log_once,
            )
            training_files = make_samples(
                data=data,
                sources=self.training_sources,
                folder=folder / self.digest / "train",
                seed=2 * data.seed,
                views=data.views,
                progress=progress,
                warn=log_once,
            )
        self.validation = StoredCrops(validation_files)
        self.training = StoredCrops(training_files)

    @torch.no_grad()
    def reachable_psnr(self) -> dict[str, float]:
        """Mean PSNR in dB in the holes of the validation samples, before training and at best.

        "untrained": the holes show the initial Gaussians, the first guess that a network changes.
        "colours of the targets": the initial Gaussians have the colours that the targets show. A
        run can raise PSNR only from the first value towards the second.
        """
        # An untrained network changes nothing. Its random weights must not use up random numbers
        # of the run.
        with torch.random.fork_rng(devices=[]):
            network = open_residual(self.recipe.network).to(self.renderer.device)
        values: dict[str, list[float]] = {"untrained": [], "colours of the targets": []}
        for item in range(self.validation_items):
            (sample,) = self.load_batch(step=None, items=[item])  # None: a validation item
            # A view without a hole, such as the photo's own, has no PSNR.
            if not bool(sample.hole.any()):
                continue
            values["untrained"].append(self._sample_psnr(network, sample))
            values["colours of the targets"].append(
                self._sample_psnr(network, _with_target_colors(sample))
            )
        return {
            name: sum(numbers) / len(numbers) if numbers else math.nan
            for name, numbers in values.items()
        }

    def _sample_psnr(self, network: nn.Module, sample: Sample) -> float:
        """PSNR in dB in the hole of a sample that the network completes."""
        views = self.complete(network, [sample])
        return hole_psnr(views.rgb[0], views.target[0], views.hole[0])

    def load_batch(self, step: int | None, items: Sequence[int]) -> list[Sample]:
        """Read samples, for validation if `step` is None; InputError if one cannot be read."""
        source = self.validation if step is None else self.training
        device = device_for_kernels(self.renderer.device)
        samples = [source.load(item).to(device) for item in items]

        # Each sample computes the network's input, the cells of 2×2 pixels that get Gaussians, and
        # the renderer's tiles to draw once, and keeps them. This is done here, in the thread that
        # reads ahead, so that the training loop does not wait for it. It is done on the renderer's
        # device, because the sample's images are fewer bytes to copy there than the input is.
        for sample in samples:
            sample.network_input(self.network.inputs)
            sample.chosen_cells(self.recipe.cells)
            _ = sample.tiles
        return samples

    def complete(self, network: nn.Module, batch: Sequence[Sample]) -> ViewBatch:
        """Complete samples of one size, as inference does: Gaussians in masked cells alone."""
        return complete_samples(network, self.network.inputs, batch, self.renderer, self.precision)

    def loss(self, network: nn.Module, batch: Sequence[Sample]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of samples, with Gaussians in the cells that the recipe's key `cells` names."""
        views = complete_samples(
            network,
            self.network.inputs,
            batch,
            self.renderer,
            self.precision,
            self.recipe.cells,
        )
        return self._loss_of(views)

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the weights in half precision, for `spackle predict --residual`."""
        tensors = {
            name: tensor.detach().half().cpu().contiguous()
            for name, tensor in network.state_dict().items()
        }
        write_atomic(path, save(tensors, {ARCHITECTURE_KEY: self.recipe.network}))


def _with_target_colors(sample: Sample) -> Sample:
    """The sample with initial Gaussians in the colours that the target shows at their cells."""
    rows, columns = sample.features.mask.shape
    cell_pixels = sample.target.view(rows, CELL, columns, CELL, 3)
    view = copy.copy(sample.view)
    view.initial = dataclasses.replace(sample.initial, rgb=cell_pixels.mean((1, 3)))
    return dataclasses.replace(sample, view=view)
