"""What a benchmark found: seconds of each stage for each image and setting, and medians over images."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

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
MS = 1000.0


@dataclasses.dataclass(frozen=True)
class ViewCost:
    """What one view of one photo costs."""

    setting: str  # the disparity, "0.3"
    base_gaussians: int
    added: int
    seconds: Mapping[str, Sequence[float]]  # of `STAGES`: one for each run

    def stage_ms(self, name: str) -> float:
        """Median over the runs."""
        return MS * statistics.median(self.seconds[name])

    def figures(self) -> dict[str, float]:
        """Every figure of the tables: counts, milliseconds, shares (not percent), views per second."""
        stages = {name: self.stage_ms(name) for name in STAGES}
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
        """What `plain` gave; KeyError or TypeError for anything else."""
        fields = [field.name for field in dataclasses.fields(ViewCost)]
        views = tuple(ViewCost(**{name: view[name] for name in fields}) for view in content["views"])
        if any(set(view.seconds) != set(STAGES) for view in views):
            raise KeyError("stages")
        return ImageCost(str(content["name"]), dict(content["facts"]), views, content["problem"])


@dataclasses.dataclass(frozen=True)
class Spread:
    """Of a figure over images."""

    n: int
    mean: float
    q1: float
    median: float
    q3: float


@dataclasses.dataclass(frozen=True)
class Bill:
    """A dataset's costs."""

    config: Mapping[str, Any]
    images: tuple[ImageCost, ...]

    @property
    def measured(self) -> list[ImageCost]:
        return [image for image in self.images if image.problem is None]

    @property
    def settings(self) -> list[str]:
        return [f"{disparity:g}" for disparity in self.config["disparities"]]

    @property
    def precision(self) -> str | None:
        """What the base's network computed in; None where the base has none."""
        found = self.measured[0].facts["notes"].get("precision")
        return None if found is None else str(found)

    def spread(self, setting: str, figure: str) -> Spread:
        """Over the images that were measured, of which there is one at least; each counts once."""
        found = [view.figures()[figure] for i in self.measured for view in i.views if view.setting == setting]
        q1, median, q3 = (float(value) for value in np.quantile(found, [0.25, 0.5, 0.75]))
        return Spread(len(found), float(np.mean(found)), q1, median, q3)

    def plain(self) -> dict[str, Any]:
        """Ready for JSON: everything, and the medians beside it."""
        names = list(self.measured[0].views[0].figures())
        spreads = [
            {"setting": setting, "figure": name} | dataclasses.asdict(self.spread(setting, name))
            for setting in self.settings
            for name in names
        ]
        problems = {image.name: image.problem for image in self.images if image.problem is not None}
        images = [image.plain() for image in self.images]
        return {"config": dict(self.config), "problems": problems, "spreads": spreads, "images": images}
