"""The plots of a report: areas of holes against disparity, and numbers scene by scene.

matplotlib is optional (pip install 'spackle-nvs[eval]'); this is the only file that imports it.
"""

from __future__ import annotations

import base64
import importlib.util
import io
import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from spackle.paper.evaluation.measurements import (
    Measurement,
    Run,
    group_values,
    mean_of_known,
    paper_measurements,
)
from spackle.paper.evaluation.method_descriptions import describe_method
from spackle.paper.evaluation.pictures import best_first, evenly_spaced_indices
from spackle.paper.evaluation.table_layouts import HOLE_AREA
from spackle.paper.evaluation.table_texts import method_row_name
from spackle.runtime.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes

MATPLOTLIB_SETTINGS: Any = {
    "svg.fonttype": "none",  # keep text as text
    "svg.hashsalt": "spackle",  # makes bytes reproducible
    "text.parse_math": False,  # a $ in a scene's name is no formula
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#d5d9de",
    "lines.markersize": 5,
}
PLOT_WIDTH_INCHES = 4.6  # about as wide as a phone
AXES_HEIGHT_INCHES = 2.5  # of the axes with the title above and the numbers below them
BARE_AXES_HEIGHT_INCHES = 1.0  # the same, if the axes had no row
SCENE_HEIGHT_INCHES = 0.21  # of a scene's row in a plot scene by scene
LEGEND_LINE_INCHES = 0.19  # of a method's line in the legend, which is below the axes
MAX_PLOTTED_SCENES = 30
MAX_NAME_LETTERS = 14  # of a scene's name beside a plot

PAPER_METHOD = "Spackle on SHARP (paper)"  # the paper's row name in its table of hole areas

# The plots of near views: for each metric the titles of the plot and of its x axis.
SCENE_PLOTS = {
    "psnr_hole": ("PSNR in the hole, scene by scene", "PSNR (dB), higher is better"),
    "distance": ("Distance in the hole, scene by scene", "distance (0 to 8), lower is better"),
}

Point = tuple[float, float]  # x and y


class Series(NamedTuple):
    """The points of one method in a plot; a method is one way to render new views of a photo."""

    title: str
    method: str  # gives the color and the shape of the markers
    points: Sequence[Point]
    is_hollow: bool = False  # whether the markers are filled with white
    line_style: str = "none"  # or "-" or "--", as in matplotlib


class Plot(NamedTuple):
    """A finished plot with its texts."""

    title: str
    alt_text: str  # for readers who cannot see the plot
    address: str  # the SVG image as a data URL
    note: str


def check_matplotlib(option: str) -> None:
    """Raise an InputError that names `option`, which needs matplotlib, if it is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError(f"{option}: needs matplotlib: pip install 'spackle-nvs[eval]'")


def plots_of_run(run: Run) -> list[Plot]:
    """All plots that can be drawn from an evaluation's numbers.

    Evaluations against second photos have plots scene by scene, those of large camera moves a plot
    of the area of holes.
    """
    if run.compares_with_photos:
        plots = [scenes_plot(run, metric) for metric in SCENE_PLOTS]
    else:
        plots = [hole_area_plot(run)]
    return [plot for plot in plots if plot is not None]


def _draw_plot(
    title: str,
    run: Run,
    series: Sequence[Series],
    x_title: str,
    y_title: str,
    finish_axes: Callable[[Axes], object],
    note: str = "",
    axes_height_inches: float = AXES_HEIGHT_INCHES,
) -> Plot:
    """Draw series of points as an SVG image; the same series give the same bytes.

    Args:
        title: the plot's title.
        run: the evaluation; the plot says which scenes and which base it shows.
        series: the points of each method.
        x_title: the title of the x axis.
        y_title: the title of the y axis.
        finish_axes: sets scales and ticks.
        note: a sentence below the plot.
        axes_height_inches: of the image without its legend.
    """
    # Imported here, because matplotlib is optional.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(MATPLOTLIB_SETTINGS), warnings.catch_warnings():
        # matplotlib warns about letters without a glyph; the browser's font has these letters.
        warnings.simplefilter("ignore")
        # The legend has a line for each method, and takes no space from the axes.
        height_inches = axes_height_inches + LEGEND_LINE_INCHES * len(series)
        figure = Figure(figsize=(PLOT_WIDTH_INCHES, height_inches), layout="constrained")
        axes = figure.subplots()

        for method_series in series:
            description = describe_method(method_series.method)
            axes.plot(
                [x for x, _ in method_series.points],
                [y for _, y in method_series.points],
                description.marker,
                color=description.color,
                linestyle=method_series.line_style,
                markerfacecolor="white" if method_series.is_hollow else description.color,
                alpha=0.8,  # transparent, because markers may lie on each other
                label=method_series.title,
            )
        axes.set(xlabel=x_title, ylabel=y_title)
        # Inside of the image, which may be copied from the page.
        figure.suptitle(f"{title}\n{run.title}, base {run.base_title}", fontsize="medium")
        finish_axes(axes)
        figure.legend(loc="outside lower left", frameon=False, ncols=1)

        # Without date and version in the file, the same series give the same bytes.
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})

    # The image becomes a part of the page, which is one file.
    svg = base64.b64encode(file.getvalue()).decode()
    alt_text = f"{title}. {', '.join(method_series.title for method_series in series)}"
    return Plot(title, alt_text, f"data:image/svg+xml;base64,{svg}", note)


def hole_area_plot(run: Run) -> Plot | None:
    """The mean hole area ratio (HAR) against disparity, before and after completion.

    HAR is the fraction of a view's pixels that the Gaussians leave open; a disparity is a size of
    the camera move. The paper's numbers are drawn with hollow markers. None if nothing was
    measured.
    """
    series = _hole_area_series(run)
    if not series:
        return None

    disparities = sorted(
        {disparity for method_series in series for disparity, _ in method_series.points}
    )
    hole_ratios = [hole_ratio for method_series in series for _, hole_ratio in method_series.points]

    def finish_axes(axes: Axes) -> None:
        """Mark the disparities on the x axis, and show percent on the y axis."""
        _set_logarithmic_scale(axes, hole_ratios)
        axes.set_xticks(disparities)
        axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")

    return _draw_plot(
        "Hole Area Ratio against disparity",
        run,
        series,
        x_title="disparity of the view",
        y_title="HAR, share of the pixels",
        finish_axes=finish_axes,
    )


def _hole_area_series(run: Run) -> list[Series]:
    """The points (disparity, mean HAR) of a run and of the paper, before and after completion.

    HAR is the hole area ratio, the fraction of pixels that are left open. The metric "har_before"
    is the HAR of the base alone, "har" that after a method has filled holes. Series without points
    are left out.
    """
    # The first method serves as well as any, because "har_before" is the same for all.
    any_method = run.methods[0]
    before = _mean_by_disparity(run.measurements, run.title, "har_before", any_method)
    series = [Series(f"before: {run.base_title} alone", "base", before, line_style="--")]
    for method in run.methods:
        if method != "base":
            after = _mean_by_disparity(run.measurements, run.title, "har", method)
            title = f"after: {method_row_name(run, method)}"
            series.append(Series(title, method, after, line_style="-"))

    # The paper's numbers, from its table of hole areas, are drawn beside the run's, so that a
    # reader can compare them.
    published = paper_measurements(HOLE_AREA.label)
    paper_before = _mean_by_disparity(published, run.title, "har_before", PAPER_METHOD)
    paper_after = _mean_by_disparity(published, run.title, "har", PAPER_METHOD)
    # The paper's series have the colours of ours, but hollow markers.
    before_title = "before: SHARP (paper)"
    series.append(Series(before_title, "base", paper_before, is_hollow=True, line_style="--"))
    after_title = f"after: {PAPER_METHOD}"
    series.append(Series(after_title, "spackle", paper_after, is_hollow=True, line_style="-"))
    return [method_series for method_series in series if method_series.points]


def _mean_by_disparity(
    measurements: Iterable[Measurement], dataset: str, metric: str, method: str
) -> list[Point]:
    """The mean of a method's metric over a dataset's views, for each disparity: (disparity, mean).

    Disparities, sizes of the camera move, ascend; those without a finite number are left out.
    """
    chosen = (
        measurement
        for measurement in measurements
        if measurement.dataset == dataset
        and measurement.metric == metric
        and measurement.method == method
    )
    points = []
    for (setting,), values in group_values(chosen, "setting").items():
        mean = mean_of_known(values).value
        if mean is not None:
            points.append((float(setting), mean))
    return sorted(points)


def _set_logarithmic_scale(axes: Axes, values: Sequence[float]) -> None:
    """Make the y axis logarithmic; if a value is 0, it is linear below the smallest other value.

    If all values are 0, the axis stays linear.
    """
    # A logarithm has no place for 0, which a method reaches if it fills every hole.
    positive_values = [value for value in values if value > 0]
    if len(positive_values) == len(values):
        axes.set_yscale("log")
    elif positive_values:
        exponent = math.floor(math.log10(min(positive_values)))
        axes.set_yscale("symlog", linthresh=10.0**exponent)
        axes.set_ylim(bottom=0)


def scenes_plot(run: Run, metric: str) -> Plot | None:
    """A plot of a metric with a row for each scene, best first, and a marker for each method.

    Scenes are ranked by the results of the method "spackle", or of the last method if the run lacks
    it. If there are too many scenes, some are chosen evenly from best to worst. None if nothing was
    measured.

    Args:
        run: an evaluation against second photos.
        metric: a key of `SCENE_PLOTS`, which has the titles of the plot and of its x axis.
    """
    # A method may lack the metric, if it failed on all images.
    values_by_method = {}
    for method in run.methods:
        values = run.mean_by_image(metric, method)
        if values:
            values_by_method[method] = values
    if not values_by_method:
        return None

    ranking_method = "spackle" if "spackle" in values_by_method else list(values_by_method)[-1]
    ranked_scenes = best_first(values_by_method[ranking_method], metric)
    shown_indices = evenly_spaced_indices(len(ranked_scenes), MAX_PLOTTED_SCENES)
    scenes = [ranked_scenes[index] for index in shown_indices]

    series = []
    for method, values in values_by_method.items():
        points = [
            (values[scene], float(row)) for row, scene in enumerate(scenes) if scene in values
        ]
        series.append(Series(title=method_row_name(run, method), method=method, points=points))

    def finish_axes(axes: Axes) -> None:
        """Name the rows, and let the first be at the top."""
        axes.set_yticks(range(len(scenes)), [_shortened_name(scene) for scene in scenes])
        axes.set_ylim(len(scenes) - 0.5, -0.5)  # half a row beyond the outermost rows

    note = ""
    # A single scene has no order.
    if len(ranked_scenes) > 1:
        note = f"In the order of {describe_method(ranking_method).title}, best first."
    if len(scenes) < len(ranked_scenes):
        note += f" {len(scenes)} of {len(ranked_scenes)} scenes, spread evenly."

    title, x_title = SCENE_PLOTS[metric]
    return _draw_plot(
        title,
        run,
        series,
        x_title=x_title,
        y_title="",  # the rows' names say what they are
        finish_axes=finish_axes,
        note=note,
        axes_height_inches=BARE_AXES_HEIGHT_INCHES + SCENE_HEIGHT_INCHES * len(scenes),
    )


def _shortened_name(name: str) -> str:
    """Shorten a name to 14 letters in its middle, because names may differ at both ends."""
    if len(name) <= MAX_NAME_LETTERS:
        return name
    half = MAX_NAME_LETTERS // 2
    return f"{name[: half - 1]}…{name[-half:]}"
