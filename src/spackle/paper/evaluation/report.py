"""An evaluation as one self-contained HTML page with tables, plots and pictures (template: report.html).

matplotlib draws the plots as SVG: holes against disparity, and numbers scene by scene.
"""

from __future__ import annotations

import base64
import importlib.util
import io
import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jinja2 import Environment
from markupsafe import Markup, escape
from PIL import Image

from spackle.paper.evaluation.measurements import (
    IMAGES,
    REMARK,
    Measurement,
    Run,
    mean,
    paper_rows,
    pivot,
    setting_title,
)
from spackle.paper.evaluation.method_descriptions import METHODS
from spackle.paper.evaluation.metrics import METRICS
from spackle.paper.evaluation.pictures import column_title, evenly, kept_pictures, rank, ranked
from spackle.paper.evaluation.protocols import TRUTH
from spackle.paper.evaluation.table import EMPTY, TEXTS, Cells, Table, groups
from spackle.paper.evaluation.tables import grouped, make_tables, method_name
from spackle.runtime.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes

REPORT = "report.html"
MOST, LEAST = 8, 2  # the most images on a page, and the least of each evaluation
# A slider shows the first `MOST_SHOWN` existing pictures of this list, to limit the page's size.
SHOWN = (
    "base",
    "spackle",
    TRUTH,
    "inpaint2d",
    "paper",
    "seeds",
    "direct-ft",
    "spackle-scene",
    "dense",
)
MOST_SHOWN = 6
# The columns of a method's means, in order; a column without numbers is left out.
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr_hole": ("PSNR in the hole ↑", "{:.2f}".format),
    "ssim_hole": ("SSIM in the hole ↑", "{:.4f}".format),
    **{name: (facts.title, facts.text) for name, facts in METRICS.items() if name != "ssim"},
    "har": ("HAR ↓", TEXTS["ratio"]),
    "aux": ("added GS", TEXTS["count"]),
}
RC: Any = {
    "svg.fonttype": "none",  # keep text as text
    "svg.hashsalt": "spackle",  # makes bytes reproducible
    "text.parse_math": False,  # a $ in a scene's name is no formula
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#d5d9de",
    "lines.markersize": 5,
}
WIDTH, HEIGHT = 4.6, 3.4  # size of a plot in inches, about as wide as a phone
ROW = 0.21  # height of a scene's row in inches
SCENES, LETTERS = 30, 14  # the most scenes in a plot, and letters of a scene's name
SCENE_PLOTS = {  # titles of the plot and of its x axis
    "psnr_hole": ("PSNR in the hole, scene by scene", "PSNR (dB), higher is better"),
    "distance": ("Distance in the hole, scene by scene", "distance (0 to 8), lower is better"),
}


def make_report(sources: Sequence[tuple[Run, Path]], *, whole: bool = False) -> str:
    """Make a report as a self-contained HTML page; the same results give the same bytes.

    Args:
        sources: evaluations and benchmarks with joint tables, each with the folder of its pictures.
        whole: see `make_tables`.
    """
    runs, measured = (
        [run for run, _ in sources],
        [source for source in sources if not source[0].timed],
    )
    count = max(LEAST, MOST // max(1, len(measured)))
    text = resources.files("spackle.paper.evaluation").joinpath(REPORT).read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"groups": groups, "bold": _bold}
    page = environment.from_string(text).render(
        title=f"Spackle: evaluation on {', '.join(dict.fromkeys(run.title for run in runs))}",
        parts=[_part(run, folder, count) for run, folder in measured],
        tables=make_tables(runs, whole=whole),
        runs=runs,
        most=MOST,
        least=LEAST,
    )
    return page + "\n"


def _bold(text: str) -> Markup:
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text))))


def _part(run: Run, folder: Path, count: int) -> dict[str, Any]:
    """The page's section on an evaluation, with `count` images, evenly spaced from the worst to the best."""
    ranking = rank(run)
    names, cases = ranking.names[::-1] if ranking else run.measured, []
    for place in evenly(len(names), count):
        pictures = kept_pictures(run, folder, names[place])
        shown = {
            name: pictures[name]
            for name in [name for name in SHOWN if name in pictures][:MOST_SHOWN]
        }
        position = {0: "worst", len(names) - 1: "best"}.get(place, f"{place + 1} of {len(names)}")
        if shown:
            cases.append(
                _case(run, names[place], position if ranking and len(names) > 1 else "", shown)
            )
    return {
        "run": run,
        "paper_images": IMAGES.get(run.title),
        "methods": [method_name(run, method) for method in run.methods],
        "summary": means_table(run, run.rows),
        "plots": plots_of(run),
        "ranking": ranking,
        "cases": cases,
        "remarks": list(
            dict.fromkeys((row.image, row.value) for row in run.rows if row.metric == REMARK)
        ),
    }


def means_table(run: Run, rows: Iterable[Measurement]) -> Table:
    """Means of metrics over a run's images: a row for each method, grouped by setting if there are several settings."""
    values = pivot((row for row in rows if row.metric in COLUMNS), "setting", "method", "metric")
    settings = list(dict.fromkeys(setting for setting, *_ in values))
    keys = [key for key in COLUMNS if any(metric == key for *_, metric in values)]
    bodies: list[list[Cells]] = []
    for setting in settings:
        lines = []
        for method in run.methods:
            means = [mean(values.get((setting, method, key), ())).value for key in keys]
            cells = [
                EMPTY if v is None else COLUMNS[key][1](v)
                for key, v in zip(keys, means, strict=True)
            ]
            lines.append([column_title(run, method), *cells])
        bodies.append(grouped(setting_title(setting), lines) if len(settings) > 1 else list(lines))
    heads = [re.sub(" ([↑↓])", "\N{NO-BREAK SPACE}\\1", COLUMNS[key][0]) for key in keys]
    words = ["", ""][len(settings) == 1 :]
    return Table("", "", "", [("", head) for head in (*words, *heads)], bodies, words=len(words))


def _case(run: Run, name: str, position: str, files: Mapping[str, Path]) -> dict[str, Any]:
    """The page's entry on an image: pictures for the slider, and the numbers of the view in these pictures."""
    setting, view = run.largest_hole(name)
    shown = [row for row in run.rows if (row.image, row.setting, row.view) == (name, setting, view)]
    hole = next(
        (float(row.value) for row in shown if row.metric == "har_before" and row.value is not None),
        None,
    )
    names = list(files)
    left = "base" if "base" in names and len(names) > 1 else names[0]
    with Image.open(files[left]) as image:
        width, height = image.size
    data = {method: base64.b64encode(file.read_bytes()).decode() for method, file in files.items()}
    return {
        "name": name,
        "position": position,
        "setting": setting,
        "view": view,
        "hole": None if hole is None else f"{100 * hole:.2g} %",
        "titles": {method: column_title(run, method) for method in names},
        "pictures": {method: f"data:image/webp;base64,{text}" for method, text in data.items()},
        "left": left,
        "right": next((n for n in ("spackle", *reversed(names)) if n in names and n != left), left),
        "width": width,
        "height": height,
        "table": means_table(run, shown),
    }


# --- plots


class Series(NamedTuple):
    """The points of one method in a plot."""

    title: str
    method: str  # a name in `METHODS`
    points: Sequence[tuple[float, float]]
    hollow: bool = False
    line: str = "none"  # or "-" or "--", as in matplotlib


class Plot(NamedTuple):
    """A plot with title and texts."""

    title: str
    alt: str  # text for readers who cannot see the plot
    address: str  # the plot as a data URL
    note: str


def check_matplotlib(option: str) -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError(f"{option}: needs matplotlib: pip install 'spackle-nvs[eval]'")


def plots_of(run: Run) -> list[Plot]:
    """All plots that can be drawn from an evaluation's numbers."""
    made = [scenes_plot(run, metric) for metric in SCENE_PLOTS] if run.near else [holes_plot(run)]
    return [plot for plot in made if plot]


def _draw(
    title: str,
    series: Sequence[Series],
    x: str,
    y: str,
    finish: Callable[[Axes], object],
    note: str = "",
    height: float = HEIGHT,
) -> Plot:
    """Plot series as an SVG file `height` inches high, with axes titled `x` and `y`; `finish` sets scales and ticks."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(RC), warnings.catch_warnings():
        # matplotlib warns about letters without a glyph; the browser's font has these letters.
        warnings.simplefilter("ignore")
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes = figure.subplots()
        for one in series:
            color, form = METHODS[one.method].color, METHODS[one.method].marker
            places = ([p[0] for p in one.points], [p[1] for p in one.points])
            face = "white" if one.hollow else color
            axes.plot(*places, form, color=color, ls=one.line, mfc=face, alpha=0.8, label=one.title)
        axes.set(xlabel=x, ylabel=y)
        finish(axes)
        figure.legend(loc="outside lower left", frameon=False, ncols=1)
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    address = f"data:image/svg+xml;base64,{base64.b64encode(file.getvalue()).decode()}"
    return Plot(title, f"{title}. {', '.join(one.title for one in series)}", address, note)


def holes_plot(run: Run) -> Plot | None:
    """HAR against disparity, before and after completion, with the paper's values; None if nothing was measured."""

    def means(rows: Iterable[Measurement], metric: str, method: str) -> list[tuple[float, float]]:
        chosen = (
            row
            for row in rows
            if (row.method, row.metric, row.dataset) == (method, metric, run.title)
        )
        by_setting = {
            float(setting): mean(values).value
            for (setting,), values in pivot(chosen, "setting").items()
        }
        return [(move, value) for move, value in sorted(by_setting.items()) if value is not None]

    papers, theirs = paper_rows("tab:controlled_disocclusion"), "Spackle on SHARP (paper)"
    series = [
        Series(
            f"before: {run.base} alone",
            "base",
            means(run.rows, "har_before", run.methods[0]),
            line="--",
        )
    ]
    filling = [method for method in run.methods if method != "base"]
    series += [
        Series(f"after: {method_name(run, m)}", m, means(run.rows, "har", m), line="-")
        for m in filling
    ]
    series.append(
        Series("before: SHARP (paper)", "base", means(papers, "har_before", theirs), True, "--")
    )
    series.append(Series(f"after: {theirs}", "spackle", means(papers, "har", theirs), True, "-"))
    series = [one for one in series if one.points]
    values = [value for one in series for _, value in one.points]
    positive = [value for value in values if value > 0]

    def finish(axes: Axes) -> None:
        """Set a logarithmic y axis; if a HAR is zero, the axis is linear near zero."""
        if len(positive) == len(values):
            axes.set_yscale("log")
        elif positive:
            axes.set_yscale("symlog", linthresh=10.0 ** math.floor(math.log10(min(positive))))
            axes.set_ylim(bottom=0)
        axes.set_xticks(sorted({move for one in series for move, _ in one.points}))
        axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")

    title, y = "Hole Area Ratio against disparity", "HAR, share of the pixels"
    return _draw(title, series, "disparity of the view", y, finish) if series else None


def scenes_plot(run: Run, metric: str) -> Plot | None:
    """A metric of each scene by each method; scenes are ranked by the method spackle, or else the last method."""
    values = {
        method: by_image for method in run.methods if (by_image := run.by_image(metric, method))
    }
    if not values:
        return None
    leader = "spackle" if "spackle" in values else list(values)[-1]
    order = ranked(values[leader], metric)
    names = [order[k] for k in evenly(len(order), SCENES)]
    series = []
    for method, by_image in values.items():
        points = [
            (by_image[name], float(row)) for row, name in enumerate(names) if name in by_image
        ]
        series.append(Series(method_name(run, method), method, points))

    def finish(axes: Axes) -> None:
        axes.set_yticks(range(len(names)), [_short(name) for name in names])
        axes.set_ylim(len(names) - 0.5, -0.5)

    title, x = SCENE_PLOTS[metric]
    some = (
        f" {len(names)} of {len(order)} scenes, spread evenly." if len(names) < len(order) else ""
    )
    note = f"In the order of {METHODS[leader].title}, best first.{some}"
    return _draw(title, series, x, "", finish, note, HEIGHT / 2 + ROW * len(names))


def _short(name: str) -> str:
    """Shorten a name in its middle, because names may differ at both ends."""
    half = LETTERS // 2
    return name if len(name) <= LETTERS else f"{name[: half - 1]}…{name[-half:]}"
