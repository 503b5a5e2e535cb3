"""Fill the paper's six tables and one more with measured numbers; the paper's stand beside them.

Read `make_tables` first. table_layouts.py says what each table shows, table_texts.py names rows
and writes notes, table.py writes the finished tables as Markdown and LaTeX.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from spackle.paper.evaluation.measurements import (
    NEAR_SETTING,
    Measurement,
    Run,
    group_values,
    paper_measurements,
    setting_title,
)
from spackle.paper.evaluation.paper_numbers import PAPER_IMAGE_COUNTS, PAPER_SETTINGS
from spackle.paper.evaluation.table import (
    NO_NUMBER,
    NOT_RUN,
    RowTexts,
    Table,
    to_latex,
    to_markdown,
)
from spackle.paper.evaluation.table_layouts import (
    EXPANDED_OVERHEAD,
    NEAR_VIEW_QUALITY,
    OVERHEAD,
    TABLE_LAYOUTS,
    Source,
    TableLayout,
)
from spackle.paper.evaluation.table_numbers import (
    PAPER_SUFFIX,
    Column,
    columns_of_layout,
    mean_of_metric,
    texts_of_methods,
)
from spackle.paper.evaluation.table_texts import (
    caption_of_table,
    missing_columns,
    notes_of_table,
    shown_methods,
)
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic

MARKDOWN_FILE = "tables.md"
LATEX_FILE = "tables.tex"

DISPARITY_PATTERN = "{}: disparity {}"  # a head above columns, such as "S1: disparity 0.3"


class DatasetRow(NamedTuple):
    """A row of a dataset: a method's numbers, the paper's, or "not run"."""

    name: str
    image_count: str  # "20/23": 20 measured images of the paper's 23
    texts: list[str]  # one for each column


class TableContent(NamedTuple):
    """The heads and rows of a table, as in `Table`."""

    heads: list[tuple[str, str]]
    bodies: list[list[RowTexts]]


def make_tables(runs: Sequence[Run], *, with_unmeasured: bool = False) -> list[Table]:
    """Make the tables for which the runs have numbers.

    Counts of Gaussians and times come from benchmarks; for datasets without a benchmark, counts
    come from evaluations of large views.

    Args:
        runs: results of `spackle evaluate` and `spackle bench`, at most one of each kind for a
            dataset and base.
        with_unmeasured: whether to make all tables of the paper, also those without measured
            numbers.

    Raises:
        InputError: two runs have the same dataset, protocol and base, or runs differ in their
            disparities (sizes of camera moves).
    """
    # Before a table is made, because all tables share datasets and settings.
    _check_distinct(runs)
    runs_by_source = _runs_by_source(runs)
    large_settings = _settings_of_large_views(runs)

    tables = []
    for layout in TABLE_LAYOUTS:
        shown_runs = runs_by_source[layout.source]
        is_in_paper = len(paper_measurements(layout.label)) > 0
        if not shown_runs and not (with_unmeasured and is_in_paper):
            continue
        settings = [NEAR_SETTING] if layout.source == "near" else large_settings
        content = _content_of_table(layout, shown_runs, settings)
        table = Table(
            label=layout.label,
            title=layout.title,
            caption=caption_of_table(layout, shown_runs),
            heads=content.heads,
            bodies=content.bodies,
            word_columns=layout.word_columns,
            notes=notes_of_table(layout, shown_runs),
        )
        tables.append(table)
    return tables


def _content_of_table(
    layout: TableLayout, runs: Sequence[Run], settings: Sequence[str]
) -> TableContent:
    """Heads and rows of a table, without the columns of metrics that no run has measured.

    If there is no other column, the table has neither heads nor rows: its notes say why.
    """
    missing = missing_columns(layout, runs)
    shown_columns = tuple(column for column in layout.columns if column not in missing)
    if not shown_columns:
        return TableContent(heads=[], bodies=[])
    shown_layout = dataclasses.replace(layout, columns=shown_columns)

    # Three tables of the paper have a layout of their own.
    if layout is NEAR_VIEW_QUALITY:
        return _near_view_content(shown_layout, runs, settings)
    if layout is OVERHEAD:
        return _overhead_content(shown_layout, runs, settings)
    if layout is EXPANDED_OVERHEAD:
        return _expanded_overhead_content(shown_layout, runs, settings)
    return _content_by_dataset(shown_layout, runs, settings)


def _check_distinct(runs: Sequence[Run]) -> None:
    """Raise an InputError if two runs would fill the same rows of a table."""
    known_keys = set()
    for run in runs:
        protocol = run.config["protocol"]
        key = (protocol, run.title, run.base_title)
        if key in known_keys:
            raise InputError(
                f"two results for {run.title} under {protocol} with the base {run.base_title}: "
                "give one of the two"
            )
        known_keys.add(key)


def _runs_by_source(runs: Sequence[Run]) -> dict[Source, list[Run]]:
    """The runs that tables of each kind show: large views, near views, and costs.

    Costs come from benchmarks. An evaluation of large views has counts of Gaussians, too, and
    stands in for a benchmark of its dataset and base if there is none.
    """
    near_runs = [run for run in runs if run.compares_with_photos]
    large_runs = [run for run in runs if not run.compares_with_photos and not run.is_benchmark]
    benchmarks = [run for run in runs if run.is_benchmark]

    # A benchmark times the same views, so its counts are preferred.
    benchmarked = {(run.title, run.base_title) for run in benchmarks}
    stand_ins = [run for run in large_runs if (run.title, run.base_title) not in benchmarked]
    return {"near": near_runs, "large": large_runs, "cost": benchmarks + stand_ins}


def _settings_of_large_views(runs: Sequence[Run]) -> list[str]:
    """The settings that all runs of large views share: their disparities, as text.

    Without such runs these are the paper's 0.3, 0.4, 0.5.

    Raises:
        InputError: the runs have different disparities.
    """
    # Tables have columns for each disparity, so all runs must have the same.
    settings = {tuple(run.settings) for run in runs if not run.compares_with_photos}
    if len(settings) > 1:
        raise InputError("the results have different disparities: make a separate table for each")
    if not settings:
        return list(PAPER_SETTINGS)
    (shared_settings,) = settings
    return list(shared_settings)


def write_tables(
    tables: Sequence[Table],
    folder: Path,
    *,
    markdown_file: str = MARKDOWN_FILE,
    latex_file: str = LATEX_FILE,
    label_suffix: str = "",
) -> None:
    """Write tables as Markdown and as LaTeX.

    Args:
        tables: the tables.
        folder: an existing folder.
        markdown_file: the name of the Markdown file.
        latex_file: the name of the LaTeX file.
        label_suffix: the end of each label, which lets a document include several files.
    """
    markdown = "\n".join(to_markdown(table) for table in tables)
    write_atomic(folder / markdown_file, markdown.encode())

    # A comment for whoever includes the file in a document.
    head = "% needs \\usepackage{booktabs,graphicx}\n"
    latex = head + "\n".join(to_latex(table, label_suffix) for table in tables)
    write_atomic(folder / latex_file, latex.encode())


# --- rows


def _datasets(runs: Sequence[Run]) -> list[str]:
    """The titles of the datasets among the runs, and then the paper's other datasets.

    In both parts the paper's datasets come first, in the paper's order.
    """
    titles = {run.title for run in runs}
    measured_of_paper = [title for title in PAPER_IMAGE_COUNTS if title in titles]
    all_measured = [*measured_of_paper, *(run.title for run in runs)]
    return list(dict.fromkeys([*all_measured, *PAPER_IMAGE_COUNTS]))


def prepend_group_name(name: str, rows: Sequence[RowTexts]) -> list[RowTexts]:
    """Rows of a table with one more column on the left: the group's name, in the first row only."""
    rows_with_name: list[RowTexts] = []
    for texts in rows:
        shown_name = name if not rows_with_name else NO_NUMBER
        rows_with_name.append((shown_name, *texts))
    return rows_with_name


def _rows_of_dataset(
    dataset: str,
    layout: TableLayout,
    runs: Sequence[Run],
    columns: Sequence[Column],
    *,
    paper_label: str,
) -> list[DatasetRow]:
    """A dataset's rows: first those of the runs (or "not run"), then the paper's.

    Args:
        dataset: the dataset's title.
        layout: the table, which says which methods have a row.
        runs: results of all datasets.
        columns: the table's columns of numbers.
        paper_label: the label of the paper's table with the numbers for these columns.
    """
    rows = []
    for run in runs:
        if run.title != dataset:
            continue
        names = shown_methods(layout, run)

        # Such as "20/23": 20 measured images of the 23 in the paper.
        image_count = str(len(run.measured_images))
        if dataset in PAPER_IMAGE_COUNTS:
            image_count += f"/{PAPER_IMAGE_COUNTS[dataset]}"

        # One list of texts for each method, in the same order.
        rows_of_run = texts_of_methods(run.measurements, columns, list(names))
        for name, texts in zip(names.values(), rows_of_run, strict=True):
            rows.append(DatasetRow(name, image_count, texts))

    # A dataset that was not measured stands in the table, too, so that nobody overlooks the gap.
    if not rows:
        rows.append(DatasetRow(NOT_RUN, NO_NUMBER, [NO_NUMBER] * len(columns)))

    published = [
        measurement
        for measurement in paper_measurements(paper_label)
        if measurement.dataset == dataset
    ]
    for method in dict.fromkeys(measurement.method for measurement in published):
        (texts,) = texts_of_methods(published, columns, [method])
        # If the paper has other settings than the runs, all its texts are empty: no row.
        has_numbers = any(texts)
        if has_numbers:
            rows.append(DatasetRow(method, str(PAPER_IMAGE_COUNTS[dataset]), texts))
    return rows


# --- the contents of the tables


def _content_by_dataset(
    layout: TableLayout, runs: Sequence[Run], settings: Sequence[str]
) -> TableContent:
    """Heads and rows of a table with a group of rows for each dataset.

    A group has the rows of our methods, then the paper's.

    The columns are repeated for each setting, that is, for each size of the camera move.
    """
    # Near views have one setting, which needs no head above its columns.
    is_near_view = list(settings) == [NEAR_SETTING]
    columns = columns_of_layout(
        layout.columns,
        settings,
        group_pattern="" if is_near_view else DISPARITY_PATTERN,
        marks_best=layout.marks_best,
    )
    # A column has two heads: one that it shares with its neighbours ("" if none), and its own. "n"
    # is the number of images.
    heads = [("", "Dataset"), ("", "Method"), ("", "n")]
    heads += [(column.group, column.title) for column in columns]

    bodies = []
    for dataset in _datasets(runs):
        rows = _rows_of_dataset(dataset, layout, runs, columns, paper_label=layout.label)
        row_texts = [(row.name, row.image_count, *row.texts) for row in rows]
        bodies.append(prepend_group_name(dataset, row_texts))
    return TableContent(heads, bodies)


def _near_view_content(
    layout: TableLayout, runs: Sequence[Run], settings: Sequence[str]
) -> TableContent:
    """Heads and rows of a table with a row for each method, and columns for each dataset.

    The rows of our methods are a group above those of the paper's.
    """
    columns = columns_of_layout(layout.columns, settings, marks_best=layout.marks_best)
    datasets = _datasets(runs)
    # A column has two heads: one that it shares with its neighbours ("" if none), and its own.
    heads = [("", "Method")]

    # By the row's name, then by dataset: the texts of the row in the dataset's columns.
    measured_rows: dict[str, dict[str, list[str]]] = {}
    paper_rows: dict[str, dict[str, list[str]]] = {}
    for dataset in datasets:
        for row in _rows_of_dataset(dataset, layout, runs, columns, paper_label=layout.label):
            if row.name == NOT_RUN:
                continue
            rows = paper_rows if row.name.endswith(PAPER_SUFFIX) else measured_rows
            rows.setdefault(row.name, {})[dataset] = row.texts
    # If nothing was measured, one row above the paper's says so.
    if not measured_rows:
        measured_rows[NOT_RUN] = {}

    # Datasets without any number would only widen the table.
    all_rows = [*measured_rows.values(), *paper_rows.values()]
    datasets = [name for name in datasets if any(any(row.get(name, ())) for row in all_rows)]
    heads += [(dataset, column.title) for dataset in datasets for column in columns]

    no_numbers = [NO_NUMBER] * len(columns)
    bodies: list[list[RowTexts]] = []
    for rows in (measured_rows, paper_rows):
        body: list[RowTexts] = []
        for name, texts_by_dataset in rows.items():
            row_texts = [name]
            for dataset in datasets:
                row_texts += texts_by_dataset.get(dataset, no_numbers)
            # The paper has no numbers for metrics of ours.
            if any(row_texts[1:]) or name == NOT_RUN:
                body.append(row_texts)
        bodies.append(body)
    return TableContent(heads, bodies)


def _overhead_content(
    layout: TableLayout, runs: Sequence[Run], settings: Sequence[str]
) -> TableContent:
    """Heads and rows of the table of costs: added Gaussians by dataset and on average, then times.

    Each setting (size of the camera move) has the same columns. Times are medians of the datasets'
    medians; each stands in the first column of its setting.
    """
    columns = columns_of_layout(layout.columns, settings, group_pattern=DISPARITY_PATTERN)
    # A column has two heads: one that it shares with its neighbours ("" if none), and its own.
    # "From" is the method, or the paper, that a row's numbers are from.
    heads = [("", "Dataset"), ("", "From")]
    heads += [(column.group, column.title) for column in columns]

    bodies = []
    for dataset in _datasets(runs):
        # The paper's numbers for single datasets stand in its expanded table.
        rows = _rows_of_dataset(dataset, layout, runs, columns, paper_label=EXPANDED_OVERHEAD.label)
        bodies.append(prepend_group_name(dataset, [(row.name, *row.texts) for row in rows]))

    # Each dataset counts once, whatever its number of images.
    means = _means_of_datasets(layout, runs)
    average_rows = []
    for name, measurements in means.items():
        (texts,) = texts_of_methods(measurements, columns, [name])
        average_rows.append((name, *texts))
    bodies.append(prepend_group_name("Average", average_rows))

    bodies.append(_time_rows(layout, settings, means))
    return TableContent(heads, bodies)


def _means_of_datasets(layout: TableLayout, runs: Sequence[Run]) -> dict[str, list[Measurement]]:
    """The mean of each metric over each dataset, as measurements, listed by the row's name.

    The caller averages these means, so that each dataset counts once, whatever its number of
    images. A row of the paper has averages over datasets already; they are listed unchanged.
    """
    means: dict[str, list[Measurement]] = {}
    for run in runs:
        names = shown_methods(layout, run)
        values = group_values(run.measurements, "method", "setting", "metric")
        for method, setting, metric in values:
            if method not in names:
                continue
            mean = mean_of_metric(values, method, setting, metric)
            if mean is not None:
                # The caller averages over images, so the dataset is entered as an image.
                name = names[method]
                measurement = Measurement(
                    dataset="",
                    image=run.title,
                    setting=setting,
                    view="",
                    method=name,
                    metric=metric,
                    value=mean.value,
                )
                means.setdefault(name, []).append(measurement)

    # In this table the paper has averages over datasets, not numbers of each dataset.
    for measurement in paper_measurements(layout.label):
        means.setdefault(measurement.method, []).append(measurement)
    return means


def _time_rows(
    layout: TableLayout, settings: Sequence[str], means: Mapping[str, Sequence[Measurement]]
) -> list[RowTexts]:
    """The rows with times, which stand below the rows with counts of Gaussians in a table.

    The first row is a heading. Then each kind of time, such as the base's time, has a group of
    rows, one for each method.

    Args:
        layout: the table; each setting has a column for each of `layout.columns`.
        settings: disparities (sizes of camera moves), as text.
        means: for each row's name the numbers of all datasets.
    """
    # The heading has a text in its first column. The other columns stay empty: one for the methods,
    # and those of the counts, in which the rows below the heading have their times.
    count_columns = len(layout.columns) * len(settings)
    rows: list[RowTexts] = [("Runtime efficiency", *[NO_NUMBER] * (1 + count_columns))]

    for time_column in layout.time_columns:
        columns = columns_of_layout([time_column], settings)  # one for each setting
        rows_of_methods = []
        for name, measurements in means.items():
            (texts,) = texts_of_methods(measurements, columns, [name])

            # A setting has several columns of counts. Its time stands in the first of them.
            row_texts = [name]
            for text in texts:
                row_texts.append(text)
                row_texts += [NO_NUMBER] * (len(layout.columns) - 1)
            rows_of_methods.append(row_texts)
        rows += prepend_group_name(time_column.title, rows_of_methods)
    return rows


def _expanded_overhead_content(
    layout: TableLayout, runs: Sequence[Run], settings: Sequence[str]
) -> TableContent:
    """Heads and rows of the table of counts, times and rates.

    Each dataset has a group of rows: for each setting (size of the camera move) a row for each
    method.
    """
    # "From" is the method that a row's numbers are from; "n" is the number of images.
    titles = ["Dataset", "Setting", "From", *(column.title for column in layout.columns), "n"]
    # No column shares a second head with its neighbours, so that one is empty.
    heads = [("", title) for title in titles]

    bodies = []
    for dataset in _datasets(runs):
        group: list[RowTexts] = []
        for setting in settings:
            # Settings are rows here, so the columns are those of one setting.
            columns = columns_of_layout(layout.columns, [setting])
            rows = _rows_of_dataset(dataset, layout, runs, columns, paper_label=layout.label)
            for row in rows:
                group.append((setting_title(setting), row.name, *row.texts, row.image_count))
        bodies.append(prepend_group_name(dataset, group))
    return TableContent(heads, bodies)
