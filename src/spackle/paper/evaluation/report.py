"""Evaluations as one self-contained HTML page; report.html is its template."""

from __future__ import annotations

import base64
import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment
from markupsafe import Markup, escape

from spackle.core.image_files import open_image
from spackle.paper.evaluation.measurements import (
    NEAR_SETTING,
    REMARK_METRIC,
    Measurement,
    Run,
    Value,
    group_values,
    mean_of_known,
    setting_title,
)
from spackle.paper.evaluation.metrics import METRICS
from spackle.paper.evaluation.paper_numbers import PAPER_IMAGE_COUNTS
from spackle.paper.evaluation.pictures import (
    STORED_FORMATS,
    Ranking,
    evenly_spaced_indices,
    picture_title,
    ranking_of_run,
    stored_pictures,
)
from spackle.paper.evaluation.plots import Plot, plots_of_run
from spackle.paper.evaluation.protocols import TRUE_PICTURE
from spackle.paper.evaluation.table import (
    NO_NUMBER,
    NUMBER_FORMATS,
    NumberFormat,
    RowTexts,
    Table,
    group_widths,
)
from spackle.paper.evaluation.table_numbers import Column, texts_of_methods
from spackle.paper.evaluation.table_texts import method_row_name, overview_notes
from spackle.paper.evaluation.tables import make_tables, prepend_group_name

REPORT_FILE = "report.html"  # the page, and in this package its template
MAX_IMAGES = 8  # on a page
MIN_IMAGES_EACH = 2  # of each evaluation, even if this makes more than `MAX_IMAGES`

# A slider shows the first existing pictures of this list, not more, to limit the page's size.
SLIDER_PICTURES = (
    "base",
    "spackle",
    TRUE_PICTURE,
    "inpaint2d",
    "paper",
    "initial",
    "direct-ft",
    "spackle-scene",
    "dense",
)
MAX_SLIDER_PICTURES = 6


class MeansColumn(NamedTuple):
    """A column in the table of a method's means."""

    title: str
    format: NumberFormat


# By metric, in the order of the columns; a column without numbers is left out.
MEANS_COLUMNS = {
    "distance": MeansColumn(METRICS["distance"].title, METRICS["distance"].format),
    "psnr": MeansColumn(METRICS["psnr"].title, METRICS["psnr"].format),
    "psnr_hole": MeansColumn("PSNR in the hole ↑", "{:.2f}".format),
    "ssim_hole": MeansColumn("SSIM in the hole ↑", "{:.4f}".format),
    **{
        name: MeansColumn(metric.title, metric.format)
        for name, metric in METRICS.items()
        if name not in ("distance", "psnr", "ssim")
    },
    "har": MeansColumn("HAR ↓", NUMBER_FORMATS["ratio"]),
    "aux": MeansColumn("added GS", NUMBER_FORMATS["count"]),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportImage:
    """The page's entry on an image, in the view in which the base leaves the largest hole."""

    name: str
    position: str  # in the ranking, such as "worst" or "3 of 12"; "" without a ranking
    setting: str  # a disparity as text, or "near"
    view: str
    hole: str | None  # the hole's share of the view, such as "4.2 %"
    titles: Mapping[str, str]  # of the slider's pictures, by name
    pictures: Mapping[str, str]  # data URLs, by name
    left: str  # the name of the picture that the slider shows on the left at first
    right: str
    width: int  # of a picture, in pixels
    height: int
    table: Table  # the numbers of the view


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportPart:
    """The page's sections on an evaluation."""

    run: Run
    paper_images: int | None  # the number of the dataset's images in the paper
    plots: Sequence[Plot]
    ranking: Ranking | None
    images: Sequence[ReportImage]
    remarks: Sequence[tuple[str, Value]]  # names of images, and what is to be said about them


def make_report(sources: Sequence[tuple[Run, Path]], *, with_unmeasured: bool = False) -> str:
    """Make a report as a self-contained HTML page; the same results give the same bytes.

    Args:
        sources: evaluations and benchmarks, each with the folder of its pictures; the page's tables
            show them together.
        with_unmeasured: whether to show all tables of the paper, also those without measured
            numbers.
    """
    runs = [run for run, _ in sources]
    evaluations = [(run, folder) for run, folder in sources if not run.is_benchmark]
    # The page's images are shared out among the evaluations.
    images_each = max(MIN_IMAGES_EACH, MAX_IMAGES // max(1, len(evaluations)))
    datasets = ", ".join(dict.fromkeys(run.title for run in runs))

    # Names of images come from files; the template escapes them.
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["group_widths"] = group_widths
    environment.filters["bold"] = _bold_markup
    # The template is a file of this package, and has the name of the page that is made from it.
    template_file = resources.files("spackle.paper.evaluation").joinpath(REPORT_FILE)
    template = environment.from_string(template_file.read_text(encoding="utf-8"))

    page = template.render(
        title=f"Spackle: evaluation on {datasets}",
        overview=overview_table([run for run, _ in evaluations]),
        parts=[_part_of_run(run, folder, images_each) for run, folder in evaluations],
        tables=make_tables(runs, with_unmeasured=with_unmeasured),
        runs=runs,
        max_images=MAX_IMAGES,
        min_images=MIN_IMAGES_EACH,
    )
    return page + "\n"


def _bold_markup(text: str) -> Markup:
    """A text as HTML, escaped, with bold type for what stands between **."""
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text))))


def _part_of_run(run: Run, folder: Path, max_images: int) -> ReportPart:
    """The page's sections on an evaluation, with some images from the worst to the best.

    Of each image the page has a slider, which shows two pictures side by side. Images without
    pictures are left out.

    Args:
        run: the evaluation.
        folder: the folder of its pictures.
        max_images: the most images to show.
    """
    ranking = ranking_of_run(run)
    names = run.measured_images if ranking is None else ranking.names[::-1]  # worst first

    images = []
    for index in evenly_spaced_indices(len(names), max_images):
        files = stored_pictures(run, folder, names[index])
        slider_names = [name for name in SLIDER_PICTURES if name in files][:MAX_SLIDER_PICTURES]
        if not slider_names:  # the folder's pictures were deleted
            continue
        slider_files = {name: files[name] for name in slider_names}
        position = "" if ranking is None else _position_text(index, len(names))
        images.append(_report_image(run, names[index], position, slider_files))

    # A metric that fails leaves the same remark for each view; each is listed once.
    remarks = [
        (measurement.image, measurement.value)
        for measurement in run.measurements
        if measurement.metric == REMARK_METRIC
    ]
    distinct_remarks = list(dict.fromkeys(remarks))
    return ReportPart(
        run=run,
        paper_images=PAPER_IMAGE_COUNTS.get(run.title),
        plots=plots_of_run(run),
        ranking=ranking,
        images=images,
        remarks=distinct_remarks,
    )


def _position_text(index: int, count: int) -> str:
    """An image's place in a ranking from worst to best: "worst", "3 of 12" or "best".

    `index` counts from 0, the worst of `count` images. A single image gets an empty text.
    """
    if count == 1:
        return ""
    if index == 0:
        return "worst"
    if index == count - 1:
        return "best"
    return f"{index + 1} of {count}"


def overview_table(runs: Sequence[Run]) -> Table:
    """What all evaluations measured, in a row for each method, grouped by scenes and base.

    Columns are the holes that remain at each size of the camera move, and the metrics against true
    second photos; columns without numbers are left out.
    """
    columns = _overview_columns(runs)

    # Evaluations of large views and of near views with one base share their rows.
    runs_by_group: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        runs_by_group.setdefault((run.title, run.base_title), []).append(run)

    groups = []
    for (title, base), group_runs in runs_by_group.items():
        methods = list(dict.fromkeys(method for run in group_runs for method in run.methods))
        measurements = [measurement for run in group_runs for measurement in run.measurements]
        rows = texts_of_methods(measurements, columns, methods)
        names = [method_row_name(group_runs[0], method) for method in methods]
        groups.append((f"{title}, base {base}", names, rows))

    # Only columns in which any row has a number.
    shown_indices = [
        index
        for index in range(len(columns))
        if any(texts[index] for _, _, rows in groups for texts in rows)
    ]
    bodies = []
    for group_title, names, rows in groups:
        row_texts = [
            (name, *(texts[index] for index in shown_indices))
            for name, texts in zip(names, rows, strict=True)
        ]
        bodies.append(prepend_group_name(group_title, row_texts))
    # The first two columns, of the group and of the method, need no heads.
    shown_heads = [(columns[index].group, columns[index].title) for index in shown_indices]
    return Table(
        label="",
        title="",
        caption="",
        heads=[("", ""), ("", ""), *shown_heads],
        bodies=bodies,
        word_columns=2,
        notes=overview_notes(runs),
    )


def _overview_columns(runs: Sequence[Run]) -> list[Column]:
    """The columns of an overview: holes at each size of the camera move, then image metrics."""
    settings = dict.fromkeys(
        setting for run in runs if not run.compares_with_photos for setting in run.settings
    )
    columns = [
        Column(
            group="Hole area ratio ↓",
            title=setting_title(setting),
            setting=setting,
            metric="har",
            format=NUMBER_FORMATS["ratio"],
        )
        for setting in settings
    ]
    columns += [
        Column(
            group="Against true second photos",
            title=column.title,
            setting=NEAR_SETTING,
            metric=metric,
            format=column.format,
            lower_is_better=not column.title.endswith("↑"),
        )
        for metric, column in MEANS_COLUMNS.items()
        if metric not in ("har", "aux")  # no metrics of images
    ]
    return columns


def means_table(run: Run, measurements: Iterable[Measurement]) -> Table:
    """Means of metrics over an evaluation's images: a row for each method.

    If there are several settings (sizes of the camera move), the rows are grouped by setting, and a
    first column has the setting's title.

    Args:
        run: the evaluation, which names methods and base.
        measurements: the numbers to average: all, or those of one view.
    """
    # An overview shows what people compare first; tables.md has the other numbers.
    shown = [measurement for measurement in measurements if measurement.metric in MEANS_COLUMNS]
    values = group_values(shown, "setting", "method", "metric")
    settings = list(dict.fromkeys(setting for setting, _, _ in values))
    measured_metrics = {metric for _, _, metric in values}
    metrics = [metric for metric in MEANS_COLUMNS if metric in measured_metrics]

    bodies: list[list[RowTexts]] = []
    for setting in settings:
        rows: list[RowTexts] = []
        for method in run.methods:
            row = [picture_title(run, method)]
            for metric in metrics:
                mean = mean_of_known(values.get((setting, method, metric), ())).value
                row.append(NO_NUMBER if mean is None else MEANS_COLUMNS[metric].format(mean))
            rows.append(row)
        if len(settings) > 1:
            rows = prepend_group_name(setting_title(setting), rows)
        bodies.append(rows)

    # The columns of words, which need no heads: the method, and before it the setting, if shown.
    word_heads = [""] if len(settings) == 1 else ["", ""]
    # An arrow stays on the line of its metric's name.
    metric_heads = [
        re.sub(" ([↑↓])", "\N{NO-BREAK SPACE}\\1", MEANS_COLUMNS[metric].title)
        for metric in metrics
    ]
    return Table(
        label="",
        title="",
        caption="",
        heads=[("", head) for head in (*word_heads, *metric_heads)],
        bodies=bodies,
        word_columns=len(word_heads),
    )


def _report_image(run: Run, name: str, position: str, files: Mapping[str, Path]) -> ReportImage:
    """The page's entry on an image: pictures for the slider, and the numbers of the view in them.

    Args:
        run: the evaluation.
        name: the image's name.
        position: the image's place in the ranking, in words.
        files: the files of the slider's pictures, by the picture's name: a method, or "truth".
    """
    setting, view = run.view_with_largest_hole(name)
    view_measurements = [
        measurement
        for measurement in run.measurements
        if measurement.image == name and measurement.setting == setting and measurement.view == view
    ]
    # All pictures of a slider have the same size, because they show one view.
    names = list(files)
    left, right = _first_slider_pictures(names)
    with open_image(files[left], STORED_FORMATS) as image:
        width, height = image.size

    return ReportImage(
        name=name,
        position=position,
        setting=setting,
        view=view,
        hole=_hole_share_text(view_measurements),
        titles={picture: picture_title(run, picture) for picture in names},
        pictures={picture: _data_url(file) for picture, file in files.items()},
        left=left,
        right=right,
        width=width,
        height=height,
        table=means_table(run, view_measurements),
    )


def _first_slider_pictures(names: Sequence[str]) -> tuple[str, str]:
    """The names of the pictures that a slider shows at first on the left and on the right.

    On the left is the base, or if it is missing the first picture; on the right is "spackle", or if
    it is missing the last picture. A single picture is on both sides.
    """
    left = "base" if "base" in names and len(names) > 1 else names[0]
    for name in ("spackle", *reversed(names)):
        if name in names and name != left:
            return left, name
    return left, left


def _hole_share_text(view_measurements: Sequence[Measurement]) -> str | None:
    """The hole's share of a view before completion, such as "4.2 %"; None if unknown."""
    for measurement in view_measurements:
        if measurement.metric == "har_before" and measurement.value is not None:
            return f"{100 * float(measurement.value):.2g} %"
    return None


def _data_url(file: Path) -> str:
    """A WebP file as a data URL, so that the page needs no other file."""
    return f"data:image/webp;base64,{base64.b64encode(file.read_bytes()).decode()}"
