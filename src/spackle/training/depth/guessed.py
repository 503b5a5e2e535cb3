"""Photos without depth, and what weights that are there already guess of them: only nearly true, but of real things."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from spackle.bases.lite.base import LiteBase, Look
from spackle.errors import InputError
from spackle.formats import atomic_path
from spackle.image import load_photo
from spackle.training.depth.augment import GUESSED, Frame, Rng, Turning
from spackle.training.depth.made import TRIES, Warn

LOOKS_PX = (128 * 160, 192 * 256, 256 * 320, 352 * 480)  # each both ways round; much smaller ones agree on little
UNSURE = 0.12  # where looks, of all sizes and networks, differ by more than this in logarithms, a guess does not count
STEEP = 0.25  # nor where it changes by more than this from pixel to pixel: its outlines are soft, true ones are not


@dataclasses.dataclass(frozen=True)
class GuessedPhotos:
    """A folder of guesses, one for each photo, as a source."""

    folder: Path
    photos: Sequence[Path]
    turning: Turning = GUESSED
    mingles: float = 0.6  # whatever is behind, the front one's outlines are then true

    def fill(self, base: LiteBase, progress: Callable[[int, int], None], warn: Warn) -> None:
        """Guess what is missing; a photo that cannot be read is named and left out."""
        self.folder.mkdir(parents=True, exist_ok=True)
        looks = [Look(pixels, network) for pixels in LOOKS_PX for network in range(len(base.networks))]
        for index, photo in enumerate(self.photos):
            if not self._file(index).is_file():
                try:
                    guess = sure_inverse_depth(base.looks(load_photo(photo).rgb, looks))
                except (InputError, ValueError) as error:
                    warn(f"passed over: {error}")
                    continue
                with atomic_path(self._file(index)) as temporary:
                    temporary.write_bytes(save({"inverse_depth": guess.half()}))
            progress(index + 1, len(self.photos))

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """As `Source` has it."""
        for _ in range(TRIES):
            index = int(rng.integers(len(self.photos)))
            if (file := self._file(index)).is_file():
                try:
                    guess = load_file(file)["inverse_depth"].float()
                except (OSError, SafetensorError, KeyError) as error:
                    raise InputError(f"{file}: no guess, or damaged: delete it, and it is made anew") from error
                rgb = load_photo(self.photos[index]).rgb.permute(2, 0, 1).contiguous()
                inverse_depth = interpolate(guess[None, None], size=rgb.shape[1:], mode="nearest-exact")[0, 0]
                return f"guessed {self.photos[index]}", Frame(rgb, inverse_depth, inverse_depth > 0)
        raise InputError(f"{self.folder}: guesses are missing: start the run anew, and they are made")

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:05d}.safetensors"


def sure_inverse_depth(looks: Tensor) -> Tensor:
    """[h, w] the mean of looks [n, h, w] in logarithms, over its median; 0 where they disagree, or it is steep."""
    looks = looks - looks.flatten(1).median(1).values[:, None, None]
    mean = looks.mean(0)
    around = max_pool2d(mean[None], 3, 1, 1) + max_pool2d(-mean[None], 3, 1, 1)
    known = (looks.std(0, unbiased=False) < UNSURE) & (around[0] < STEEP)
    return mean.exp().clamp(1e-3, 1e3).where(known, torch.zeros_like(mean))
