"""An evaluation in pictures: contact sheets, and one page for a browser with tables, plots and pictures.

The page (report.html is its template) fetches nothing from anywhere.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jinja2 import Environment
from markupsafe import Markup, escape
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import pad

from spackle.color import to_bytes
from spackle.evaluation.folder import image_file
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.plots import UNPRINTABLE, evenly, plots_of, ranked
from spackle.evaluation.protocols import TRUTH
from spackle.evaluation.rows import IMAGES, NEAR, REMARK, Run, mean
from spackle.evaluation.table import EMPTY, TEXTS, Table, groups
from spackle.evaluation.tables import make_tables, method_name
from spackle.files import atomic_path
from spackle.formats.png import thumbnail

REPORT, WORST, BEST = "report.html", "worst.png", "best.png"
SIDE = 320  # pixels of a thumbnail's longer side
GAP, LINE = 6, 22  # pixels between pictures, and of a line of text
FONT = 14
CASES = 6
# A sheet is ordered by the first of these that was measured for the method in question.
ORDER = {"near-view": ("distance", "lpips", "psnr_hole"), "large-view": ("clipiqa", "musiq", "har", "har_before")}
NAMES = {"psnr_hole": "PSNR in the hole ↑", "har": "HAR ↓", "har_before": "the base's HAR ↓"}
LARGE_SIDE = 960  # pixels of a picture's longer side at most
SMALLER = (720, 540, 400)  # where they would be too many bytes
BUDGET = 7_500_000  # characters of all pictures of a page
QUALITY = 85  # of WebP
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


class Ranking(NamedTuple):
    """Images from best to worst."""

    names: list[str]
    criterion: str  # what they were ordered by
    values: dict[str, float]


def strip(pictures: Mapping[str, Tensor]) -> Tensor:
    """Thumbnails of one view by each method, and the truth, in a row with gaps: [h, n · (w + GAP), 3]."""
    return torch.cat([pad(thumbnail(p, SIDE), (0, 0, 0, GAP), value=1.0) for p in pictures.values()], dim=1)


def columns(run: Run) -> list[str]:
    """What a strip shows: the methods, and the truth where there is one."""
    return [*run.methods, *([TRUTH] if run.near else [])]


def column_title(run: Run, name: str) -> str:
    """What a picture is called."""
    return TRUTH if name == TRUTH else f"base ({run.base})" if name == "base" else METHODS[name].title


def rank(run: Run) -> Ranking | None:
    """By the method that matters: Spackle if it was run, else the last one. None where nothing was measured."""
    method = "spackle" if "spackle" in run.methods else run.methods[-1]
    for metric in ORDER[str(run.config["protocol"])]:
        if values := run.by_image(metric, method):
            title = METRICS[metric].title if metric in METRICS else NAMES[metric]
            return Ranking(ranked(values, metric), f"{title} of {METHODS[method].title}", values)
    return None


def write_sheets(run: Run, folder: Path) -> None:
    """best.png and worst.png of the strips in a folder; none where nothing was measured."""
    if ranking := rank(run):
        strips = {name: image_file(folder, k, name, ".png") for k, name in enumerate(run.images)}
        for name, order in ((BEST, ranking.names), (WORST, ranking.names[::-1])):
            with atomic_path(folder / name) as temporary:
                sheet(run, ranking, order[:CASES], strips).save(temporary)


def sheet(run: Run, ranking: Ranking, names: Sequence[str], strips: Mapping[str, Path]) -> Image.Image:
    """A row for each image, captioned; a column for each method, and the truth where there is one."""
    pictures = {name: Image.open(strips[name]).convert("RGB") for name in names}
    titles = [column_title(run, name) for name in columns(run)]
    width = max(max(picture.width for picture in pictures.values()), SIDE * 2)
    height = sum(picture.height + LINE + GAP for picture in pictures.values()) + LINE
    canvas = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(canvas)
    title = f"{run.title}, {run.config['protocol']}, by {ranking.criterion}"
    title = title.replace("↑", "(higher is better)").replace("↓", "(lower is better)")  # the font has no arrows
    draw.text((4, 3), title, "black", font_size=FONT)
    y = LINE
    for name in names:
        text = f"{name}, {' '.join(run.largest_hole(name))}: {ranking.values[name]:.4g}"
        draw.text((4, y + 3), text, "black", font_size=FONT)
        canvas.paste(pictures[name], (0, y + LINE))
        for index, title in enumerate(titles):
            at = index * pictures[name].width // len(titles) + 5, y + LINE + 4
            left, top, right, bottom = draw.textbbox(at, title, font_size=FONT)
            draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill="black")
            draw.text(at, title, "white", font_size=FONT)
        y += pictures[name].height + LINE + GAP
    return canvas


# --- the page


def make_report(sources: Sequence[Source]) -> str:
    """A report as HTML: one file that needs nothing else, the same bytes for the same results.

    `sources` are one or more evaluations and benchmarks whose tables go together.
    """
    runs = [run for run, _ in sources]
    text = resources.files("spackle.evaluation").joinpath(REPORT).read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"groups": groups, "bold": _bold}
    page = environment.from_string(text).render(
        title=f"Spackle: evaluation on {', '.join(dict.fromkeys(run.title for run in runs))}",
        parts=_parts([(run, folder) for run, folder in sources if not run.timed]),
        tables=make_tables(runs),
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
    names, images = ranking.names[::-1] if ranking else run.measured, run.images
    cases = []
    for place in evenly(len(names), count):
        name, last = names[place], len(names) - 1
        files = {m: image_file(folder, images.index(name), name, f".{m}.webp") for m in columns(run)}
        wanted = [method for method in SHOWN if method in files and files[method].is_file()][:MOST_SHOWN]
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


def save_picture(picture: Tensor, path: Path) -> None:
    """[H, W, 3] sRGB 0..1 as WebP, smaller where it is large."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode(Image.fromarray(to_bytes(thumbnail(picture, LARGE_SIDE)).numpy())))


def encode(image: Image.Image) -> bytes:
    """As WebP; the same picture gives the same bytes."""
    file = io.BytesIO()
    image.save(file, format="WEBP", quality=QUALITY, method=4)
    return file.getvalue()


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
