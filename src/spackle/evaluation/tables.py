"""The paper's six tables and two more, as pivots of rows; the paper's figures have rows beside ours.

tables.json has their titles, captions, columns (group, title, metric, number format) and notes.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spackle.errors import InputError
from spackle.evaluation.methods import METHODS, RESIDUAL
from spackle.evaluation.metrics import DEFINITIONS, METRICS, NOTICE, metric_name, reduction
from spackle.evaluation.rows import (
    IMAGES,
    NEAR,
    NOTE,
    PAPER,
    SETTINGS,
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
from spackle.evaluation.table import EMPTY, NOT_RUN, TEXTS, Cells, Table, latex, mark_best, markdown
from spackle.files import write_whole

FILES = ("tables.md", "tables.tex")
TABLES, NOTES = load_data("tables.json").values()
EFFICIENCY, EXPANDED = "tab:efficiency_gaussian_overhead", "tab:expanded_efficiency_gaussian_overhead"
FROM_PAPER = " (paper)"  # the end of the method's name in the paper's rows
# Relative decreases: the reference method (None: the row's own), its figure, and the row's figure that replaces it.
REDUCED: dict[str, tuple[str | None, str, str]] = {
    "reduction": (None, "har_before", "har"),
    "aux_reduction": ("dense", "aux", "aux"),
}
TIMES = ("base_ms", "spackle_ms", "overhead", "base_fps", "spackle_fps")  # their medians are shown, means of others
ODD = {("Middlebury", "0.3", metric) for metric in ("base_ms", "overhead", "base_fps")}  # contradictory figures
ODD_MARK, RECIPE_MARK = NOTES["odd"][0], NOTES["recipe"][0]


class Column(NamedTuple):
    """A column: a figure at a setting."""

    group: str
    title: str
    setting: str
    metric: str
    text: Callable[[float], str]
    lower: bool | None = None  # whether lower is better; None: do not mark the best


def make_tables(runs: Sequence[Run], *, whole: bool = False) -> list[Table]:
    """Make the tables for which the runs have figures; with `whole`, all of the paper's.

    Counts of Gaussians and times come from benchmarks; for datasets without one, counts come from their large views.

    Raises:
        InputError: two runs have the same dataset, protocol and base, or runs differ in their disparities.
    """
    seen: set[tuple[str, str, str]] = set()
    for run in runs:
        key = str(run.config["protocol"]), run.title, run.base
        if key in seen:
            raise InputError(f"two results for {run.title} under {key[0]} with the base {run.base}: give one of them")
        seen.add(key)
    of = {"near": [run for run in runs if run.near], "bench": [run for run in runs if run.timed]}
    of["large"] = [run for run in runs if not run.near and not run.timed]
    of["cost"] = of["bench"] + [run for run in of["large"] if ("bench", run.title, run.base) not in seen]
    settings = next((run.settings for run in runs if not run.near), SETTINGS)
    if any(run.settings != settings for run in runs if not run.near):
        raise InputError("the results have different disparities: make a separate table for each")
    return [
        _table(label, spec, of[spec["of"]], [NEAR] if spec["of"] == "near" else settings)
        for label, spec in TABLES.items()
        if of[spec["of"]] or (whole and paper_rows(label))
    ]


def write_tables(tables: Sequence[Table], folder: Path, files: Sequence[str] = FILES, suffix: str = "") -> None:
    """Write tables as Markdown and as LaTeX; labels end with `suffix`, so that a document can include several files."""
    write_whole(folder / files[0], "\n".join(map(markdown, tables)).encode())
    head = "% needs \\usepackage{booktabs,graphicx}\n"
    write_whole(folder / files[1], (head + "\n".join(latex(table, suffix) for table in tables)).encode())


def method_name(run: Run, method: str, title: str = "") -> str:
    """The name of a method's row: with the base's name, and a mark unless the residual's weights were given."""
    if method == "base":
        return f"{run.base} alone"
    mark = RECIPE_MARK if method in RESIDUAL and run.config["residual"]["weights"] != "given" else ""
    return f"{title or METHODS[method].title}{mark} ({run.base})"


def _table(label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]) -> Table:
    makers = {
        "tab:near_view": _near_table,
        EFFICIENCY: _overhead_table,
        EXPANDED: _expanded_table,
        "tab:efficiency_stages": _stages_table,
    }
    heads, bodies = makers.get(label, _dataset_table)(label, spec, runs, settings)
    cells = "".join(cell for rows in bodies for cells in rows for cell in cells)
    notes = list(dict.fromkeys([*_notes(spec, runs, cells), *(_timed_notes(runs) if spec["of"] != "near" else [])]))
    return Table(label, spec["title"], spec["caption"], heads, bodies, words=spec.get("words", 2), notes=notes)


# --- notes


def _notes(spec: Mapping[str, Any], runs: Sequence[Run], cells: str) -> list[str]:
    """Notes below a table: views, bases, rows, the residual's weights, definitions, reasons for missing figures, and
    pyiqa's licence.
    """
    names = tuple(dict.fromkeys(name for name in (metric_name(column[2]) for column in spec["columns"]) if name))
    notes = [NOTES["swipe"].format(side=run.config["side"]) for run in runs if not run.near]
    for kind in dict.fromkeys(run.config["second_views"] for run in runs if run.near):
        titles = dict.fromkeys(run.title for run in runs if run.config["second_views"] == kind)
        notes.append(NOTES[kind].format(datasets=", ".join(titles)))
    notes += [f"Base {run.base}: {run.config['base']['says']}." for run in runs]
    called: dict[str, str] = {name: spec.get("rows", {}).get(name) or METHODS[name].title for name in METHODS}
    shown = dict.fromkeys(name for run in runs for name in run.methods if called[name] in cells)
    notes += [f"Rows: {'; '.join(f'{called[name]}: {METHODS[name].says}' for name in shown)}."] if shown else []
    for weights in dict.fromkeys(_weights(run) for run in runs):
        foreign = not weights.startswith("given")
        notes.append(NOTES["recipe"].format(residual=weights) if foreign else f"Residual: {weights}.")
    notes += [f"{METRICS[name].title[:-2]}: {METRICS[name].definition}." for name in names]
    measured = [(run.title, name, run.about.get("metrics", {}).get(name)) for run in runs for name in names]
    states = [(title, METRICS[name].title[:-2], state) for title, name, state in measured]
    for why in dict.fromkeys(why for *_, why in states if str(why).startswith(NOT_RUN)):
        where, what = (", ".join(dict.fromkeys(one[k] for one in states if one[2] == why)) for k in (0, 1))
        notes.append(f"{where}: {what} {why}.")
    for run in runs:
        if passed := list(run.problems):
            more = f" and {len(passed) - 5} more" if len(passed) > 5 else ""
            listed = f"{', '.join(passed[:5])}{more}"
            notes.append(f"{run.title}: {len(passed)} of {len(run.images)} images gave no figures: {listed}.")
    notes += [NOTES[mark] for mark, sign in (("best", "**"), ("n", "/"), ("odd", ODD_MARK)) if sign in cells]
    notes += [NOTES["average"]] if "Average" in cells else []
    return [*notes, f"{NOTICE}."] if any(name in DEFINITIONS for name in names) else notes


def _weights(run: Run) -> str:
    """A text about the origin of the residual's weights."""
    residual = run.config["residual"]
    if not residual["sha256"]:
        return "the residual has no weights, its deltas are 0"
    origin = (
        "given weights" if residual["weights"] == "given" else "the residual has the weights that ship with Spackle"
    )
    return f"{origin} ({residual['sha256'][:8]})"


def _timed_notes(runs: Sequence[Run]) -> list[str]:
    """Notes on times: machine, method, other load, sizes of the networks."""
    notes, runs = [], [run for run in runs if run.timed]
    if cold := [row.image for run in runs for row in run.rows if row.metric == "warm" and not row.value]:
        notes.append(NOTES["cold"].format(images=", ".join(cold)))
    if loads := [load for run in runs for load in run.numbers("load")]:
        notes.append(NOTES["load"].format(median=statistics.median(loads), least=min(loads), most=max(loads)))
    for run in runs:
        base, hardware, versions = run.config["base"], run.config["hardware"], run.config["versions"]
        precision = next((row.value for row in run.rows if row.metric == f"{NOTE}precision"), None)
        network = f"{run.base}'s network in {precision} on {base['device']}; " if precision else ""
        if run.config["residual"]["precision"]:
            network += f"residual in {run.config['residual']['precision']}; "
        place = f"{hardware['cpu']}, {hardware['cores']} cores, {hardware['threads']} threads"
        place += f", {hardware['gpu']}" if "gpu" in hardware else ""
        named = ", ".join(f"{name} {version}" for name, version in versions.items())
        notes.append(f"Times: {network}renderer and residual on {run.config['device']}. Machine: {place}; {named}.")
        notes.append(NOTES["runs"].format(**run.config))
        counted = {name: value / 1e6 for name, value in run.about["parameters"].items()}
        sizes = {"base": counted["base"], "used": counted["base_used"], "residual": counted["residual"]}
        sizes |= {"merged": counted["base"] + counted["residual"], "share": 1e8 * counted["share"]}
        notes.append(NOTES["parameters"].format(**sizes, **PAPER["parameters"]))
    return notes


# --- the pivots


def _columns(spec: Mapping[str, Any], settings: Iterable[str], over: str = "") -> list[Column]:
    """A table's columns at each setting; if the pattern `over` is given, it makes the head of each setting."""
    columns = []
    for setting in settings:
        for group, title, figure, *text in spec["columns"]:
            name, group = metric_name(figure), setting_title(setting, over) if over else group
            best = METRICS[name].lower if name and spec.get("best") else None
            columns.append(
                Column(group, title, setting, figure, TEXTS[text[0]] if text else METRICS[str(name)].text, best)
            )
    return columns


def _cells(rows: Iterable[Row], columns: Sequence[Column], methods: Iterable[str]) -> list[list[str]]:
    """A row of texts for each method; the best of a column is marked."""
    rows = list(rows)
    values_of, dataset = pivot(rows, "method", "setting", "metric"), rows[0].dataset if rows else ""

    def find(method: str, setting: str, metric: str) -> Mean | None:
        """A figure, possibly a derived one; figures of whole images are valid for all methods."""
        if values := values_of.get((method, setting, metric)) or values_of.get(("", "", metric)):
            return mean(values, statistics.median if metric in TIMES else statistics.fmean)
        if metric == "aux_per_cell":
            aux, holes = find(method, setting, "aux"), find(method, setting, "hole_cells")
            return Mean(aux.value / holes.value, 0) if aux and aux.value and holes and holes.value else None
        if metric in REDUCED:
            of, figure, after = REDUCED[metric]
            base, left = find(of or method, setting, figure), find(method, setting, after)
            if method != of and base and base.value and left and left.value is not None:
                return Mean(reduction(base.value, left.value), 0)
        return None

    def text(figure: Mean | None, column: Column, method: str) -> str:
        """Write a figure, and after it the number of views without one; the paper's percentages keep their digits."""
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


def grouped(name: str, rows: Sequence[Cells]) -> list[Cells]:
    """Prepend a column with the rows' common name, which only the first row shows."""
    return [(EMPTY if k else name, *cells) for k, cells in enumerate(rows)]


def _row_names(spec: Mapping[str, Any], run: Run) -> dict[str, str]:
    """A run's methods that a table shows (all, those named in it, or those with a certain figure), with their names."""
    if "rows" in spec:
        return {name: method_name(run, name, title) for name, title in spec["rows"].items() if name in run.methods}
    having = {row.method for row in run.rows if row.metric == spec["having"]} - {"base"} if "having" in spec else None
    return {method: method_name(run, method) for method in run.methods if having is None or method in having}


def _rows(
    label: str, spec: Mapping[str, Any], runs: Sequence[Run], dataset: str, columns: Sequence[Column]
) -> list[tuple[str, str, list[str]]]:
    """A dataset's rows, ours (or "not run") and then the paper's: name, number of images, and cells of each."""
    rows = []
    for run in (run for run in runs if run.title == dataset):
        names = _row_names(spec, run)
        lines = _cells(run.rows, columns, names)
        rows += [(name, images_text(run), cells) for name, cells in zip(names.values(), lines, strict=True)]
    rows = rows or [(NOT_RUN, EMPTY, [EMPTY] * len(columns))]
    papers = [row for row in paper_rows(label) if row.dataset == dataset]
    for name in dict.fromkeys(row.method for row in papers):
        cells = _cells(papers, columns, [name])[0]
        rows += [(name, str(IMAGES[dataset]), cells)] if any(cells) else []
    return rows


def _dataset_table(label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]) -> Layout:
    """A table with rows for each dataset's methods and the paper's; its columns are repeated for each disparity."""
    columns = _columns(spec, settings, "" if settings == [NEAR] else "{}: disparity {}")
    heads = [("", "Dataset"), ("", "Method"), ("", "n"), *((column.group, column.title) for column in columns)]
    of = {dataset: _rows(label, spec, runs, dataset, columns) for dataset in datasets(runs)}
    return heads, [grouped(dataset, [(name, n, *cells) for name, n, cells in rows]) for dataset, rows in of.items()]


def _near_table(label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]) -> Layout:
    """A table with a row for each method, and columns for each dataset."""
    columns, titles = _columns(spec, settings), datasets(runs)
    ours: dict[str, dict[str, list[str]]] = {}
    theirs: dict[str, dict[str, list[str]]] = {}
    for title in titles:
        for name, _, cells in _rows(label, spec, runs, title, columns):
            if name != NOT_RUN:
                (theirs if name.endswith(FROM_PAPER) else ours).setdefault(name, {})[title] = cells
    empty = [EMPTY] * len(columns)
    bodies: list[list[Cells]] = [
        [(name, *(cell for title in titles for cell in by.get(title, empty))) for name, by in group.items()]
        for group in (ours or {NOT_RUN: {}}, theirs)
    ]
    return [("", "Method"), *((title, column.title) for title in titles for column in columns)], bodies


def _overhead_table(label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]) -> Layout:
    """A table of added Gaussians for each dataset and on average, and of medians of the datasets' median times."""
    counts = _columns(spec, settings, "{}: disparity {}")
    of = {dataset: _rows(EXPANDED, spec, runs, dataset, counts) for dataset in datasets(runs)}
    bodies = [grouped(dataset, [(name, *cells) for name, _, cells in rows]) for dataset, rows in of.items()]
    pools: dict[str, list[Row]] = {}  # for each row's name, the figures of all datasets
    for run in runs:
        for method, name in _row_names(spec, run).items():
            for (by, setting, metric), values in pivot(run.rows, "method", "setting", "metric").items():
                if by == method:
                    over = mean(values, statistics.median if metric in TIMES else statistics.fmean)
                    pools.setdefault(name, []).append(Row("", run.title, setting, "", name, metric, over.value))
    for row in paper_rows(label):
        pools.setdefault(row.method, []).append(row)
    bodies.append(grouped("Average", [(name, *_cells(pool, counts, [name])[0]) for name, pool in pools.items()]))
    times: list[Cells] = [("Runtime efficiency", *[EMPTY] * (1 + len(counts)))]
    for column in spec["runtime"]:
        columns = _columns({"columns": [column]}, settings)
        medians = {name: _cells(pool, columns, [name])[0] for name, pool in pools.items()}
        spread = [(name, *(part for cell in cells for part in (cell, EMPTY))) for name, cells in medians.items()]
        times += grouped(column[1], spread)
    return [("", "Dataset"), ("", "From"), *((column.group, column.title) for column in counts)], [*bodies, times]


def _expanded_table(label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]) -> Layout:
    """A table of counts, times and rates, with a row for each setting and method."""
    bodies = []
    for dataset in datasets(runs):
        rows: list[Cells] = []
        for setting in settings:
            lines = _rows(label, spec, runs, dataset, _columns(spec, [setting]))
            rows += [(setting_title(setting), name, *cells, n) for name, n, cells in lines]
        bodies.append(grouped(dataset, rows))
    return [("", head) for head in ("Dataset", "Setting", "From", *(c[1] for c in spec["columns"]), "n")], bodies


def _stages_table(label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]) -> Layout:
    """A table of the stages' times, with a row for each setting and method, and columns for stages and sums."""
    stages = [("", title, f"{name}_stage_ms", "tenths") for name, title in STAGES.items()]
    columns = [(title, metric, TEXTS[text]) for _, title, metric, text in (*stages, *spec["columns"])]
    bodies = []
    for run in runs:
        rows: list[Cells] = []
        for setting in settings:
            for method in run.methods:
                cells = []
                for _, metric, text in columns:
                    numbers = run.numbers(metric, setting, method)
                    low, middle, high = map(text, np.quantile(numbers, [0.25, 0.5, 0.75]))
                    cells.append(f"{middle} [{low}, {high}]")
                rows.append((setting_title(setting), method_name(run, method), *cells))
        bodies.append(grouped(run.title, rows))
    return [("", head) for head in ("Dataset", "Setting", "From", *(title for title, *_ in columns))], bodies
