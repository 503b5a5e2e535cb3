"""Scaling as a picture of its own, to lie beside the Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from spackle.evaluation.report.axes import Axis
from spackle.evaluation.report.markup import Html, joined, tag
from spackle.evaluation.report.svg import SHAPES, Point, Series, scatter
from spackle.evaluation.suite.scaling import GAUSSIANS, PIXELS
from spackle.evaluation.suite.values import Found

STYLE = """svg{background:#fff}text{fill:#16191d;font:12px system-ui,sans-serif}.grid{stroke:#d5d9de;fill:none}
.line{stroke-width:1.6;fill:none}.mark{stroke-width:1.4;vector-effect:non-scaling-stroke;fill-opacity:.6}
.spackle{stroke:#0072b2}.mark.spackle{fill:#0072b2}.direct-ft{stroke:#d55e00}.mark.direct-ft{fill:#d55e00}"""
FORMS = {GAUSSIANS: ("spackle", "circle"), PIXELS: ("direct-ft", "diamond")}  # colour and shape
TIMES = (1, 2, 5)  # ticks of a decade


def scaling_svg(found: Found) -> str:
    """Time against the share of the full size, both axes logarithmic; the exponents stand in the legend."""
    series = []
    for what, (colour, shape) in FORMS.items():
        sizes = found.facts[what]
        medians = [found.row(f"{size:,} {what}").median for size in sizes]
        points = tuple(
            Point(size / sizes[-1], ms, f"{size:,}: {ms:.3g} ms") for size, ms in zip(sizes, medians, strict=True)
        )
        slope = found.row(f"exponent of {what}").median
        series.append(Series(f"{what}, up to {sizes[-1]:,}: exponent {slope:.2f}", colour, shape, points, line="solid"))
    shares = [point.x for one in series for point in one.points]
    x = _shares(shares)
    y = _milliseconds([point.y for one in series for point in one.points])
    figure = scatter("Time of a whole call", x, y, series)
    start, end = figure.index("<svg"), figure.index("</svg>")
    drawing = figure[start:end].replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg" width="720"', 1)
    return f"{drawing}{tag('style', Html(STYLE))}{_legend(series)}</svg>\n"


def _shares(values: Sequence[float]) -> Axis:
    """Halves of halves."""
    ticks, share = [(1.0, "1")], 2
    while 1 / share > min(values) / 1.2:
        ticks.insert(0, (1 / share, f"1/{share}"))
        share *= 2
    return Axis("share of the full size (logarithmic)", min(values) / 1.15, 1.1, tuple(ticks), log=True)


def _milliseconds(values: Sequence[float]) -> Axis:
    low, high = min(values) / 1.2, max(values) * 1.9  # room for the legend
    places = [step * 10.0**power for power in range(-3, 7) for step in TIMES]
    ticks = tuple((place, f"{place:g}") for place in places if low <= place <= high)
    return Axis("milliseconds (logarithmic)", low, high, ticks, log=True)


def _legend(series: Sequence[Series]) -> Html:
    """A line for each, in the upper left corner of the plot."""
    parts = []
    for row, one in enumerate(series):
        move = f"translate(78 {22 + 16 * row}) scale(4.2)"
        parts.append(tag("path", d=SHAPES[one.shape], transform=move, class_=f"mark {one.colour}"))
        parts.append(tag("text", one.title, x=88, y=26 + 16 * row))
    return joined(parts)
