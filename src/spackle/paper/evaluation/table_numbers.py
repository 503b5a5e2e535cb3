"""The entries of a table: from measured numbers to the texts in its columns.

`columns_of_layout` makes the columns, `mean_of_metric` finds an entry's number, and
`texts_of_methods` writes the entries of a method's row.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from spackle.paper.evaluation.measurements import (
    Mean,
    Measurement,
    Value,
    group_values,
    mean_of_known,
    setting_title,
)
from spackle.paper.evaluation.metrics import METRICS, metric_of_column
from spackle.paper.evaluation.table import (
    NO_NUMBER,
    NUMBER_FORMATS,
    NumberFormat,
    mark_best,
)
from spackle.paper.evaluation.table_layouts import ColumnLayout

PAPER_SUFFIX = " (paper)"  # the end of the method's name in the paper's rows

# Of these metrics tables show medians, because a busy machine makes some times far too long.
TIME_METRICS = ("base_ms", "spackle_ms", "overhead", "base_fps", "spackle_fps")


class Ratio(NamedTuple):
    """A metric that is computed from the means of two others."""

    numerator: str
    denominator: str
    denominator_method: str | None = None  # whose denominator; None: that of the row's own method
    is_reduction: bool = False  # whether the metric is 1 minus the ratio


RATIOS = {
    # Added Gaussians over masked cells of 2×2 pixels.
    "aux_per_cell": Ratio("aux", "hole_cells"),
    # By how much completion reduces the hole area ratio (paper, eq. 11).
    "reduction": Ratio("har", "har_before", is_reduction=True),
    # How many Gaussians fewer than with a Gaussian for every cell.
    "aux_reduction": Ratio("aux", "aux", denominator_method="dense", is_reduction=True),
}


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a finished table: a metric at a setting (a camera move, or near views)."""

    group: str  # the head above this and neighbouring columns; "" without a group
    title: str
    setting: str
    metric: str
    format: NumberFormat
    lower_is_better: bool | None = None  # None: the best number is not marked


# The values of measurements by (method, setting, metric).
GroupedValues = Mapping[tuple[str, ...], Sequence[Value]]


def columns_of_layout(
    column_layouts: Sequence[ColumnLayout],
    settings: Iterable[str],
    *,
    group_pattern: str = "",
    marks_best: bool = False,
) -> list[Column]:
    """A table's columns, repeated for each setting.

    Args:
        column_layouts: the columns of one setting.
        settings: disparities (sizes of camera moves) as text, or "near".
        group_pattern: the head above the columns of a setting, a format string that gets "S1" and
            "0.3"; if empty, each column has the head of its layout.
        marks_best: whether the best number of a column with image metrics is bold.
    """
    columns = []
    for setting in settings:
        for layout in column_layouts:
            image_metric = metric_of_column(layout.metric)

            # Counts, shares and times name their format; image metrics have one of their own.
            if layout.number_format is not None:
                number_format = NUMBER_FORMATS[layout.number_format]
            else:
                assert image_metric is not None
                number_format = METRICS[image_metric].format

            # The lowest count or time is not marked, because a method that adds nothing has it.
            lower_is_better = None
            if marks_best and image_metric is not None:
                lower_is_better = METRICS[image_metric].lower_is_better

            column = Column(
                group=setting_title(setting, group_pattern) if group_pattern else layout.group,
                title=layout.title,
                setting=setting,
                metric=layout.metric,
                format=number_format,
                lower_is_better=lower_is_better,
            )
            columns.append(column)
    return columns


def mean_of_metric(values: GroupedValues, method: str, setting: str, metric: str) -> Mean | None:
    """The mean of a method's metric over the views of a setting, for an entry of a table.

    For times it is the median, because a busy machine makes some of them far too long. For a metric
    of `RATIOS` that was not measured itself, it is the ratio of two means. A number of whole images
    stands for all methods and settings.

    Args:
        values: measured numbers by (method, setting, metric).
        method: the method's name.
        setting: a disparity as text, or "near".
        metric: the metric's name.

    Returns:
        The mean; None if nothing was measured.
    """
    measured = values.get((method, setting, metric))
    if not measured:
        measured = values.get(("", "", metric))  # whole images have no method and no setting
    if measured:
        statistic = statistics.median if metric in TIME_METRICS else statistics.fmean
        return mean_of_known(measured, statistic)
    if metric in RATIOS:
        return _ratio_of_means(values, method, setting, RATIOS[metric])
    return None


def _ratio_of_means(values: GroupedValues, method: str, setting: str, ratio: Ratio) -> Mean | None:
    """A metric that is the ratio of two means, or 1 minus the ratio.

    Args:
        values: measured numbers by (method, setting, metric).
        method: the name of the numerator's method.
        setting: a disparity as text, or "near".
        ratio: the two metrics, and whether the result is 1 minus their ratio. The denominator is of
            the same method, unless `ratio` names another one for it.

    Returns:
        The ratio; None if a mean is unknown, if the denominator is 0, or if the method would be
        compared with itself.
    """
    # A method compared with itself would always have the ratio 1, which tells nothing.
    if method == ratio.denominator_method:
        return None
    denominator_method = ratio.denominator_method or method
    numerator = mean_of_metric(values, method, setting, ratio.numerator)
    denominator = mean_of_metric(values, denominator_method, setting, ratio.denominator)

    if numerator is None or numerator.value is None:
        return None
    if denominator is None or not denominator.value:
        return None
    quotient = numerator.value / denominator.value
    value = 1 - quotient if ratio.is_reduction else quotient
    # The table shows how many views lack a number beside each of the two means. It is not repeated
    # beside their ratio, so `missing` is 0.
    return Mean(value=value, missing=0)


def _entry_text(mean: Mean | None, column: Column, method: str) -> str:
    """The text of a table's entry: the number, and in brackets the count of views without one."""
    if mean is None:
        return NO_NUMBER

    # The paper prints overheads with one decimal, so its numbers have no more digits to show.
    is_paper_overhead = method.endswith(PAPER_SUFFIX) and column.metric == "overhead"
    number_format = NUMBER_FORMATS["tenths %"] if is_paper_overhead else column.format

    # If views lack the number, the mean is over fewer views than others, which the reader must see.
    number = NO_NUMBER if mean.value is None else number_format(mean.value)
    missing = f"({mean.missing} NaN)" if mean.missing else ""
    return f"{number} {missing}".strip()


def texts_of_methods(
    measurements: Iterable[Measurement], columns: Sequence[Column], methods: Sequence[str]
) -> list[list[str]]:
    """The texts of a table's entries: for each method a list with a text for each column.

    In columns that say whether lower is better, the best text is marked bold.

    Args:
        measurements: the numbers; several for an entry are averaged.
        columns: the table's columns of numbers.
        methods: the names of the methods, one for each row.
    """
    values = group_values(measurements, "method", "setting", "metric")

    texts_by_column = []
    for column in columns:
        means = [
            mean_of_metric(values, method, column.setting, column.metric) for method in methods
        ]
        texts = [
            _entry_text(mean, column, method) for mean, method in zip(means, methods, strict=True)
        ]
        if column.lower_is_better is not None:
            numbers = [None if mean is None else mean.value for mean in means]
            texts = mark_best(numbers, texts, column.lower_is_better)
        texts_by_column.append(texts)

    # Columns are filled one after the other, but the result is a list for each row.
    return [list(texts) for texts in zip(*texts_by_column, strict=True)]
