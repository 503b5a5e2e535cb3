"""The paper's two tables of efficiency, its numbers beside those measured, and two tables of our own."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence

from spackle.evaluation import paper
from spackle.evaluation import paper_efficiency as published
from spackle.evaluation.efficiency import BASE_PATH, EXTRA, STAGES, Efficiency, Parameters
from spackle.evaluation.table import EMPTY, Line, Table
from spackle.evaluation.tables import PAPER_ROW, count_text

Cells = tuple[str, ...]
Text = Callable[[float], str]

SIDE = "right"  # the end of the swipe where the second camera of Middlebury's and Booster's pairs stands
VIEW = (
    f"One view of each image: the {SIDE} end of a swipe at that disparity (spackle.camera_path.extremes), where the "
    "second camera of a stereo pair would stand; the paper does not say which view it timed"
)
PAPER = PAPER_ROW.format("SHARP")
EXPANDED: Cells = ("Dataset", "Setting", "From", "Added GS", "Added GS (%)", "Merged GS", "base time (ms)")
EXPANDED += ("Spackle time (ms)", "Time overhead", "base FPS", "Spackle FPS", "n")


def efficiency_tables(found: Efficiency, parameters: Parameters) -> list[Table]:
    """All of them; at least one image of `found` was measured."""
    return [_overhead_table(found), _expanded_table(found), _stages_table(found), _parameters_table(parameters)]


def _overhead_table(found: Efficiency) -> Table:
    """Added Gaussians and median times (tab:efficiency_gaussian_overhead)."""
    title, settings = str(found.config["title"]), found.settings
    lines = []
    for name in _titles(found):
        rows = []
        if name == title:
            means = [(found.spread(s, "added").mean, 100 * found.spread(s, "share").mean) for s in settings]
            rows.append((_base(found), *(cell for pair in means for cell in _added(*pair))))
        if name in paper.GAUSSIANS:
            theirs = [paper.at(paper.GAUSSIANS[name], float(setting))[:2] for setting in settings]
            rows.append((PAPER, *(cell for pair in theirs for cell in _added(*pair))))
        lines += _group(name, rows)
    averages = list(zip(published.AVERAGE_ADDED, published.AVERAGE_SHARE_PERCENT, strict=True))
    indices = [published.setting_index(float(setting)) for setting in settings]
    average = [cell for i in indices for cell in _added(*((None, None) if i is None else averages[i]))]
    lines.append(Line(("Average", PAPER, *average), rule=True))
    lines.append(Line(("Runtime efficiency", *[EMPTY] * (1 + 2 * len(settings))), rule=True))
    for name, figure, our_text, their_text, values in (
        ("Median time of the base (ms)", "base_ms", _ms, _ms, published.MEDIAN_BASE_MS),
        ("Median time with Spackle (ms)", "spackle_ms", _ms, _ms, published.MEDIAN_SPACKLE_MS),
        ("Median time overhead", "overhead", _share, _percent, published.MEDIAN_OVERHEAD_PERCENT),
    ):
        ours = [cell for s in settings for cell in (our_text(found.spread(s, figure).median), EMPTY)]
        papers = [cell for i in indices for cell in (EMPTY if i is None else their_text(values[i]), EMPTY)]
        lines += [Line((name, _base(found), *ours)), Line((EMPTY, PAPER, *papers))]
    return Table(
        "tab:efficiency_gaussian_overhead",
        "Efficiency and Gaussian overhead. Counts are means over images. Times are medians: ours over the images of "
        f"{title}, the paper's over its six datasets. {_setup(found)}",
        ("Dataset", "From", *("Added GS", "Added GS (%)") * len(settings)),
        (("", 2), *((_setting(setting, "{}: disparity {}"), 2) for setting in settings)),
        tuple(lines),
        words=2,
        notes=_notes(found),
    )


def _expanded_table(found: Efficiency) -> Table:
    """Counts, times and rates of each setting (tab:expanded_efficiency_gaussian_overhead)."""
    lines: list[Line] = []
    for title in _titles(found):
        rows: list[Cells] = []
        for setting in found.settings:
            rows += [_our_row(found, setting)] if title == found.config["title"] else []
            rows += _paper_row(title, setting)
        lines += _group(title, rows)
    marked = any(published.ODD_MARK in cell for line in lines for cell in line.cells)
    return Table(
        "tab:expanded_efficiency_gaussian_overhead",
        "Expanded efficiency and Gaussian overhead. Ours: counts are means and the rest are medians over images; FPS "
        f"is one over the whole time from the photo to the view. {_setup(found)}",
        EXPANDED,
        (("", len(EXPANDED)),),
        tuple(lines),
        words=3,
        notes=(*_notes(found), *([f"{published.ODD_NOTE}."] if marked else [])),
    )


def _our_row(found: Efficiency, setting: str) -> Cells:
    added, share, merged = (found.spread(setting, figure).mean for figure in ("added", "share", "merged"))
    wanted, count = paper.IMAGES.get(str(found.config["title"])), len(found.measured)
    texts = {"base_ms": _ms, "spackle_ms": _ms, "overhead": _share, "base_fps": _rate, "spackle_fps": _rate}
    medians = (text(found.spread(setting, figure).median) for figure, text in texts.items())
    counts = (*_added(added, 100 * share), count_text(merged))
    return (_setting(setting), _base(found), *counts, *medians, str(count) if wanted is None else f"{count}/{wanted}")


def _paper_row(title: str, setting: str) -> list[Cells]:
    """The paper's row of a dataset; none where it has none."""
    row = published.time_at(title, float(setting))
    if row is None:
        return []
    added, share, merged = paper.at(paper.GAUSSIANS[title], float(setting))
    mark = published.ODD_MARK if (title, float(setting)) == published.ODD else ""
    times = (_ms(row.base_ms) + mark, _ms(row.spackle_ms), _percent(row.overhead_percent) + mark)
    rates = (_rate(row.base_fps) + mark, _rate(row.spackle_fps))
    counts = (*_added(added, share), count_text(merged))
    return [(_setting(setting), PAPER, *counts, *times, *rates, str(paper.IMAGES[title]))]


def _stages_table(found: Efficiency) -> Table:
    """Where the time goes."""
    rows: list[tuple[str, str, Text, bool]] = [
        (title, f"{name}_stage_ms", _ms, name == EXTRA[0]) for name, title in STAGES.items()
    ]
    rows += [
        (f"base path: the first {len(BASE_PATH)}", "base_ms", _ms, True),
        (f"Spackle's own: the other {len(EXTRA)}", "extra_ms", _ms, False),
        ("overhead, of the whole base path", "overhead", _share, True),
        ("overhead, of the render of the view", "overhead_of_view", _share, False),
    ]
    lines = []
    for title, figure, text, rule in rows:
        spreads = [found.spread(setting, figure) for setting in found.settings]
        cells = (f"{text(spread.median)} [{text(spread.q1)}, {text(spread.q3)}]" for spread in spreads)
        lines.append(Line((title, *cells), rule))
    return Table(
        "tab:efficiency_stages",
        f"Stages on {found.config['title']} in milliseconds: median over images [quartiles]. The render at the photo's "
        f"camera is needed once a photo, however many views are asked for. {_setup(found)}",
        ("Stage", *(_setting(setting, "{}: disparity {}") for setting in found.settings)),
        (("", 1 + len(found.settings)),),
        tuple(lines),
        notes=_notes(found),
    )


def _parameters_table(parameters: Parameters) -> Table:
    """How large the networks are."""
    rows = (
        ("SHARP", parameters.base / 1e6, published.PARAMETERS_M),
        ("SHARP and Spackle", (parameters.base + parameters.residual) / 1e6, published.MERGED_PARAMETERS_M),
        ("Spackle alone", parameters.residual / 1e6, published.ADDED_PARAMETERS_M),
        ("Spackle, % of SHARP", 100 * parameters.share, published.ADDED_PARAMETERS_PERCENT),
    )
    return Table(
        "tab:efficiency_parameters",
        "Parameters in millions, counted in the networks: SHARP's as its checkpoint has them, of which inference uses "
        f"{parameters.base_used / 1e6:.2f}. The same whatever base was timed.",
        ("Network", "counted", "paper"),
        (("", 3),),
        tuple(Line((name, f"{ours:.2f}", f"{theirs:.2f}")) for name, ours, theirs in rows),
    )


def _titles(found: Efficiency) -> list[str]:
    return list(dict.fromkeys([*paper.DATASETS, str(found.config["title"])]))


def _group(title: str, rows: Sequence[Cells]) -> list[Line]:
    """Rows under one title, with a rule above the first."""
    return [Line((title if not number else EMPTY, *row), rule=not number) for number, row in enumerate(rows)]


def _base(found: Efficiency) -> str:
    return str(found.config["base"]["title"])


def _setting(setting: str, pattern: str = "{}") -> str:
    """ "S1" for 0.3, or by the pattern "S1: disparity 0.3"; other disparities than the paper's have no such name."""
    index = published.setting_index(float(setting))
    return f"disparity {setting}" if index is None else pattern.format(f"S{index + 1}", setting)


def _added(added: float | None, percent: float | None) -> Cells:
    return count_text(added), EMPTY if percent is None else f"{percent:.2f}"


def _setup(found: Efficiency) -> str:
    """The view, the base, the weights and the machine, for every caption."""
    base, residual = found.config["base"], found.config["residual"]
    hardware, versions = found.config["hardware"], found.config["versions"]
    precision = found.measured[0].facts["notes"].get("precision")
    network = f"network in {precision} on {base['device']}" if precision else "no network"
    weights = "seeds, no weights"
    if residual["sha256"]:
        weights = f"{residual['weights']} weights {residual['sha256'][:8]} in {residual['precision']}, on the processor"
    place = f"{hardware['cpu']}, {hardware['cores']} cores, {hardware['threads']} threads"
    place += f", {hardware['gpu']} for the base, the rest on the processor" if "gpu" in hardware else ""
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"{VIEW}. Base {base['title']}: {base['says']} ({network}). Residual: {weights}. Machine: {place}; {named}."


def _notes(found: Efficiency) -> tuple[str, ...]:
    """How the times were taken, and what disturbed them."""
    runs, base_runs = found.config["runs"], found.config["base_runs"]
    notes = [
        f"Each stage: median of {runs} runs after one that is not counted; the base: {base_runs} per image. Files are "
        "read before the clock starts, and nothing is written. A time of several stages is the sum of their medians."
    ]
    cold = [image.name for image in found.measured if not image.facts["warm"]]
    if cold:
        notes.append(f"The base of {', '.join(cold)} was timed at its first prediction in a process: it was not warm.")
    loads = [float(image.facts["load"]) for image in found.measured if image.facts["load"] is not None]
    if loads:
        notes.append(
            f"Load of the machine before each image (with this benchmark in it): median {statistics.median(loads):.1f},"
            f" {min(loads):.1f} to {max(loads):.1f}; above the number of cores, other processes made times longer."
        )
    if failed := [image.name for image in found.images if image.problem is not None]:
        notes.append(f"{len(failed)} of {len(found.images)} images gave no figures: {', '.join(failed[:5])}.")
    return tuple(notes)


def _ms(value: float) -> str:
    return f"{value:,.1f}"


def _percent(value: float) -> str:
    return f"{value:.1f}%"


def _share(value: float) -> str:
    """Small overheads keep two digits: the question is whether they are below one percent."""
    return f"{100 * value:.2f}%" if value < 0.1 else f"{100 * value:.1f}%"


def _rate(value: float) -> str:
    return f"{value:.3f}" if value >= 0.1 else f"{value:.3g}"
