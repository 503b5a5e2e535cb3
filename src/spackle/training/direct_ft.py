"""The paper's naive decoupled baseline ("Direct FT"): the base's own decoder learns what the residual would.

The same targets and the same losses, but a fixed number of Gaussians: to fill a hole, some must leave what they
showed before, which the paper calls capacity competition. Its implementation has losses at the input view on "the
non-Spackle training path" alone ("Training Details and Loss Weights"): so each photo's own view is among a step's.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from spackle.bases.sharp.base import TunableSharp, normalised_camera
from spackle.bases.sharp.checkpoint import Owner, decoder_bytes, link_owner, owner_of, read_checkpoint_tensors
from spackle.dataset.reader import DatasetFiles
from spackle.dataset.sample import DatasetView
from spackle.device import enough_memory
from spackle.downloads import check_recorded, installed, weights_digest
from spackle.errors import InputError
from spackle.files import atomic_path
from spackle.render import Renderer, place_of
from spackle.training.data import short_digest
from spackle.training.method import (
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
from spackle.training.recipe import DataRecipe, Recipe
from spackle.training.sources import PseudoViews

BASE = "sharp"  # the base whose decoder can learn
VIEWS_AT_ONCE = 4  # of a photo in a step: they share a pass through the encoder, which costs more than all the rest
PICTURE_SIDE = 512  # pixels of a picture's longer side


@dataclasses.dataclass(frozen=True)
class PseudoPhotos:
    """A pseudo-supervised dataset by its photos: some are learned from, the others are for validation."""

    files: DatasetFiles
    learned: tuple[int, ...]  # places in the dataset
    validation: tuple[int, ...]  # others
    digest: str

    @staticmethod
    def of(data: DataRecipe, location: Path, weights_sha256: str) -> PseudoPhotos:
        """Divide a dataset at a place by whole photos, in a random order of `data.seed`.

        InputError for no finished dataset, or one that teaches nothing, is of another base or of other weights than
        those that learn, or has a single photo.
        """
        files = PseudoViews(location).files
        base = files.manifest.config.get("base", {})
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
        photos, per_photo = len(files), len(files.samples[0][1].holes)
        if photos < 2:
            raise InputError(f"{location}: a single photo, but one must learn and another judge: build it with more")
        order = [int(place) for place in np.random.default_rng(data.seed).permutation(photos)]
        held = min(max(1, data.validation_views // per_photo), photos // 2)
        learned = order[held:][: max(1, data.views // per_photo)]
        digest = short_digest((files.manifest.digest, learned, order[:held]))
        return PseudoPhotos(files, tuple(learned), tuple(order[:held]), digest)

    def views(self, place: int, indices: Sequence[int] | None = None) -> list[DatasetView]:
        """Some or all views of a photo, of which 0 is its own; InputError where a shard is missing or damaged."""
        group = self.files.group(place)
        return [group.view(index) for index in (range(group.views) if indices is None else indices)]

    def drawn(self, place: int, rng: np.random.Generator) -> list[DatasetView]:
        """`VIEWS_AT_ONCE` views of a photo: its own, and others at random; all of them where there are fewer."""
        others = 1 + rng.permutation(len(self.files.samples[place][1].holes) - 1)[: VIEWS_AT_ONCE - 1]
        return self.views(place, [0, *sorted(int(other) for other in others)])


def render_photo(decoder: nn.Module, base: TunableSharp, views: Sequence[DatasetView], renderer: Renderer) -> ViewBatch:
    """Predict a photo's Gaussians anew, and draw them in some of its views; InputError where memory is too small.

    Only the decoder, which follows on `base`, gets gradients.
    """
    photo_camera = views[0].photo_camera
    advice = ["try optim.precision=bf16"] if base.precision == torch.float32 else []
    with enough_memory(*advice):
        place = place_of(renderer)
        gaussians = base.gaussians(decoder, base.see(views[0].photo, photo_camera), place)
        drawn = [renderer.render(gaussians, normalised_camera(view.camera, photo_camera)) for view in views]
    return ViewBatch(
        rgb=torch.stack([rendering.rgb for rendering in drawn]),
        alpha=torch.stack([rendering.alpha for rendering in drawn]),
        base_rgb=torch.stack([view.rendering.rgb for view in views]).to(place),
        target=torch.stack([view.target for view in views]).to(place),
        hole=torch.stack([view.mask for view in views]).to(place),
    )


class DirectFt(ViewMethod):
    """Items are photos, one at a time: SHARP's decoder keeps gigabytes for the gradient of each."""

    name: ClassVar[str] = "direct-ft"
    columns: ClassVar[str] = "base, fine-tuned, target"
    remedy: ClassVar[str] = "build the dataset without the photos that are named there"
    at_once = 1

    def __init__(
        self, base: TunableSharp, owner: Owner, photos: PseudoPhotos, objective: Objective, views: int, seed: int
    ) -> None:
        """A step takes `views` of all processes together, a multiple of VIEWS_AT_ONCE; `seed` draws them."""
        super().__init__(objective)
        self.base, self.owner, self.photos, self.seed, self.digest = base, owner, photos, seed, photos.digest
        self.items, self.validation_items = len(photos.learned), len(photos.validation)
        self.items_a_step = views // VIEWS_AT_ONCE

    def complete(self, network: nn.Module, items: Sequence[int], step: int | None = None) -> ViewBatch:
        """Drawn views of one photo, for validation all of them; InputError where they cannot be read."""
        (item,) = items
        views = self.photos.views(self.photos.validation[item]) if step is None else self._drawn(step, item)
        return render_photo(network, self.base, views, self.objective.renderer)

    def _drawn(self, step: int, item: int) -> list[DatasetView]:
        return self.photos.drawn(self.photos.learned[item], np.random.default_rng([self.seed, step, item]))

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: of some photos their own view and the one with the largest hole, a row each."""
        places, rows = self.photos.validation, []
        for place in places[:: max(1, 2 * len(places) // PICTURED)][: PICTURED // 2]:
            widest = int(np.argmax(self.photos.files.samples[place][1].holes))
            views = self.photos.views(place, (0, widest))
            done = render_photo(network, self.base, views, self.objective.renderer)
            rows += [torch.cat(row, dim=1).cpu() for row in zip(done.base_rgb, done.rgb, done.target, strict=True)]
        shown = [_reduced(row, len(self.columns.split(","))) for row in rows]
        across = max(row.shape[1] for row in shown)
        return torch.cat([pad(row, (0, 0, 0, across - row.shape[1])) for row in shown])

    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Write which photos and views a step had, a file each."""
        for item in items:
            views = self._drawn(step, item)
            facts = {"step": step, "photo": self.photos.files.samples[self.photos.learned[item]][1].photo}
            with atomic_path(folder / f"{views[0].key}.json") as temporary:
                text = json.dumps({**facts, "views": [view.index for view in views]}, indent=1)
                temporary.write_text(text + "\n", encoding="utf-8")

    def export(self, network: nn.Module, path: Path) -> None:
        """The decoder in full precision, for `spackle predict --base sharp -c`, and a link to its checkpoint."""
        with atomic_path(path) as temporary:
            temporary.write_bytes(decoder_bytes(network, self.owner))
        link_owner(self.owner, path.parent)


def _reduced(row: Tensor, pictures: int) -> Tensor:
    """A row of pictures side by side, [H, W, 3], the longer side of each at most PICTURE_SIDE."""
    height, width = row.shape[0], row.shape[1] // pictures
    scale = min(1.0, PICTURE_SIDE / max(height, width))
    size = max(1, round(height * scale)), pictures * max(1, round(width * scale))
    return interpolate(row.movedim(-1, 0)[None], size, mode="area")[0].movedim(0, -1)


def plan_direct_ft(context: RunContext[Recipe], checkpoint: Path | None) -> Plan:
    """Find a checkpoint (None: the downloaded one) and a dataset that belong together; load no network yet.

    InputError for a recipe, checkpoint or dataset that cannot be used.
    """
    objective, recipe, least = load_objective(context), context.recipe, VIEWS_AT_ONCE * context.ranks.count
    if recipe.optim.batch % least:
        raise InputError(
            f"optim.batch={recipe.optim.batch}: with --method direct-ft each process takes {VIEWS_AT_ONCE} views "
            f"of a photo at a time: give a multiple of {least}"
        )
    if recipe.init is not None:
        raise InputError(f"init={recipe.init}: --method direct-ft starts from SHARP's checkpoint: leave it out")
    data = recipe.data
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
    owner = _find_owner(checkpoint)
    photos = PseudoPhotos.of(data, data.pseudo, owner.sha256)

    def start() -> Start:
        base = TunableSharp.load(owner.path, objective.precision, objective.device)
        decoder = base.network.gaussian_decoder().let_learn()
        method = DirectFt(base, owner, photos, objective, recipe.optim.batch, recipe.run.seed)
        facts = facts_of(method, base.network)
        context.reporter.log(
            f"{method.items} photos to learn from, {method.validation_items} to be judged by; "
            f"{facts['parameters']['learn']:,} weights of SHARP learn, {facts['parameters']['stay']:,} stay"
        )
        return Start(method, decoder, {**facts, "checkpoint": {"file": owner.path.name, "sha256": owner.sha256}})

    return Plan(DirectFt.name, photos.digest, start)


def _find_owner(checkpoint: Path | None) -> Owner:
    """The checkpoint that learns, held to its record where it was downloaded."""
    path = checkpoint or installed("sharp")
    if path is None:
        raise InputError(
            "--method direct-ft: no weights of SHARP on this machine: `spackle weights get sharp` downloads them "
            "(2.8 GB, for research only), -c FILE takes a local copy"
        )
    read_checkpoint_tensors(path)  # refuses what is none, and reads no numbers yet
    if owner_of(path) is not None:
        raise InputError(f"-c {path}: a decoder that was trained already: give the checkpoint that it was trained on")
    record = check_recorded(path)
    return Owner(path, weights_digest(path) if record is None else record.sha256)
