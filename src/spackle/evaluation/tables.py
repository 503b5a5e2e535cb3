"""The paper's tables, and one of ours, as pivots of rows; the paper's figures in rows beside ours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from spackle.errors import InputError
from spackle.evaluation.efficiency import efficiency_tables
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import DEFINITIONS, METRICS, NOTICE, SPLIT, definitions, reduction
from spackle.evaluation.rows import (
    IMAGES,
    NEAR,
    PAPER,
    Mean,
    Row,
    Run,
    datasets,
    images_text,
    mean,
    paper_rows,
    pivot,
    setting_title,
)
from spackle.evaluation.table import (
    EMPTY,
    NOT_RUN,
    Cells,
    Table,
    Text,
    count_text,
    mark_best,
    percent_text,
    write_table,
)
from spackle.files import write_whole

FILES = ("tables.md", "tables.tex")
LARGE_VIEWS = (
    "Views: the two ends of a swipe at that disparity, where the eye is farthest left and farthest right and looks at "
    "the focus point (spackle.camera_path.extremes), at the photo's working size with both sides even; means over views"
)
NEAR_VIEWS = (
    "Views: the dataset's other photos of the scene, from their own cameras, at their working size; means over views"
)
HEAD = "{}: disparity {}"  # above the columns of a setting
QUALITY = ("clipiqa", "niqe", "musiq")
PAIR = ("dists", "lpips")
PLACES = (("", "image"), ("_hole", "in the hole"), ("_outside", "outside"))
ABLATED = {"dense": "Dense grid init", "spackle": "Mask guided init"}
# Relative decreases: of which method (None: the row's own) which figure, and by which of the row's it is replaced.
REDUCED: dict[str, tuple[str | None, str, str]] = {
    "reduction": (None, "har_before", "har"),
    "aux_reduction": ("dense", "aux", "aux"),
}


class Column(NamedTuple):
    """A figure of one setting."""

    group: str
    title: str
    setting: str
    metric: str
    text: Text
    lower: bool | None = None  # is better; None: no best one is set off


def make_tables(runs: Sequence[Run]) -> list[Table]:
    """All tables; InputError for a dataset twice with one protocol and base, or for different disparities."""
    seen: set[tuple[str, str, str]] = set()
    for run in runs:
        key = str(run.config["protocol"]), run.title, run.base
        if key in seen:
            raise InputError(f"two results for {run.title} under {key[0]} with the base {run.base}: give one of them")
        seen.add(key)
    timed, measured = [run for run in runs if run.timed], [run for run in runs if not run.timed]
    large, near = [run for run in measured if not run.near], [run for run in measured if run.near]
    for kind in (large, timed):
        if any(run.settings != kind[0].settings for run in kind):
            raise InputError("the results have different disparities: make their tables apart")
    tables = [make(large) for make in (_quality_table, _holes_table, _gaussians_table)] if large else []
    tables += [make(near) for make in (_near_table, _detail_table, _ablation_table)] if near else []
    return tables + (efficiency_tables(timed) if timed else [])


def write_tables(tables: Sequence[Table], folder: Path, files: Sequence[str] = FILES) -> None:
    """As a file of Markdown and one of LaTeX."""
    write_whole(folder / files[0], "\n".join(write_table(table, "md") for table in tables).encode())
    head = "% needs \\usepackage{booktabs,graphicx}\n"
    write_whole(folder / files[1], (head + "\n".join(write_table(table, "tex") for table in tables)).encode())


# --- texts of figures, and of rows


def method_name(run: Run, method: str) -> str:
    """What a row is called; the base's name is always in it."""
    return f"{run.base} alone" if method == "base" else f"{METHODS[method][0]} ({run.base})"


def ratio_text(value: float) -> str:
    """Four digits, as in the paper; what would round to nothing keeps its first two."""
    return f"{value:.1e}" if 0 < value < 0.5e-4 else f"{value:.4f}"


def _text(found: Mean | None, text: Text) -> str:
    """A mean; views without a finite value are counted behind it."""
    if found is None:
        return EMPTY
    return f"{EMPTY if found.value is None else text(found.value)} {f'({found.bad} NaN)' if found.bad else ''}".strip()


def _bases(runs: Sequence[Run]) -> str:
    """Which base the rows stand on, for a caption."""
    bases = dict.fromkeys(f"{run.base}: {run.config['base']['says']}" for run in runs)
    return f"Base {'; '.join(bases)}."


def _rows_of(runs: Sequence[Run]) -> str:
    """What the rows are, and whose weights the residual has."""
    names = dict.fromkeys(method for run in runs for method in run.methods)
    rows = "; ".join(": ".join(METHODS[name]) for name in names)
    residuals = [run.config["residual"] for run in runs]
    weights = dict.fromkeys(
        f"{one['weights']} weights {one['sha256'][:8]}" if one["sha256"] else "no weights, seeds alone"
        for one in residuals
    )
    return f"Rows: {rows}. Residual: {' and '.join(weights)}."


def _notes(runs: Sequence[Run], metrics: Iterable[str] = ()) -> list[str]:
    """Notes under a table: definitions, what was not run and why, what was passed over, terms of pyiqa."""
    names = tuple(metrics)
    notes = definitions(names)
    for run in runs:
        state = run.config["metrics"]
        idle = [name for name in names if str(state.get(name, "")).startswith(NOT_RUN)]
        notes += [f"{run.title}: {METRICS[name].title[:-2]} {state[name]}." for name in idle]
        if passed := list(run.problems):
            more = f" and {len(passed) - 5} more" if len(passed) > 5 else ""
            listed = f"{', '.join(passed[:5])}{more}"
            notes.append(f"{run.title}: {len(passed)} of {len(run.images)} images gave no figures: {listed}.")
    if any(name in DEFINITIONS for name in names):
        notes.append(f"{NOTICE}.")
    return list(dict.fromkeys(notes))


# --- the pivots


def _cells(rows: Iterable[Row], columns: Sequence[Column], methods: Iterable[str]) -> list[list[str]]:
    """A row of figures for each method, the best of a column set off."""
    values_of = pivot(rows, "method", "setting", "metric")

    def find(method: str, setting: str, metric: str) -> Mean | None:
        """Derived figures, too; what is known of images alone is all methods'."""
        if values := values_of.get((method, setting, metric)) or values_of.get(("", "", metric)):
            return mean(values)
        if metric in REDUCED:
            of, figure, after = REDUCED[metric]
            base, left = find(of or method, setting, figure), find(method, setting, after)
            if method != of and base and base.value and left and left.value is not None:
                return Mean(reduction(base.value, left.value), 0)
        return None

    texts = []
    for column in columns:
        found = [find(method, column.setting, column.metric) for method in methods]
        cells = [_text(one, column.text) for one in found]
        values = [None if one is None else one.value for one in found]
        texts.append(cells if column.lower is None else mark_best(values, cells, column.lower))
    return [list(cells) for cells in zip(*texts, strict=True)]


def _dataset_table(
    label: str,
    title: str,
    caption: str,
    runs: Sequence[Run],
    columns: Sequence[Column],
    names: Callable[[Run], dict[str, str]],
    metrics: Iterable[str] = (),
) -> Table:
    """For each dataset a row for each method of `names` (and what it is called), and the paper's rows."""
    heads = [("", "Dataset"), ("", "Method"), ("", "n"), *((column.group, column.title) for column in columns)]
    bodies = []
    for dataset in datasets(runs):
        rows: list[Cells] = []
        for run in (run for run in runs if run.title == dataset):
            methods = names(run)
            for name, cells in zip(methods.values(), _cells(run.rows, columns, methods), strict=True):
                rows.append((name, images_text(run), *cells))
        rows = rows or [(NOT_RUN, *[EMPTY] * (1 + len(columns)))]
        papers = [row for row in paper_rows(label) if row.dataset == dataset]
        for name in dict.fromkeys(row.method for row in papers):
            rows.append((name, str(IMAGES[dataset]), *_cells(papers, columns, [name])[0]))
        bodies.append([(EMPTY if k else dataset, *cells) for k, cells in enumerate(rows)])
    return Table(label, title, caption, heads, bodies, words=2, notes=_notes(runs, metrics))


def _named(run: Run, metric: str = "") -> dict[str, str]:
    """The methods of a run, or those that fill holes and have a figure, and what they are called."""
    having = {row.method for row in run.rows if row.metric == metric} - {"base"} if metric else run.methods
    return {method: method_name(run, method) for method in run.methods if method in having}


# --- large views


def _quality_table(runs: Sequence[Run]) -> Table:
    """No-reference metrics (tab:large_view_nr_iqa)."""
    return _dataset_table(
        "tab:large_view_nr_iqa",
        "Quality of large views, without a truth",
        f"No-reference quality under controlled large views. {LARGE_VIEWS}. {_bases(runs)} {_rows_of(runs)} "
        "n: images, of those in the paper. Bold: best of a run's rows.",
        runs,
        [
            Column(setting_title(setting, HEAD), figure.title, setting, name, figure.text, figure.lower)
            for setting in runs[0].settings
            for name, figure in ((name, METRICS[name]) for name in QUALITY)
        ],
        _named,
        QUALITY,
    )


def _holes_table(runs: Sequence[Run]) -> Table:
    """Hole Area Ratio before and after (paper, eq. 11; tab:controlled_disocclusion)."""
    figures = (("base HAR ↓", "har_before", ratio_text), ("HAR ↓", "har", ratio_text))
    return _dataset_table(
        "tab:controlled_disocclusion",
        "Hole Area Ratio before and after",
        "Hole Area Ratio (HAR), 1 − coverage: the share of pixels whose rendered opacity is below 0.95. Reduction: of "
        f"the mean HAR, 1 − after / before. {LARGE_VIEWS}. {_bases(runs)} {_rows_of(runs)} "
        "n: images, of those in the paper.",
        runs,
        _threes(runs, *figures, ("Reduction ↑", "reduction", lambda share: f"{percent_text(share)}%")),
        lambda run: _named(run, "har"),
    )


def _gaussians_table(runs: Sequence[Run]) -> Table:
    """Added and merged Gaussians (tab:expanded_efficiency_gaussian_overhead, without its times)."""
    figures = (("Added GS", "aux", count_text), ("Added GS (%)", "aux_share", percent_text))
    return _dataset_table(
        "tab:expanded_efficiency_gaussian_overhead",
        "Gaussians added and merged",
        "Gaussians added for a view, their share of the base's and both together; means over views. "
        f"{LARGE_VIEWS}. {_bases(runs)} {_rows_of(runs)} The paper's base has {PAPER['base_gaussians']:,} Gaussians.",
        runs,
        _threes(runs, *figures, ("Merged GS", "merged", count_text)),
        lambda run: _named(run, "aux"),
    )


def _threes(runs: Sequence[Run], *figures: tuple[str, str, Text]) -> list[Column]:
    groups = {setting: setting_title(setting, HEAD) for setting in runs[0].settings}
    return [Column(group, title, key, name, text) for key, group in groups.items() for title, name, text in figures]


# --- near views


def _near_table(runs: Sequence[Run]) -> Table:
    """DISTS and LPIPS, a row for each method (tab:near_view)."""
    columns, titles = [Column("", "", NEAR, m, METRICS[m].text) for m in PAIR], datasets(runs)
    bodies: list[list[Cells]] = []
    found: dict[str, dict[str, list[str]]] = {}
    for run in runs:
        names = _named(run)
        for name, cells in zip(names.values(), _cells(run.rows, columns, names), strict=True):
            found.setdefault(name, {})[run.title] = cells
    papers = paper_rows("tab:near_view")
    theirs = {
        name: {title: _cells((r for r in papers if r.dataset == title), columns, [name])[0] for title in IMAGES}
        for name in dict.fromkeys(row.method for row in papers)
    }
    for rows in (found, theirs):
        empty = [EMPTY] * len(PAIR)
        bodies.append([(n, *(c for title in titles for c in by.get(title, empty))) for n, by in rows.items()])
    return Table(
        "tab:near_view",
        "Distance from true second photos",
        f"Distance from true second photos; lower is better. {NEAR_VIEWS}. {_bases(runs)} {_rows_of(runs)} "
        f"Images: {_images(runs)}. Empty: not run.",
        [("", "Method"), *((title, name.upper()) for title in titles for name in PAIR)],
        bodies,
        notes=_notes(runs, PAIR),
    )


def _detail_table(runs: Sequence[Run]) -> Table:
    """PSNR and SSIM over the image, in the hole and outside; the masked distance. Not in the paper."""
    places = [(name, f"{name}{place}", where) for name in SPLIT for place, where in PLACES]
    columns = [
        Column(METRICS[name].title, where, NEAR, figure, METRICS[name].text, METRICS[name].lower)
        for name, figure, where in (*places, ("distance", "distance", "in the hole"))
    ]
    return _dataset_table(
        "tab:near_view_holes",
        "Against true second photos, in the hole and outside",
        "Against true second photos, where it matters. The hole is where the base's opacity is below 0.95. HAR: its "
        f"share of the pixels. {NEAR_VIEWS}. {_bases(runs)} {_rows_of(runs)} Bold: best of a run's rows. "
        "n: images, of those in the paper, which has no such table.",
        runs,
        [Column("", "base HAR", NEAR, "har_before", ratio_text), *columns],
        _named,
        (*SPLIT, "distance"),
    )


def _ablation_table(runs: Sequence[Run]) -> Table:
    """A Gaussian for every cell against those of the mask (tab:mask_guided_init)."""
    return _dataset_table(
        "tab:mask_guided_init",
        "Dense grid against mask guided",
        "Dense grid initialisation against mask guided one. Dense: an aux Gaussian for each cell of 2×2 pixels, in "
        "one pass; mask guided: for the masked cells, with a second pass where that leaves holes. The same network for "
        f"both. Reduction: of the mean count. {NEAR_VIEWS}. {_bases(runs)} n: images, of those in the paper.",
        runs,
        [
            Column("", "Base GS", NEAR, "base_gaussians", count_text),
            Column("", "Aux. GS ↓", NEAR, "aux", lambda count: f"{count:,.2f}"),
            Column("", "Reduction ↑", NEAR, "aux_reduction", lambda share: f"{percent_text(share)}%"),
            *(Column("", METRICS[name].title, NEAR, name, METRICS[name].text) for name in PAIR),
        ],
        lambda run: {m: f"{title} ({run.base})" for m, title in ABLATED.items() if m in run.methods},
        PAIR,
    )


def _images(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.title} {images_text(run)}" for run in runs)
