"""The clock of the benchmarks: tasks that take turns, stage by stage; and the stages of a view's completion."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.scene_fill import FillContext, fill_view

TOTAL = "total"
MS = 1000.0
CPU = torch.device("cpu")
# Stages of a view in the order of the work, as the tables call them.
STAGES = {
    "base": "photo to base Gaussians",
    "view": "render of the view",
    "photo": "render at the photo's camera",
    "completion": "mask, seeds, network, placing",
    "rerender": "re-render of touched tiles, after each pass",
}
BASE_PATH = ("base", "view")  # from the photo to a picture without Spackle
EXTRA = ("photo", "completion", "rerender")  # what Spackle adds to it

Lap = Callable[[str], None]
Task = Callable[[Lap], Any]
Values = npt.NDArray[np.float64]  # one a run
Times = dict[tuple[str, str], Values]  # (task, stage) → milliseconds


def measure(runs: int, tasks: Mapping[str, Task], device: torch.device = CPU, *, warm: bool = False) -> Times:
    """Milliseconds of each task (its stage "total") and of its stages, each of which it ends by calling its argument.

    The tasks take turns, so a busy machine slows all of them alike. Laps of one name within a run add up. A stage ends
    when the device has done its work. One run more, which compiles and warms up, comes first, unless they are `warm`.
    """

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return MS * time.perf_counter()

    times: dict[tuple[str, str], list[float]] = {}
    for run in range(1 if warm else 0, runs + 1):
        for name, task in tasks.items():
            laps: dict[str, float] = {}
            start = last = now()

            def lap(stage: str, laps: dict[str, float] = laps) -> None:
                nonlocal last
                end = now()
                laps[stage] = laps.get(stage, 0.0) + end - last
                last = end

            task(lap)
            laps[TOTAL] = now() - start
            for stage, milliseconds in laps.items() if run else ():
                times.setdefault((name, stage), []).append(milliseconds)
    return {key: np.array(values) for key, values in times.items()}


@dataclasses.dataclass(frozen=True)
class _LappedRenderer:
    """A `Renderer` whose renders are laps, told apart from the completion around them."""

    renderer: Renderer
    lap: Lap

    def __getattr__(self, name: str) -> Any:
        return getattr(self.renderer, name)

    def render(self, gaussians: Gaussians | Sequence[Gaussians], camera: Camera, **options: Any) -> Rendering:
        self.lap("completion")
        drawn = self.renderer.render(gaussians, camera, **options)
        self.lap("rerender")
        return drawn


@torch.no_grad()
def complete_in_laps(context: FillContext, camera: Camera, lap: Lap) -> Gaussians:
    """A view's aux Gaussians; laps "view", "photo", "completion" and, where there are holes, "rerender"."""
    context = context.placed
    before = context.renderer.render(context.base, camera)
    lap("view")
    guard = context.photo_guard()
    lap("photo")
    inside = dataclasses.replace(context, renderer=_LappedRenderer(context.renderer, lap))
    aux = fill_view(inside, camera, [guard], before).aux
    lap("completion")
    return aux
