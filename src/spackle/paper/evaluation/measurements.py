"""Measured and published numbers, one `Measurement` a number; tables are made by grouping them.

Read in this order: `Measurement` (a number with its keys), `group_values` and `mean_of_known`
(from numbers to the entries of a table), `Run` (all numbers of an evaluation or benchmark),
`paper_measurements`.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from spackle.bases.settings import describe_base, title_of_base
from spackle.paper.evaluation.paper_numbers import PAPER_SETTINGS, PAPER_TABLES

# The setting of views from the viewpoints of second photos.
NEAR_SETTING = "near"

# Metrics whose values are texts: why an image could not be measured; a remark about an image;
# and, with a name after the prefix, a fact that a base tells about its prediction.
PROBLEM_METRIC = "problem"
REMARK_METRIC = "remark"
NOTE_PREFIX = "note."

# In benchmarks, facts about an image: how many parameters the networks that ran have.
BASE_PARAMETERS = "base_parameters"
RESIDUAL_PARAMETERS = "residual_parameters"

Value = float | str | None


class Measurement(NamedTuple):
    """One number, with what it is about; a line of rows.jsonl."""

    dataset: str  # the dataset's name in the paper's tables
    image: str
    setting: str  # a disparity as text, such as "0.3", or "near"; "" for a number of a whole image
    view: str  # "" for a number of a whole image
    method: str  # "" for a number of a whole image
    metric: str
    value: Value  # None if the number is not finite; text for a problem, a remark or a note


def image_measurement(dataset: str, image: str, metric: str, value: Value) -> Measurement:
    """A number of a whole image, which is valid for all its settings, views and methods."""
    return Measurement(
        dataset=dataset, image=image, setting="", view="", method="", metric=metric, value=value
    )


class Mean(NamedTuple):
    """The mean of a metric over views."""

    value: float | None  # None if no view has a finite value
    missing: int  # the number of views without a finite value


def mean_of_known(
    values: Sequence[Value], statistic: Callable[[list[float]], float] = statistics.fmean
) -> Mean:
    """The mean of the values that are known, and the number of those that are not.

    Args:
        values: numbers, or None where a metric gave no finite number.
        statistic: what is computed instead of the mean, such as `statistics.median`.
    """
    known = [float(value) for value in values if value is not None]
    missing = len(values) - len(known)
    return Mean(statistic(known) if known else None, missing)


def group_values(
    measurements: Iterable[Measurement], *fields: str
) -> dict[tuple[str, ...], list[Value]]:
    """The values of measurements, grouped by the measurements' entries in the named fields.

    For instance, ``group_values(measurements, "method", "metric")["base", "psnr"]`` lists all
    PSNR of the method "base". Groups and values keep the order of the measurements.
    """
    groups: dict[tuple[str, ...], list[Value]] = {}
    for measurement in measurements:
        key = tuple(getattr(measurement, field) for field in fields)
        groups.setdefault(key, []).append(measurement.value)
    return groups


@dataclasses.dataclass(frozen=True)
class Run:
    """The results of an evaluation or a benchmark of one dataset.

    A method is one way to render new views of a photo. The base is the network (or depth map)
    that turns the photo into Gaussians, from which all methods start.
    """

    config: Mapping[str, Any]  # the content of config.json: options that determine the results
    measurements: Sequence[Measurement]
    # What did not determine the renders: versions, machine, and for each metric how it was
    # measured.
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def title(self) -> str:
        """The dataset's title."""
        return str(self.config["title"])

    @property
    def about_scenes(self) -> str:
        """Half a sentence about scenes that only have the layout of a dataset; else ""."""
        return str(self.config.get("about_scenes", ""))

    @property
    def base_title(self) -> str:
        """The name of the base in tables, such as "SHARP"; see `title_of_base`.

        It follows from the base's weights whenever results are shown, so that no stored name can
        promise weights that were not used.
        """
        base = self.config["base"]
        return title_of_base(str(base["name"]), base["weights"])

    @property
    def base_description(self) -> str:
        """Half a sentence about the base, for the notes below tables."""
        base = self.config["base"]
        return describe_base(str(base["name"]), base["weights"], str(base["says"]))

    @property
    def is_benchmark(self) -> bool:
        """Whether `spackle bench` measured times, rather than `spackle evaluate` pictures."""
        return bool(self.config["kind"] == "bench")

    @property
    def compares_with_photos(self) -> bool:
        """Whether the views are those of second photos, and were compared with these."""
        return bool(self.config["protocol"] == "near-view")

    @property
    def methods(self) -> list[str]:
        """The names of the compared methods, in the order of the options."""
        return list(self.config["methods"])

    @property
    def settings(self) -> list[str]:
        """The settings: the disparities of the camera moves as text, or "near" alone."""
        if self.compares_with_photos:
            return [NEAR_SETTING]
        return [f"{disparity:g}" for disparity in self.config["disparities"]]

    @property
    def problems(self) -> dict[str, str]:
        """Images that could not be measured, each with the reason."""
        return {
            measurement.image: str(measurement.value)
            for measurement in self.measurements
            if measurement.metric == PROBLEM_METRIC
        }

    @property
    def images(self) -> list[str]:
        """The names of all images, in the dataset's order."""
        return list(dict.fromkeys(measurement.image for measurement in self.measurements))

    @property
    def measured_images(self) -> list[str]:
        """The names of the images without a problem, in the dataset's order."""
        problems = self.problems
        return [image for image in self.images if image not in problems]

    def mean_by_image(self, metric: str, method: str) -> dict[str, float]:
        """The mean of a metric over each image's views, by the image's name.

        Views that were not measured by this metric do not count. Images without a finite value are
        left out.
        """
        of_method = (
            measurement
            for measurement in self.measurements
            if measurement.method == method and measurement.metric == metric
        )

        # The keys of groups are tuples, here of one name.
        means = {}
        for (image,), values in group_values(of_method, "image").items():
            mean = mean_of_known(values).value
            if mean is not None:
                means[image] = mean
        return means

    def view_with_largest_hole(self, image: str) -> tuple[str, str]:
        """Setting and name of the image's view in which the base leaves the largest hole.

        A hole is where the base's Gaussians cover too little. Pictures show this view.
        """
        hole_ratios = [
            measurement
            for measurement in self.measurements
            if measurement.image == image and measurement.metric == "har_before"
        ]
        # A ratio that was no finite number is None, and counts as 0.
        largest = max(hole_ratios, key=lambda measurement: float(measurement.value or 0))
        return largest.setting, largest.view


@functools.cache
def paper_measurements(label: str) -> tuple[Measurement, ...]:
    """The numbers of one table of the paper, with shares (0..1) instead of percent.

    `label` is the table's label in the paper's LaTeX source.
    """
    measurements = []
    # A table whose rows have different metrics is listed in several parts with the same label.
    tables = [table for table in PAPER_TABLES if table.label == label]
    for table in tables:
        for row in table.rows:
            # A row of near views has numbers for one setting, a row of large views for three.
            settings = PAPER_SETTINGS if len(row.values_by_setting) > 1 else (NEAR_SETTING,)

            for setting, values in zip(settings, row.values_by_setting, strict=True):
                for metric, value in zip(table.metrics, values, strict=True):
                    is_percent = metric.endswith("_percent")
                    measurement = Measurement(
                        dataset=row.dataset,
                        image="",
                        setting=setting,
                        view="",
                        method=row.method,
                        metric=metric.removesuffix("_percent"),
                        value=value / 100 if is_percent else value,
                    )
                    measurements.append(measurement)
    return tuple(measurements)


def setting_title(setting: str, pattern: str = "{}") -> str:
    """The title of a setting in tables: "S1" for the paper's disparity "0.3", else "disparity 0.6".

    Args:
        setting: a disparity as text.
        pattern: for the paper's settings, a format string that gets "S1" and "0.3".
    """
    if setting not in PAPER_SETTINGS:
        return f"disparity {setting}"
    number = PAPER_SETTINGS.index(setting) + 1
    return pattern.format(f"S{number}", setting)
