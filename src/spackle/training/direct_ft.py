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

from spackle.bases.sharp.checkpoint import Owner, decoder_bytes, link_owner
from spackle.bases.sharp.tuning import TunableSharp, normalised_camera
from spackle.device import enough_memory
from spackle.formats import atomic_path
from spackle.pseudo import PseudoSample
from spackle.render import Renderer
from spackle.training.method import MethodName
from spackle.training.pseudo_photos import VIEWS_AT_ONCE, PseudoPhotos
from spackle.training.step import Batch
from spackle.training.validation import PICTURED, Judge
from spackle.training.view_method import ViewMethod

PICTURE_SIDE = 512  # pixels of a picture's longer side


def render_photo(decoder: nn.Module, base: TunableSharp, views: Sequence[PseudoSample], renderer: Renderer) -> Batch:
    """Predict a photo's Gaussians anew, and draw them in some of its views.

    Args:
        decoder: the only thing that gets gradients.
        base: everything before it.
        views: of one photo.
        renderer: draws.

    Raises:
        InputError: too little memory.
    """
    photo_camera = views[0].photo_camera
    advice = ["try optim.precision=bf16"] if base.precision == torch.float32 else []
    with enough_memory(*advice):
        gaussians = base.gaussians(decoder, base.see(views[0].photo, photo_camera))
        drawn = [renderer.render(gaussians, normalised_camera(view.camera, photo_camera)) for view in views]
    hole = torch.stack([view.mask for view in views])
    return Batch(
        rgb=torch.stack([rendering.rgb for rendering in drawn]),
        alpha=torch.stack([rendering.alpha for rendering in drawn]),
        base_rgb=torch.stack([view.rendering.rgb for view in views]),
        target=torch.stack([view.target for view in views]),
        hole=hole,
        valid=torch.ones_like(hole),
    )


@dataclasses.dataclass(frozen=True)
class DirectFt(ViewMethod):
    """Items are photos, one at a time: SHARP's decoder keeps gigabytes for the gradient of each."""

    base: TunableSharp
    owner: Owner
    photos: PseudoPhotos
    judge: Judge
    views: int  # of a step, of all processes together: a multiple of VIEWS_AT_ONCE
    seed: int  # of the views that are drawn

    name: ClassVar[MethodName] = "direct-ft"
    at_once: ClassVar[int] = 1
    columns: ClassVar[str] = "base, fine-tuned, target"
    remedy: ClassVar[str] = "build the dataset without the photos that are named there"

    @property
    def digest(self) -> str:
        """The dataset's, its SHARP weights included, and of how it is divided."""
        return self.photos.digest

    @property
    def items(self) -> int:
        """Photos to learn from."""
        return len(self.photos.learned)

    @property
    def judged_items(self) -> int:
        """Photos to be judged by, in all of their views."""
        return len(self.photos.judged)

    @property
    def items_a_step(self) -> int:
        """Photos of a step."""
        return self.views // VIEWS_AT_ONCE

    def complete(self, network: nn.Module, step: int, items: Sequence[int]) -> Batch:
        """Views of one photo, drawn with what the decoder says; InputError where they cannot be read."""
        return render_photo(network, self.base, self._drawn(step, *items), self.judge.renderer)

    def complete_judged(self, network: nn.Module, items: Sequence[int]) -> Batch:
        """All views of one photo, likewise."""
        (item,) = items
        return render_photo(network, self.base, self.photos.all(self.photos.judged[item]), self.judge.renderer)

    def _drawn(self, step: int, item: int) -> list[PseudoSample]:
        """The views that a step takes of a photo: nothing but the arguments decides."""
        return self.photos.drawn(self.photos.learned[item], np.random.default_rng([self.seed, step, item]))

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: of some photos their own view and the one with the largest hole, a row each."""
        places, rows = self.photos.judged, []
        for place in places[:: max(1, 2 * len(places) // PICTURED)][: PICTURED // 2]:
            views = self.photos.widest(place)
            done = render_photo(network, self.base, views, self.judge.renderer)
            rows += [torch.cat(row, dim=1) for row in zip(done.base_rgb, done.rgb, done.target, strict=True)]
        shown = [_reduced(row, len(self.columns.split(","))) for row in rows]
        widest = max(row.shape[1] for row in shown)
        return torch.cat([pad(row, (0, 0, 0, widest - row.shape[1])) for row in shown])

    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Write which photos and views a step had, a file each."""
        for item in items:
            views = self._drawn(step, item)
            facts = {"step": step, "photo": self.photos.name(self.photos.learned[item])}
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
