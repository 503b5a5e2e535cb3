"""The paper's six tables and one more, made as pivots of rows; the paper's numbers stand beside ours.

tables.json has titles, captions, columns (group, title, metric, number format) and notes.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from spackle.paper.evaluation.measurements import (
    IMAGES,
    NEAR,
    NOTE,
    PAPER,
    SETTINGS,
    Mean,
    Measurement,
    Run,
    Value,
    load_data,
    mean,
    paper_rows,
    pivot,
    setting_title,
)
from spackle.paper.evaluation.method_descriptions import METHODS
from spackle.paper.evaluation.metrics import METRICS, metric_name
from spackle.paper.evaluation.table import (
    EMPTY,
    NOT_RUN,
    TEXTS,
    Cells,
    Table,
    latex,
    mark_best,
    markdown,
)
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic

FILES = ("tables.md", "tables.tex")
TABLES, NOTES = load_data("tables.json").values()
EFFICIENCY, EXPANDED = (
    "tab:efficiency_gaussian_overhead",
    "tab:expanded_efficiency_gaussian_overhead",
)
FROM_PAPER = " (paper)"  # the end of the method's name in the paper's rows
# Derived metrics: a metric over a second metric of the same method, or of a third entry's method.
RATIOS = {
    "aux_per_cell": ("aux", "hole_cells", ""),
    "reduction": ("har", "har_before", ""),  # 1 minus this ratio (paper, eq. 11)
    "aux_reduction": ("aux", "aux", "dense"),  # 1 minus this ratio
}
TIMES = (
    "base_ms",
    "spackle_ms",
    "overhead",
    "base_fps",
    "spackle_fps",
)  # tables show medians of these


class Column(NamedTuple):
    """A column: a metric at a setting."""

    group: str
    title: str
    setting: str
    metric: str
    text: Callable[[float], str]
    lower: bool | None = None  # whether lower is better; None: do not mark the best


Layout = tuple[list[tuple[str, str]], list[list[Cells]]]  # heads and bodies of a `Table`
Values = Mapping[tuple[str, ...], Sequence[Value]]  # by method, setting and metric


def make_tables(runs: Sequence[Run], *, whole: bool = False) -> list[Table]:
    """Make the tables for which the runs have numbers; with `whole`, make all tables of the paper.

    Counts of Gaussians and times come from benchmarks; for datasets without a benchmark, counts come from large views.

    Raises:
        InputError: two runs have the same dataset, protocol and base, or runs differ in their disparities.
    """
    keys = [(str(run.config["protocol"]), run.title, run.base) for run in runs]
    for protocol, title, base in keys:
        if keys.count((protocol, title, base)) > 1:
            raise InputError(
                f"two results for {title} under {protocol} with the base {base}: give one of the two"
            )
    of = {"near": [run for run in runs if run.near]}
    of["large"] = [run for run in runs if not run.near and not run.timed]
    of["cost"] = [run for run in runs if run.timed]
    of["cost"] += [run for run in of["large"] if ("bench", run.title, run.base) not in keys]
    disparities = {tuple(run.settings) for run in runs if not run.near} or {tuple(SETTINGS)}
    if len(disparities) > 1:
        raise InputError("the results have different disparities: make a separate table for each")
    layouts = {"tab:near_view": _near_table, EFFICIENCY: _overhead_table, EXPANDED: _expanded_table}
    tables = []
    for label, spec in TABLES.items():
        chosen = of[spec["of"]]
        if chosen or (whole and paper_rows(label)):
            settings = [NEAR] if spec["of"] == "near" else [*next(iter(disparities))]
            heads, bodies = layouts.get(label, _dataset_table)(label, spec, chosen, settings)
            notes = [*dict.fromkeys(_notes(spec, chosen)), *spec.get("notes", ())]
            tables.append(
                Table(
                    label,
                    spec["title"],
                    spec["caption"],
                    heads,
                    bodies,
                    spec.get("words", 2),
                    notes,
                )
            )
    return tables


def write_tables(
    tables: Sequence[Table], folder: Path, files: Sequence[str] = FILES, suffix: str = ""
) -> None:
    """Write tables as Markdown and as LaTeX; labels end with `suffix`, so that a document can include several files."""
    write_atomic(folder / files[0], "\n".join(map(markdown, tables)).encode())
    head = "% needs \\usepackage{booktabs,graphicx}\n"
    write_atomic(
        folder / files[1], (head + "\n".join(latex(table, suffix) for table in tables)).encode()
    )


def method_name(run: Run, method: str, title: str = "") -> str:
    """The name of a method's row: with the base's name, and ‡ unless the residual's weights were given."""
    if method == "base":
        return f"{run.base} alone"
    mark = (
        NOTES["recipe"][0]
        if METHODS[method].uses_residual and run.config["residual"]["weights"] != "given"
        else ""
    )
    return f"{title or METHODS[method].title}{mark} ({run.base})"


def _notes(spec: Mapping[str, Any], runs: Sequence[Run]) -> list[str]:
    """Notes below a table, some of them repeated: views, bases, rows, weights, metrics, missing images, times."""
    names = dict.fromkeys(name for column in spec["columns"] if (name := metric_name(column[2])))
    rows = {
        method: spec.get("rows", {}).get(method) for run in runs for method in _row_names(spec, run)
    }
    notes = [
        NOTES[run.config["second_views"] if run.near else "large"].format(**run.config)
        for run in runs
    ]
    notes += [f"Base {run.base}: {run.config['base']['says']}." for run in runs]
    said = [
        f"{title or METHODS[method].title}: {METHODS[method].summary}"
        for method, title in rows.items()
    ]
    notes += [f"Rows: {'; '.join(said)}."] if said else []
    notes += [_residual_note(run) for run in runs]
    notes += [f"{METRICS[name].title[:-2]}: {METRICS[name].definition}." for name in names]
    for run in runs:
        states = {name: str(run.about.get("metrics", {}).get(name)) for name in names}
        for why in dict.fromkeys(state for state in states.values() if state.startswith(NOT_RUN)):
            notes.append(
                f"{', '.join(METRICS[name].title[:-2] for name in names if states[name] == why)} {why}."
            )
        if problems := list(run.problems):
            listed = ", ".join([*problems[:5], *(["…"] if len(problems) > 5 else [])])
            notes.append(
                f"{run.title}: {len(problems)} of {len(run.images)} images could not be measured: {listed}."
            )
    return notes + [note for run in runs if run.timed for note in _timed_notes(run)]


def _residual_note(run: Run) -> str:
    residual = run.config["residual"]
    digest = str(residual["sha256"])[:8]
    if residual["weights"] == "given":
        return f"Residual: given weights ({digest})."
    shipped = f"the residual has the weights that ship with Spackle ({digest})"
    weights = shipped if residual["sha256"] else "the residual has no weights (deltas are 0)"
    note: str = NOTES["recipe"].format(residual=weights)
    return note


def _timed_notes(run: Run) -> list[str]:
    base, residual, hardware = run.config["base"], run.config["residual"], run.config["hardware"]
    precision = next((row.value for row in run.rows if row.metric == f"{NOTE}precision"), None)
    network = f"{run.base}'s network in {precision} on {base['device']}; " if precision else ""
    network += f"residual in {residual['precision']}; " if residual["precision"] else ""
    machine = [hardware["cpu"], f"{hardware['cores']} cores", f"{hardware['threads']} threads"]
    machine += [hardware["gpu"]] if "gpu" in hardware else []
    versions = ", ".join(f"{name} {version}" for name, version in run.config["versions"].items())
    counted = {name: value / 1e6 for name, value in run.about["parameters"].items()}
    sizes = {"base": counted["base"], "used": counted["base_used"], "residual": counted["residual"]}
    sizes |= {"merged": counted["base"] + counted["residual"], "share": 1e8 * counted["share"]}
    return [
        f"Times: {network}renderer and residual on {run.config['device']}. Machine: {', '.join(machine)}; {versions}.",
        NOTES["runs"].format(**run.config),
        NOTES["parameters"].format(**sizes, **PAPER["parameters"]),
    ]


# --- the pivots


def _columns(spec: Mapping[str, Any], settings: Iterable[str], over: str = "") -> list[Column]:
    """A table's columns, once for each setting; `over` is a pattern for the heading above a setting's columns."""
    columns = []
    for setting in settings:
        for group, title, metric, *text in spec["columns"]:
            name, group = metric_name(metric), setting_title(setting, over) if over else group
            best = METRICS[name].lower if name and spec.get("best") else None
            write = TEXTS[text[0]] if text else METRICS[str(name)].text
            columns.append(Column(group, title, setting, metric, write, best))
    return columns


def _find(values: Values, method: str, setting: str, metric: str) -> Mean | None:
    """A metric's mean, or the ratio of two means; values of whole images are valid for all methods."""
    if known := values.get((method, setting, metric)) or values.get(("", "", metric)):
        return mean(known, statistics.median if metric in TIMES else statistics.fmean)
    if metric in RATIOS:
        of, over, other = RATIOS[metric]
        part, whole = (
            _find(values, method, setting, of),
            _find(values, other or method, setting, over),
        )
        if method != other and part and part.value is not None and whole and whole.value:
            ratio = part.value / whole.value
            return Mean(1 - ratio if metric.endswith("reduction") else ratio, 0)
    return None


def _text(found: Mean | None, column: Column, method: str) -> str:
    """A cell: the number, and the count of views without a number; the paper's percentages keep their digits."""
    if found is None:
        return EMPTY
    write = (
        TEXTS["tenths %"]
        if method.endswith(FROM_PAPER) and column.metric == "overhead"
        else column.text
    )
    bad = f"({found.bad} NaN)" if found.bad else ""
    return f"{EMPTY if found.value is None else write(found.value)} {bad}".strip()


def _cells(
    rows: Iterable[Measurement], columns: Sequence[Column], methods: Sequence[str]
) -> list[list[str]]:
    """A row of texts for each method; the best of a column is marked."""
    values, texts = pivot(rows, "method", "setting", "metric"), []
    for column in columns:
        means = {method: _find(values, method, column.setting, column.metric) for method in methods}
        cells = [_text(found, column, method) for method, found in means.items()]
        if column.lower is not None:
            cells = mark_best(
                [found.value if found else None for found in means.values()], cells, column.lower
            )
        texts.append(cells)
    return [list(cells) for cells in zip(*texts, strict=True)]


def _row_names(spec: Mapping[str, Any], run: Run) -> dict[str, str]:
    """The methods of a run that a table shows, with the names of their rows."""
    if "rows" in spec:
        return {
            name: method_name(run, name, title)
            for name, title in spec["rows"].items()
            if name in run.methods
        }
    having = (
        {row.method for row in run.rows if row.metric == spec["having"]} - {"base"}
        if "having" in spec
        else None
    )
    return {
        method: method_name(run, method)
        for method in run.methods
        if having is None or method in having
    }


def _datasets(runs: Sequence[Run]) -> list[str]:
    return list(dict.fromkeys([*IMAGES, *(run.title for run in runs)]))


def grouped(name: str, rows: Sequence[Cells]) -> list[Cells]:
    """Prepend a column with the rows' common name in the first row."""
    return [(EMPTY if k else name, *cells) for k, cells in enumerate(rows)]


def _rows(
    label: str,
    spec: Mapping[str, Any],
    runs: Sequence[Run],
    dataset: str,
    columns: Sequence[Column],
) -> list[tuple[str, str, list[str]]]:
    """A dataset's rows, ours (or "not run") before the paper's; a row is a name, a number of images, and cells."""
    rows = []
    for run in (run for run in runs if run.title == dataset):
        names, of = _row_names(spec, run), f"/{IMAGES[dataset]}" if dataset in IMAGES else ""
        lines = _cells(run.rows, columns, list(names))
        rows += [
            (name, f"{len(run.measured)}{of}", cells)
            for name, cells in zip(names.values(), lines, strict=True)
        ]
    rows = rows or [(NOT_RUN, EMPTY, [EMPTY] * len(columns))]
    papers = [row for row in paper_rows(label) if row.dataset == dataset]
    for name in dict.fromkeys(row.method for row in papers):
        cells = _cells(papers, columns, [name])[0]
        rows += [(name, str(IMAGES[dataset]), cells)] if any(cells) else []
    return rows


def _dataset_table(
    label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]
) -> Layout:
    """A table with rows for our methods and the paper's, by dataset; the columns are repeated for each disparity."""
    columns = _columns(spec, settings, "" if settings == [NEAR] else "{}: disparity {}")
    heads = [
        ("", "Dataset"),
        ("", "Method"),
        ("", "n"),
        *((column.group, column.title) for column in columns),
    ]
    of = {dataset: _rows(label, spec, runs, dataset, columns) for dataset in _datasets(runs)}
    return heads, [
        grouped(dataset, [(name, n, *cells) for name, n, cells in rows])
        for dataset, rows in of.items()
    ]


def _near_table(
    label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]
) -> Layout:
    """A table with a row for each method, and columns for each dataset."""
    columns, titles = _columns(spec, settings), _datasets(runs)
    ours: dict[str, dict[str, list[str]]] = {}
    theirs: dict[str, dict[str, list[str]]] = {}
    for title in titles:
        for name, _, cells in _rows(label, spec, runs, title, columns):
            if name != NOT_RUN:
                (theirs if name.endswith(FROM_PAPER) else ours).setdefault(name, {})[title] = cells
    empty = [EMPTY] * len(columns)
    bodies: list[list[Cells]] = [
        [
            (name, *(cell for title in titles for cell in by.get(title, empty)))
            for name, by in group.items()
        ]
        for group in (ours or {NOT_RUN: {}}, theirs)
    ]
    return [
        ("", "Method"),
        *((title, column.title) for title in titles for column in columns),
    ], bodies


def _overhead_table(
    label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]
) -> Layout:
    """A table of added Gaussians, by dataset and on average; times are medians of the datasets' medians."""
    counts = _columns(spec, settings, "{}: disparity {}")
    of = {dataset: _rows(EXPANDED, spec, runs, dataset, counts) for dataset in _datasets(runs)}
    bodies = [
        grouped(dataset, [(name, *cells) for name, _, cells in rows])
        for dataset, rows in of.items()
    ]
    pools: dict[str, list[Measurement]] = {}  # for each row's name, the numbers of all datasets
    for run in runs:
        values, names = pivot(run.rows, "method", "setting", "metric"), _row_names(spec, run)
        for method, setting, metric in values:
            if method in names and (found := _find(values, method, setting, metric)):
                row = Measurement("", run.title, setting, "", names[method], metric, found.value)
                pools.setdefault(names[method], []).append(row)
    for row in paper_rows(label):
        pools.setdefault(row.method, []).append(row)
    bodies.append(
        grouped(
            "Average", [(name, *_cells(pool, counts, [name])[0]) for name, pool in pools.items()]
        )
    )
    times: list[Cells] = [("Runtime efficiency", *[EMPTY] * (1 + len(counts)))]
    for column in spec["runtime"]:
        columns = _columns({"columns": [column]}, settings)
        medians = {name: _cells(pool, columns, [name])[0] for name, pool in pools.items()}
        spread = [
            (name, *(part for cell in cells for part in (cell, EMPTY)))
            for name, cells in medians.items()
        ]
        times += grouped(column[1], spread)
    return [("", "Dataset"), ("", "From"), *((column.group, column.title) for column in counts)], [
        *bodies,
        times,
    ]


def _expanded_table(
    label: str, spec: Mapping[str, Any], runs: Sequence[Run], settings: Sequence[str]
) -> Layout:
    """A table of counts, times and rates, with a row for each setting and method."""
    bodies = []
    for dataset in _datasets(runs):
        rows: list[Cells] = []
        for setting in settings:
            lines = _rows(label, spec, runs, dataset, _columns(spec, [setting]))
            rows += [(setting_title(setting), name, *cells, n) for name, n, cells in lines]
        bodies.append(grouped(dataset, rows))
    return [
        ("", head) for head in ("Dataset", "Setting", "From", *(c[1] for c in spec["columns"]), "n")
    ], bodies
