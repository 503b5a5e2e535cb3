"""The paper's two tables of what Spackle costs in Gaussians and time, its figures beside ours; and one of stages."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence

import numpy as np

from spackle.evaluation.rows import (
    IMAGES,
    NOTE,
    PAPER,
    Row,
    Run,
    datasets,
    images_text,
    mean,
    median,
    paper_rows,
    pivot,
    setting_title,
)
from spackle.evaluation.table import EMPTY, Cells, Table, Text, count_text, percent_text
from spackle.evaluation.timing import BASE_PATH, EXTRA, STAGES

SIDE = "right"  # the end of the swipe where the second camera of Middlebury's and Booster's pairs stands
VIEW = (
    f"One view of each image: the {SIDE} end of a swipe at that disparity (spackle.camera_path.extremes), where the "
    "second camera of a stereo pair would stand; the paper does not say which view it timed"
)
OVERHEAD, EXPANDED = "tab:efficiency_gaussian_overhead", "tab:expanded_efficiency_gaussian_overhead"
THEIRS = "SHARP (paper)"
ODD = {("Middlebury", "0.3", metric) for metric in ("base_ms", "overhead", "base_fps")}  # figures that do not agree
ODD_MARK = "†"
ODD_NOTE = (
    f"{ODD_MARK} Printed as published, though the row contradicts itself: 0.671 FPS is 1,490 ms and not 6,410.3, and "
    "neither gives −3.3 %. The paper's caption speaks of measurement outliers."
)


def _ms(value: float) -> str:
    return f"{value:,.1f}"


def _share(value: float) -> str:
    """Small overheads keep two digits: the question is whether they are below one percent."""
    return f"{100 * value:.2f}%" if value < 0.1 else f"{100 * value:.1f}%"


def _rate(value: float) -> str:
    return f"{value:.3f}" if value >= 0.1 else f"{value:.3g}"


COUNTS: dict[str, tuple[str, Text]] = {"aux": ("Added GS", count_text), "aux_share": ("Added GS (%)", percent_text)}
TIMES: dict[str, tuple[str, Text]] = {
    "base_ms": ("base time (ms)", _ms),
    "spackle_ms": ("Spackle time (ms)", _ms),
    "overhead": ("Time overhead", _share),
    "base_fps": ("base FPS", _rate),
    "spackle_fps": ("Spackle FPS", _rate),
}
EXPANDED_COLUMNS = {**COUNTS, "merged": ("Merged GS", count_text), **TIMES}
RUNTIME = {
    "base_ms": "Median time of the base (ms)",
    "spackle_ms": "Median time with Spackle (ms)",
    "overhead": "Median time overhead",
}


def efficiency_tables(runs: Sequence[Run]) -> list[Table]:
    """All three; the runs have the same disparities."""
    return [_overhead_table(runs), _expanded_table(runs), _stages_table(runs)]


def _figures(rows: Iterable[Row], setting: str, metrics: Iterable[str]) -> list[str]:
    """A setting's figures over images, times as medians and counts as means; the paper's as it prints them."""
    found = pivot(rows, "setting", "metric", "method", "dataset")
    cells = []
    for metric in metrics:
        keys = [key for key in found if key[:2] == (setting, metric)]
        values = [value for key in keys for value in found[key]]
        one = (median if metric in TIMES else mean)(values).value
        theirs = any(key[2].endswith("(paper)") for key in keys)
        text = (lambda share: f"{100 * share:.1f}%") if theirs and metric == "overhead" else EXPANDED_COLUMNS[metric][1]
        mark = ODD_MARK if theirs and any((key[3], setting, metric) in ODD for key in keys) else ""
        cells.append(EMPTY if one is None else text(one) + mark)
    return cells


def _overhead_table(runs: Sequence[Run]) -> Table:
    """Added Gaussians and median times (tab:efficiency_gaussian_overhead)."""
    settings = runs[0].settings
    bases = {base: [run for run in runs if run.base == base] for base in dict.fromkeys(run.base for run in runs)}
    summary = paper_rows(OVERHEAD)

    def counts(rows: Sequence[Row]) -> list[str]:
        return [cell for setting in settings for cell in _figures(rows, setting, COUNTS)]

    bodies: list[list[Cells]] = []
    for dataset in datasets(runs):
        lines = [(run.base, *counts(run.rows)) for run in runs if run.title == dataset]
        if dataset in IMAGES:
            lines.append((THEIRS, *counts([row for row in paper_rows(EXPANDED) if row.dataset == dataset])))
        bodies.append([(EMPTY if k else dataset, *cells) for k, cells in enumerate(lines)])
    lines = []
    for base, own in bases.items():
        if len(own) > 1:  # of the datasets' means, as the paper's
            means = [
                row._replace(value=mean(values).value)
                for run in own
                for (setting, metric), values in pivot(run.rows, "setting", "metric").items()
                for row in [Row(run.title, "", setting, "", base, metric, None)]
                if metric in COUNTS
            ]
            lines.append((base, *counts(means)))
    lines.append((THEIRS, *counts(summary)))
    bodies.append([(EMPTY if k else "Average", *cells) for k, cells in enumerate(lines)])
    rows: list[Cells] = [("Runtime efficiency", *[EMPTY] * (1 + 2 * len(settings)))]
    for metric, title in RUNTIME.items():
        pools = {base: [row for run in own for row in run.rows] for base, own in bases.items()} | {THEIRS: summary}
        for k, (name, pool) in enumerate(pools.items()):
            cells = [cell for s in settings for cell in (*_figures(pool, s, [metric]), EMPTY)]
            rows.append((EMPTY if k else title, name, *cells))
    over = [setting_title(setting, "{}: disparity {}") for setting in settings]
    return Table(
        OVERHEAD,
        "Efficiency and Gaussian overhead",
        "Efficiency and Gaussian overhead. Counts are means over images. Times are medians: ours over the images of "
        f"{', '.join(dict.fromkeys(run.title for run in runs))}, the paper's over its six datasets. {_setup(runs)}",
        [("", "Dataset"), ("", "From"), *((head, title) for head in over for title, _ in COUNTS.values())],
        [*bodies, rows],
        words=2,
        notes=_notes(runs),
    )


def _expanded_table(runs: Sequence[Run]) -> Table:
    """Counts, times and rates of each setting (tab:expanded_efficiency_gaussian_overhead)."""
    bodies: list[list[Cells]] = []
    for dataset in datasets(runs):
        lines: list[Cells] = []
        theirs = [row for row in paper_rows(EXPANDED) if row.dataset == dataset]
        for setting in runs[0].settings:
            name = setting_title(setting)
            for run in (run for run in runs if run.title == dataset):
                lines.append((name, run.base, *_figures(run.rows, setting, EXPANDED_COLUMNS), images_text(run)))
            if any(row.setting == setting for row in theirs):
                figures = _figures(theirs, setting, EXPANDED_COLUMNS)
                lines.append((name, THEIRS, *figures, str(IMAGES[dataset])))
        bodies.append([(EMPTY if k else dataset, *cells) for k, cells in enumerate(lines)])
    marked = any(ODD_MARK in cell for rows in bodies for cells in rows for cell in cells)
    heads = ("Dataset", "Setting", "From", *(title for title, _ in EXPANDED_COLUMNS.values()), "n")
    return Table(
        EXPANDED,
        "Gaussians added and merged, and times",
        "Expanded efficiency and Gaussian overhead. Ours: counts are means and the rest are medians over images; FPS "
        f"is one over the whole time from the photo to the view. {_setup(runs)}",
        [("", head) for head in heads],
        bodies,
        words=3,
        notes=[*_notes(runs), _parameters_note(runs[0]), *([ODD_NOTE] if marked else [])],
    )


def _stages_table(runs: Sequence[Run]) -> Table:
    """Where the time goes."""
    stages: list[tuple[str, str, Text]] = [(title, f"{name}_stage_ms", _ms) for name, title in STAGES.items()]
    sums: list[tuple[str, str, Text]] = [
        (f"base path: the first {len(BASE_PATH)}", "base_ms", _ms),
        (f"Spackle's own: the other {len(EXTRA)}", "extra_ms", _ms),
        ("overhead, of the whole base path", "overhead", _share),
        ("overhead, of the render of the view", "overhead_of_view", _share),
    ]
    bodies = []
    for group in (stages[: len(BASE_PATH)], stages[len(BASE_PATH) :], sums):
        rows = []
        for title, metric, text in group:
            cells = []
            for run in runs:
                for setting in run.settings:
                    low, middle, high = map(float, np.quantile(run.numbers(metric, setting), [0.25, 0.5, 0.75]))
                    cells.append(f"{text(middle)} [{text(low)}, {text(high)}]")
            rows.append((title, *cells))
        bodies.append(rows)
    named = [(f"{run.title}, {run.base}" if len(runs) > 1 else "", setting) for run in runs for setting in run.settings]
    return Table(
        "tab:efficiency_stages",
        "Stages",
        f"Stages on {', '.join(dict.fromkeys(run.title for run in runs))} in milliseconds: median over images "
        "[quartiles]. The render at the photo's camera is needed once a photo, however many views are asked for. "
        f"{_setup(runs)}",
        [("", "Stage"), *((run, setting_title(setting, "{}: disparity {}")) for run, setting in named)],
        bodies,
        notes=_notes(runs),
    )


def _parameters_note(run: Run) -> str:
    """How large the networks are, and how large the paper says they are."""
    counted, paper = run.about["parameters"], PAPER["parameters"]
    base, added = counted["base"] / 1e6, counted["residual"] / 1e6
    return (
        f"Parameters in millions, counted in the networks: SHARP {base:.2f}, of which inference uses "
        f"{counted['base_used'] / 1e6:.2f}; with Spackle {base + added:.2f}; Spackle alone {added:.2f} "
        f"({100 * counted['share']:.2f} %). The paper: {paper['base_m']}, {paper['merged_m']}, "
        f"{paper['residual_m']} ({paper['share_percent']} %)."
    )


def _setup(runs: Sequence[Run]) -> str:
    """The view, the bases, the weights and the machines, for every caption."""
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
    return " ".join([f"{VIEW}.", *dict.fromkeys(texts)])


def _notes(runs: Sequence[Run]) -> list[str]:
    """How the times were taken, and what disturbed them."""
    notes = []
    for run in runs:
        notes.append(
            f"Each stage: median of {run.config['runs']} runs after one that is not counted; the base: "
            f"{run.config['base_runs']} per image. Files are read before the clock starts, and nothing is written. A "
            "time of several stages is the sum of their medians."
        )
        if cold := [row.image for row in run.rows if row.metric == "warm" and not row.value]:
            listed = ", ".join(cold)
            notes.append(f"The base of {listed} was timed at its first prediction in a process: it was not warm.")
        if loads := run.numbers("load"):
            notes.append(
                "Load of the machine before each image (with this benchmark in it): median "
                f"{statistics.median(loads):.1f}, {min(loads):.1f} to {max(loads):.1f}; above the number of cores, "
                "other processes made times longer."
            )
        if failed := list(run.problems):
            notes.append(f"{len(failed)} of {len(run.images)} images gave no figures: {', '.join(failed[:5])}.")
    return list(dict.fromkeys(notes))
