"""The paper's tables, and one of ours, for the protocols that were run; the paper's numbers beside them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence

from spackle.errors import InputError
from spackle.evaluation import paper
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import DEFINITIONS, METRICS, NOTICE, SPLIT, definitions, reduction
from spackle.evaluation.protocols import NEAR
from spackle.evaluation.results import Mean, Run
from spackle.evaluation.table import EMPTY, Line, Table, mark_best

NOT_RUN = "not run"
PAPER_ROW = "{} (paper)"
FILLING = (
    "spackle",
    "spackle-scene",
    "network",
    "seeds",
    "dense",
    "direct-ft",
)  # methods that leave an opacity to measure
ADDING = ("spackle", "spackle-scene", "network", "seeds", "dense")
LARGE_VIEWS = (
    "Views: the two ends of a swipe at that disparity, where the eye is farthest left and farthest right and looks at "
    "the focus point (spackle.camera_path.extremes), at the photo's working size with both sides even; means over views"
)
NEAR_VIEWS = (
    "Views: the dataset's other photos of the scene, from their own cameras, at their working size; means over views"
)
PAIR = ("dists", "lpips")
PLACES = (("", "image"), ("_hole", "in the hole"), ("_outside", "outside"))
ABLATED = {"dense": "Dense grid init", "spackle": "Mask guided init"}
Cells = tuple[str, ...]


def make_tables(runs: Sequence[Run]) -> list[Table]:
    """All tables; InputError for a dataset twice with one protocol and base, or for different disparities."""
    large, near = [run for run in runs if not run.near], [run for run in runs if run.near]
    seen: set[tuple[bool, str, str]] = set()
    for run in runs:
        if (run.near, run.title, run.base) in seen:
            raise InputError(
                f"two results for {run.title} under {run.config['protocol']} with the base {run.base}: give one of them"
            )
        seen.add((run.near, run.title, run.base))
    tables: list[Table] = []
    if large:
        disparities = list(large[0].config["disparities"])
        if any(list(run.config["disparities"]) != disparities for run in large):
            raise InputError("the results have different disparities: make their tables apart")
        tables += [make(large, disparities) for make in (quality_table, holes_table, gaussians_table)]
    if near:
        tables += [make(near) for make in (near_table, detail_table, ablation_table)]
    return tables


# --- what the tables have in common


def method_name(run: Run, method: str) -> str:
    """What a row is called; the base's name is always in it."""
    return f"{run.base} alone" if method == "base" else f"{METHODS[method].title} ({run.base})"


def count_text(value: float | None, digits: int = 0) -> str:
    """With commas between thousands."""
    return EMPTY if value is None else f"{value:,.{digits}f}"


def ratio_text(value: float | None) -> str:
    """Four digits, as in the paper; what would round to nothing keeps its first two."""
    if value is None:
        return EMPTY
    return f"{value:.1e}" if 0 < value < 0.5e-4 else f"{value:.4f}"


def _percent_text(value: float | None, sign: str = "%") -> str:
    return EMPTY if value is None else f"{value:.2f}{sign}"


def _metric_text(mean: Mean, metric: str) -> str:
    """A mean of a metric; views without a finite value are shown."""
    return _with_bad(EMPTY if mean.value is None else METRICS[metric].text(mean.value), mean.bad)


def _with_bad(text: str, bad: int) -> str:
    return f"{text} ({bad} NaN)".strip() if bad else text


def _share(run: Run) -> str:
    """How many of the paper's images were measured."""
    wanted = paper.IMAGES.get(run.title)
    return str(len(run.measured)) if wanted is None else f"{len(run.measured)}/{wanted}"


def _datasets(runs: Sequence[Run]) -> list[str]:
    """Titles: the paper's in its order, whether they were run or not, then others."""
    return list(dict.fromkeys([*paper.DATASETS, *(run.title for run in runs)]))


def _lines(
    runs: Sequence[Run], width: int, ours: Callable[[Run], list[Cells]], papers: Callable[[str], list[Cells]]
) -> tuple[Line, ...]:
    """For each dataset the rows of its runs, or one that says "not run", and the paper's; its name in the first."""
    lines: list[Line] = []
    for title in _datasets(runs):
        rows = [row for run in runs if run.title == title for row in ours(run)]
        rows = [*(rows or [(NOT_RUN, *[EMPTY] * (width - 1))]), *papers(title)]
        lines += [Line((title if k == 0 else EMPTY, *row), rule=k == 0) for k, row in enumerate(rows)]
    return tuple(lines)


def _notes(runs: Sequence[Run], metrics: Iterable[str] = ()) -> tuple[str, ...]:
    """Notes under a table: definitions, what was not run and why, what was passed over, terms of pyiqa."""
    names = tuple(metrics)
    notes = definitions(names)
    for run in runs:
        state = run.config["metrics"]
        idle = [name for name in names if str(state.get(name, "")).startswith(NOT_RUN)]
        notes += [f"{run.title}: {METRICS[name].title[:-2]} {state[name]}." for name in idle]
        passed = [record.name for record in run.records if record.problem is not None]
        if passed:
            more = f" and {len(passed) - 5} more" if len(passed) > 5 else ""
            listed = f"{', '.join(passed[:5])}{more}"
            notes.append(f"{run.title}: {len(passed)} of {len(run.records)} images gave no figures: {listed}.")
    if any(name in DEFINITIONS for name in names):
        notes.append(f"{NOTICE}.")
    return tuple(dict.fromkeys(notes))


def _bases(runs: Sequence[Run]) -> str:
    """Which base the rows stand on, for a caption."""
    bases = dict.fromkeys(f"{run.base}: {run.config['base']['says']}" for run in runs)
    return f"Base {'; '.join(bases)}." if bases else "No run."


def _rows_of(runs: Sequence[Run]) -> str:
    """What the rows are, and whose weights the residual has."""
    names = dict.fromkeys(method for run in runs for method in run.methods)
    rows = "; ".join(f"{METHODS[name].title}: {METHODS[name].description}" for name in names)
    residuals = [run.config["residual"] for run in runs]
    weights = dict.fromkeys(
        f"{one['weights']} weights {one['sha256'][:8]}" if one["sha256"] else "no weights, seeds alone"
        for one in residuals
    )
    return f"Rows: {rows}. Residual: {' and '.join(weights)}."


def _best_marked(run: Run, figures: Sequence[tuple[str, str, str]]) -> list[list[str]]:
    """A column of texts for each (metric, figure, setting), a row for each method, the best set off."""
    columns = []
    for metric, figure, setting in figures:
        means = [run.mean(figure, method, setting) for method in run.methods]
        texts = [_metric_text(mean, metric) for mean in means]
        columns.append(mark_best([mean.value for mean in means], texts, METRICS[metric].lower))
    return columns


# --- large views


def quality_table(runs: Sequence[Run], disparities: Sequence[float]) -> Table:
    """No-reference metrics (tab:large_view_nr_iqa)."""
    figures = [(name, name, f"{disparity:g}") for disparity in disparities for name in paper.QUALITY_FIGURES]

    def ours(run: Run) -> list[Cells]:
        names = [method_name(run, method) for method in run.methods]
        return [(n, _share(run), *cells) for n, *cells in zip(names, *_best_marked(run, figures), strict=True)]

    def papers(title: str) -> list[Cells]:
        rows = []
        for name in paper.METHODS if title in paper.DATASETS else ():
            values = [value for d in disparities for value in paper.at(paper.QUALITY.get((title, name)), d)]
            texts = [EMPTY if v is None else METRICS[m].text(v) for (m, _, _), v in zip(figures, values, strict=True)]
            rows.append((PAPER_ROW.format(name), str(paper.IMAGES[title]), *texts))
        return rows

    return _large_table(
        "tab:large_view_nr_iqa",
        f"No-reference quality under controlled large views. {LARGE_VIEWS}. {_bases(runs)} {_rows_of(runs)} "
        "n: images, of those in the paper. Bold: best of a run's rows.",
        [METRICS[name].title for name in paper.QUALITY_FIGURES],
        (runs, disparities, ours, papers),
        paper.QUALITY_FIGURES,
    )


def holes_table(runs: Sequence[Run], disparities: Sequence[float]) -> Table:
    """Hole Area Ratio before and after (paper, eq. 11; tab:controlled_disocclusion)."""

    def three(run: Run, method: str, setting: str) -> Cells:
        before, after = (run.mean(figure, method, setting) for figure in ("har_before", "har"))
        less = None
        if before.value and after.value is not None:
            less = 100 * reduction(before.value, after.value)
        return ratio_text(before.value), _with_bad(ratio_text(after.value), after.bad), _percent_text(less)

    return _large_table(
        "tab:controlled_disocclusion",
        "Hole Area Ratio (HAR), 1 − coverage: the share of pixels whose rendered opacity is below 0.95. Reduction: of "
        f"the mean HAR, 1 − after / before. {LARGE_VIEWS}. {_bases(runs)} {_rows_of(runs)} "
        "n: images, of those in the paper.",
        ("base HAR ↓", "HAR ↓", "Reduction ↑"),
        _threes(runs, disparities, FILLING, three, paper.HOLES, (ratio_text, ratio_text, _percent_text)),
    )


def gaussians_table(runs: Sequence[Run], disparities: Sequence[float]) -> Table:
    """Added and merged Gaussians (tab:expanded_efficiency_gaussian_overhead, without its times)."""
    share_text = functools.partial(_percent_text, sign="")

    def three(run: Run, method: str, setting: str) -> Cells:
        added, share, merged = (run.mean(figure, method, setting).value for figure in ("aux", "aux_share", "merged"))
        return count_text(added), share_text(None if share is None else 100 * share), count_text(merged)

    return _large_table(
        "tab:expanded_efficiency_gaussian_overhead",
        "Gaussians added for a view, their share of the base's and both together; means over views. "
        f"{LARGE_VIEWS}. {_bases(runs)} {_rows_of(runs)} The paper's base has {paper.BASE_GAUSSIANS:,} Gaussians.",
        ("Added GS", "Added GS (%)", "Merged GS"),
        _threes(runs, disparities, ADDING, three, paper.GAUSSIANS, (count_text, share_text, count_text)),
    )


Filling = tuple[Sequence[Run], Sequence[float], Callable[[Run], list[Cells]], Callable[[str], list[Cells]]]


def _threes(
    runs: Sequence[Run],
    disparities: Sequence[float],
    methods: Sequence[str],
    three: Callable[[Run, str, str], Cells],
    theirs: Mapping[str, tuple[float, ...]],
    texts: Sequence[Callable[[float | None], str]],
) -> Filling:
    """Rows with three cells for each disparity: a row for each of the methods that was run, and one of the paper's."""

    def ours(run: Run) -> list[Cells]:
        rows = []
        for method in (name for name in run.methods if name in methods):
            cells = [cell for disparity in disparities for cell in three(run, method, f"{disparity:g}")]
            rows.append((method_name(run, method), _share(run), *cells))
        return rows

    def papers(title: str) -> list[Cells]:
        if title not in theirs:
            return []
        found = [zip(texts, paper.at(theirs[title], disparity), strict=True) for disparity in disparities]
        cells = [text(value) for three in found for text, value in three]
        return [(PAPER_ROW.format("Spackle on SHARP"), str(paper.IMAGES[title]), *cells)]

    return runs, disparities, ours, papers


def _large_table(
    label: str, caption: str, heads: Sequence[str], filling: Filling, metrics: Sequence[str] = ()
) -> Table:
    """Three columns for each disparity behind dataset, method and number of images."""
    runs, disparities, ours, papers = filling
    named = [
        f"S{1 + paper.DISPARITIES.index(d)}: disparity {d:g}" if d in paper.DISPARITIES else f"disparity {d:g}"
        for d in disparities
    ]
    columns = ("Dataset", "Method", "n", *[*heads] * len(disparities))
    groups = (("", 3), *((name, 3) for name in named))
    lines = _lines(runs, len(columns) - 1, ours, papers)
    return Table(label, caption, columns, groups, lines, words=2, notes=_notes(runs, metrics))


# --- near views


def near_table(runs: Sequence[Run]) -> Table:
    """DISTS and LPIPS, a row for each method (tab:near_view)."""
    titles = _datasets(runs)
    rows: dict[str, list[str]] = {}
    for name, method, base in dict.fromkeys((method_name(r, m), m, r.base) for r in runs for m in r.methods):
        rows[name] = []
        for title in titles:
            own = [run for run in runs if run.title == title and run.base == base and method in run.methods]
            rows[name] += [_metric_text(own[0].mean(m, method, NEAR), m) if own else EMPTY for m in PAIR]
    lines = [Line((name, *cells)) for name, cells in rows.items()]
    for number, name in enumerate(paper.NEAR_METHODS):
        found = (paper.NEAR.get((name, title), (None, None)) for title in titles)
        lines.append(Line((PAPER_ROW.format(name), *(ratio_text(v) for pair in found for v in pair)), rule=number == 0))
    return Table(
        "tab:near_view",
        f"Distance from true second photos; lower is better. {NEAR_VIEWS}. {_bases(runs)} {_rows_of(runs)} "
        f"Images: {_images(runs)}. Empty: not run.",
        ("Method", *("DISTS", "LPIPS") * len(titles)),
        (("", 1), *((title, 2) for title in titles)),
        tuple(lines),
        notes=_notes(runs, PAIR),
    )


def detail_table(runs: Sequence[Run]) -> Table:
    """PSNR and SSIM over the image, in the hole and outside; the masked distance. Not in the paper."""
    figures = [(name, f"{name}{place}", NEAR) for name in SPLIT for place, _ in PLACES] + [
        ("distance", "distance", NEAR)
    ]

    def ours(run: Run) -> list[Cells]:
        heads = [
            (method_name(run, m), _share(run), ratio_text(run.mean("har_before", m, NEAR).value)) for m in run.methods
        ]
        return [(*head, *cells) for head, *cells in zip(heads, *_best_marked(run, figures), strict=True)]

    return Table(
        "tab:near_view_holes",
        "Against true second photos, where it matters. The hole is where the base's opacity is below 0.95. HAR: its "
        f"share of the pixels. {NEAR_VIEWS}. {_bases(runs)} {_rows_of(runs)} Bold: best of a run's rows. "
        "n: images, of those in the paper, which has no such table.",
        ("Dataset", "Method", "n", "base HAR", *[place for _, place in PLACES] * 2, "in the hole"),
        (("", 4), *((METRICS[name].title, 3) for name in SPLIT), (METRICS["distance"].title, 1)),
        _lines(runs, 10, ours, lambda title: []),
        words=2,
        notes=_notes(runs, (*SPLIT, "distance")),
    )


def ablation_table(runs: Sequence[Run]) -> Table:
    """A Gaussian for every cell against those of the mask (tab:mask_guided_init)."""

    def ours(run: Run) -> list[Cells]:
        dense, guided = (run.mean("aux", method, NEAR).value for method in ABLATED)
        less = None if not dense or guided is None else 100 * reduction(dense, guided)
        rows = []
        for method, title in ((method, title) for method, title in ABLATED.items() if method in run.methods):
            count = count_text(guided if method == "spackle" else dense, 2)
            reduced = _percent_text(less) if method == "spackle" else "–"
            pair = [_metric_text(run.mean(metric, method, NEAR), metric) for metric in PAIR]
            rows.append((f"{title} ({run.base})", count_text(run.base_gaussians), count, reduced, *pair))
        return rows

    def papers(title: str) -> list[Cells]:
        if title not in paper.ABLATION:
            return []
        many, dists, lpips, few, less, few_dists, few_lpips = paper.ABLATION[title]
        base, (dense, guided) = count_text(paper.BASE_GAUSSIANS), map(PAPER_ROW.format, ABLATED.values())
        return [
            (dense, base, count_text(many, 2), "–", ratio_text(dists), ratio_text(lpips)),
            (guided, base, count_text(few, 2), _percent_text(less), ratio_text(few_dists), ratio_text(few_lpips)),
        ]

    return Table(
        "tab:mask_guided_init",
        "Dense grid initialisation against mask guided one. Dense: an aux Gaussian for each cell of 2×2 pixels, in "
        "one pass; mask guided: for the masked cells, with a second pass where that leaves holes. The same network for "
        f"both. Reduction: of the mean count. {NEAR_VIEWS}. {_bases(runs)} Images: {_images(runs)}.",
        ("Dataset", "Method", "Base GS", "Aux. GS ↓", "Reduction ↑", *(METRICS[name].title for name in PAIR)),
        (("", 7),),
        _lines(runs, 6, ours, papers),
        words=2,
        notes=_notes(runs, PAIR),
    )


def _images(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.title} {_share(run)}" for run in runs)
