"""What a view costs in Gaussians and in time, stage by stage: the base alone, and with Spackle on top."""

from __future__ import annotations

import dataclasses
import itertools
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
from spackle.device import Precision
from spackle.evaluation.timing import MS, Lap, measure, timed
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


@dataclasses.dataclass(frozen=True)
class Parameters:
    """Of SHARP at its published size and of the residual, whatever the options choose."""

    base: int  # as its checkpoint has them
    base_used: int  # by inference, which needs neither the transformers' classifiers nor the alignment of depths
    residual: int

    @property
    def share(self) -> float:
        """What the residual adds, of the base's."""
        return self.residual / self.base


def count_parameters() -> Parameters:
    """Count in the networks themselves, without weights: SHARP 702.31 M, the residual 8.02 M."""
    with torch.device("meta"):
        used, residual = (sum(p.numel() for p in n.parameters()) for n in (SharpNetwork(FULL), ResidualNet()))
    return Parameters(used + sum(map(math.prod, unused_shapes(FULL).values())), used, residual)


@dataclasses.dataclass(frozen=True)
class ViewCost:
    """What one view of one photo costs."""

    setting: str  # the disparity, "0.3"
    base_gaussians: int
    added: int
    seconds: Mapping[str, Sequence[float]]  # of `STAGES`: one for each run

    def figures(self) -> dict[str, float]:
        """Every figure of the tables: counts, milliseconds (medians of runs), shares (not percent), views a second."""
        stages = {name: MS * statistics.median(self.seconds[name]) for name in STAGES}
        before, extra = (sum(stages[name] for name in names) for names in (BASE_PATH, EXTRA))
        counts = {"added": self.added, "share": self.added / self.base_gaussians}
        counts |= {"base_gaussians": self.base_gaussians, "merged": self.base_gaussians + self.added}
        times = {"base_ms": before, "spackle_ms": before + extra, "extra_ms": extra}
        ratios = {"overhead": extra / before, "overhead_of_view": extra / stages["view"]}
        rates = {"base_fps": MS / before, "spackle_fps": MS / (before + extra)}
        return {**counts, **times, **ratios, **rates, **{f"{name}_stage_ms": ms for name, ms in stages.items()}}


@dataclasses.dataclass(frozen=True)
class ImageCost:
    """One image: its views, or why there are none."""

    name: str
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # sizes, notes of the base, load of the machine
    views: tuple[ViewCost, ...] = ()
    problem: str | None = None

    def plain(self) -> dict[str, Any]:
        """Ready for JSON, the figures beside the seconds they come from."""
        views = [{**dataclasses.asdict(view), "figures": view.figures()} for view in self.views]
        return {"name": self.name, "facts": dict(self.facts), "problem": self.problem, "views": views}

    @staticmethod
    def of(content: Mapping[str, Any]) -> ImageCost:
        """The image that `plain` wrote; KeyError or TypeError for anything else."""
        fields = [field.name for field in dataclasses.fields(ViewCost)]
        views = tuple(ViewCost(**{name: view[name] for name in fields}) for view in content["views"])
        if any(set(view.seconds) != set(STAGES) for view in views):
            raise KeyError("stages")
        return ImageCost(str(content["name"]), dict(content["facts"]), views, content["problem"])


class Spread(NamedTuple):
    """Of a figure over images."""

    n: int
    mean: float
    q1: float
    median: float
    q3: float


@dataclasses.dataclass(frozen=True)
class Efficiency:
    """The costs of a dataset's images."""

    config: Mapping[str, Any]
    images: tuple[ImageCost, ...]

    @property
    def measured(self) -> list[ImageCost]:
        return [image for image in self.images if image.problem is None]

    @property
    def settings(self) -> list[str]:
        return [f"{disparity:g}" for disparity in self.config["disparities"]]

    def spread(self, setting: str, figure: str) -> Spread:
        """Over the measured images, of which there is at least one; each counts once."""
        found = [view.figures()[figure] for i in self.measured for view in i.views if view.setting == setting]
        q1, median, q3 = (float(value) for value in np.quantile(found, [0.25, 0.5, 0.75]))
        return Spread(len(found), float(np.mean(found)), q1, median, q3)

    def plain(self) -> dict[str, Any]:
        """Ready for JSON: everything, and the medians beside it."""
        keys = itertools.product(self.settings, self.measured[0].views[0].figures())
        spreads = [{"setting": s, "figure": name} | self.spread(s, name)._asdict() for s, name in keys]
        problems = {image.name: image.problem for image in self.images if image.problem is not None}
        images = [image.plain() for image in self.images]
        return {"config": dict(self.config), "problems": problems, "spreads": spreads, "images": images}


class TimedBase(NamedTuple):
    """A photo's Gaussians, and how long they took."""

    prediction: BasePrediction
    seconds: Sequence[float]  # of each run
    warm: bool  # no run was the first of its process


def time_base(predict: Callable[[], BasePrediction], runs: int, device: torch.device, warm: bool) -> TimedBase:
    """Predict so many times; the first one in a process (not `warm`) counts only if it takes more than `COLD_S`."""
    prediction, first = timed(predict, device)
    counts = warm or first > COLD_S
    seconds = [first] if counts else []
    while len(seconds) < runs:
        seconds.append(timed(predict, device)[1])
    return TimedBase(prediction, seconds, warm or not counts)


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
    base: TimedBase,
    setting: str,
    camera: Camera,
    renderer: Renderer,
    network: ResidualNet | None,
    runs: int,
    *,
    device: torch.device,
    precision: Precision = "auto",
) -> ViewCost:
    """The cost of one view, which the tables call by `setting`; `device` is the base's, `precision` the residual's."""
    prediction, added = base.prediction, 0
    completer = Completer(prediction.gaussians, prediction.camera, renderer, network, precision=precision)

    def view(lap: Lap) -> None:
        nonlocal added
        added = len(complete_in_laps(completer, camera, lap))

    times = measure(runs, {"": view}, device)
    stages = {name: [ms / MS for ms in times.get(("", name), [0.0] * runs)] for name in STAGES if name != "base"}
    return ViewCost(setting, len(prediction.gaussians), added, {"base": list(base.seconds), **stages})
