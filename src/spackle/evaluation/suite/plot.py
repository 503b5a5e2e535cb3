"""Scaling as a picture of its own, to lie beside the Markdown."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spackle.evaluation.plots import Series, draw
from spackle.evaluation.suite.scaling import GAUSSIANS, PIXELS
from spackle.evaluation.suite.values import Found

if TYPE_CHECKING:
    from spackle.evaluation.plots import Axes

STYLES = {GAUSSIANS: "spackle", PIXELS: "direct-ft"}  # of the report's methods


def scaling_svg(found: Found) -> str:
    """Time against the share of the full size, both axes logarithmic; the exponents stand in the legend."""
    series = []
    for what, style in STYLES.items():
        sizes = found.facts[what]
        points = [(size / sizes[-1], found.row(f"{size:,} {what}").median) for size in sizes]
        slope = found.row(f"exponent of {what}").median
        series.append(Series(f"{what}, up to {sizes[-1]:,}: exponent {slope:.2f}", style, points, line="-"))

    def finish(axes: Axes) -> None:
        axes.set(xscale="log", yscale="log", title="Time of a whole call")

    return draw(series, "share of the full size", "milliseconds", finish).decode()
