"""Training batches: pictures with depth from several sources, chosen by seed, step and index in the
batch alone.
"""

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
from spackle.core.photo import load_photo
from spackle.runtime.errors import InputError
from spackle.runtime.files import atomic_path

UPRIGHT = 0.2  # share of steps with upright pictures
COARSER = 2  # ratio of the network's input size to its output size


class Source(Protocol):
    """A source of frames."""

    @property
    def turning(self) -> Turning:
        """How far cameras are turned for augmentation."""

    @property
    def mingles(self) -> float:
        """The probability that a frame is merged with another one from any source."""

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """Draw a random frame; returns its name and the frame. InputError if it cannot be read."""


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
    mingles: float = 0.35  # high, because frames are few

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """As `Source` has it."""
        return self.frames[int(rng.integers(len(self.frames)))]


@dataclasses.dataclass(frozen=True)
class DepthBatch:
    """Pictures of one size, and their true inverse depth at half the size."""

    rgb: Tensor  # [B, 3, H, W] sRGB in 0..1
    inverse_depth: Tensor  # [B, H/2, W/2] in any unit
    valid: Tensor  # [B, H/2, W/2] bool

    @staticmethod
    def of(frames: Sequence[Frame], size: tuple[int, int]) -> DepthBatch:
        """Resize frames of one size for a network with the input `size`; depth is sampled at the
        nearest pixel.
        """
        rgb, inverse_depth, valid = (
            torch.stack([getattr(frame, field.name) for frame in frames])
            for field in dataclasses.fields(Frame)
        )
        coarse = [side // COARSER for side in size]
        known = interpolate(
            torch.stack([inverse_depth, valid.float()], 1), size=coarse, mode="nearest-exact"
        )
        rgb = interpolate(rgb, size=size, mode="bicubic", antialias=True).clamp(0, 1)
        return DepthBatch(rgb, known[:, 0], known[:, 1] > 0.5)


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Draws pictures from sources by their shares."""

    sources: Sequence[Source]
    shares: Sequence[float]
    size: tuple[int, int]  # height and width; swapped in upright steps
    seed: int
    scales: Sequence[float] = (1.0,)  # factors on `size`; each step draws one

    def batch(self, step: int, places: Sequence[int]) -> DepthBatch:
        """The pictures with these indices in a step, at a random scale; InputError if one cannot be
        read.
        """
        # NumPy pads seeds with zeros, so [seed, step] equals [seed, step, 0]; pictures therefore
        # add 1 (below).
        rng = np.random.default_rng([self.seed, step])
        height, width = self.size[::-1] if rng.random() < UPRIGHT else self.size
        scale = self.scales[int(rng.integers(len(self.scales)))]
        pictures = [self._picture(step, place, height, width)[1] for place in places]
        return DepthBatch.of(pictures, scaled_size(height, width, scale))

    def name(self, step: int, place: int) -> str:
        """The name of the picture with this index in a step."""
        return self._picture(step, place, *self.size)[0]

    def _picture(self, step: int, place: int, height: int, width: int) -> tuple[str, Frame]:
        """A picture's name and the picture; the name does not depend on the size."""
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
        return self.sources[
            int(rng.choice(len(self.sources), p=np.array(self.shares) / sum(self.shares)))
        ]


# in both orientations; much smaller sizes agree less
LOOKS_PX = (
    128 * 160,
    192 * 256,
    256 * 320,
    352 * 480,
)
# a guess is ignored in pixels where predictions of all sizes and networks differ by more
# (logarithm)
UNSURE = 0.12
# a guess is ignored in pixels with a larger change to neighbours, because predicted outlines are
# blurred
STEEP = 0.25


@dataclasses.dataclass(frozen=True)
class GuessedPhotos:
    """Photos with the teacher's guesses, which are stored in a folder, as a source."""

    folder: Path
    photos: Sequence[Path]
    turning: Turning = GUESSED
    mingles: float = 0.6  # high, because merging gives exact outlines

    def fill(self, base: LiteBase, progress: Callable[[int, int], None], warn: Warn) -> None:
        """Make missing guesses; photos that cannot be read are left out and reported to `warn`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        looks = [
            InputScale(pixels, network)
            for pixels in LOOKS_PX
            for network in range(len(base.networks))
        ]
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
                    raise InputError(
                        f"{file}: no guess, or damaged: delete it, and it is made anew"
                    ) from error
                rgb = load_photo(self.photos[index]).rgb.permute(2, 0, 1).contiguous()
                inverse_depth = interpolate(
                    guess[None, None], size=rgb.shape[1:], mode="nearest-exact"
                )[0, 0]
                return f"guessed {self.photos[index]}", Frame(rgb, inverse_depth, inverse_depth > 0)
        raise InputError(
            f"{self.folder}: guesses are missing: start the run anew, and they are made"
        )

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:05d}.safetensors"


def sure_inverse_depth(looks: Tensor) -> Tensor:
    """[h, w] the geometric mean of predictions, given as logarithms [n, h, w]; 0 in pixels that
    differ or are steep.
    """
    looks = looks - looks.flatten(1).median(1).values[:, None, None]
    mean = looks.mean(0)
    around = max_pool2d(mean[None], 3, 1, 1) + max_pool2d(-mean[None], 3, 1, 1)
    known = (looks.std(0, unbiased=False) < UNSURE) & (around[0] < STEEP)
    return mean.exp().clamp(1e-3, 1e3).where(known, torch.zeros_like(mean))
