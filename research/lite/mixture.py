"""What a step learns from: pictures with depth of several sources, by nothing but the step and the place in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from frames import GUESSED, MADE, MEASURED, Frame, Rng, Turning, mingled, relit, turned
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from synthetic_scenes import TRIES, SyntheticScenes, Warn
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from spackle.bases.lite import InputScale, LiteBase, scaled_size
from spackle.errors import InputError
from spackle.files import atomic_path
from spackle.image import load_photo

UPRIGHT = 0.2  # share of steps whose pictures stand upright
COARSER = 2  # the network's output has half of its input's size


class Source(Protocol):
    """A supply of frames."""

    @property
    def turning(self) -> Turning:
        """How far its cameras are turned."""

    @property
    def mingles(self) -> float:
        """How often one of its frames and another, of any source, make one picture."""

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """A random one and what it is called; InputError where it cannot be read."""


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Synthetic scenes as a source."""

    scenes: SyntheticScenes
    turning: Turning = MADE
    mingles: float = 0.2

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """As `Source` has it."""
        index = int(rng.integers(self.scenes.count))
        return f"synthetic scene {index}", self.scenes.frame(index)


@dataclasses.dataclass(frozen=True)
class Kept:
    """Frames in memory as a source."""

    frames: Sequence[tuple[str, Frame]]
    turning: Turning = MEASURED
    mingles: float = 0.35  # there are few

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """As `Source` has it."""
        return self.frames[int(rng.integers(len(self.frames)))]


@dataclasses.dataclass(frozen=True)
class DepthBatch:
    """Pictures of one size, and their truth at half of it."""

    rgb: Tensor  # [B, 3, H, W] sRGB in 0..1
    inverse_depth: Tensor  # [B, H/2, W/2] in any unit
    valid: Tensor  # [B, H/2, W/2] bool

    @staticmethod
    def of(frames: Sequence[Frame], size: tuple[int, int]) -> DepthBatch:
        """Frames of one size as a network of the input (height, width) sees them; depth is one of theirs, no mean."""
        rgb, inverse_depth, valid = (
            torch.stack([getattr(frame, field.name) for frame in frames]) for field in dataclasses.fields(Frame)
        )
        coarse = [side // COARSER for side in size]
        known = interpolate(torch.stack([inverse_depth, valid.float()], 1), size=coarse, mode="nearest-exact")
        rgb = interpolate(rgb, size=size, mode="bicubic", antialias=True).clamp(0, 1)
        return DepthBatch(rgb, known[:, 0], known[:, 1] > 0.5)


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Sources by their shares."""

    sources: Sequence[Source]
    shares: Sequence[float]
    size: tuple[int, int]  # height and width; upright steps have them the other way round
    seed: int
    scales: Sequence[float] = (1.0,)  # of what the network sees of a step's pictures, one drawn for each step

    def batch(self, step: int, places: Sequence[int]) -> DepthBatch:
        """The pictures at some places of a step, seen large or small; InputError where one cannot be read."""
        # A seed ends in zeros without end: a step's own numbers would be those of its place 0, hence the 1 below.
        rng = np.random.default_rng([self.seed, step])
        height, width = self.size[::-1] if rng.random() < UPRIGHT else self.size
        scale = self.scales[int(rng.integers(len(self.scales)))]
        pictures = [self._picture(step, place, height, width)[1] for place in places]
        return DepthBatch.of(pictures, scaled_size(height, width, scale))

    def name(self, step: int, place: int) -> str:
        """Where the picture at a place of a step comes from."""
        return self._picture(step, place, *self.size)[0]

    def _picture(self, step: int, place: int, height: int, width: int) -> tuple[str, Frame]:
        """What it is called, which its size does not change, and itself."""
        rng = np.random.default_rng([self.seed, step, 1 + place])
        source = self._source(rng)
        name, frame = source.draw(rng)
        seen = turned(rng, frame, height, width, source.turning)
        if rng.random() < source.mingles:
            source = self._source(rng)
            other, frame = source.draw(rng)
            name = f"{name} and {other}"
            seen = mingled(rng, seen, turned(rng, frame, height, width, source.turning))
        return name, dataclasses.replace(seen, rgb=relit(rng, seen.rgb))

    def _source(self, rng: Rng) -> Source:
        return self.sources[int(rng.choice(len(self.sources), p=np.array(self.shares) / sum(self.shares)))]


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
        looks = [InputScale(pixels, network) for pixels in LOOKS_PX for network in range(len(base.networks))]
        for index, photo in enumerate(self.photos):
            if not self._file(index).is_file():
                try:
                    guess = sure_inverse_depth(base.at_scales(load_photo(photo).rgb, looks))
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
