"""Which plots a report has: holes against the move, Gaussians against holes, scene by scene against the truth."""

from __future__ import annotations

from collections.abc import Iterator

from spackle.evaluation import paper
from spackle.evaluation.methods import METHODS
from spackle.evaluation.report.axes import linear, percent_decades
from spackle.evaluation.report.markup import Html
from spackle.evaluation.report.svg import Point, Series, dot_rows, scatter, spread
from spackle.evaluation.results import Run
from spackle.evaluation.sheets import UP, mean_of
from spackle.evaluation.tables import ADDING, FILLING, method_name, percent_text, ratio_text

FORMS = {
    "base": "circle",
    "spackle": "diamond",
    "spackle-scene": "plus",
    "seeds": "up",
    "dense": "square",
    "inpaint2d": "down",
    "direct-ft": "bar",
}
DOTS, SCENES = 1000, 30  # of a plot at most: pages stay small, rows legible
SCENE_FIGURES = {  # titles of the plot and of its axis
    "psnr_hole": ("PSNR in the hole, scene by scene", "PSNR (dB), higher is better"),
    "distance": ("Distance in the hole, scene by scene", "distance (0 to 8), lower is better"),
}


def plots_of(run: Run) -> list[Html]:
    """The plots of an evaluation that its figures allow."""
    made = [holes_plot(run)] if not run.near else []
    made.append(overhead_plot(run))
    if run.near:
        made += [scenes_plot(run, figure) for figure in SCENE_FIGURES]
    return [plot for plot in made if plot]


def holes_plot(run: Run) -> Html | None:
    """HAR against disparity, before and after; the paper's too."""
    moves = [float(value) for value in run.config["disparities"]]
    series = [_holes(run, "har_before", run.methods[0], f"before: {run.base} alone", "base", "dashed")]
    for method in (name for name in run.methods if name in FILLING):
        series.append(_holes(run, "har", method, f"after: {method_name(run, method)}", method, "solid"))
    series += _paper_holes(run.title)
    series = [one for one in series if one.points]
    if not series:
        return None
    x = linear("disparity of the view", [*moves, *(p.x for one in series for p in one.points)], origin=False)
    y = percent_decades("HAR, % of the pixels (logarithmic)", [p.y for one in series for p in one.points])
    return scatter("Hole Area Ratio against disparity", x, y, series)


def _holes(run: Run, figure: str, method: str, title: str, colour: str, line: str) -> Series:
    means = {m: run.mean(figure, method, f"{m:g}").value for m in sorted(map(float, run.config["disparities"]))}
    points = tuple(Point(m, v, f"{m:g}, {ratio_text(v)}") for m, v in means.items() if v is not None)
    return Series(title, colour, FORMS[colour], points, False, line)


def _paper_holes(title: str) -> list[Series]:
    """The paper's two lines, hollow; none where it does not have the dataset."""
    made = []
    for name, place, colour, line in (
        ("before: SHARP (paper)", 0, "base", "dashed"),
        ("after: Spackle on SHARP (paper)", 1, "spackle", "solid"),
    ):
        found = {move: paper.at(paper.HOLES.get(title), move)[place] for move in paper.DISPARITIES}
        points = (Point(m, v, f"{m:g}, {ratio_text(v)}") for m, v in found.items() if v is not None)
        made.append(Series(name, colour, FORMS[colour], tuple(points), True, line))
    return made


def overhead_plot(run: Run) -> Html | None:
    """Added Gaussians against the size of the hole: a dot for each image and view."""
    series, all_dots = [], 0
    for method in (name for name in run.methods if name in ADDING):
        dots = list(_overheads(run, method))
        all_dots += len(dots)
        kept = tuple(dots[k] for k in spread(len(dots), DOTS // len(ADDING)))
        series.append(Series(method_name(run, method), method, FORMS[method], kept))
    series = [one for one in series if one.points]
    if not series:
        return None
    shown = sum(len(one.points) for one in series)
    note = "One dot for each image and view." if shown == all_dots else f"{shown:,} of {all_dots:,} images and views."
    if not run.near and run.title in paper.HOLES:
        series.append(Series("Spackle on SHARP (paper), means", "spackle", "circle", _paper_overheads(run.title), True))
    x = linear("hole before, % of the pixels", [p.x for one in series for p in one.points])
    y = linear("added Gaussians, % of the base's", [p.y for one in series for p in one.points])
    return scatter("Added Gaussians against hole size", x, y, series, note)


def _overheads(run: Run, method: str) -> Iterator[Point]:
    for record in run.measured:
        for row in record.rows:
            before, share = row.figures.get("har_before"), row.figures.get("aux_share")
            if row.method == method and before is not None and share is not None:
                says = f"{record.name}, {row.setting} {row.view}: {before:.2%} hole, {share:.2%} added"
                yield Point(100 * before, 100 * share, says)


def _paper_overheads(title: str) -> tuple[Point, ...]:
    points = []
    for move in paper.DISPARITIES:
        before, share = paper.at(paper.HOLES[title], move)[0], paper.at(paper.GAUSSIANS[title], move)[1]
        if before is not None and share is not None:
            points.append(Point(100 * before, share, f"disparity {move:g}: {percent_text(share)} added"))
    return tuple(points)


def scenes_plot(run: Run, figure: str) -> Html | None:
    """A figure of each scene by each method, in the order of the method that matters."""
    values = {
        method: {r.name: v for r in run.measured if (v := mean_of(r, figure, method)) is not None}
        for method in run.methods
    }
    values = {method: found for method, found in values.items() if found}
    if not values:
        return None
    leader = "spackle" if "spackle" in values else list(values)[-1]
    lead, sign = values[leader], -1 if figure in UP else 1
    order = sorted(lead, key=lambda name: (sign * lead[name], name))
    names = [order[k] for k in spread(len(order), SCENES)]
    series = []
    for method, found in values.items():
        points = (Point(found[n], k, f"{n}: {found[n]:.4g}") for k, n in enumerate(names) if n in found)
        series.append(Series(method_name(run, method), method, FORMS[method], tuple(points)))
    title, axis = SCENE_FIGURES[figure]
    x = linear(axis, [p.x for one in series for p in one.points], origin=False)
    some = f" {len(names)} of {len(order)} scenes, spread evenly." if len(names) < len(order) else ""
    return dot_rows(title, x, names, series, f"In the order of {METHODS[leader].title}, best first.{some}")
