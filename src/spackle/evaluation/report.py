"""An evaluation on one page for a browser: tables, plots and pictures; it fetches nothing (template: report.html)."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment
from markupsafe import Markup, escape
from PIL import Image

from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.pictures import LARGE_SIDE, Ranking, column_title, encode, kept_pictures, rank
from spackle.evaluation.plots import UNPRINTABLE, evenly, plots_of
from spackle.evaluation.protocols import TRUTH
from spackle.evaluation.rows import IMAGES, NEAR, REMARK, Run, mean
from spackle.evaluation.table import EMPTY, TEXTS, Table, groups
from spackle.evaluation.tables import make_tables, method_name

REPORT = "report.html"
SMALLER = (720, 540, 400)  # where they would be too many bytes
BUDGET = 7_500_000  # characters of all pictures of a page
MOST = 8  # images of a page
LEAST = 2  # of each evaluation, however many there are
# A slider has the first of these that there are: all methods of all images would make a page too large.
SHOWN = ("base", "spackle", TRUTH, "inpaint2d", "paper", "seeds", "direct-ft", "spackle-scene", "dense")
MOST_SHOWN = 6
HEADLINES = {  # figures of near views: what they are, their unit, digits
    "psnr_hole": ("PSNR in the hole, higher is better", " dB", 2),
    "distance": ("Masked perceptual distance in the hole, lower is better", "", 3),
}
# Columns beside a picture, in this order, where they were measured.
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr_hole": ("PSNR in the hole ↑", "{:.2f}".format),
    "ssim_hole": ("SSIM in the hole ↑", "{:.4f}".format),
    **{name: (figure.title, figure.text) for name, figure in METRICS.items() if name != "ssim"},
    "har": ("HAR ↓", TEXTS["ratio"]),
    "aux": ("added GS", TEXTS["count"]),
}
Source = tuple[Run, Path]  # an evaluation, and the folder with its pictures


def make_report(sources: Sequence[Source], *, whole: bool = False) -> str:
    """A report as HTML: one file that needs nothing else, the same bytes for the same results.

    `sources` are one or more evaluations and benchmarks whose tables go together; `whole`: see `make_tables`.
    """
    runs = [run for run, _ in sources]
    text = resources.files("spackle.evaluation").joinpath(REPORT).read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"groups": groups, "bold": _bold}
    page = environment.from_string(text).render(
        title=f"Spackle: evaluation on {', '.join(dict.fromkeys(run.title for run in runs))}",
        parts=_parts([(run, folder) for run, folder in sources if not run.timed]),
        tables=make_tables(runs, whole=whole),
        runs=runs,
        most=MOST,
        least=LEAST,
        side=LARGE_SIDE,
    )
    return UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", page) + "\n"


def _bold(text: str) -> Markup:
    """What stands between ** is bold."""
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text))))


def _parts(sources: Sequence[Source]) -> list[dict[str, Any]]:
    """What the page has of each evaluation."""
    count = max(LEAST, MOST // max(1, len(sources)))
    rankings = [rank(run) for run, _ in sources]
    picked = [_pick(*source, ranking, count) for source, ranking in zip(sources, rankings, strict=True)]
    fits = iter(fitting([pictures for cases in picked for _, _, pictures in cases]))
    return [
        {
            "run": run,
            "paper_images": IMAGES.get(run.title),
            "methods": [method_name(run, method) for method in run.methods],
            "findings": findings(run),
            "plots": plots_of(run),
            "ranking": ranking,
            "cases": [_case(run, name, place, next(fits)) for name, place, _ in cases],
            "remarks": [(row.image, row.value) for row in run.rows if row.metric == REMARK],
        }
        for (run, _), ranking, cases in zip(sources, rankings, picked, strict=True)
    ]


def findings(run: Run) -> list[str]:
    """What an evaluation found, in sentences, from means over all views."""

    def mean_of(metric: str, method: str, setting: str) -> float | None:
        rows = (row for row in run.rows if (row.metric, row.method, row.setting) == (metric, method, setting))
        return mean([row.value for row in rows]).value

    lines = []
    for metric, (what, unit, digits) in HEADLINES.items() if run.near else ():
        means = {method: mean_of(metric, method, NEAR) for method in run.methods}
        texts = [f"{METHODS[method].title} {v:.{digits}f}{unit}" for method, v in means.items() if v is not None]
        lines += [f"{what}: {', '.join(texts)}."] if texts else []
    adding = {row.method for row in run.rows if row.metric == "aux"} - {"base"}
    for method in [name for name in run.methods if name in adding and not run.near][:1]:
        for setting in run.settings:
            figures = [mean_of(name, method, setting) for name in ("har_before", "har", "aux_share", "aux")]
            before, after, share, added = (value or 0.0 for value in figures)
            lines.append(
                f"At disparity {setting} the base alone leaves {_percent(before)} of the pixels open, "
                f"{METHODS[method].title} {_percent(after)}, with {TEXTS['count'](added)} added Gaussians a view "
                f"({_percent(share)} of the base's)."
            )
    return lines


def _percent(share: float) -> str:
    """With as many digits as it takes to see it."""
    return "0 %" if share == 0 else f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.1g} %"


def _pick(run: Run, folder: Path, ranking: Ranking | None, count: int) -> list[tuple[str, str, dict[str, bytes]]]:
    """Images from the worst to the best, evenly between them: name, place in the ranking, WebP by method.

    Those without pictures are left out.
    """
    names = ranking.names[::-1] if ranking else run.measured
    cases = []
    for place in evenly(len(names), count):
        name, last = names[place], len(names) - 1
        files = kept_pictures(run, folder, name)
        wanted = [method for method in SHOWN if method in files][:MOST_SHOWN]
        position = {0: "worst", last: "best"}.get(place, f"{place + 1} of {len(names)}") if ranking and last else ""
        if wanted:
            cases.append((name, position, {method: files[method].read_bytes() for method in wanted}))
    return cases


def _case(run: Run, name: str, place: str, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """An image: its pictures one over the other, and the figures of the view that they show."""
    setting, view = run.largest_hole(name)
    shown = [row for row in run.rows if (row.image, row.setting, row.view) == (name, setting, view)]
    figures = {(row.method, row.metric): float(row.value) for row in shown if row.value is not None}
    hole = next((value for (_, metric), value in figures.items() if metric == "har_before"), None)
    names = list(pictures)
    left = "base" if "base" in names and len(names) > 1 else names[0]
    with Image.open(io.BytesIO(pictures[left])) as image:
        width, height = image.size
    keys = [key for key in COLUMNS if any(metric == key for _, metric in figures)]
    rows = []
    for method in run.methods:
        values = [(COLUMNS[key][1], figures.get((method, key))) for key in keys]
        rows.append((column_title(run, method), *(EMPTY if v is None else text(v) for text, v in values)))
    heads = ["", *(re.sub(" ([↑↓])", "\N{NO-BREAK SPACE}\\1", COLUMNS[key][0]) for key in keys)]
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
        "table": Table("", "", "", [("", head) for head in heads], [rows]),
    }


def fitting(cases: Sequence[Mapping[str, bytes]]) -> list[dict[str, bytes]]:
    """The same pictures, all of them smaller where they are too many bytes together."""

    def shrunk(data: bytes, side: int) -> bytes:
        with Image.open(io.BytesIO(data)) as image:
            small = image.convert("RGB")
        small.thumbnail((side, side))
        return encode(small)

    fits = [dict(case) for case in cases]
    for side in SMALLER:
        if sum(len(data) * 4 // 3 for case in fits for data in case.values()) <= BUDGET:
            break
        fits = [{name: shrunk(data, side) for name, data in case.items()} for case in cases]
    return fits
