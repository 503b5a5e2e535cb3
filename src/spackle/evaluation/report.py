"""An evaluation as one page for a browser: tables, plots and pictures, with nothing to fetch from anywhere."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment
from PIL import Image
from torch import Tensor

from spackle.color import to_bytes
from spackle.evaluation.folder import image_file
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.plots import UNPRINTABLE, evenly, plots_of
from spackle.evaluation.protocols import TRUTH
from spackle.evaluation.rows import IMAGES, NEAR, REMARK, Run, mean
from spackle.evaluation.sheets import Ranking, column_title, columns, rank
from spackle.evaluation.table import EMPTY, TEXTS, Table, write_table
from spackle.evaluation.tables import make_tables, method_name
from spackle.files import atomic_path
from spackle.formats.png import thumbnail

REPORT = "report.html"
SIDE = 960  # pixels of a picture's longer side at most
SMALLER = (720, 540, 400)  # where they would be too many bytes
BUDGET = 7_500_000  # characters of all pictures of a page
QUALITY = 85  # of WebP
MOST = 8  # images of a page
LEAST = 2  # of each evaluation, however many there are
# A slider has the first of these that there are: all methods of all images would make a page too large.
SHOWN = ("base", "spackle", TRUTH, "inpaint2d", "network", "seeds", "direct-ft", "spackle-scene", "dense")
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


class ShownImage(NamedTuple):
    """An image of the page."""

    name: str
    place: str  # which of how many it is, where they are ranked
    pictures: Mapping[str, bytes]  # method to WebP


def make_report(sources: Sequence[Source]) -> str:
    """A report as HTML: one file that needs nothing else, the same bytes for the same results.

    `sources` are one or more evaluations and benchmarks whose tables go together.
    """
    runs = [run for run, _ in sources]
    text = resources.files("spackle.evaluation").joinpath(REPORT).read_text(encoding="utf-8")
    template = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(text)
    page = template.render(
        title=f"Spackle: evaluation on {', '.join(dict.fromkeys(run.title for run in runs))}",
        parts=_parts([(run, folder) for run, folder in sources if not run.timed]),
        tables=[(table, write_table(table, "html")) for table in make_tables(runs)],
        runs=runs,
        most=MOST,
        least=LEAST,
        side=SIDE,
    )
    return UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", page) + "\n"


def _parts(sources: Sequence[Source]) -> list[dict[str, Any]]:
    """What the page has of each evaluation."""
    count = max(LEAST, MOST // max(1, len(sources)))
    rankings = [rank(run) for run, _ in sources]
    picked = [_pick(*source, ranking, count) for source, ranking in zip(sources, rankings, strict=True)]
    fits = iter(fitting([case.pictures for cases in picked for case in cases]))
    return [
        {
            "run": run,
            "paper_images": IMAGES.get(run.title),
            "methods": [method_name(run, method) for method in run.methods],
            "findings": findings(run),
            "plots": plots_of(run),
            "ranking": ranking,
            "cases": [_case(run, case._replace(pictures=next(fits))) for case in cases],
            "remarks": [(row.image, row.value) for row in run.rows if row.metric == REMARK],
        }
        for (run, _), ranking, cases in zip(sources, rankings, picked, strict=True)
    ]


def findings(run: Run) -> list[str]:
    """What an evaluation found, in sentences, from means over all views."""

    def mean_of(metric: str, method: str, setting: str) -> float | None:
        own = (row for row in run.rows if (row.metric, row.method, row.setting) == (metric, method, setting))
        return mean([row.value for row in own]).value

    lines = []
    for metric, (what, unit, digits) in HEADLINES.items() if run.near else ():
        means = {method: mean_of(metric, method, NEAR) for method in run.methods}
        texts = [f"{METHODS[method][0]} {v:.{digits}f}{unit}" for method, v in means.items() if v is not None]
        lines += [f"{what}: {', '.join(texts)}."] if texts else []
    adding = {row.method for row in run.rows if row.metric == "aux"} - {"base"}
    for method in [name for name in run.methods if name in adding and not run.near][:1]:
        for setting in run.settings:
            found = [mean_of(name, method, setting) for name in ("har_before", "har", "aux_share", "aux")]
            before, after, share, added = (value or 0.0 for value in found)
            lines.append(
                f"At disparity {setting} the base alone leaves {_percent(before)} of the pixels open, "
                f"{METHODS[method][0]} {_percent(after)}, with {TEXTS['count'](added)} added Gaussians a view "
                f"({_percent(share)} of the base's)."
            )
    return lines


def _percent(share: float) -> str:
    """With as many digits as it takes to see it."""
    return "0 %" if share == 0 else f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.1g} %"


def _pick(run: Run, folder: Path, ranking: Ranking | None, count: int) -> list[ShownImage]:
    """Images from the worst to the best, evenly between them; those without pictures are passed over."""
    names, images = ranking.names[::-1] if ranking else run.measured, run.images
    cases: list[ShownImage] = []
    for place in evenly(len(names), count):
        name, last = names[place], len(names) - 1
        files = {m: image_file(folder, images.index(name), name, f".{m}.webp") for m in columns(run)}
        wanted = [method for method in SHOWN if method in files and files[method].is_file()][:MOST_SHOWN]
        position = {0: "worst", last: "best"}.get(place, f"{place + 1} of {len(names)}") if ranking and last else ""
        cases += (
            [ShownImage(name, position, {method: files[method].read_bytes() for method in wanted})] if wanted else []
        )
    return cases


def _case(run: Run, case: ShownImage) -> dict[str, Any]:
    """An image: its pictures one over the other, and the figures of the view that they show."""
    setting, view = run.largest_hole(case.name)
    own = [row for row in run.rows if (row.image, row.setting, row.view) == (case.name, setting, view)]
    figures = {(row.method, row.metric): float(row.value) for row in own if row.value is not None}
    hole = next((value for (_, metric), value in figures.items() if metric == "har_before"), None)
    names = list(case.pictures)
    left = "base" if "base" in names and len(names) > 1 else names[0]
    with Image.open(io.BytesIO(case.pictures[left])) as image:
        width, height = image.size
    keys = [key for key in COLUMNS if any(metric == key for _, metric in figures)]
    rows = []
    for method in run.methods:
        values = [(COLUMNS[key][1], figures.get((method, key))) for key in keys]
        rows.append((column_title(run, method), *(EMPTY if v is None else text(v) for text, v in values)))
    heads = ["", *(re.sub(" ([↑↓])", "\N{NO-BREAK SPACE}\\1", COLUMNS[key][0]) for key in keys)]
    encoded = {name: base64.b64encode(data).decode() for name, data in case.pictures.items()}
    return {
        "name": case.name,
        "place": case.place,
        "setting": setting,
        "view": view,
        "hole": None if hole is None else _percent(hole),
        "titles": {name: column_title(run, name) for name in names},
        "pictures": {name: f"data:image/webp;base64,{data}" for name, data in encoded.items()},
        "left": left,
        "right": next((n for n in ("spackle", *reversed(names)) if n in names and n != left), left),
        "width": width,
        "height": height,
        "table": write_table(Table("", "", "", [("", head) for head in heads], [rows]), "html"),
    }


def save_picture(picture: Tensor, path: Path) -> None:
    """[H, W, 3] sRGB 0..1 as WebP, smaller where it is large."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode(Image.fromarray(to_bytes(thumbnail(picture, SIDE)).numpy())))


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
