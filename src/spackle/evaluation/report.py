"""An evaluation on one page for a browser: tables, plots and pictures; it fetches nothing (template: report.html).

The plots are SVG files that matplotlib draws: holes against the move, Gaussians against holes, scene by scene.
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

from spackle.errors import InputError
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.pictures import (
    LARGE_SIDE,
    Ranking,
    column_title,
    encode,
    evenly,
    kept_pictures,
    rank,
    ranked,
)
from spackle.evaluation.protocols import TRUTH
from spackle.evaluation.rows import IMAGES, REMARK, Row, Run, mean, paper_rows, pivot, setting_title
from spackle.evaluation.table import EMPTY, TEXTS, Cells, Table, groups
from spackle.evaluation.tables import grouped, make_tables, method_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes

REPORT = "report.html"
MOST = 8  # images of a page in their full size
LEAST = 2  # of each evaluation, however many there are
# A slider has the first of these that there are: all methods of all images would make a page too large.
SHOWN = ("base", "spackle", TRUTH, "inpaint2d", "paper", "seeds", "direct-ft", "spackle-scene", "dense")
MOST_SHOWN = 6
# Of a method, in this order, where they were measured.
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr_hole": ("PSNR in the hole ↑", "{:.2f}".format),
    "ssim_hole": ("SSIM in the hole ↑", "{:.4f}".format),
    **{name: (figure.title, figure.text) for name, figure in METRICS.items() if name != "ssim"},
    "har": ("HAR ↓", TEXTS["ratio"]),
    "aux": ("added GS", TEXTS["count"]),
}
Source = tuple[Run, Path]  # an evaluation, and the folder with its pictures
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
# Characters that neither HTML nor XML may hold; names of files may.
UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
SCENE_FIGURES = {  # titles of the plot and of its axis
    "psnr_hole": ("PSNR in the hole, scene by scene", "PSNR (dB), higher is better"),
    "distance": ("Distance in the hole, scene by scene", "distance (0 to 8), lower is better"),
}


def make_report(sources: Sequence[Source], *, whole: bool = False) -> str:
    """A report as HTML: one file that needs nothing else, the same bytes for the same results.

    `sources` are one or more evaluations and benchmarks whose tables go together; `whole`: see `make_tables`.
    """
    runs, measured = [run for run, _ in sources], [source for source in sources if not source[0].timed]
    count = max(LEAST, MOST // max(1, len(measured)))
    many = max(1.0, count * len(measured) / MOST)  # whose pictures are smaller, so that the page is not larger
    side = round(LARGE_SIDE / math.sqrt(many))
    text = resources.files("spackle.evaluation").joinpath(REPORT).read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"groups": groups, "bold": _bold}
    page = environment.from_string(text).render(
        title=f"Spackle: evaluation on {', '.join(dict.fromkeys(run.title for run in runs))}",
        parts=[_part(run, folder, count, side) for run, folder in measured],
        tables=make_tables(runs, whole=whole),
        runs=runs,
        most=MOST,
        least=LEAST,
        side=side,
    )
    return UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", page) + "\n"


def _bold(text: str) -> Markup:
    """What stands between ** is bold."""
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text))))


def _part(run: Run, folder: Path, count: int, side: int) -> dict[str, Any]:
    """The page's section of an evaluation, with a limited number of images and picture size."""
    ranking = rank(run)
    return {
        "run": run,
        "paper_images": IMAGES.get(run.title),
        "methods": [method_name(run, method) for method in run.methods],
        "summary": figures_table(run, run.rows),
        "plots": plots_of(run),
        "ranking": ranking,
        "cases": _cases(run, folder, ranking, count, side),
        "remarks": [(row.image, row.value) for row in run.rows if row.metric == REMARK],
    }


def figures_table(run: Run, rows: Iterable[Row]) -> Table:
    """Means over a run: a line for each method, and for each of several settings."""
    values = pivot((row for row in rows if row.metric in COLUMNS), "setting", "method", "metric")
    settings = list(dict.fromkeys(setting for setting, *_ in values))
    keys = [key for key in COLUMNS if any(metric == key for *_, metric in values)]
    bodies: list[list[Cells]] = []
    for setting in settings:
        lines = []
        for method in run.methods:
            means = [mean(values.get((setting, method, key), ())).value for key in keys]
            cells = [EMPTY if v is None else COLUMNS[key][1](v) for key, v in zip(keys, means, strict=True)]
            lines.append([column_title(run, method), *cells])
        bodies.append(grouped(setting_title(setting), lines) if len(settings) > 1 else list(lines))
    heads = [re.sub(" ([↑↓])", "\N{NO-BREAK SPACE}\\1", COLUMNS[key][0]) for key in keys]
    words = ["", ""][len(settings) == 1 :]
    return Table("", "", "", [("", head) for head in (*words, *heads)], bodies, words=len(words))


def _percent(share: float) -> str:
    """A number with as many digits as show its value."""
    return "0 %" if share == 0 else f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.1g} %"


def _cases(run: Run, folder: Path, ranking: Ranking | None, count: int, side: int) -> list[dict[str, Any]]:
    """Images from the worst to the best, evenly between them; without those that have no pictures."""
    names = ranking.names[::-1] if ranking else run.measured
    cases = []
    for place in evenly(len(names), count):
        name, last = names[place], len(names) - 1
        files = kept_pictures(run, folder, name)
        pictures = {shown: _small(files[shown], side) for shown in [one for one in SHOWN if one in files][:MOST_SHOWN]}
        position = {0: "worst", last: "best"}.get(place, f"{place + 1} of {len(names)}") if ranking and last else ""
        if pictures:
            cases.append(_case(run, name, position, pictures))
    return cases


def _small(path: Path, side: int) -> bytes:
    """A picture as WebP, of at most the given width and height."""
    with Image.open(path) as image:
        if max(image.size) <= side:
            return path.read_bytes()
        small = image.convert("RGB")
    small.thumbnail((side, side))
    return encode(small)


def _case(run: Run, name: str, place: str, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """An image: its pictures one over the other, and the figures of the view that they show."""
    setting, view = run.largest_hole(name)
    shown = [row for row in run.rows if (row.image, row.setting, row.view) == (name, setting, view)]
    hole = next((float(row.value) for row in shown if row.metric == "har_before" and row.value is not None), None)
    names = list(pictures)
    left = "base" if "base" in names and len(names) > 1 else names[0]
    with Image.open(io.BytesIO(pictures[left])) as image:
        width, height = image.size
    return {
        "name": name,
        "place": place,
        "setting": setting,
        "view": view,
        "hole": None if hole is None else _percent(hole),
        "titles": {method: column_title(run, method) for method in names},
        "pictures": {m: f"data:image/webp;base64,{base64.b64encode(data).decode()}" for m, data in pictures.items()},
        "left": left,
        "right": next((n for n in ("spackle", *reversed(names)) if n in names and n != left), left),
        "width": width,
        "height": height,
        "table": figures_table(run, shown),
    }


# --- plots


class Series(NamedTuple):
    """Points of one method."""

    title: str
    method: str  # of `METHODS`
    points: Sequence[tuple[float, float]]
    hollow: bool = False
    line: str = "none"  # or "-", "--"


class Plot(NamedTuple):
    """A plot and its title."""

    title: str
    alt: str  # for those who do not see it
    svg: bytes
    note: str

    @property
    def address(self) -> str:
        """The plot as a data URL."""
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
        """Set ticks at decades; holes of zero are drawn at the foot of the axis."""
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
    values, series, count = pivot(run.rows, "metric", "method", "image", "setting", "view"), list[Series](), 0
    adding = [name for name in run.methods if name != "base" and any(key[:2] == ("aux_share", name) for key in values)]
    for method in adding:
        shares = {key[1:]: share for key, (share, *_) in values.items() if key[:2] == ("aux_share", method)}
        pairs = [(values[("har_before", *view)][0], share) for view, share in shares.items()]
        known = [(one, two) for one, two in pairs if one is not None and two is not None]
        dots = [(100 * float(one), 100 * float(two)) for one, two in known]
        count += len(dots)
        kept = [dots[k] for k in evenly(len(dots), DOTS // len(adding))]
        series += [Series(method_name(run, method), method, kept)] if kept else []
    if not series:
        return None
    shown = sum(len(one.points) for one in series)
    note = "One dot for each image and view." if shown == count else f"{shown:,} of {count:,} images and views."
    papers = {"har_before": "tab:controlled_disocclusion", "aux_share": "tab:expanded_efficiency_gaussian_overhead"}
    holes, shares_of_paper = (
        [100 * float(row.value or 0) for row in paper_rows(label) if (row.dataset, row.metric) == (run.title, metric)]
        for metric, label in papers.items()
    )
    if not run.near and holes:
        points = list(zip(holes, shares_of_paper, strict=True))
        series.append(Series("Spackle on SHARP (paper), means", "spackle", points, True))
    title, x = "Added Gaussians against hole size", "hole before, % of the pixels"
    y = "added Gaussians, % of the base's"
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
    """A name shortened in its middle, because names differ at their ends as often as at their beginnings."""
    name, half = UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", name), LETTERS // 2
    return name if len(name) <= LETTERS else f"{name[: half - 1]}…{name[-half:]}"
