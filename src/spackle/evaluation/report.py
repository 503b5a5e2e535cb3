"""An evaluation as one page for a browser: tables, plots and pictures, with nothing to fetch from anywhere."""

from __future__ import annotations

import base64
import dataclasses
import io
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment
from PIL import Image
from torch import Tensor

from spackle.color import to_bytes
from spackle.evaluation import paper
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.plots import UNPRINTABLE, evenly, plots_of
from spackle.evaluation.protocols import NEAR
from spackle.evaluation.results import RESULTS, TIMES, ImageResult, Run, image_file, load_run, read_json
from spackle.evaluation.sheets import TRUTH, Ranking, column_title, columns, rank
from spackle.evaluation.table import BEST, EMPTY, Table
from spackle.evaluation.tables import ADDING, NOT_RUN, PAPER_ROW, count_text, make_tables, method_name, ratio_text
from spackle.files import atomic_path
from spackle.formats.png import thumbnail

REPORT = "report.html"
BENCH = "bench.json"  # of `spackle bench`
SIDE = 960  # pixels of a picture's longer side at most
SMALLER = (720, 540, 400)  # where they would be too many bytes
BUDGET = 7_500_000  # characters of all pictures of a page
QUALITY = 85  # of WebP
MOST = 8  # images of a page
LEAST = 2  # of each evaluation, however many there are
# A slider has the first of these that there are: all methods of all images would make a page too large.
SHOWN = ("base", "spackle", TRUTH, "inpaint2d", "network", "seeds", "direct-ft", "spackle-scene", "dense")
MOST_SHOWN = 6
TITLES = {
    "tab:large_view_nr_iqa": "Quality of large views, without a truth",
    "tab:controlled_disocclusion": "Hole Area Ratio before and after",
    "tab:expanded_efficiency_gaussian_overhead": "Gaussians added and merged",
    "tab:near_view": "Distance from true second photos",
    "tab:near_view_holes": "Against true second photos, in the hole and outside",
    "tab:mask_guided_init": "Dense grid against mask guided",
}
HEADLINES = {  # figures of near views: what they are, their unit, digits
    "psnr_hole": ("PSNR in the hole, higher is better", " dB", 2),
    "distance": ("Masked perceptual distance in the hole, lower is better", "", 3),
}
# Columns beside a picture, in this order, where they were measured.
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr_hole": ("PSNR in the hole ↑", "{:.2f}".format),
    "ssim_hole": ("SSIM in the hole ↑", "{:.4f}".format),
    **{name: (figure.title, figure.text) for name, figure in METRICS.items() if name != "ssim"},
    "har": ("HAR ↓", ratio_text),
    "aux": ("added GS", "{:,.0f}".format),
}


@dataclasses.dataclass(frozen=True)
class ReportSource:
    """An evaluation, and what lies beside its figures."""

    run: Run
    pictures: Callable[[int], Mapping[str, bytes]]  # of the image at that place in `run.records`: method → WebP
    versions: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    machine: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def make_report(sources: Sequence[ReportSource], bench: Mapping[str, Any] | None = None) -> str:
    """A report as HTML: one file that needs nothing else, the same bytes for the same results.

    `sources` are one or more evaluations whose tables go together; of `bench` all but the single images is shown.
    """
    titles = dict.fromkeys(source.run.title for source in sources)
    text = resources.files("spackle.evaluation").joinpath(REPORT).read_text(encoding="utf-8")
    template = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(text)
    page = template.render(
        title=f"Spackle: evaluation on {', '.join(titles)}",
        parts=_parts(sources),
        tables=[_table(table) for table in make_tables([source.run for source in sources])],
        bench={key: value for key, value in (bench or {}).items() if key != "images"},
        best=BEST,
        most=MOST,
        least=LEAST,
        side=SIDE,
        not_run=NOT_RUN,
        paper=PAPER_ROW.format(""),
        columns=lambda rows: dict.fromkeys(key for row in rows for key in row),
    )
    return UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", page) + "\n"


def source_of(run: Run, folder: Path, versions: Mapping[str, Any], machine: Mapping[str, Any]) -> ReportSource:
    """An evaluation for a report, with the pictures in its folder."""

    def pictures(index: int) -> dict[str, bytes]:
        files = {name: image_file(folder, index, run.records[index].name, f".{name}.webp") for name in columns(run)}
        return {name: file.read_bytes() for name, file in files.items() if file.is_file()}

    return ReportSource(run, pictures, versions, machine)


def load_source(folder: Path) -> ReportSource:
    """A finished evaluation for a report; InputError where there is none."""
    run = load_run(folder)
    times = read_json(folder / TIMES) if (folder / TIMES).is_file() else {}
    return source_of(run, folder, read_json(folder / RESULTS).get("versions", {}), times.get("hardware", {}))


def find_bench(folders: Sequence[Path]) -> dict[str, Any] | None:
    """What `spackle bench` wrote into the first of the folders that has it."""
    found = next((folder / BENCH for folder in folders if (folder / BENCH).is_file()), None)
    content = None if found is None else read_json(found)
    return content if isinstance(content, dict) else None


def _parts(sources: Sequence[ReportSource]) -> list[dict[str, Any]]:
    """What the page has of each evaluation."""
    count = max(LEAST, MOST // len(sources))
    rankings = [rank(source.run) for source in sources]
    picked = [_pick(source, ranking, count) for source, ranking in zip(sources, rankings, strict=True)]
    fits = iter(fitting([pictures for cases in picked for _, _, pictures in cases]))
    return [
        {
            "run": source.run,
            "paper_images": paper.IMAGES.get(source.run.title),
            "methods": [method_name(source.run, method) for method in source.run.methods],
            "findings": findings(source.run),
            "plots": plots_of(source.run),
            "ranking": ranking,
            "cases": [_case(source.run, record, place, next(fits)) for record, place, _ in cases],
            "setup": dict(source.run.config) | {"versions": source.versions, "machine": source.machine},
        }
        for source, ranking, cases in zip(sources, rankings, picked, strict=True)
    ]


def findings(run: Run) -> list[str]:
    """What an evaluation found, in sentences, from means over all views."""
    lines = []
    if run.near:
        for figure, (what, unit, digits) in HEADLINES.items():
            means = {method: run.mean(figure, method, NEAR).value for method in run.methods}
            means_text = [f"{METHODS[m].title} {v:.{digits}f}{unit}" for m, v in means.items() if v is not None]
            lines += [f"{what}: {', '.join(means_text)}."] if means_text else []
        return lines
    for method in [name for name in ADDING if name in run.methods][:1]:
        for move in run.config["disparities"]:
            found = [run.mean(name, method, f"{move:g}").value for name in ("har_before", "har", "aux_share", "aux")]
            if None not in found:
                before, after, share, added = (value or 0.0 for value in found)
                lines.append(
                    f"At disparity {move:g} the base alone leaves {_percent(before)} of the pixels open, "
                    f"{METHODS[method].title} {_percent(after)}, with {count_text(added)} added Gaussians a view "
                    f"({_percent(share)} of the base's)."
                )
    return lines


def _percent(share: float) -> str:
    """With as many digits as it takes to see it."""
    return "0 %" if share == 0 else f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.1g} %"


def _table(table: Table) -> dict[str, Any]:
    """A table whose datasets' names stand above their rows: on a phone they cost no width."""
    dropped = table.words - 1
    groups = [(name, count - (0 if k else dropped)) for k, (name, count) in enumerate(table.groups)]
    bodies: list[tuple[str, list[tuple[str, ...]]]] = []
    for line in table.lines:
        if line.rule or not bodies:
            bodies.append((line.cells[0] if dropped else "", []))
        bodies[-1][1].append(line.cells[dropped:])
    return {
        "title": TITLES.get(table.label, table.label),
        "label": table.label,
        "groups": groups if any(name for name, _ in groups) else [],
        "columns": table.columns[dropped:],
        "bodies": bodies,
        "caption": table.caption,
        "notes": table.notes,
    }


Picked = tuple[ImageResult, str, Mapping[str, bytes]]  # an image, which of how many it is, its pictures


def _pick(source: ReportSource, ranking: Ranking | None, count: int) -> list[Picked]:
    """Images from the worst to the best, evenly between them; those without pictures are passed over."""
    records = {record.name: (index, record) for index, record in enumerate(source.run.records)}
    names = ranking.names[::-1] if ranking else [record.name for record in source.run.measured]
    cases: list[Picked] = []
    for place in evenly(len(names), count):
        index, record = records[names[place]]
        pictures = source.pictures(index)
        chosen = {name: pictures[name] for name in [name for name in SHOWN if name in pictures][:MOST_SHOWN]}
        last = len(names) - 1
        position = {0: "worst", last: "best"}.get(place, f"{place + 1} of {len(names)}") if ranking and last else ""
        cases += [(record, position, chosen)] if chosen else []
    return cases


def _case(run: Run, record: ImageResult, place: str, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """An image: its pictures one over the other, and the figures of the view that they show."""
    shown = record.facts["shown"]
    rows = [row for row in record.rows if (row.setting, row.view) == (shown["setting"], shown["view"])]
    by_method = {row.method: row.figures for row in rows}
    hole = next((figures.get("har_before") for figures in by_method.values()), None)
    names = list(pictures)
    left = "base" if "base" in pictures and len(names) > 1 else names[0]
    with Image.open(io.BytesIO(pictures[left])) as image:
        width, height = image.size
    keys = [key for key in COLUMNS if any(figures.get(key) is not None for figures in by_method.values())]
    cells = []
    for method in (name for name in run.methods if name in by_method):
        values = [(COLUMNS[key][1], by_method[method].get(key)) for key in keys]
        cells.append((column_title(run, method), *(EMPTY if v is None else text(v) for text, v in values)))
    return {
        "name": record.name,
        "place": place,
        "shown": shown,
        "hole": None if hole is None else _percent(hole),
        "titles": {name: column_title(run, name) for name in names},
        "pictures": {name: f"data:image/webp;base64,{base64.b64encode(d).decode()}" for name, d in pictures.items()},
        "left": left,
        "right": next((n for n in ("spackle", *reversed(names)) if n in pictures and n != left), left),
        "width": width,
        "height": height,
        "heads": [re.sub(" ([↑↓])", "\N{NO-BREAK SPACE}\\1", COLUMNS[key][0]) for key in keys],
        "rows": cells,
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
