"""What a view costs in Gaussians and in time, stage by stage: the base alone, and with Spackle on top."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from spackle.bases.protocol import BasePrediction
from spackle.bases.sharp.checkpoint import unused_shapes
from spackle.bases.sharp.layers import FULL
from spackle.bases.sharp.network import SharpNetwork
from spackle.camera import Camera
from spackle.evaluation.timing import MS, Lap, measure, now
from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, ResidualNet

# Stages in the order of the work, as the tables call them.
STAGES = {
    "base": "photo to base Gaussians",
    "view": "render of the view",
    "photo": "render at the photo's camera",
    "completion": "mask, seeds, network, placing",
    "rerender": "re-render of touched tiles, after each pass",
}
BASE_PATH = ("base", "view")  # from the photo to a picture without Spackle
EXTRA = ("photo", "completion", "rerender")  # what Spackle adds to it
COLD_S = 10.0  # of a first prediction that takes longer, as SHARP's does, compiling kernels is a small part

Record = dict[str, Any]  # ready for JSON


def count_parameters() -> dict[str, float]:
    """Of SHARP as its checkpoint has it, 702.31 M; of that used by inference; of the residual, 8.02 M; and its share.

    They are counted in the networks, without weights. Inference needs neither SHARP's classifiers nor the part that
    aligns depths.
    """
    with torch.device("meta"):
        used, residual = (sum(p.numel() for p in n.parameters()) for n in (SharpNetwork(FULL), ResidualNet()))
    base = used + sum(map(math.prod, unused_shapes(FULL).values()))
    return {"base": base, "base_used": used, "residual": residual, "share": residual / base}


class Spread(NamedTuple):
    """Of a figure over images."""

    n: int
    mean: float
    q1: float
    median: float
    q3: float


@dataclasses.dataclass(frozen=True)
class Efficiency:
    """The costs of a dataset's images.

    An image is a record of its name, facts (sizes, notes of the base, load of the machine), views (see `view_cost`),
    and the problem that left it without views, or None.
    """

    config: Mapping[str, Any]
    images: Sequence[Record]

    @property
    def measured(self) -> list[Record]:
        """The images that gave figures."""
        return [image for image in self.images if image["problem"] is None]

    @property
    def settings(self) -> list[str]:
        """The disparities as the views have them."""
        return [f"{disparity:g}" for disparity in self.config["disparities"]]

    def spread(self, setting: str, figure: str) -> Spread:
        """Over the measured images, of which there is at least one; each counts once."""
        views = [view for image in self.measured for view in image["views"] if view["setting"] == setting]
        found = [view["figures"][figure] for view in views]
        q1, median, q3 = (float(value) for value in np.quantile(found, [0.25, 0.5, 0.75]))
        return Spread(len(found), float(np.mean(found)), q1, median, q3)

    def plain(self) -> Record:
        """Ready for JSON: everything, and the medians beside it."""
        figures = self.measured[0]["views"][0]["figures"]
        spreads = [
            {"setting": s, "figure": name} | self.spread(s, name)._asdict() for s in self.settings for name in figures
        ]
        problems = {image["name"]: image["problem"] for image in self.images if image["problem"] is not None}
        return {"config": dict(self.config), "problems": problems, "spreads": spreads, "images": list(self.images)}


def view_cost(setting: str, base_gaussians: int, added: int, seconds: Mapping[str, Sequence[float]]) -> Record:
    """A view's record: counts, the seconds of each run of `STAGES`, and every figure of the tables that comes of them.

    The figures are counts, milliseconds (medians of runs), shares (not percent) and views a second.
    """
    stages = {name: MS * statistics.median(seconds[name]) for name in STAGES}
    before, extra = (sum(stages[name] for name in names) for names in (BASE_PATH, EXTRA))
    figures = {
        "added": added,
        "share": added / base_gaussians,
        "base_gaussians": base_gaussians,
        "merged": base_gaussians + added,
        "base_ms": before,
        "spackle_ms": before + extra,
        "extra_ms": extra,
        "overhead": extra / before,
        "overhead_of_view": extra / stages["view"],
        "base_fps": MS / before,
        "spackle_fps": MS / (before + extra),
        **{f"{name}_stage_ms": ms for name, ms in stages.items()},
    }
    counts = {"base_gaussians": base_gaussians, "added": added}
    return {"setting": setting, **counts, "seconds": dict(seconds), "figures": figures}


def time_base(
    predict: Callable[[], BasePrediction], runs: int, device: torch.device, warm: bool
) -> tuple[BasePrediction, list[float], bool]:
    """Predict so many times: the prediction, the seconds of each run, and whether none was the first of its process.

    The first one in a process (not `warm`) counts only if it takes more than `COLD_S`.
    """
    seconds: list[float] = []
    cold = False
    while len(seconds) < runs:
        start = now(device)
        prediction = predict()
        seconds.append(now(device) - start)
        if not warm and len(seconds) == 1:
            cold = seconds[0] > COLD_S
            seconds, warm = seconds if cold else [], True
    return prediction, seconds, not cold


@dataclasses.dataclass(frozen=True)
class _LappedRenderer:
    """A `Renderer` whose renders are laps, told apart from the completion around them."""

    renderer: Renderer
    lap: Lap

    def render(self, gaussians: Gaussians | Sequence[Gaussians], camera: Camera, **options: Any) -> Rendering:
        self.lap("completion")
        drawn = self.renderer.render(gaussians, camera, **options)
        self.lap("rerender")
        return drawn


@torch.no_grad()
def complete_in_laps(completer: Completer, camera: Camera, lap: Lap) -> Gaussians:
    """A view's aux Gaussians; one lap for each of `STAGES` behind the base ("rerender": only where there are holes)."""
    before = completer.renderer.render(completer.base, camera)
    lap("view")
    shield = completer.photo_guard()
    lap("photo")
    inside = dataclasses.replace(completer, renderer=_LappedRenderer(completer.renderer, lap))
    aux = inside.complete_view(camera, [shield], rendering=before)
    lap("completion")
    return aux


def time_view(
    base_s: Sequence[float], completer: Completer, setting: str, camera: Camera, runs: int, device: torch.device
) -> Record:
    """The cost of one view, which the tables call by `setting`; the base, on `device`, took `base_s` seconds."""
    added = 0

    def view(lap: Lap) -> None:
        nonlocal added
        added = len(complete_in_laps(completer, camera, lap))

    times = measure(runs, {"": view}, device)
    none = np.zeros(runs)  # of a view without holes, which is not rendered again
    stages = {name: (times.get(("", name), none) / MS).tolist() for name in STAGES if name != "base"}
    return view_cost(setting, len(completer.base), added, {"base": base_s, **stages})
