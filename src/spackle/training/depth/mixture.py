"""What a step learns from: pictures with depth of several sources, by nothing but the step and the place in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.bases.lite.base import scaled_size
from spackle.training.depth.augment import MADE, MEASURED, Frame, Rng, Turning, mingled, relit, turned
from spackle.training.depth.made import MadeScenes

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
    """Made scenes as a source."""

    scenes: MadeScenes
    turning: Turning = MADE
    mingles: float = 0.2

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """As `Source` has it."""
        index = int(rng.integers(self.scenes.count))
        return f"made scene {index}", self.scenes.frame(index)


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
