"""What the tables have in common: which runs stand where, and how numbers are written.

Tables of the large-view protocol, in the paper's layouts.

Tables of the near-view protocol: against true second photos.

All tables of some runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from spackle.errors import InputError
from spackle.evaluation import paper
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import DEFINITIONS, METRICS, NOTICE, SPLIT, definitions, reduction
from spackle.evaluation.results import Mean, Run
from spackle.evaluation.table import EMPTY, Line, Table, mark_best

NOT_RUN = "not run"
PAPER_ROW = "{} (paper)"


def datasets(runs: Sequence[Run]) -> list[str]:
    """Titles: the paper's in its order, whether they were run or not, then others."""
    return list(dict.fromkeys([*paper.DATASETS, *(run.title for run in runs)]))


def runs_of(runs: Sequence[Run], title: str) -> list[Run]:
    return [run for run in runs if run.title == title]


def method_name(run: Run, method: str) -> str:
    """What a row is called; the base's name is always in it."""
    return f"{run.base} alone" if method == "base" else f"{METHODS[method].title} ({run.base})"


def share_of_paper(run: Run) -> str:
    """How many of the paper's images were measured."""
    wanted = paper.IMAGES.get(run.title)
    return str(len(run.measured)) if wanted is None else f"{len(run.measured)}/{wanted}"


def metric_text(mean: Mean, metric: str) -> str:
    """A mean of a metric; views without a finite value are shown."""
    figure = METRICS[metric]
    return with_bad(EMPTY if mean.value is None else figure.text(mean.value), mean.bad)


def with_bad(text: str, bad: int) -> str:
    return f"{text} ({bad} NaN)".strip() if bad else text


def count_text(value: float | None, digits: int = 0) -> str:
    return EMPTY if value is None else f"{value:,.{digits}f}"


def ratio_text(value: float | None) -> str:
    """Four digits, as in the paper; what would round to nothing keeps its first two."""
    if value is None:
        return EMPTY
    return f"{value:.1e}" if 0 < value < 0.5e-4 else f"{value:.4f}"


def percent_text(value: float | None) -> str:
    return EMPTY if value is None else f"{value:.2f}%"


def said(runs: Sequence[Run], metrics: Iterable[str] = ()) -> tuple[str, ...]:
    """Notes under a table: definitions, what was not run and why, what was passed over, terms of pyiqa."""
    names = tuple(metrics)
    notes = definitions(names)
    for run in runs:
        state = run.config["metrics"]
        notes += [f"{run.title}: {METRICS[name].title[:-2]} {state[name]}." for name in names if _idle(run, name)]
        passed = [record.name for record in run.records if record.problem is not None]
        if passed:
            more = f" and {len(passed) - 5} more" if len(passed) > 5 else ""
            listed = f"{', '.join(passed[:5])}{more}"
            notes.append(f"{run.title}: {len(passed)} of {len(run.records)} images gave no figures: {listed}.")
    if any(name in DEFINITIONS for name in names):
        notes.append(f"{NOTICE}.")
    return tuple(dict.fromkeys(notes))


def _idle(run: Run, metric: str) -> bool:
    return str(run.config["metrics"].get(metric, "")).startswith(NOT_RUN)


def bases(runs: Sequence[Run]) -> str:
    """Which base the rows stand on, for a caption."""
    says = dict.fromkeys(f"{run.base}: {run.config['base']['says']}" for run in runs)
    return f"Base {'; '.join(says)}." if says else "No run."


def methods_said(runs: Sequence[Run]) -> str:
    """What the rows are, and whose weights the residual has."""
    names = dict.fromkeys(method for run in runs for method in run.methods)
    rows = "; ".join(f"{METHODS[name].title}: {METHODS[name].says}" for name in names)
    return f"Rows: {rows}. Residual: {' and '.join(dict.fromkeys(_weights(run) for run in runs))}."


def _weights(run: Run) -> str:
    residual = run.config["residual"]
    digest = residual["sha256"]
    return f"{residual['weights']} weights {digest[:8]}" if digest else "no weights, seeds alone"


LARGE_VIEWS = (
    "Views: the two ends of a swipe at that disparity, where the eye is farthest left and farthest right and looks at "
    "the focus point (spackle.camera_path.extremes), at the photo's working size with both sides even; means over views"
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
        f"No-reference quality under controlled large views. {LARGE_VIEWS}. {bases(runs)} {methods_said(runs)} "
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
        f"the mean HAR, 1 − after / before. {LARGE_VIEWS}. {bases(runs)} {methods_said(runs)} "
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
        f"{LARGE_VIEWS}. {bases(runs)} {methods_said(runs)} The paper's base has {paper.BASE_GAUSSIANS:,} Gaussians.",
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


NEAR = "near"  # the protocol's only setting
PAIR = ("dists", "lpips")
NEAR_VIEWS = (
    "Views: the dataset's other photos of the scene, from their own cameras, at their working size; means over views"
)
PLACES = (("", "image"), ("_hole", "in the hole"), ("_outside", "outside"))
HOLE = "The hole is where the base's opacity is below 0.95."
ABLATED = {"dense": "Dense grid init", "spackle": "Mask guided init"}


def near_table(runs: Sequence[Run]) -> Table:
    """DISTS and LPIPS, a row for each method (tab:near_view)."""
    titles = datasets(runs)
    rows: dict[str, list[str]] = {}
    for name, method, base in dict.fromkeys((method_name(r, m), m, r.base) for r in runs for m in r.methods):
        rows[name] = []
        for title in titles:
            own = [run for run in runs_of(runs, title) if run.base == base and method in run.methods]
            rows[name] += [metric_text(own[0].mean(m, method, NEAR), m) if own else EMPTY for m in PAIR]
    lines = [Line((name, *cells)) for name, cells in rows.items()]
    for number, name in enumerate(paper.NEAR_METHODS):
        found = (paper.NEAR.get((name, title), (None, None)) for title in titles)
        lines.append(Line((PAPER_ROW.format(name), *(ratio_text(v) for pair in found for v in pair)), rule=number == 0))
    return Table(
        "tab:near_view",
        f"Distance from true second photos; lower is better. {NEAR_VIEWS}. {bases(runs)} {methods_said(runs)} "
        f"Images: {_images(runs)}. Empty: not run.",
        ("Method", *("DISTS", "LPIPS") * len(titles)),
        (("", 1), *((title, 2) for title in titles)),
        tuple(lines),
        notes=said(runs, PAIR),
    )


def detail_table(runs: Sequence[Run]) -> Table:
    """PSNR and SSIM over the image, in the hole and outside; the masked distance. Not in the paper."""
    lines: list[Line] = []
    for title in datasets(runs):
        rows = [row for run in runs_of(runs, title) for row in _detail_rows(run)] or [(NOT_RUN, *[EMPTY] * 9)]
        lines += [Line((title if k == 0 else EMPTY, *row), rule=k == 0) for k, row in enumerate(rows)]
    return Table(
        "tab:near_view_holes",
        f"Against true second photos, where it matters. {HOLE} HAR: its share of the pixels. {NEAR_VIEWS}. "
        f"{bases(runs)} {methods_said(runs)} Bold: best of a run's rows. "
        "n: images, of those in the paper, which has no such table.",
        ("Dataset", "Method", "n", "base HAR", *[place for _, place in PLACES] * 2, "in the hole"),
        (("", 4), *((METRICS[name].title, 3) for name in SPLIT), (METRICS["distance"].title, 1)),
        tuple(lines),
        words=2,
        notes=said(runs, (*SPLIT, "distance")),
    )


def ablation_table(runs: Sequence[Run]) -> Table:
    """A Gaussian for every cell against those of the mask (tab:mask_guided_init)."""
    lines: list[Line] = []
    for title in datasets(runs):
        rows = [row for run in runs_of(runs, title) for row in _ablation_rows(run)]
        rows = rows or [(NOT_RUN, *[EMPTY] * 5)]
        rows += _paper_ablation(title) if title in paper.ABLATION else []
        lines += [Line((title if k == 0 else EMPTY, *row), rule=k == 0) for k, row in enumerate(rows)]
    return Table(
        "tab:mask_guided_init",
        "Dense grid initialisation against mask guided one. Dense: an aux Gaussian for each cell of 2×2 pixels, in "
        "one pass; mask guided: for the masked cells, with a second pass where that leaves holes. The same network for "
        f"both. Reduction: of the mean count. {NEAR_VIEWS}. {bases(runs)} Images: {_images(runs)}.",
        ("Dataset", "Method", "Base GS", "Aux. GS ↓", "Reduction ↑", *(METRICS[name].title for name in PAIR)),
        (("", 7),),
        tuple(lines),
        words=2,
        notes=said(runs, PAIR),
    )


def _images(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.title} {share_of_paper(run)}" for run in runs)


def _detail_rows(run: Run) -> list[Cells]:
    figures = [(name, f"{name}{place}") for name in SPLIT for place, _ in PLACES] + [("distance", "distance")]
    columns = []
    for metric, figure in figures:
        means = [run.mean(figure, method, NEAR) for method in run.methods]
        texts = [metric_text(mean, metric) for mean in means]
        columns.append(mark_best([mean.value for mean in means], texts, METRICS[metric].lower))
    heads = [
        (method_name(run, m), share_of_paper(run), ratio_text(run.mean("har_before", m, NEAR).value))
        for m in run.methods
    ]
    return [(*head, *cells) for head, *cells in zip(heads, *columns, strict=True)]


def _ablation_rows(run: Run) -> list[Cells]:
    dense, guided = (run.mean("aux", method, NEAR).value for method in ABLATED)
    rows = []
    for method, title in ABLATED.items():
        if method not in run.methods:
            continue
        count = run.mean("aux", method, NEAR).value
        both = method == "spackle" and dense and guided is not None
        less = percent_text(100 * reduction(dense, guided)) if both and dense and guided is not None else EMPTY
        pair = [metric_text(run.mean(metric, method, NEAR), metric) for metric in PAIR]
        base = count_text(run.base_gaussians)
        rows.append((f"{title} ({run.base})", base, count_text(count, 2), less if method == "spackle" else "–", *pair))
    return rows


def _paper_ablation(title: str) -> list[Cells]:
    many, dists, lpips, few, less, few_dists, few_lpips = paper.ABLATION[title]
    base, (dense, guided) = count_text(paper.BASE_GAUSSIANS), ABLATED.values()
    return [
        (PAPER_ROW.format(dense), base, count_text(many, 2), "–", ratio_text(dists), ratio_text(lpips)),
        (
            PAPER_ROW.format(guided),
            base,
            count_text(few, 2),
            percent_text(less),
            ratio_text(few_dists),
            ratio_text(few_lpips),
        ),
    ]


def make_tables(runs: Sequence[Run]) -> list[Table]:
    """The paper's tables, and one of ours, for the protocols that were run; the paper's numbers beside them.

    Raises:
        InputError: a dataset twice under one protocol with the same base, or different disparities.
    """
    tables: list[Table] = []
    large = [run for run in runs if not run.near]
    near = [run for run in runs if run.near]
    for protocol in (large, near):
        _check(protocol)
    if large:
        disparities = list(large[0].config["disparities"])
        if any(list(run.config["disparities"]) != disparities for run in large):
            raise InputError("the results have different disparities: make their tables apart")
        tables += [make(large, disparities) for make in (quality_table, holes_table, gaussians_table)]
    if near:
        tables += [make(near) for make in (near_table, detail_table, ablation_table)]
    return tables


def _check(runs: Sequence[Run]) -> None:
    seen: set[tuple[str, str]] = set()
    for run in runs:
        if (run.title, run.base) in seen:
            raise InputError(
                f"two results for {run.title} under {run.config['protocol']} with the base {run.base}: give one of them"
            )
        seen.add((run.title, run.base))
