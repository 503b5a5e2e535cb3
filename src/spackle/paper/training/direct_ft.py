"""The paper's naive decoupled baseline ("Direct FT"): SHARP's own decoder is trained in place of the residual.

Targets and losses are those of the residual. Each step includes the photo's own view, because the paper has losses at
the input view only in "the non-Spackle training path" ("Training Details and Loss Weights").
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from spackle.bases.settings import MISSING_WEIGHTS_ADVICE
from spackle.bases.sharp.base import (
    SourceCheckpoint,
    default_window_batch,
    encode_decoder,
    link_source_checkpoint,
    load_network,
    resize_to_square,
    source_checkpoint_of,
)
from spackle.bases.sharp.encoder import set_precision
from spackle.bases.sharp.network import DecoderInput, SharpNetwork, apply_deltas
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.paper.dataset.sample import DatasetView
from spackle.paper.training.recipe import Recipe
from spackle.paper.training.residual import ViewBatch, ViewTask
from spackle.paper.training.samples import short_digest
from spackle.paper.training.sources import open_pseudo_dataset, split_photos
from spackle.render import Renderer
from spackle.runtime.device import report_memory_shortage, without_autocast_or_tf32
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.progress import Reporter
from spackle.weights import installed_weights, weights_digest
from spackle.weights.checkpoints import read_tensors

VIEWS_PER_PHOTO = 4  # views of a photo in a step; they share one pass through the encoder, the most expensive part


@dataclasses.dataclass(frozen=True)
class TunableSharp:
    """SHARP with frozen weights, and a trainable decoder `network.gaussian_decoder()` in float32."""

    network: SharpNetwork
    precision: torch.dtype  # of frozen weights, and of the decoder under autocast

    @staticmethod
    def load(
        path: str | os.PathLike[str], precision: torch.dtype, device: torch.device
    ) -> TunableSharp:
        """Read a checkpoint, see `load_network`, and freeze it; `precision` is float32 or bfloat16."""
        network = load_network(path, torch.float32)
        set_precision(network.monodepth_model, precision)
        return TunableSharp(network.to(device), precision)

    @torch.no_grad()
    def encode(self, rgb: Tensor, photo_camera: Camera) -> DecoderInput:
        """Run the frozen encoder on a photo [H, W, 3], sRGB in 0..1, with a camera of the same size."""
        device = next(self.network.parameters()).device
        image = resize_to_square(rgb.to(device), self.network.config.side)
        with without_autocast_or_tf32(device):
            return self.network.encode(
                image, photo_camera.focal[0] / photo_camera.width, default_window_batch(device)
            )

    def gaussians(
        self, decoder: nn.Module, encoded: DecoderInput, place: torch.device | str = "cpu"
    ) -> Gaussians:
        """Gaussians in SHARP's normalised space, on the device `place`; gradients reach `decoder`."""
        device = encoded.image_and_disparity.device
        autocast = torch.autocast(
            device.type, self.precision, enabled=self.precision != torch.float32
        )
        with without_autocast_or_tf32(device):
            with autocast:
                deltas = decoder(encoded.image_and_disparity, encoded.encoder_maps)
            return apply_deltas(encoded.initial, deltas).to(place)


def normalised_camera(camera: Camera, photo_camera: Camera) -> Camera:
    """A camera that sees Gaussians in SHARP's normalised space as `camera` sees the same Gaussians in metres.

    D = diag(W / 2fx, H / 2fy, 1) maps normalised space to metres. Stretching Gaussians by D takes an eigendecomposition
    (`stretch_gaussians`), whose gradient is undefined for round Gaussians. A renderer uses the camera's matrix P only
    as P x for centres and P Σ Pᵀ for covariances. The matrix P D thus renders the same image, with all gradients.
    """
    fx, fy = photo_camera.focal
    matrix = camera.world_to_camera.double()  # float32 would shift the image
    stretch = matrix.new_tensor(
        [photo_camera.width / (2 * fx), photo_camera.height / (2 * fy), 1.0, 1.0]
    )
    return dataclasses.replace(camera, world_to_camera=matrix * stretch)


def render_views_of_photo(
    decoder: nn.Module, base: TunableSharp, views: Sequence[DatasetView], renderer: Renderer
) -> ViewBatch:
    """Predict a photo's Gaussians and render them in the given views; only `decoder` gets gradients.

    InputError if memory runs out.
    """
    photo_camera = views[0].photo_camera
    with report_memory_shortage("try optim.precision=bf16"):
        gaussians = base.gaussians(
            decoder, base.encode(views[0].photo, photo_camera), renderer.device
        )
        drawn = [
            renderer.render(gaussians, normalised_camera(view.camera, photo_camera))
            for view in views
        ]
    return ViewBatch.of(
        (one, v.rendering.rgb, v.target, v.mask) for one, v in zip(drawn, views, strict=True)
    )


class DirectFt(ViewTask):
    """Trains SHARP's decoder; its items are photos, run one at a time, because one gradient takes gigabytes."""

    name: ClassVar[str] = "direct-ft"
    micro_batch = 1

    def __init__(
        self, recipe: Recipe, device: torch.device, checkpoint: Path | None = None
    ) -> None:
        """Check that the dataset matches the checkpoint (None: the downloaded one), without loading the network.

        InputError if the recipe, the checkpoint or the dataset cannot be used.
        """
        super().__init__(recipe, device)
        data = recipe.data
        if recipe.optim.batch % VIEWS_PER_PHOTO:
            raise InputError(
                f"optim.batch={recipe.optim.batch}: give a multiple of {VIEWS_PER_PHOTO} views"
            )
        if data.pseudo is None or recipe.init or data.photos or data.rgbd or data.stereo:
            raise InputError(
                "--method direct-ft learns only from data.pseudo, a dataset of `spackle dataset build --base sharp`: "
                "leave out init and other data"
            )
        path = checkpoint or installed_weights("sharp")
        if path is None:
            raise InputError(f"--method direct-ft: {MISSING_WEIGHTS_ADVICE['sharp']}")
        read_tensors(path, "give SHARP's checkpoint")  # without the numbers; refuses other files
        if source_checkpoint_of(path) is not None:
            raise InputError(
                f"-c {path}: holds an already trained decoder: give the original checkpoint of SHARP"
            )
        self.owner = SourceCheckpoint(path, weights_digest(path))
        self.files = open_pseudo_dataset(data.pseudo)
        base = self.files.manifest.config.get("base", {})
        if (base.get("name"), base.get("weights")) != ("sharp", self.owner.sha256):
            raise InputError(
                f"{data.pseudo}: built with the base {base.get('name')}, weights {base.get('weights')}: build a "
                f"dataset with --base sharp and the weights {path}"
            )
        self.training_photos, self.validation_photos = split_photos(self.files, data)
        self.digest = short_digest(
            (self.files.manifest.digest, self.training_photos, self.validation_photos)
        )
        self.items, self.validation_items = len(self.training_photos), len(self.validation_photos)
        self.items_per_step = recipe.optim.batch // VIEWS_PER_PHOTO

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Load SHARP."""
        self.base = TunableSharp.load(self.owner.path, self.precision, self.device)
        self.network = self.base.network.gaussian_decoder().enable_training()
        reporter.log(f"{self.items} training photos, {self.validation_items} validation photos")
        return {"checkpoint": {"file": self.owner.path.name, "sha256": self.owner.sha256}}

    def load_batch(self, step: int | None, items: Sequence[int]) -> list[DatasetView]:
        """Views of a photo, see `draw_view_numbers`; for validation (step None) all views."""
        (item,) = items
        group = self.files[(self.validation_photos if step is None else self.training_photos)[item]]
        drawn = (
            range(group.views)
            if step is None
            else draw_view_numbers([self.recipe.run.seed, step, item], group.views)
        )
        return [group.view(index) for index in drawn]

    def complete(self, network: nn.Module, batch: Sequence[DatasetView]) -> ViewBatch:
        return render_views_of_photo(network, self.base, batch, self.renderer)

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the decoder in float32, for `spackle predict --base sharp -c`, and a link to SHARP's checkpoint."""
        write_atomic(path, encode_decoder(network, self.owner))
        link_source_checkpoint(self.owner, path.parent)


def draw_view_numbers(seed: Sequence[int], views: int) -> list[int]:
    """Numbers of up to `VIEWS_PER_PHOTO` views of a photo: 0 for the photo's own view, then random other views."""
    others = 1 + np.random.default_rng(seed).permutation(views - 1)[: VIEWS_PER_PHOTO - 1]
    return [0, *sorted(others.tolist())]
