"""Before and after: an image of an evaluation, two pictures one over the other with a slider between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from spackle.evaluation.metrics import METRICS
from spackle.evaluation.report.markup import Html, joined, tag
from spackle.evaluation.report.pictures import data_address, size_of
from spackle.evaluation.report.summary import percent
from spackle.evaluation.results import Record, Row, Run
from spackle.evaluation.sheets import column_title
from spackle.evaluation.tables import ratio_text

# Columns beside a picture, in this order, where they were measured.
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr_hole": ("PSNR in the hole ↑", "{:.2f}".format),
    "ssim_hole": ("SSIM in the hole ↑", "{:.4f}".format),
    **{name: (figure.title, figure.text) for name, figure in METRICS.items() if name != "ssim"},
    "har": ("HAR ↓", ratio_text),
    "aux": ("added GS", "{:,.0f}".format),
}


def case_html(run: Run, record: Record, place: str, pictures: Mapping[str, bytes]) -> Html:
    """An image: its slider, and its figures."""
    shown = record.facts["shown"]
    rows = [row for row in record.rows if (row.setting, row.view) == (shown["setting"], shown["view"])]
    setting = "near view" if run.near else f"disparity {shown['setting']}"
    hole = next((row.figures.get("har_before") for row in rows), None)
    about = f"{setting}, {shown['view']}" + (f"; the base leaves {percent(hole)} open" if hole is not None else "")
    titles = {name: column_title(run, name) for name in pictures}
    return tag(
        "article",
        tag("h4", record.name, " ", tag("span", place, class_="place")),
        tag("p", about),
        tag("div", _slider(record.name, titles, pictures), _figures(titles, run, rows), class_="pair"),
        class_="case",
    )


def _slider(name: str, titles: Mapping[str, str], pictures: Mapping[str, bytes]) -> Html:
    """All pictures over each other; two of them are to be seen, to the left and to the right of the slider."""
    names = list(pictures)
    left = "base" if "base" in pictures and len(names) > 1 else names[0]
    right = next((n for n in ("spackle", *reversed(names)) if n in pictures and n != left), left)
    width, height = size_of(pictures[left])
    layers = []
    for key, data in pictures.items():
        image = tag("img", src=data_address(data), alt=f"{name}: {titles[key]}", width=width, height=height)
        sides = " ".join(side for side, of in (("left", left), ("right", right)) if of == key)
        layers.append(tag("figure", image, tag("figcaption", titles[key]), class_=f"layer {sides}".strip()))
    grip = tag(
        "input", type="range", min="0", max="100", step="0.5", value="50",
        aria_label=f"{name}: how far the left picture reaches, in percent",
    )  # fmt: skip
    stage = tag("div", *layers, tag("i", aria_hidden="true"), grip, class_="stage", style=f"--ratio:{width}/{height}")
    choices = [_choice("left", left, titles), _choice("right", right, titles)]
    return tag("div", stage, tag("p", *choices, class_="sides"), class_="slider")


def _choice(side: str, now: str, titles: Mapping[str, str]) -> Html:
    """Which picture is on a side."""
    options = [
        tag("option", title, value=number, selected=name == now) for number, (name, title) in enumerate(titles.items())
    ]
    return tag("label", f"{side} ", tag("select", *options, data_side=side))


def _figures(titles: Mapping[str, str], run: Run, rows: Sequence[Row]) -> Html:
    """A row for each method, a column for each figure that was measured."""
    by_method = {row.method: row.figures for row in rows}
    keys = [key for key in COLUMNS if any(figures.get(key) is not None for figures in by_method.values())]
    head = tag("tr", tag("td"), *(tag("th", _head(COLUMNS[key][0]), scope="col") for key in keys))
    lines = []
    for method in (name for name in run.methods if name in by_method):
        values = [by_method[method].get(key) for key in keys]
        texts = ["" if v is None else COLUMNS[key][1](v) for key, v in zip(keys, values, strict=True)]
        name = tag("th", titles.get(method) or column_title(run, method), scope="row")
        lines.append(tag("tr", name, *(tag("td", text) for text in texts)))
    table = tag("table", tag("thead", head), tag("tbody", joined(lines)))
    return tag("div", table, class_="scroll", tabindex="0", role="region", aria_label="figures of this view")


def _head(title: str) -> str:
    """An arrow stays beside the last word."""
    return title.replace(" ↑", "\N{NO-BREAK SPACE}↑").replace(" ↓", "\N{NO-BREAK SPACE}↓")
