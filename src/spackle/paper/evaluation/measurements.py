"""Measured numbers and the paper's numbers (paper.json), one row per number; tables are pivots of rows."""

from __future__ import annotations

import dataclasses
import functools
import json
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from typing import Any, NamedTuple

NEAR = "near"  # the setting of views at the viewpoints of second photos
PROBLEM, REMARK, NOTE = (
    "problem",
    "remark",
    "note.",
)  # metrics with text as values; "note." precedes a note's name
BASE_STAGES = (
    "base",
    "view",
)  # stages of a view without Spackle: photo to base Gaussians, render of the view
COMPLETION_STAGES = (
    "photo",
    "completion",
)  # stages that Spackle adds: render at the photo's camera; mask to rendered view
Value = float | str | None


def load_data(name: str) -> dict[str, Any]:
    """The content of a JSON file beside this module."""
    content: dict[str, Any] = json.loads(
        resources.files("spackle.paper.evaluation").joinpath(name).read_text("utf-8")
    )
    return content


PAPER = load_data("paper.json")
IMAGES: dict[str, int] = PAPER[
    "images"
]  # the number of images of each dataset, in the order of the tables
SETTINGS: list[str] = PAPER["settings"]  # S1, S2, S3
DISPARITIES = tuple(map(float, SETTINGS))


class Measurement(NamedTuple):
    """One number. A number of a whole image has an empty setting, view and method."""

    dataset: str  # the dataset's name in the paper's tables
    image: str
    setting: str  # "0.3" (a disparity), or "near"
    view: str
    method: str
    metric: str
    value: Value  # None if the number is not finite; text for a problem, a remark or a note


class Mean(NamedTuple):
    """The mean of a metric over views."""

    value: float | None  # None if no view has a finite value
    bad: int  # the number of views without a finite value


def mean(values: Sequence[Value], of: Callable[[list[float]], float] = statistics.fmean) -> Mean:
    """The mean of the finite values; `of` may be another statistic, such as `statistics.median`."""
    known = [float(value) for value in values if value is not None]
    return Mean(of(known) if known else None, len(values) - len(known))


def pivot(rows: Iterable[Measurement], *columns: str) -> dict[tuple[str, ...], list[Value]]:
    """Group the values of rows by the rows' entries in `columns`."""
    groups: dict[tuple[str, ...], list[Value]] = {}
    for row in rows:
        groups.setdefault(tuple(getattr(row, column) for column in columns), []).append(row.value)
    return groups


@dataclasses.dataclass(frozen=True)
class Run:
    """The results of an evaluation or a benchmark of one dataset."""

    config: Mapping[str, Any]
    rows: Sequence[Measurement]
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # versions, machine, metrics

    @property
    def title(self) -> str:
        """The dataset's title."""
        return str(self.config["title"])

    @property
    def base(self) -> str:
        return str(self.config["base"]["title"])

    @property
    def timed(self) -> bool:
        return bool(self.config["kind"] == "bench")

    @property
    def near(self) -> bool:
        return bool(self.config["protocol"] == "near-view")

    @property
    def methods(self) -> list[str]:
        return list(self.config["methods"])

    @property
    def settings(self) -> list[str]:
        """The settings: disparities as text, or "near"."""
        return (
            [NEAR] if self.near else [f"{disparity:g}" for disparity in self.config["disparities"]]
        )

    @property
    def problems(self) -> dict[str, str]:
        """Images that could not be measured, each with the reason."""
        return {row.image: str(row.value) for row in self.rows if row.metric == PROBLEM}

    @property
    def images(self) -> list[str]:
        """All images, in the dataset's order."""
        return list(dict.fromkeys(row.image for row in self.rows))

    @property
    def measured(self) -> list[str]:
        problems = self.problems
        return [image for image in self.images if image not in problems]

    def by_image(self, metric: str, method: str) -> dict[str, float]:
        """The mean of a metric over each image's views; images without a finite value are left out."""
        rows = (row for row in self.rows if (row.method, row.metric) == (method, metric))
        means = {image: mean(values).value for (image,), values in pivot(rows, "image").items()}
        return {image: value for image, value in means.items() if value is not None}

    def largest_hole(self, image: str) -> tuple[str, str]:
        """Setting and view of the image's view with the largest hole in the base; pictures show this view."""
        holes = [row for row in self.rows if (row.image, row.metric) == (image, "har_before")]
        shown = max(holes, key=lambda row: float(row.value or 0))
        return shown.setting, shown.view


@functools.cache
def paper_rows(label: str) -> tuple[Measurement, ...]:
    """The numbers of a table of the paper, with shares instead of percent."""
    rows = []
    for table in (table for table in PAPER["tables"] if table["label"] == label):
        metrics = table["metrics"]
        for dataset, method, *values in table["values"]:
            settings = SETTINGS if len(values) > len(metrics) else [NEAR]
            keys = [(setting, metric) for setting in settings for metric in metrics]
            for (setting, metric), value in zip(keys, values, strict=True):
                name = metric.removesuffix("_percent")
                rows.append(
                    Measurement(
                        dataset,
                        "",
                        setting,
                        "",
                        method,
                        name,
                        value if name == metric else value / 100,
                    )
                )
    return tuple(rows)


def setting_title(setting: str, pattern: str = "{}") -> str:
    """The title of a setting: `pattern` filled with "S1" and "0.3" for "0.3"; "disparity 0.6" if not in the paper."""
    return (
        pattern.format(f"S{SETTINGS.index(setting) + 1}", setting)
        if setting in SETTINGS
        else f"disparity {setting}"
    )
