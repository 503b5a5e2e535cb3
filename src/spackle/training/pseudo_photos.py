"""A pseudo-supervised dataset by its photos: several views of one at a time, some photos kept for validation."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spackle.errors import InputError
from spackle.pseudo import PseudoFiles, PseudoSample
from spackle.training.cache import digest_of
from spackle.training.pseudo_source import PseudoViews
from spackle.training.recipe import DataRecipe

BASE = "sharp"  # the base whose decoder can learn
VIEWS_AT_ONCE = 4  # of a photo in a step: they share a pass through the encoder, which costs more than all the rest


@dataclasses.dataclass(frozen=True)
class PseudoPhotos:
    """Which photos of a dataset teach, and which judge."""

    files: PseudoFiles
    learned: tuple[int, ...]  # places in the dataset
    judged: tuple[int, ...]  # others
    digest: str

    @staticmethod
    def of(data: DataRecipe, location: Path, weights_sha256: str) -> PseudoPhotos:
        """Divide a dataset: whole photos, in a random order of `data.seed`.

        Args:
            data: views, validation_views and seed count.
            location: of the dataset (see `only_dataset`).
            weights_sha256: of the checkpoint whose decoder learns.

        Raises:
            InputError: no finished dataset, one that teaches nothing, one of another base or of other weights, or one
                with a single photo.
        """
        files = PseudoViews(location).files
        _check_base(files, weights_sha256)
        photos, per_photo = len(files), len(files.samples[0][1].holes)
        if photos < 2:
            raise InputError(f"{location}: a single photo, but one must learn and another judge: build it with more")
        order = [int(place) for place in np.random.default_rng(data.seed).permutation(photos)]
        judged = min(max(1, data.validation_views // per_photo), photos // 2)
        learned = order[judged:][: max(1, data.views // per_photo)]
        digest = digest_of((files.manifest.digest, learned, order[:judged]))
        return PseudoPhotos(files, tuple(learned), tuple(order[:judged]), digest)

    def drawn(self, place: int, rng: np.random.Generator) -> list[PseudoSample]:
        """`VIEWS_AT_ONCE` views of a photo: its own, and others at random; all of them where there are fewer.

        Raises:
            InputError: a shard that is missing or damaged.
        """
        group = self.files.group(place)
        others = 1 + rng.permutation(group.views - 1)[: VIEWS_AT_ONCE - 1]
        return [group.view(index) for index in [0, *sorted(int(other) for other in others)]]

    def all(self, place: int) -> list[PseudoSample]:
        """Every view of a photo; InputError likewise."""
        group = self.files.group(place)
        return [group.view(index) for index in range(group.views)]

    def widest(self, place: int) -> list[PseudoSample]:
        """A photo's own view and the one with the largest hole; InputError likewise."""
        holes: Sequence[float] = self.files.samples[place][1].holes
        group = self.files.group(place)
        return [group.view(index) for index in (0, int(np.argmax(holes)))]

    def name(self, place: int) -> str:
        """What a photo is called in its folder."""
        return self.files.samples[place][1].photo


def only_dataset(data: DataRecipe) -> Path:
    """The dataset that a recipe names; InputError where it names none, or other sources."""
    for key, value in (("photos", data.photos), ("rgbd", data.rgbd), ("stereo", data.stereo)):
        if value:
            raise InputError(
                f"data.{key}: its samples have Gaussians that cannot change, and --method direct-ft changes them: "
                f"leave it out (data.{key}={'[]' if key == 'rgbd' else 'null'}) and give data.pseudo"
            )
    if data.pseudo is None:
        raise InputError(
            "data.pseudo: missing, and --method direct-ft learns from nothing else: "
            "give a dataset of `spackle dataset build --base sharp`"
        )
    return data.pseudo


def _check_base(files: PseudoFiles, weights_sha256: str) -> None:
    """InputError unless the dataset's renderings and masks are those of the weights that are to learn."""
    base, location = files.manifest.config.get("base", {}), files.location
    if base.get("name") != BASE:
        raise InputError(
            f"{location}: built with --base {base.get('name')}, so its holes are not SHARP's, which is to learn: "
            "build one with --base sharp"
        )
    if base.get("weights") != weights_sha256:
        raise InputError(
            f"{location}: built with other weights of SHARP (SHA-256 {base.get('weights')}): "
            "give them with -c, or build a dataset with these"
        )
