"""The paper's tables, and some of ours, as pivots of rows; the paper's figures in rows beside ours.

tables.json has their titles, captions, columns (group, title, metric, and how a figure is written) and notes.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spackle.errors import InputError
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import DEFINITIONS, METRICS, NOTICE, definitions, reduction
from spackle.evaluation.rows import (
    BASE_PATH,
    EXTRA,
    IMAGES,
    NEAR,
    NOTE,
    PAPER,
    STAGES,
    Mean,
    Row,
    Run,
    datasets,
    images_text,
    load_data,
    mean,
    paper_rows,
    pivot,
    setting_title,
)
from spackle.evaluation.table import EMPTY, NOT_RUN, TEXTS, Cells, Table, mark_best, write_table
from spackle.files import write_whole

FILES = ("tables.md", "tables.tex")
TABLES = load_data("tables.json")
NOTES: dict[str, str] = TABLES["notes"]
EXPANDED = "tab:expanded_efficiency_gaussian_overhead"
THEIRS = "SHARP (paper)"  # what the paper's figures come from
FROM_PAPER = " (paper)"  # ends the method of the paper's rows
# Relative decreases: of which method (None: the row's own) which figure, and by which of the row's it is replaced.
REDUCED: dict[str, tuple[str | None, str, str]] = {
    "reduction": (None, "har_before", "har"),
    "aux_reduction": ("dense", "aux", "aux"),
}
TIMES = ("base_ms", "spackle_ms", "overhead", "base_fps", "spackle_fps")  # medians, where all others are means
ODD = {("Middlebury", "0.3", metric) for metric in ("base_ms", "overhead", "base_fps")}  # figures that do not agree
ODD_MARK = NOTES["odd"][0]


class Column(NamedTuple):
    """A figure of one setting."""

    group: str
    title: str
    setting: str
    metric: str
    text: Callable[[float], str]
    lower: bool | None = None  # is better; None: no best one is set off


def make_tables(runs: Sequence[Run]) -> list[Table]:
    """All tables; InputError for a dataset twice with one protocol and base, or for different disparities."""
    seen: set[tuple[str, str, str]] = set()
    for run in runs:
        key = str(run.config["protocol"]), run.title, run.base
        if key in seen:
            raise InputError(f"two results for {run.title} under {key[0]} with the base {run.base}: give one of them")
        seen.add(key)
    kinds: dict[str, list[Run]] = {"large": [], "near": [], "bench": []}
    for run in runs:
        kinds["bench" if run.timed else "near" if run.near else "large"].append(run)
    for kind in (kinds["large"], kinds["bench"]):
        if any(run.settings != kind[0].settings for run in kind):
            raise InputError("the results have different disparities: make their tables apart")
    return [
        _table(label, spec, name, of_kind)
        for name, of_kind in kinds.items()
        if of_kind
        for label, spec in TABLES[name].items()
    ]


def write_tables(tables: Sequence[Table], folder: Path, files: Sequence[str] = FILES) -> None:
    """As a file of Markdown and one of LaTeX."""
    write_whole(folder / files[0], "\n".join(write_table(table, "md") for table in tables).encode())
    head = "% needs \\usepackage{booktabs,graphicx}\n"
    write_whole(folder / files[1], (head + "\n".join(write_table(table, "tex") for table in tables)).encode())


def method_name(run: Run, method: str) -> str:
    """What a row is called; the base's name is always in it."""
    return f"{run.base} alone" if method == "base" else f"{METHODS[method][0]} ({run.base})"


def _table(label: str, spec: Mapping[str, Any], kind: str, runs: Sequence[Run]) -> Table:
    make, words = {
        "tab:near_view": (_near_table, 1),
        "tab:efficiency_gaussian_overhead": (_overhead_table, 2),
        EXPANDED: (_expanded_table, 3),
        "tab:efficiency_stages": (_stages_table, 1),
    }.get(label, (_dataset_table, 2))
    heads, bodies = make({"label": spec.get("paper", label), **spec}, runs)
    facts = {"views": TABLES["views"][kind], "base_gaussians": f"{PAPER['base_gaussians']:,}"}
    facts["datasets"] = ", ".join(dict.fromkeys(run.title for run in runs))
    facts["images"] = ", ".join(f"{run.title} {images_text(run)}" for run in runs)
    facts |= _timed_facts(runs) if kind == "bench" else _measured_facts(runs)
    notes = _timed_notes(runs) if kind == "bench" else _measured_notes(spec, runs)
    if label == EXPANDED:
        notes.append(_parameters_note(runs[0]))
        notes += [NOTES["odd"]] if any(ODD_MARK in cell for rows in bodies for cells in rows for cell in cells) else []
    return Table(label, spec["title"], spec["caption"].format(**facts), heads, bodies, words=words, notes=notes)


# --- captions and notes


def _measured_facts(runs: Sequence[Run]) -> dict[str, str]:
    """Which base the rows stand on, what they are, and whose weights the residual has."""
    bases = dict.fromkeys(f"{run.base}: {run.config['base']['says']}" for run in runs)
    names = dict.fromkeys(method for run in runs for method in run.methods)
    residuals = [run.config["residual"] for run in runs]
    weights = dict.fromkeys(
        f"{one['weights']} weights {one['sha256'][:8]}" if one["sha256"] else "no weights, seeds alone"
        for one in residuals
    )
    rows = "; ".join(": ".join(METHODS[name]) for name in names)
    return {"bases": f"Base {'; '.join(bases)}.", "rows": f"Rows: {rows}. Residual: {' and '.join(weights)}."}


def _measured_notes(spec: Mapping[str, Any], runs: Sequence[Run]) -> list[str]:
    """Definitions, what was not run and why, images without figures, terms of pyiqa."""
    names = tuple(dict.fromkeys(name for name in (_metric(column[2]) for column in spec["columns"]) if name))
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


def _timed_facts(runs: Sequence[Run]) -> dict[str, str]:
    """The view, the bases, the weights and the machines."""
    texts = []
    for run in runs:
        base, residual = run.config["base"], run.config["residual"]
        hardware, versions = run.config["hardware"], run.config["versions"]
        precision = next((row.value for row in run.rows if row.metric == f"{NOTE}precision"), None)
        network = f"network in {precision} on {base['device']}" if precision else "no network"
        weights = "seeds, no weights"
        if residual["sha256"]:
            weights = f"{residual['weights']} weights {residual['sha256'][:8]} in {residual['precision']}"
            weights += ", on the processor"
        place = f"{hardware['cpu']}, {hardware['cores']} cores, {hardware['threads']} threads"
        place += f", {hardware['gpu']} for the base, the rest on the processor" if "gpu" in hardware else ""
        named = ", ".join(f"{name} {version}" for name, version in versions.items())
        texts.append(
            f"Base {base['title']}: {base['says']} ({network}). Residual: {weights}. Machine: {place}; {named}."
        )
    return {"setup": " ".join([f"{TABLES['views']['bench']}.", *dict.fromkeys(texts)])}


def _timed_notes(runs: Sequence[Run]) -> list[str]:
    """How the times were taken, and what disturbed them."""
    notes = []
    for run in runs:
        notes.append(NOTES["runs"].format(**run.config))
        if cold := [row.image for row in run.rows if row.metric == "warm" and not row.value]:
            notes.append(NOTES["cold"].format(images=", ".join(cold)))
        if loads := run.numbers("load"):
            notes.append(NOTES["load"].format(median=statistics.median(loads), least=min(loads), most=max(loads)))
        if failed := list(run.problems):
            notes.append(f"{len(failed)} of {len(run.images)} images gave no figures: {', '.join(failed[:5])}.")
    return list(dict.fromkeys(notes))


def _parameters_note(run: Run) -> str:
    """How large the networks are, and how large the paper says they are."""
    counted = run.about["parameters"]
    base, residual = counted["base"] / 1e6, counted["residual"] / 1e6
    sizes = {"base": base, "used": counted["base_used"] / 1e6, "residual": residual, "merged": base + residual}
    return NOTES["parameters"].format(**sizes, share=100 * counted["share"], **PAPER["parameters"])


# --- the pivots


def _metric(figure: str) -> str | None:
    """The metric that a figure of the image, the hole or its outside is of; None of counts and shares."""
    name = figure.partition("_")[0]
    return name if name in METRICS else None


def _columns(spec: Mapping[str, Any], settings: Iterable[str], over: str = "") -> list[Column]:
    """A table's columns at each setting, whose name stands above them by the pattern `over`."""
    columns = []
    for setting in settings:
        for group, title, figure, *text in spec["columns"]:
            name, group = _metric(figure), setting_title(setting, over) if over else group
            best = METRICS[name].lower if name and spec.get("best") else None
            columns.append(
                Column(group, title, setting, figure, TEXTS[text[0]] if text else METRICS[str(name)].text, best)
            )
    return columns


def _cells(rows: Iterable[Row], columns: Sequence[Column], methods: Iterable[str]) -> list[list[str]]:
    """A row of figures for each method, the best of a column set off."""
    rows = list(rows)
    values_of, dataset = pivot(rows, "method", "setting", "metric"), rows[0].dataset if rows else ""

    def find(method: str, setting: str, metric: str) -> Mean | None:
        """Derived figures, too; what is known of images alone is all methods'."""
        if values := values_of.get((method, setting, metric)) or values_of.get(("", "", metric)):
            return mean(values, statistics.median if metric in TIMES else statistics.fmean)
        if metric in REDUCED:
            of, figure, after = REDUCED[metric]
            base, left = find(of or method, setting, figure), find(method, setting, after)
            if method != of and base and base.value and left and left.value is not None:
                return Mean(reduction(base.value, left.value), 0)
        return None

    def text(figure: Mean | None, column: Column, method: str) -> str:
        """Views without a finite value are counted behind it; the paper's percentages are printed as it has them."""
        if figure is None:
            return EMPTY
        paper = method.endswith(FROM_PAPER)
        write = TEXTS["tenths %"] if paper and column.metric == "overhead" else column.text
        mark = ODD_MARK if paper and (dataset, column.setting, column.metric) in ODD else ""
        bad = f"({figure.bad} NaN)" if figure.bad else ""
        return f"{EMPTY if figure.value is None else write(figure.value)}{mark} {bad}".strip()

    texts = []
    for column in columns:
        figures = [find(method, column.setting, column.metric) for method in methods]
        cells = [text(figure, column, method) for figure, method in zip(figures, methods, strict=True)]
        values = [None if figure is None else figure.value for figure in figures]
        texts.append(cells if column.lower is None else mark_best(values, cells, column.lower))
    return [list(cells) for cells in zip(*texts, strict=True)]


Layout = tuple[list[tuple[str, str]], list[list[Cells]]]  # heads and bodies of a `Table`


def _grouped(name: str, rows: Sequence[Cells]) -> list[Cells]:
    """Rows whose first one is preceded by the name of all of them."""
    return [(EMPTY if k else name, *cells) for k, cells in enumerate(rows)]


def _of(label: str, dataset: str) -> list[Row]:
    """The paper's figures for a dataset in a table."""
    return [row for row in paper_rows(label) if row.dataset == dataset]


def _dataset_table(spec: Mapping[str, Any], runs: Sequence[Run]) -> Layout:
    """For each dataset a row for each method, and the paper's rows; the columns repeat for each disparity."""
    columns = _columns(spec, runs[0].settings, "" if runs[0].near else "{}: disparity {}")
    bodies = []
    for dataset in datasets(runs):
        rows: list[Cells] = []
        for run in (run for run in runs if run.title == dataset):
            names = _row_names(spec, run)
            for name, cells in zip(names.values(), _cells(run.rows, columns, names), strict=True):
                rows.append((name, images_text(run), *cells))
        rows = rows or [(NOT_RUN, *[EMPTY] * (1 + len(columns)))]
        papers = _of(spec["label"], dataset)
        for name in dict.fromkeys(row.method for row in papers):
            rows.append((name, str(IMAGES[dataset]), *_cells(papers, columns, [name])[0]))
        bodies.append(_grouped(dataset, rows))
    return [("", "Dataset"), ("", "Method"), ("", "n"), *((column.group, column.title) for column in columns)], bodies


def _row_names(spec: Mapping[str, Any], run: Run) -> dict[str, str]:
    """The methods of a run that a table shows (all, those named by it, or those having a figure), and their names."""
    if "rows" in spec:
        return {method: f"{title} ({run.base})" for method, title in spec["rows"].items() if method in run.methods}
    having = {row.method for row in run.rows if row.metric == spec["having"]} - {"base"} if "having" in spec else None
    return {method: method_name(run, method) for method in run.methods if having is None or method in having}


def _near_table(spec: Mapping[str, Any], runs: Sequence[Run]) -> Layout:
    """A row for each method, columns for each dataset (tab:near_view)."""
    columns, titles = _columns(spec, [NEAR]), datasets(runs)
    bodies: list[list[Cells]] = []
    ours: dict[str, dict[str, list[str]]] = {}
    for run in runs:
        names = _row_names(spec, run)
        for name, cells in zip(names.values(), _cells(run.rows, columns, names), strict=True):
            ours.setdefault(name, {})[run.title] = cells
    methods = dict.fromkeys(row.method for row in paper_rows(spec["label"]))
    theirs = {
        name: {title: _cells(_of(spec["label"], title), columns, [name])[0] for title in IMAGES} for name in methods
    }
    for group in (ours, theirs):
        empty = [EMPTY] * len(columns)
        bodies.append([(name, *(cell for t in titles for cell in by.get(t, empty))) for name, by in group.items()])
    return [("", "Method"), *((title, column.title) for title in titles for column in columns)], bodies


def _overhead_table(spec: Mapping[str, Any], runs: Sequence[Run]) -> Layout:
    """Added Gaussians of each dataset, their average, and median times."""
    settings, label = runs[0].settings, spec["label"]
    counts = _columns(spec, settings, "{}: disparity {}")
    bases = {base: [run for run in runs if run.base == base] for base in dict.fromkeys(run.base for run in runs)}
    (summary,) = dict.fromkeys(row.method for row in paper_rows(label))
    bodies: list[list[Cells]] = []
    for dataset in datasets(runs):
        rows: list[Cells] = [
            (run.base, *_cells(run.rows, counts, run.methods)[0]) for run in runs if run.title == dataset
        ]
        if theirs := _of(EXPANDED, dataset):
            rows.append((THEIRS, *_cells(theirs, counts, [theirs[0].method])[0]))
        bodies.append(_grouped(dataset, rows))
    averages: list[Cells] = []
    for base, group in bases.items():
        if len(group) > 1:  # of the datasets' means, as the paper's
            means = [
                Row(run.title, "", setting, "", base, metric, mean(values).value)
                for run in group
                for (setting, metric), values in pivot(run.rows, "setting", "metric").items()
                if metric in ("aux", "aux_share")
            ]
            averages.append((base, *_cells(means, counts, [base])[0]))
    averages.append((THEIRS, *_cells(paper_rows(label), counts, [summary])[0]))
    bodies.append(_grouped("Average", averages))
    times: list[Cells] = [("Runtime efficiency", *[EMPTY] * (1 + len(counts)))]
    pools = {base: ([row for run in group for row in run.rows], group[0].methods[0]) for base, group in bases.items()}
    pools[THEIRS] = (list(paper_rows(label)), summary)
    for column in spec["runtime"]:
        rows = []
        for name, (pool, method) in pools.items():
            cells = _cells(pool, _columns({"columns": [column]}, settings), [method])[0]
            rows.append((name, *(part for cell in cells for part in (cell, EMPTY))))
        times += _grouped(column[1], rows)
    return [("", "Dataset"), ("", "From"), *((column.group, column.title) for column in counts)], [*bodies, times]


def _expanded_table(spec: Mapping[str, Any], runs: Sequence[Run]) -> Layout:
    """Counts, times and rates, a row for each setting."""
    bodies = []
    for dataset in datasets(runs):
        rows: list[Cells] = []
        theirs = _of(EXPANDED, dataset)
        for setting in runs[0].settings:
            name, columns = setting_title(setting), _columns(spec, [setting])
            for run in (run for run in runs if run.title == dataset):
                rows.append((name, run.base, *_cells(run.rows, columns, run.methods)[0], images_text(run)))
            if any(row.setting == setting for row in theirs):
                figures = _cells(theirs, columns, [theirs[0].method])[0]
                rows.append((name, THEIRS, *figures, str(IMAGES[dataset])))
        bodies.append(_grouped(dataset, rows))
    return [("", head) for head in ("Dataset", "Setting", "From", *(c[1] for c in spec["columns"]), "n")], bodies


def _stages_table(spec: Mapping[str, Any], runs: Sequence[Run]) -> Layout:
    """Where the time goes: stages, and what they come to; a column for each run and setting."""
    base = [(STAGES[name], f"{name}_stage_ms", "tenths") for name in BASE_PATH]
    extra = [(STAGES[name], f"{name}_stage_ms", "tenths") for name in EXTRA]
    sums = [(f"base path: the first {len(base)}", "base_ms", "tenths")]
    sums += [(f"Spackle's own: the other {len(extra)}", "extra_ms", "tenths")]
    sums += [(title, figure, text) for _, title, figure, text in spec["columns"]]
    places = [(run, setting) for run in runs for setting in run.settings]
    bodies = []
    for group in (base, extra, sums):
        rows: list[Cells] = []
        for title, metric, text in group:
            cells = []
            for run, setting in places:
                low, middle, high = map(TEXTS[text], np.quantile(run.numbers(metric, setting), [0.25, 0.5, 0.75]))
                cells.append(f"{middle} [{low}, {high}]")
            rows.append((title, *cells))
        bodies.append(rows)
    over = [f"{run.title}, {run.base}" if len(runs) > 1 else "" for run, _ in places]
    titles = [setting_title(setting, "{}: disparity {}") for _, setting in places]
    return [("", "Stage"), *zip(over, titles, strict=True)], bodies
