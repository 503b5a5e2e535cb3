"""What a view costs in Gaussians and in time, stage by stage: the base alone, and with Spackle on top."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from spackle.bases.protocol import Base, BasePrediction
from spackle.bases.sharp.checkpoint import unused_shapes
from spackle.bases.sharp.layers import FULL
from spackle.bases.sharp.network import SharpNetwork
from spackle.camera import Camera
from spackle.device import Precision
from spackle.evaluation.efficiency_results import ViewCost
from spackle.gaussians import Gaussians
from spackle.image import Photo
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, ResidualNet

T = TypeVar("T")

COLD_S = 10.0  # a first prediction that takes longer is counted: what it warms up is little of that


@dataclasses.dataclass(frozen=True)
class Parameters:
    """Of the two networks; not of what the options choose, but of SHARP at its published size and of the residual."""

    base: int  # as its checkpoint has them
    base_used: int  # by inference, which needs neither the transformers' classifiers nor the alignment of depths
    residual: int

    @property
    def share(self) -> float:
        """What the residual adds, of the base's."""
        return self.residual / self.base


def count_parameters() -> Parameters:
    """Count in the networks themselves, which takes no weights: SHARP 702.31 M, the residual 8.02 M."""
    with torch.device("meta"):
        used, residual = (sum(p.numel() for p in n.parameters()) for n in (SharpNetwork(FULL), ResidualNet()))
    return Parameters(used + sum(math.prod(shape) for shape in unused_shapes(FULL).values()), used, residual)


@dataclasses.dataclass
class Clock:
    """Times calls; on a GPU until its work is done, and not until it has been handed over."""

    device: torch.device  # of the base's network

    def time(self, call: Callable[[], T]) -> tuple[T, float]:
        """What a call gives, and its seconds."""
        self._wait()
        start = time.perf_counter()
        result = call()
        self._wait()
        return result, time.perf_counter() - start

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


@dataclasses.dataclass
class ClockedRenderer:
    """A `Renderer` that adds up the seconds of its renders: those within a completion are told apart by it."""

    renderer: Renderer
    clock: Clock
    seconds: float = 0.0

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        """See `Renderer.render`."""
        drawn, seconds = self.clock.time(
            lambda: self.renderer.render(gaussians, camera, eps2d=eps2d, tiles=tiles, onto=onto)
        )
        self.seconds += seconds
        return drawn


@dataclasses.dataclass(frozen=True)
class TimedBase:
    """A photo's Gaussians, and how long they took."""

    prediction: BasePrediction
    seconds: Sequence[float]  # of each run
    warm: bool  # no run was the first of its process


def time_base(base: Base, photo: Photo, runs: int, clock: Clock, warm: bool) -> TimedBase:
    """Predict a photo so many times.

    Where nothing was predicted before (`warm` is false) the first one compiles kernels and fills caches, and is not
    counted, but for one that takes more than `COLD_S`: SHARP on a processor.
    """
    prediction, first = clock.time(lambda: base.predict(photo))
    counts = warm or first > COLD_S
    seconds = [first] if counts else []
    while len(seconds) < runs:
        seconds.append(clock.time(lambda: base.predict(photo))[1])
    return TimedBase(prediction, seconds, warm or not counts)


@dataclasses.dataclass(frozen=True)
class ViewBench:
    """A predicted photo, of which views are to be timed."""

    base: TimedBase
    renderer: Renderer
    network: ResidualNet | None
    clock: Clock
    precision: Precision = "auto"  # of the residual's network

    @torch.no_grad()
    def time_view(self, setting: str, camera: Camera, runs: int) -> ViewCost:
        """The cost of one view: `runs` times after one time that is not counted."""
        laps = [self._lap(camera) for _ in range(runs + 1)][1:]
        stages = {name: [seconds[name] for seconds, _ in laps] for name in laps[0][0]}
        added = laps[-1][1]  # the same in all of them
        count = len(self.base.prediction.gaussians)
        return ViewCost(setting, count, added, {"base": list(self.base.seconds), **stages})

    def _lap(self, camera: Camera) -> tuple[Mapping[str, float], int]:
        """Seconds of every stage behind the base, and how many aux Gaussians came of it."""
        base, timed = self.base.prediction.gaussians, self.clock.time
        inside = ClockedRenderer(self.renderer, self.clock)
        photo_camera = self.base.prediction.camera
        completer = Completer(base, photo_camera, inside, self.network, precision=self.precision)
        before, view = timed(lambda: self.renderer.render(base, camera))
        shield, photo = timed(completer.photo_guard)
        inside.seconds = 0.0
        (aux, _), whole = timed(lambda: completer.completed_view(camera, [shield], rendering=before))
        seconds = {"view": view, "photo": photo, "completion": whole - inside.seconds, "rerender": inside.seconds}
        return seconds, len(aux)
