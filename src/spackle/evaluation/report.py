"""An evaluation as one self-contained HTML page with tables, plots and pictures (template: report.html).

matplotlib draws the plots as SVG: holes against disparity, added Gaussians against holes, and figures of scenes.
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
MOST = 8  # how many images a page shows at full size
LEAST = 2  # the least number of images of each evaluation
# A slider shows the first `MOST_SHOWN` of these that exist; all methods would make the page too large.
SHOWN = ("base", "spackle", TRUTH, "inpaint2d", "paper", "seeds", "direct-ft", "spackle-scene", "dense")
MOST_SHOWN = 6
# The columns of a method's figures, in this order; a column is left out if it was not measured.
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr_hole": ("PSNR in the hole ↑", "{:.2f}".format),
    "ssim_hole": ("SSIM in the hole ↑", "{:.4f}".format),
    **{name: (figure.title, figure.text) for name, figure in METRICS.items() if name != "ssim"},
    "har": ("HAR ↓", TEXTS["ratio"]),
    "aux": ("added GS", TEXTS["count"]),
}
Source = tuple[Run, Path]  # an evaluation, and the folder with its pictures
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
DOTS, SCENES = 1000, 30  # at most in a plot, for small pages and legible rows
LETTERS = 14  # at most, in a scene's name
# Characters that file names may have, but HTML and XML may not.
UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
SCENE_FIGURES = {  # titles of the plot and of its x axis
    "psnr_hole": ("PSNR in the hole, scene by scene", "PSNR (dB), higher is better"),
    "distance": ("Distance in the hole, scene by scene", "distance (0 to 8), lower is better"),
}


def make_report(sources: Sequence[Source], *, whole: bool = False) -> str:
    """Make a report as a self-contained HTML page; the same results give the same bytes.

    `sources`: evaluations and benchmarks with joint tables; `whole`: see `make_tables`.
    """
    runs, measured = [run for run, _ in sources], [source for source in sources if not source[0].timed]
    count = max(LEAST, MOST // max(1, len(measured)))
    many = max(1.0, count * len(measured) / MOST)  # with more images than `MOST`, their pictures are smaller
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
    """Make text between ** bold."""
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text))))


def _part(run: Run, folder: Path, count: int, side: int) -> dict[str, Any]:
    """The page's section on an evaluation, with `count` images of at most `side` pixels a side."""
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
    """Means of figures over a run's images: a row for each method, grouped by setting if there are several."""
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
    """A share in percent, with enough digits to be above 0."""
    return "0 %" if share == 0 else f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.1g} %"


def _cases(run: Run, folder: Path, ranking: Ranking | None, count: int, side: int) -> list[dict[str, Any]]:
    """`count` images, evenly spaced from the worst to the best; images without pictures are left out."""
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
    """A picture as WebP, reduced to at most `side` pixels a side."""
    with Image.open(path) as image:
        if max(image.size) <= side:
            return path.read_bytes()
        small = image.convert("RGB")
    small.thumbnail((side, side))
    return encode(small)


def _case(run: Run, name: str, place: str, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """The page's entry on an image: its pictures for the slider, and the figures of the view that they show."""
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
    """The points of one method in a plot."""

    title: str
    method: str  # a name in `METHODS`
    points: Sequence[tuple[float, float]]
    hollow: bool = False
    line: str = "none"  # or "-" or "--", as in matplotlib


class Plot(NamedTuple):
    """A plot with title and texts."""

    title: str
    alt: str  # text for readers who cannot see it
    svg: bytes
    note: str

    @property
    def address(self) -> str:
        """The plot as a data URL."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg).decode()}"


Finish = Callable[["Axes"], object]  # sets the scales and ticks of a plot


def check_matplotlib(option: str) -> None:
    """InputError if matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError(f"{option}: needs matplotlib: pip install 'spackle-nvs[eval]'")


def plots_of(run: Run) -> list[Plot]:
    """The plots of an evaluation for which it has figures."""
    scenes = [scenes_plot(run, metric) for metric in SCENE_FIGURES] if run.near else []
    made = [*([] if run.near else [holes_plot(run)]), overhead_plot(run), *scenes]
    return [plot for plot in made if plot]


def _draw(
    title: str, series: Sequence[Series], x: str, y: str, finish: Finish, note: str = "", height: float = HEIGHT
) -> Plot:
    """Plot series as an SVG file `height` inches high, with axes titled `x` and `y`; equal input gives equal bytes."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(RC), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # matplotlib warns about letters that its font lacks; the browser has them
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
    """HAR against disparity, before and after completion, with the paper's; None if nothing was measured."""

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
        """Set a logarithmic y axis; if a HAR is zero, the axis becomes linear near zero to show it."""
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
    """Added Gaussians against the size of the hole, a dot for each image and view; None if none were counted."""
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
    """A figure of each scene by each method; scenes are ranked by Spackle if it was run, else by the last method."""
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
    """Shorten a name in its middle, because names may differ at the end as well as at the beginning."""
    name, half = UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", name), LETTERS // 2
    return name if len(name) <= LETTERS else f"{name[: half - 1]}…{name[-half:]}"
