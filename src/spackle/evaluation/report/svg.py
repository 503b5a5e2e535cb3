"""Plots as SVG within the page, whose style sheet colours them: points and lines between two axes, and rows of dots.

A plot is drawn at about the width of a phone, so that its letters are as large there as those of the page.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from spackle.evaluation.report.axes import Axis
from spackle.evaluation.report.markup import Html, escaped, joined, tag

WIDTH, HEIGHT = 360.0, 270.0
RIGHT, TOP, BOTTOM = 16.0, 10.0, 44.0  # margins; the left one is as wide as what stands there
LETTER = 7.6  # of a letter's width, in a wide font
NAMES, ROW = 122.0, 19.0  # of rows of dots: the margin for their names, and their height
SIZE = 4.2  # half a mark's width
LETTERS = 14  # of a row's name

# Outlines of marks within -1..1, of about the same area.
SHAPES = {
    "square": "M-.9-.9H.9V.9H-.9Z",
    "diamond": "M0-1.25 1.25 0 0 1.25-1.25 0Z",
    "up": "M0-1.2 1.15.9H-1.15Z",
    "down": "M0 1.2 1.15-.9H-1.15Z",
    "plus": "M-.4-1.2H.4V-.4H1.2V.4H.4V1.2H-.4V.4H-1.2V-.4H-.4Z",
    "bar": "M-.45-1.3H.45V1.3H-.45Z",
    "circle": "M-1 0A1 1 0 1 1 1 0A1 1 0 1 1-1 0Z",
}


@dataclasses.dataclass(frozen=True)
class Point:
    x: float
    y: float  # in rows of dots: the row's number
    says: str = ""  # when it is pointed at


@dataclasses.dataclass(frozen=True)
class Series:
    """Points that look alike; form tells them apart as well as colour does."""

    title: str
    colour: str  # a class of the style sheet
    shape: str  # of `SHAPES`
    points: tuple[Point, ...]
    hollow: bool = False
    line: str = ""  # "", "solid" or "dashed"


def scatter(title: str, x: Axis, y: Axis, series: Sequence[Series], note: str = "") -> Html:
    """Points, and lines through those of a series that has one."""
    left = 24 + LETTER * max(len(text) for _, text in y.ticks)
    right, low = WIDTH - RIGHT, HEIGHT - BOTTOM

    def place(point: Point) -> tuple[float, float]:
        return left + x.at(point.x) * (right - left), low - y.at(point.y) * (low - TOP)

    parts = [_vertical(x, left, right, TOP, low)]
    for value, text in y.ticks:
        height = low - y.at(value) * (low - TOP)
        parts.append(tag("path", d=f"M{left:.1f} {height:.1f}H{right:g}", class_="grid"))
        parts.append(tag("text", text, x=left - 6, y=height + 4, text_anchor="end"))
    middle = (TOP + low) / 2
    parts.append(tag("text", y.title, transform=f"translate(11 {middle:g}) rotate(-90)", text_anchor="middle"))
    for one in series:
        parts += [_line(one, [place(p) for p in one.points]), *(_mark(one, p, *place(p)) for p in one.points)]
    return _figure(title, joined(parts), HEIGHT, series, note)


def dot_rows(title: str, x: Axis, rows: Sequence[str], series: Sequence[Series], note: str = "") -> Html:
    """A row for each name; a point's y is its row's number."""
    right, low = WIDTH - RIGHT, TOP + ROW * len(rows)
    parts = [_vertical(x, NAMES, right, TOP, low)]
    for number, name in enumerate(rows):
        height = TOP + ROW * (number + 0.5)
        said = joined([_short(name), tag("title", name)])
        parts.append(tag("path", d=f"M{NAMES:g} {height:.1f}H{right:g}", class_="grid"))
        parts.append(tag("text", said, x=NAMES - 8, y=height + 4, text_anchor="end"))
    for one in series:
        for p in one.points:
            parts.append(_mark(one, p, NAMES + x.at(p.x) * (right - NAMES), TOP + ROW * (p.y + 0.5)))
    return _figure(title, joined(parts), low + BOTTOM, series, note)


def _short(name: str) -> str:
    """What fits into the margin: names differ at their ends as often as at their beginnings."""
    half = LETTERS // 2
    return name if len(name) <= LETTERS else f"{name[: half - 1]}…{name[-half:]}"


def _vertical(x: Axis, left: float, right: float, top: float, low: float) -> Html:
    """Lines at the ticks of the lower axis, their values and its title."""
    parts = []
    for value, text in x.ticks:
        place = left + x.at(value) * (right - left)
        parts.append(tag("path", d=f"M{place:.1f} {top:g}V{low:g}", class_="grid"))
        parts.append(tag("text", text, x=place, y=low + 16, text_anchor="middle"))
    parts.append(tag("text", x.title, x=(left + right) / 2, y=low + 36, text_anchor="middle"))
    return joined(parts)


def _line(one: Series, places: Sequence[tuple[float, float]]) -> Html:
    if not one.line or len(places) < 2:
        return Html("")
    way = " ".join(f"{x:.1f} {y:.1f}" for x, y in places)
    return tag("path", d=f"M{way}", class_=f"line {one.colour} {one.line}")


def _mark(one: Series, point: Point, x: float, y: float) -> Html:
    hint = [tag("title", f"{one.title}: {point.says}")] if point.says else []
    kind = "hollow" if one.hollow else "full"
    move = f"translate({x:.1f} {y:.1f}) scale({SIZE:g})"
    return tag("path", *hint, d=SHAPES[one.shape], transform=move, class_=f"mark {one.colour} {kind}")


def _figure(title: str, inside: Html, height: float, series: Sequence[Series], note: str) -> Html:
    """The drawing below its title, with a legend."""
    said = f"{title}. {', '.join(one.title for one in series)}"
    drawing = tag("svg", inside, viewBox=f"0 0 {WIDTH:g} {height:g}", role="img", aria_label=said, class_="plot")
    keys = []
    for one in series:
        dash = tag("path", d="M0 8H26", class_=f"line {one.colour} {one.line}") if one.line else Html("")
        sign = tag("svg", dash, _mark(one, Point(0, 0), 13, 8), viewBox="0 0 26 16", aria_hidden="true")
        keys.append(tag("li", sign, one.title))
    foot = [tag("p", note, class_="note")] if note else []
    return tag("figure", tag("figcaption", escaped(title)), drawing, tag("ul", *keys, class_="legend"), *foot)


def spread(count: int, most: int) -> list[int]:
    """At most so many of so many, evenly, the first and the last among them."""
    if count <= most:
        return list(range(count))
    if most == 1:
        return [0]
    return [math.floor(k * (count - 1) / (most - 1) + 0.5) for k in range(most)]
