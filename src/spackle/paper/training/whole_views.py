"""Whole views of a dataset's photos as training samples: what is trained is what is evaluated.

Each sample is made as `spackle evaluate` makes a view: from the photo's Gaussians and the view's
camera, by the same `FillContext`. Nothing is cut, left out or stored in between.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any, NamedTuple

import torch

from spackle.bases import BasePrediction
from spackle.paper.dataset.joined import JoinedDataset
from spackle.paper.dataset.sample import PhotoGroup
from spackle.paper.training.recipe import DataRecipe
from spackle.paper.training.sample_factory import short_digest
from spackle.paper.training.samples import Sample
from spackle.paper.training.sources import open_pseudo_dataset, split_photos
from spackle.render import Renderer
from spackle.residual.network import ResidualNet
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext

# Photos kept in memory, because the views of a photo follow each other in validation. One of SHARP
# has 40 MB of Gaussians.
KEPT_PHOTOS = 2


class SplitViews(NamedTuple):
    """The whole views of a dataset, divided by photos."""

    training: WholeViews
    validation: WholeViews
    digest: str  # identifies the views
    datasets: list[dict[str, Any]]  # place, digest and configuration of each, for run.json


class WholeViews:
    """All views of some photos of a dataset, numbered from 0: the views of each photo in a row."""

    def __init__(
        self,
        dataset: JoinedDataset,
        photos: Sequence[int],
        network: ResidualNet,
        renderer: Renderer,
    ) -> None:
        """Number the views; nothing is read yet.

        Args:
            dataset: the dataset.
            photos: the photos' indices in the dataset.
            network: the network that is trained; views compute the inputs that it names.
            renderer: renders the base, the photo's Gaussians, from the views.
        """
        self.network = network
        self.renderer = renderer
        # Of each view: the photo's index in the dataset, and the view's number among the photo's.
        self.views: list[tuple[int, int]] = []
        samples = dataset.samples
        for photo in photos:
            view_count = len(samples[photo].holes)
            self.views += [(photo, view) for view in range(view_count)]
        self._read_photo = lru_cache(maxsize=KEPT_PHOTOS)(dataset.__getitem__)

        # Samples are read by threads. A new thread uses CUDA's device 0, so each is told which
        # device this process uses; see `_on_renderer_device`.
        self._cuda_device: int | None = None
        if renderer.device.type == "cuda":
            self._cuda_device = torch.cuda.current_device()

    def __len__(self) -> int:
        """The number of views."""
        return len(self.views)

    def load(self, item: int) -> Sample:
        """A view by its number, with its target; InputError if the dataset is damaged."""
        photo_index, view_index = self.views[item]
        photo = self._read_photo(photo_index)
        with self._on_renderer_device():
            return self._make_sample(photo, view_index)

    @torch.no_grad()
    def _make_sample(self, photo: PhotoGroup, view_index: int) -> Sample:
        """One view of a photo, rendered from the photo's Gaussians as evaluation renders it.

        The dataset's own rendering of the view, if it has one, is not used, because its pictures
        have 8 bits.
        """
        camera = photo.camera(view_index)
        base = photo.base.to(self.renderer.device)
        prediction = BasePrediction(base, photo.photo_camera, notes={}, photo=photo.photo)
        context = FillContext.of(prediction, self.renderer, self.network)
        rendering = self.renderer.render(context.base, camera)
        target = photo.target(view_index, rendering.rgb)
        return Sample(context.base, context.view(rendering, camera), target)

    def _on_renderer_device(self) -> AbstractContextManager[object]:
        """A block in which CUDA's current device is the renderer's."""
        if self._cuda_device is None:
            return contextlib.nullcontext()
        return torch.cuda.device(self._cuda_device)


def find_whole_views(data: DataRecipe, network: ResidualNet, renderer: Renderer) -> SplitViews:
    """The whole views of a recipe's dataset, for training and for validation.

    All views count: also those with few holes or none, such as the photo's own view, and those of
    photos that are too small for crops.

    Args:
        data: the recipe's data: the dataset, and the numbers of views.
        network: the network that is trained.
        renderer: renders the base from the views.

    Raises:
        InputError: the recipe names other data, or the dataset cannot be used.
    """
    has_other_data = data.photos is not None or data.rgbd or data.stereo is not None
    if not data.pseudo or has_other_data:
        raise InputError(
            "data.crops=null: whole views come from data.pseudo alone, a dataset of `spackle "
            "dataset build`: leave out data.photos, data.rgbd and data.stereo, or set data.crops=1"
        )
    dataset = open_pseudo_dataset(data.pseudo)
    training_photos, validation_photos = split_photos(dataset, data)
    return SplitViews(
        training=WholeViews(dataset, training_photos, network, renderer),
        validation=WholeViews(dataset, validation_photos, network, renderer),
        digest=short_digest((dataset.digest, training_photos, validation_photos)),
        datasets=dataset.facts,
    )
