"""The paper's naive decoupled baseline ("Direct FT"): SHARP's own decoder learns to fill holes.

SHARP is a network that turns a photo into Gaussians. Its encoder stays as it is, its decoder is
trained in place of the residual network. Targets and losses are those of the residual. Each step
includes the photo's own view, whose target is the photo itself, in every pixel: the paper mentions
"input-view losses" of "the non-Spackle training path" ("Training Details and Loss Weights"), but
not what they are.
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
from torch.nn.functional import interpolate

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
from spackle.paper.training.sample_factory import short_digest
from spackle.paper.training.sources import open_pseudo_dataset, split_photos
from spackle.render import Renderer
from spackle.runtime.device import report_memory_shortage, without_autocast_or_tf32
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.progress import Reporter
from spackle.weights import installed_weights, weights_digest
from spackle.weights.checkpoints import read_tensors

# Views of a photo in a step. They share one pass through the encoder, the most expensive part.
VIEWS_PER_PHOTO = 4


@dataclasses.dataclass(frozen=True)
class TunableSharp:
    """SHARP with frozen weights, but a trainable decoder.

    The decoder, `network.gaussian_decoder()`, has weights in float32.
    """

    network: SharpNetwork
    precision: torch.dtype  # of frozen weights, and of the decoder under autocast

    @staticmethod
    def load(
        path: str | os.PathLike[str], precision: torch.dtype, device: torch.device
    ) -> TunableSharp:
        """Read a checkpoint of SHARP and freeze it; InputError if the file is unusable.

        `precision`, float32 or bfloat16, is that of the encoder and of the decoder's arithmetic.
        """
        # The decoder's weights stay in float32: small steps of the optimiser would vanish in bf16.
        network = load_network(path, torch.float32)
        set_precision(network.monodepth_model, precision)
        return TunableSharp(network.to(device), precision)

    @torch.no_grad()
    def encode(self, rgb: Tensor, photo_camera: Camera) -> DecoderInput:
        """Run the frozen encoder on a photo [H, W, 3], sRGB in 0..1.

        `photo_camera` is the photo's, of the same size.

        Returns what the decoder needs: image, disparity, feature maps and initial Gaussians.
        """
        device = next(self.network.parameters()).device
        square_image = resize_to_square(rgb.to(device), self.network.config.side)
        focal_per_width = photo_camera.focal[0] / photo_camera.width
        with without_autocast_or_tf32(device):
            return self.network.encode(square_image, focal_per_width, default_window_batch(device))

    def gaussians(
        self, decoder: nn.Module, encoded: DecoderInput, target_device: torch.device | str = "cpu"
    ) -> Gaussians:
        """The photo's Gaussians, in SHARP's normalised space; gradients reach `decoder`.

        The normalised space is stretched, so that every photo has the same field of view.

        Args:
            decoder: SHARP's decoder, or a wrapper that distributes it over processes.
            encoded: what `encode` has returned for the photo.
            target_device: where the Gaussians are needed.
        """
        device = encoded.image_and_disparity.device
        autocast = torch.autocast(
            device.type, self.precision, enabled=self.precision != torch.float32
        )
        with without_autocast_or_tf32(device):
            # The decoder gives deltas, changes of the initial Gaussians. Low precision is enough
            # for them, but would shift the Gaussians, so that only the decoder runs in it.
            with autocast:
                deltas = decoder(encoded.image_and_disparity, encoded.encoder_maps)
            return apply_deltas(encoded.initial, deltas).to(target_device)


def normalised_camera(camera: Camera, photo_camera: Camera) -> Camera:
    """A camera that sees Gaussians in SHARP's normalised space as `camera` sees them in metres.

    D = diag(W / 2fx, H / 2fy, 1) maps normalised space to metres, with W, H, fx and fy of
    `photo_camera`, the camera of the photo. Stretching Gaussians by D takes an eigendecomposition,
    whose gradient is undefined for round Gaussians. A renderer uses the camera's matrix P only as
    P x for centres and P Σ Pᵀ for covariances. The matrix P D thus renders the same image, with all
    gradients.
    """
    fx, fy = photo_camera.focal
    x_stretch = photo_camera.width / (2 * fx)
    y_stretch = photo_camera.height / (2 * fy)
    world_to_camera = camera.world_to_camera.double()  # float32 would shift the image
    # The columns of P are stretched; the fourth one is the translation.
    stretch = world_to_camera.new_tensor([x_stretch, y_stretch, 1.0, 1.0])
    return dataclasses.replace(camera, world_to_camera=world_to_camera * stretch)


def render_views_of_photo(
    decoder: nn.Module, base: TunableSharp, views: Sequence[DatasetView], renderer: Renderer
) -> ViewBatch:
    """Predict a photo's Gaussians and render them in the given views.

    Args:
        decoder: SHARP's decoder; only this network gets gradients.
        base: the rest of SHARP.
        views: views of one photo, with their targets.
        renderer: renders the Gaussians.

    Returns:
        The rendered views, beside those of the dataset, their targets and holes. The target of the
        photo's own view is the photo, which counts in every pixel. InputError if memory runs out.
    """
    photo_camera = views[0].photo_camera
    with report_memory_shortage("try optim.precision=bf16"):
        encoded = base.encode(views[0].photo, photo_camera)
        gaussians = base.gaussians(decoder, encoded, renderer.device)
        # The Gaussians are in SHARP's normalised space, so the cameras are brought there.
        renderings = [
            renderer.render(gaussians, normalised_camera(view.camera, photo_camera))
            for view in views
        ]
    images = [
        (rendering, view.rendering.rgb, target_of(view), view.mask)
        for rendering, view in zip(renderings, views, strict=True)
    ]
    photos_views = [index for index, view in enumerate(views) if is_photos_view(view)]
    return ViewBatch.of(images, fully_supervised=photos_views)


def is_photos_view(view: DatasetView) -> bool:
    """Whether a view is the photo's own: seen by the photo's camera."""
    return view.index == 0


def target_of(view: DatasetView) -> Tensor:
    """[H, W, 3] sRGB that a view should show: the photo in its own view, else the completed view.

    For its own view the dataset has the base's rendering, which would teach the decoder nothing
    but the base's errors.
    """
    if not is_photos_view(view):
        return view.target
    height, width = view.target.shape[:2]
    if view.photo.shape[:2] == (height, width):
        return view.photo
    # Views have even sides, so a photo with an odd side is stretched by one pixel.
    photo = view.photo.movedim(-1, 0)[None]  # [1, 3, h, w]
    stretched = interpolate(photo, (height, width), mode="bilinear", align_corners=False)
    return stretched[0].movedim(0, -1)


class DirectFt(ViewTask):
    """Trains SHARP's decoder; its items are photos, run one at a time.

    One at a time, because the gradient of one photo takes gigabytes.
    """

    name: ClassVar[str] = "direct-ft"
    micro_batch = 1

    def __init__(
        self, recipe: Recipe, device: torch.device, checkpoint: Path | None = None
    ) -> None:
        """Check that the dataset was built with the checkpoint, without loading the network.

        Args:
            recipe: the settings of the run.
            device: where the networks compute.
            checkpoint: SHARP's weights; None: the downloaded file.

        Raises:
            InputError: the recipe, the checkpoint or the dataset cannot be used.
        """
        super().__init__(recipe, device)
        self._check_recipe(recipe)
        self.sharp_checkpoint = self._find_checkpoint(checkpoint)
        self.dataset = open_pseudo_dataset(recipe.data.pseudo)
        self._check_base_of_dataset()

        # What the training loop asks of every task: a digest of the data, and numbers of items.
        self.training_photos, self.validation_photos = split_photos(self.dataset, recipe.data)
        self.digest = short_digest(
            (self.dataset.digest, self.training_photos, self.validation_photos)
        )
        self.items = len(self.training_photos)
        self.validation_items = len(self.validation_photos)
        self.items_per_step = recipe.optim.batch // VIEWS_PER_PHOTO

    @staticmethod
    def _check_recipe(recipe: Recipe) -> None:
        """InputError if a recipe names other data than datasets, or initial weights, or a batch
        that cannot be divided into photos."""
        data = recipe.data
        if recipe.optim.batch % VIEWS_PER_PHOTO:
            raise InputError(
                f"optim.batch={recipe.optim.batch}: give a multiple of {VIEWS_PER_PHOTO} views"
            )
        has_other_data = recipe.init or data.photos or data.rgbd or data.stereo
        if not data.pseudo or has_other_data:
            raise InputError(
                "`method` direct-ft learns only from data.pseudo, a dataset of `spackle dataset "
                "build` with `base` sharp: leave out init and other data"
            )

    @staticmethod
    def _find_checkpoint(checkpoint: Path | None) -> SourceCheckpoint:
        """SHARP's original checkpoint, given or downloaded; InputError if it is unusable."""
        path = checkpoint or installed_weights("sharp")
        if path is None:
            raise InputError(f"`method` direct-ft: {MISSING_WEIGHTS_ADVICE['sharp']}")
        # This only refuses files that are no checkpoint; `prepare` loads the network.
        read_tensors(path, "give SHARP's checkpoint")
        if source_checkpoint_of(path) is not None:
            raise InputError(
                f"`checkpoint` {path}: holds an already trained decoder: give the original "
                "checkpoint of SHARP"
            )
        return SourceCheckpoint(path, weights_digest(path))

    def _check_base_of_dataset(self) -> None:
        """InputError if the dataset was not built with the weights of SHARP that are trained here.

        The dataset's manifest records its base: the network that turned photos into Gaussians.
        """
        first_part = self.dataset.parts[0]  # all have the same base
        base = first_part.manifest.config.get("base", {})
        name = base.get("name")
        weights = base.get("weights")  # their SHA-256
        # With another network the holes of the views would lie elsewhere.
        if name != "sharp" or weights != self.sharp_checkpoint.sha256:
            raise InputError(
                f"{first_part.location}: built with the base {name}, weights {weights}: build a "
                f"dataset with `base` sharp and the weights {self.sharp_checkpoint.path}"
            )

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Load SHARP; returns the datasets and the file and digest of its weights, for run.json."""
        self.base = TunableSharp.load(self.sharp_checkpoint.path, self.precision, self.device)
        self.network = self.base.network.gaussian_decoder().enable_training()
        reporter.log(f"{self.items} training photos, {self.validation_items} validation photos")
        return {
            "datasets": self.dataset.facts,
            "checkpoint": {
                "file": self.sharp_checkpoint.path.name,
                "sha256": self.sharp_checkpoint.sha256,
            },
        }

    def load_batch(self, step: int | None, items: Sequence[int]) -> list[DatasetView]:
        """Views of one photo: a random choice of `VIEWS_PER_PHOTO` views, or all for validation.

        Args:
            step: the number of the training step; None: the photo is for validation.
            items: the number of the photo, as a list.
        """
        (item,) = items  # `micro_batch` is 1
        if step is None:
            photo = self.dataset[self.validation_photos[item]]
            view_numbers = list(range(photo.views))
        else:
            photo = self.dataset[self.training_photos[item]]
            # The choice depends on these numbers alone: a resumed run makes the same choice.
            view_numbers = draw_view_numbers([self.recipe.run.seed, step, item], photo.views)
        return [photo.view(number) for number in view_numbers]

    def complete(self, network: nn.Module, batch: Sequence[DatasetView]) -> ViewBatch:
        return render_views_of_photo(network, self.base, batch, self.renderer)

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the decoder in float32, for `spackle predict`, and a link to SHARP's checkpoint.

        The file holds only what was trained; the link finds the rest of SHARP.
        """
        write_atomic(path, encode_decoder(network, self.sharp_checkpoint))
        link_source_checkpoint(self.sharp_checkpoint, path.parent)


def draw_view_numbers(seed: Sequence[int], view_count: int) -> list[int]:
    """Numbers of up to `VIEWS_PER_PHOTO` views of a photo, in ascending order.

    The first one is 0, the photo's own view; the others are a random choice of the other views.

    Args:
        seed: numbers that determine the choice.
        view_count: number of views that the photo has.
    """
    shuffled = 1 + np.random.default_rng(seed).permutation(view_count - 1)
    chosen = shuffled[: VIEWS_PER_PHOTO - 1]
    return [0, *sorted(chosen.tolist())]
