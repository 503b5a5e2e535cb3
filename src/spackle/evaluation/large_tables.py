"""Tables of the large-view protocol, in the paper's layouts."""

from __future__ import annotations

from collections.abc import Sequence

from spackle.evaluation import paper
from spackle.evaluation.cells import (
    NOT_RUN,
    PAPER_ROW,
    bases,
    count_text,
    datasets,
    method_name,
    methods_said,
    metric_text,
    percent_text,
    ratio_text,
    runs_of,
    said,
    share_of_paper,
    with_bad,
)
from spackle.evaluation.figures import METRICS
from spackle.evaluation.metrics import reduction
from spackle.evaluation.results import Run
from spackle.evaluation.table import EMPTY, Line, Table, mark_best

VIEWS = (
    "Views: the two ends of a swipe at that disparity, where the eye is farthest left and farthest right and looks at "
    "the focus point (spackle.trajectory.extremes), at the photo's working size with both sides even; means over views"
)
FILLING = ("spackle", "spackle-scene", "seeds", "dense", "direct-ft")  # methods that leave an opacity to measure
ADDING = ("spackle", "spackle-scene", "seeds", "dense")


def quality_table(runs: Sequence[Run], disparities: Sequence[float]) -> Table:
    """No-reference metrics (tab:large_view_nr_iqa)."""
    columns = tuple(METRICS[name].title for name in paper.QUALITY_FIGURES)
    lines: list[Line] = []
    for title in datasets(runs):
        rows = [row for run in runs_of(runs, title) for row in _quality_rows(run, disparities)]
        rows = rows or [(NOT_RUN, EMPTY, *[EMPTY] * 3 * len(disparities))]
        rows += [_paper_quality(title, name, disparities) for name in paper.METHODS if title in paper.DATASETS]
        lines += _group(title, rows)
    return Table(
        "tab:large_view_nr_iqa",
        f"No-reference quality under controlled large views. {VIEWS}. {bases(runs)} {methods_said(runs)} "
        "n: images, of those in the paper. Bold: best of a run's rows.",
        ("Dataset", "Method", "n", *columns * len(disparities)),
        (("", 3), *((_setting(d), 3) for d in disparities)),
        tuple(lines),
        words=2,
        notes=said(runs, paper.QUALITY_FIGURES),
    )


def holes_table(runs: Sequence[Run], disparities: Sequence[float]) -> Table:
    """Hole Area Ratio before and after (tab:controlled_disocclusion)."""
    lines: list[Line] = []
    for title in datasets(runs):
        rows = [row for run in runs_of(runs, title) for row in _hole_rows(run, disparities)]
        rows = rows or [(NOT_RUN, EMPTY, *[EMPTY] * 3 * len(disparities))]
        if title in paper.HOLES:
            rows.append(_paper_holes(title, disparities))
        lines += _group(title, rows)
    return Table(
        "tab:controlled_disocclusion",
        "Hole Area Ratio (HAR), 1 − coverage: the share of pixels whose rendered opacity is below 0.95. Reduction: of "
        f"the mean HAR, 1 − after / before. {VIEWS}. {bases(runs)} {methods_said(runs)} "
        "n: images, of those in the paper.",
        ("Dataset", "Method", "n", *("base HAR ↓", "HAR ↓", "Reduction ↑") * len(disparities)),
        (("", 3), *((_setting(d), 3) for d in disparities)),
        tuple(lines),
        words=2,
        notes=said(runs),
    )


def gaussians_table(runs: Sequence[Run], disparities: Sequence[float]) -> Table:
    """Added and merged Gaussians (tab:expanded_efficiency_gaussian_overhead, without its times)."""
    lines: list[Line] = []
    for title in datasets(runs):
        rows = [row for run in runs_of(runs, title) for row in _gaussian_rows(run, disparities)]
        rows = rows or [(NOT_RUN, EMPTY, *[EMPTY] * 3 * len(disparities))]
        if title in paper.GAUSSIANS:
            rows.append(_paper_gaussians(title, disparities))
        lines += _group(title, rows)
    return Table(
        "tab:expanded_efficiency_gaussian_overhead",
        "Gaussians added for a view, their share of the base's and both together; means over views. "
        f"{VIEWS}. {bases(runs)} {methods_said(runs)} The paper's base has {paper.BASE_GAUSSIANS:,} Gaussians.",
        ("Dataset", "Method", "n", *("Added GS", "Added GS (%)", "Merged GS") * len(disparities)),
        (("", 3), *((_setting(d), 3) for d in disparities)),
        tuple(lines),
        words=2,
        notes=said(runs),
    )


Cells = tuple[str, ...]


def _setting(disparity: float) -> str:
    if disparity in paper.DISPARITIES:
        return f"S{1 + paper.DISPARITIES.index(disparity)}: disparity {disparity:g}"
    return f"disparity {disparity:g}"


def _group(title: str, rows: Sequence[Cells]) -> list[Line]:
    """Rows of a dataset, its name in the first."""
    return [Line((title if number == 0 else EMPTY, *row), rule=number == 0) for number, row in enumerate(rows)]


def _quality_rows(run: Run, disparities: Sequence[float]) -> list[Cells]:
    columns: list[list[str]] = []
    for disparity in disparities:
        for metric in paper.QUALITY_FIGURES:
            means = [run.mean(metric, method, f"{disparity:g}") for method in run.methods]
            texts = [metric_text(mean, metric) for mean in means]
            columns.append(mark_best([mean.value for mean in means], texts, METRICS[metric].lower))
    names = [method_name(run, method) for method in run.methods]
    return [(name, share_of_paper(run), *cells) for name, *cells in zip(names, *columns, strict=True)]


def _paper_quality(title: str, name: str, disparities: Sequence[float]) -> Cells:
    cells = [
        EMPTY if value is None else METRICS[metric].text(value)
        for disparity in disparities
        for metric, value in zip(
            paper.QUALITY_FIGURES, paper.at(paper.QUALITY.get((title, name)), disparity), strict=True
        )
    ]
    return (PAPER_ROW.format(name), str(paper.IMAGES[title]), *cells)


def _hole_rows(run: Run, disparities: Sequence[float]) -> list[Cells]:
    rows = []
    for method in (name for name in run.methods if name in FILLING):
        cells: list[str] = []
        for disparity in disparities:
            before, after = (run.mean(figure, method, f"{disparity:g}") for figure in ("har_before", "har"))
            less = None
            if before.value and after.value is not None:
                less = 100 * reduction(before.value, after.value)
            cells += [ratio_text(before.value), with_bad(ratio_text(after.value), after.bad), percent_text(less)]
        rows.append((method_name(run, method), share_of_paper(run), *cells))
    return rows


def _paper_holes(title: str, disparities: Sequence[float]) -> Cells:
    cells: list[str] = []
    for disparity in disparities:
        before, after, less = paper.at(paper.HOLES[title], disparity)
        cells += [ratio_text(before), ratio_text(after), percent_text(less)]
    return (PAPER_ROW.format("Spackle on SHARP"), str(paper.IMAGES[title]), *cells)


def _gaussian_rows(run: Run, disparities: Sequence[float]) -> list[Cells]:
    rows = []
    for method in (name for name in run.methods if name in ADDING):
        cells: list[str] = []
        for disparity in disparities:
            added, share, merged = (run.mean(f, method, f"{disparity:g}").value for f in ("aux", "aux_share", "merged"))
            cells += [count_text(added), EMPTY if share is None else f"{100 * share:.2f}", count_text(merged)]
        rows.append((method_name(run, method), share_of_paper(run), *cells))
    return rows


def _paper_gaussians(title: str, disparities: Sequence[float]) -> Cells:
    cells: list[str] = []
    for disparity in disparities:
        added, share, merged = paper.at(paper.GAUSSIANS[title], disparity)
        cells += [count_text(added), EMPTY if share is None else f"{share:.2f}", count_text(merged)]
    return (PAPER_ROW.format("Spackle on SHARP"), str(paper.IMAGES[title]), *cells)
