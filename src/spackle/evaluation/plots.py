"""Plots as SVG files, drawn by matplotlib: holes against the move, Gaussians against holes, scene by scene."""

from __future__ import annotations

import base64
import importlib.util
import io
import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from spackle.errors import InputError
from spackle.evaluation.methods import METHODS
from spackle.evaluation.rows import Row, Run, mean, paper_rows, pivot
from spackle.evaluation.tables import method_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes

RC: Any = {
    "svg.fonttype": "none",  # the letters stay text
    "svg.hashsalt": "spackle",  # the same plot gives the same bytes
    "text.parse_math": False,  # a $ in a scene's name is a $
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#d5d9de",
    "lines.markersize": 5,
}
WIDTH, HEIGHT = 4.6, 3.4  # inches of a plot, about a phone's width
ROW = 0.21  # inches of a scene's row
DOTS, SCENES = 1000, 30  # at most in a plot: pages stay small, rows legible
LETTERS = 14  # of a scene's name
UP = ("psnr_hole", "clipiqa", "musiq")  # higher is better
# Characters that neither HTML nor XML may hold; names of files may.
UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
SCENE_FIGURES = {  # titles of the plot and of its axis
    "psnr_hole": ("PSNR in the hole, scene by scene", "PSNR (dB), higher is better"),
    "distance": ("Distance in the hole, scene by scene", "distance (0 to 8), lower is better"),
}


class Series(NamedTuple):
    """Points of one method."""

    title: str
    method: str  # of `METHODS`
    points: Sequence[tuple[float, float]]
    hollow: bool = False
    line: str = "none"  # or "-", "--"


class Plot(NamedTuple):
    """A drawing below its title."""

    title: str
    alt: str  # for those who do not see it
    svg: bytes
    note: str

    @property
    def address(self) -> str:
        """The drawing as a data address."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg).decode()}"


Finish = Callable[["Axes"], object]  # sets scales and ticks


def check_matplotlib(option: str) -> None:
    """InputError where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError(f"{option}: needs matplotlib: pip install 'spackle-nvs[eval]'")


def plots_of(run: Run) -> list[Plot]:
    """The plots of an evaluation that its figures allow."""
    scenes = [scenes_plot(run, metric) for metric in SCENE_FIGURES] if run.near else []
    made = [*([] if run.near else [holes_plot(run)]), overhead_plot(run), *scenes]
    return [plot for plot in made if plot]


def _draw(
    title: str, series: Sequence[Series], x: str, y: str, finish: Finish, note: str = "", height: float = HEIGHT
) -> Plot:
    """Series on axes with the titles `x` and `y`, as an SVG file `height` inches high: the same bytes for the same."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(RC), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a name has letters that matplotlib's font lacks; the browser's has them
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes = figure.subplots()
        for one in series:
            _, _, colour, form = METHODS[one.method]
            places = ([p[0] for p in one.points], [p[1] for p in one.points])
            face = "white" if one.hollow else colour
            axes.plot(*places, form, color=colour, ls=one.line, mfc=face, alpha=0.8, label=one.title)
        axes.set(xlabel=x, ylabel=y)
        finish(axes)
        figure.legend(loc="outside lower left", frameon=False, ncols=1)
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return Plot(title, f"{title}. {', '.join(one.title for one in series)}", file.getvalue(), note)


def holes_plot(run: Run) -> Plot | None:
    """HAR against disparity, before and after, and the paper's; None where nothing was measured."""

    def means(rows: Iterable[Row], metric: str, method: str) -> list[tuple[float, float]]:
        chosen = (row for row in rows if (row.method, row.metric, row.dataset) == (method, metric, run.title))
        by_setting = {float(setting): mean(values).value for (setting,), values in pivot(chosen, "setting").items()}
        return [(move, value) for move, value in sorted(by_setting.items()) if value is not None]

    papers, theirs = paper_rows("tab:controlled_disocclusion"), "Spackle on SHARP (paper)"
    series = [Series(f"before: {run.base} alone", "base", means(run.rows, "har_before", run.methods[0]), line="--")]
    filling = [method for method in run.methods if method != "base"]
    series += [Series(f"after: {method_name(run, m)}", m, means(run.rows, "har", m), line="-") for m in filling]
    series.append(Series("before: SHARP (paper)", "base", means(papers, "har_before", theirs), True, "--"))
    series.append(Series(f"after: {theirs}", "spackle", means(papers, "har", theirs), True, "-"))
    series = [one for one in series if one.points]
    values = [value for one in series for _, value in one.points]
    positive = [value for value in values if value > 0]

    def finish(axes: Axes) -> None:
        """Decades; a hole of zero stands at the foot of the axis."""
        if len(positive) == len(values):
            axes.set_yscale("log")
        elif positive:
            axes.set_yscale("symlog", linthresh=10.0 ** math.floor(math.log10(min(positive))))
            axes.set_ylim(bottom=0)
        axes.set_xticks(sorted({move for one in series for move, _ in one.points}))
        axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")

    title, y = "Hole Area Ratio against disparity", "HAR, share of the pixels"
    return _draw(title, series, "disparity of the view", y, finish) if series else None


def overhead_plot(run: Run) -> Plot | None:
    """Added Gaussians against the size of the hole: a dot for each image and view; None where none were counted."""
    series, count = [], 0
    values = pivot(run.rows, "method", "image", "setting", "view", "metric")
    adding = {row.method for row in run.rows if row.metric == "aux" and row.method != "base"}
    for method in (name for name in run.methods if name in adding):
        views = [key[:-1] for key in values if key[0] == method and key[-1] == "aux_share"]
        pairs = [(values[(*view, "har_before")][0], values[(*view, "aux_share")][0]) for view in views]
        dots = [(100 * float(one), 100 * float(two)) for one, two in pairs if one is not None and two is not None]
        count += len(dots)
        if kept := [dots[k] for k in evenly(len(dots), DOTS // len(adding))]:
            series.append(Series(method_name(run, method), method, kept))
    if not series:
        return None
    shown = sum(len(one.points) for one in series)
    note = "One dot for each image and view." if shown == count else f"{shown:,} of {count:,} images and views."
    holes, shares = (
        [100 * float(row.value or 0) for row in paper_rows(label) if (row.dataset, row.metric) == (run.title, metric)]
        for label, metric in (
            ("tab:controlled_disocclusion", "har_before"),
            ("tab:expanded_efficiency_gaussian_overhead", "aux_share"),
        )
    )
    if not run.near and holes:
        points = list(zip(holes, shares, strict=True))
        series.append(Series("Spackle on SHARP (paper), means", "spackle", points, True))
    title, x, y = (
        "Added Gaussians against hole size",
        "hole before, % of the pixels",
        "added Gaussians, % of the base's",
    )
    return _draw(title, series, x, y, lambda axes: (axes.set_xlim(left=0), axes.set_ylim(bottom=0)), note)


def scenes_plot(run: Run, metric: str) -> Plot | None:
    """A figure of each scene by each method, in the order of Spackle, or else of the last method."""
    values = {method: by_image for method in run.methods if (by_image := run.by_image(metric, method))}
    if not values:
        return None
    leader = "spackle" if "spackle" in values else list(values)[-1]
    order = ranked(values[leader], metric)
    names = [order[k] for k in evenly(len(order), SCENES)]
    series = []
    for method, by_image in values.items():
        points = [(by_image[name], float(row)) for row, name in enumerate(names) if name in by_image]
        series.append(Series(method_name(run, method), method, points))

    def finish(axes: Axes) -> None:
        axes.set_yticks(range(len(names)), [_short(name) for name in names])
        axes.set_ylim(len(names) - 0.5, -0.5)

    title, x = SCENE_FIGURES[metric]
    some = f" {len(names)} of {len(order)} scenes, spread evenly." if len(names) < len(order) else ""
    note = f"In the order of {METHODS[leader].title}, best first.{some}"
    return _draw(title, series, x, "", finish, note, HEIGHT / 2 + ROW * len(names))


def _short(name: str) -> str:
    """A name that fits beside its row: names differ at their ends as often as at their beginnings."""
    name, half = UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", name), LETTERS // 2
    return name if len(name) <= LETTERS else f"{name[: half - 1]}…{name[-half:]}"


def ranked(values: Mapping[str, float], metric: str) -> list[str]:
    """Images from best to worst."""
    sign = -1 if metric in UP else 1
    return sorted(values, key=lambda name: (sign * values[name], name))


def evenly(count: int, most: int) -> list[int]:
    """At most so many of so many, evenly, the first and the last among them."""
    if count <= most:
        return list(range(count))
    return [math.floor(k * (count - 1) / max(1, most - 1) + 0.5) for k in range(most)]
