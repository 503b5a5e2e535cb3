"""Tables of the near-view protocol: against true second photos."""

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
)
from spackle.evaluation.figures import METRICS, SPLIT
from spackle.evaluation.metrics import reduction
from spackle.evaluation.results import Run
from spackle.evaluation.table import EMPTY, Line, Table, mark_best

NEAR = "near"  # the protocol's only setting
PAIR = ("dists", "lpips")
VIEWS = (
    "Views: the dataset's other photos of the scene, from their own cameras, at their working size; means over views"
)
PLACES = (("", "image"), ("_hole", "in the hole"), ("_outside", "outside"))
HOLE = "The hole is where the base's opacity is below 0.95."
ABLATED = {"dense": "Dense grid init", "spackle": "Mask guided init"}
Cells = tuple[str, ...]


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
        f"Distance from true second photos; lower is better. {VIEWS}. {bases(runs)} {methods_said(runs)} "
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
        f"Against true second photos, where it matters. {HOLE} HAR: its share of the pixels. {VIEWS}. {bases(runs)} "
        f"{methods_said(runs)} Bold: best of a run's rows. n: images, of those in the paper, which has no such table.",
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
        f"both. Reduction: of the mean count. {VIEWS}. {bases(runs)} Images: {_images(runs)}.",
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
