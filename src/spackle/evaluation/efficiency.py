"""What views cost in Gaussians and in time, and the paper's two tables of it, its numbers beside those measured."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from spackle.evaluation import paper
from spackle.evaluation.table import EMPTY, Line, Table
from spackle.evaluation.tables import PAPER_ROW, count_text
from spackle.evaluation.timing import MS

Record = dict[str, Any]  # ready for JSON
Cells = tuple[str, ...]
Text = Callable[[float], str]

# Stages in the order of the work, as the tables call them.
STAGES = {
    "base": "photo to base Gaussians",
    "view": "render of the view",
    "photo": "render at the photo's camera",
    "completion": "mask, seeds, network, placing",
    "rerender": "re-render of touched tiles, after each pass",
}
BASE_PATH = ("base", "view")  # from the photo to a picture without Spackle
EXTRA = ("photo", "completion", "rerender")  # what Spackle adds to it
SIDE = "right"  # the end of the swipe where the second camera of Middlebury's and Booster's pairs stands
VIEW = (
    f"One view of each image: the {SIDE} end of a swipe at that disparity (spackle.camera_path.extremes), where the "
    "second camera of a stereo pair would stand; the paper does not say which view it timed"
)
PAPER = PAPER_ROW.format("SHARP")
EXPANDED: Cells = ("Dataset", "Setting", "From", "Added GS", "Added GS (%)", "Merged GS", "base time (ms)")
EXPANDED += ("Spackle time (ms)", "Time overhead", "base FPS", "Spackle FPS", "n")
ODD_MARK = "†"
ODD_NOTE = (
    f"{ODD_MARK} Printed as published, though the row contradicts itself: 0.671 FPS is 1,490 ms and not 6,410.3, and "
    "neither gives −3.3 %. The paper's caption speaks of measurement outliers."
)


class Spread(NamedTuple):
    """Of a figure over images."""

    n: int
    mean: float
    q1: float
    median: float
    q3: float


@dataclasses.dataclass(frozen=True)
class Efficiency:
    """The costs of a dataset's images.

    An image is a record of its name, facts (sizes, notes of the base, load of the machine), views (see `view_cost`),
    and the problem that left it without views, or None.
    """

    config: Mapping[str, Any]
    images: Sequence[Record]

    @property
    def measured(self) -> list[Record]:
        """The images that gave figures."""
        return [image for image in self.images if image["problem"] is None]

    @property
    def settings(self) -> list[str]:
        """The disparities as the views have them."""
        return [f"{disparity:g}" for disparity in self.config["disparities"]]

    def spread(self, setting: str, figure: str) -> Spread:
        """Over the measured images, of which there is at least one; each counts once."""
        views = [view for image in self.measured for view in image["views"] if view["setting"] == setting]
        found = [view["figures"][figure] for view in views]
        q1, median, q3 = (float(value) for value in np.quantile(found, [0.25, 0.5, 0.75]))
        return Spread(len(found), float(np.mean(found)), q1, median, q3)

    def plain(self) -> Record:
        """Ready for JSON: everything, and the medians beside it."""
        figures = self.measured[0]["views"][0]["figures"]
        spreads = [
            {"setting": s, "figure": name} | self.spread(s, name)._asdict() for s in self.settings for name in figures
        ]
        problems = {image["name"]: image["problem"] for image in self.images if image["problem"] is not None}
        return {"config": dict(self.config), "problems": problems, "spreads": spreads, "images": list(self.images)}


def view_cost(setting: str, base_gaussians: int, added: int, seconds: Mapping[str, Sequence[float]]) -> Record:
    """A view's record: counts, the seconds of each run of `STAGES`, and every figure of the tables that comes of them.

    The figures are counts, milliseconds (medians of runs), shares (not percent) and views a second.
    """
    stages = {name: MS * statistics.median(seconds[name]) for name in STAGES}
    before, extra = (sum(stages[name] for name in names) for names in (BASE_PATH, EXTRA))
    figures = {
        "added": added,
        "share": added / base_gaussians,
        "base_gaussians": base_gaussians,
        "merged": base_gaussians + added,
        "base_ms": before,
        "spackle_ms": before + extra,
        "extra_ms": extra,
        "overhead": extra / before,
        "overhead_of_view": extra / stages["view"],
        "base_fps": MS / before,
        "spackle_fps": MS / (before + extra),
        **{f"{name}_stage_ms": ms for name, ms in stages.items()},
    }
    counts = {"base_gaussians": base_gaussians, "added": added}
    return {"setting": setting, **counts, "seconds": dict(seconds), "figures": figures}


def efficiency_tables(found: Efficiency, parameters: Mapping[str, float]) -> list[Table]:
    """All of them; at least one image of `found` was measured."""
    return [_overhead_table(found), _expanded_table(found, parameters), _stages_table(found)]


def _overhead_table(found: Efficiency) -> Table:
    """Added Gaussians and median times (tab:efficiency_gaussian_overhead)."""
    title, base, settings = str(found.config["title"]), str(found.config["base"]["title"]), found.settings

    def counts(name: str) -> list[Cells]:
        rows = []
        if name == title:
            means = [(found.spread(s, "added").mean, 100 * found.spread(s, "share").mean) for s in settings]
            rows.append((base, *(cell for pair in means for cell in _added(*pair))))
        return [*rows, published(paper.GAUSSIANS[name])] if name in paper.GAUSSIANS else rows

    def published(numbers: tuple[float, ...]) -> Cells:
        return (PAPER, *(cell for s in settings for cell in _added(*paper.at(numbers, float(s))[:2])))

    lines = _grouped(found, counts)
    lines.append(Line(("Average", *published(paper.AVERAGE)), rule=True))
    lines.append(Line(("Runtime efficiency", *[EMPTY] * (1 + 2 * len(settings))), rule=True))
    for name, figure, our_text, their_text, medians in (
        ("Median time of the base (ms)", "base_ms", _ms, _ms, paper.MEDIAN_BASE_MS),
        ("Median time with Spackle (ms)", "spackle_ms", _ms, _ms, paper.MEDIAN_SPACKLE_MS),
        ("Median time overhead", "overhead", _share, _percent, paper.MEDIAN_OVERHEAD),
    ):
        ours = [cell for s in settings for cell in (our_text(found.spread(s, figure).median), EMPTY)]
        values = [paper.at(medians, float(s))[0] for s in settings]
        theirs = [cell for value in values for cell in (EMPTY if value is None else their_text(value), EMPTY)]
        lines += [Line((name, base, *ours)), Line((EMPTY, PAPER, *theirs))]
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


def _expanded_table(found: Efficiency, parameters: Mapping[str, float]) -> Table:
    """Counts, times and rates of each setting (tab:expanded_efficiency_gaussian_overhead)."""

    def rows(title: str) -> list[Cells]:
        found_rows = []
        for setting in found.settings:
            found_rows += [_our_row(found, setting)] if title == found.config["title"] else []
            known = title in paper.TIMES and float(setting) in paper.DISPARITIES
            found_rows += [_paper_row(title, setting)] if known else []
        return found_rows

    lines = _grouped(found, rows)
    marked = any(ODD_MARK in cell for line in lines for cell in line.cells)
    return Table(
        "tab:expanded_efficiency_gaussian_overhead",
        "Expanded efficiency and Gaussian overhead. Ours: counts are means and the rest are medians over images; FPS "
        f"is one over the whole time from the photo to the view. {_setup(found)}",
        EXPANDED,
        (("", len(EXPANDED)),),
        tuple(lines),
        words=3,
        notes=(*_notes(found), _parameters_note(parameters), *([ODD_NOTE] if marked else [])),
    )


def _our_row(found: Efficiency, setting: str) -> Cells:
    added, share, merged = (found.spread(setting, figure).mean for figure in ("added", "share", "merged"))
    wanted, count = paper.IMAGES.get(str(found.config["title"])), len(found.measured)
    texts = {"base_ms": _ms, "spackle_ms": _ms, "overhead": _share, "base_fps": _rate, "spackle_fps": _rate}
    medians = (text(found.spread(setting, figure).median) for figure, text in texts.items())
    counts = (str(found.config["base"]["title"]), *_added(added, 100 * share), count_text(merged))
    return (_setting(setting), *counts, *medians, str(count) if wanted is None else f"{count}/{wanted}")


def _paper_row(title: str, setting: str) -> Cells:
    added, share, merged = paper.at(paper.GAUSSIANS[title], float(setting))
    values = [value or 0.0 for value in paper.at(paper.TIMES[title], float(setting))]
    times = [text(value) for text, value in zip((_ms, _ms, _percent, _rate, _rate), values, strict=True)]
    if (title, float(setting)) == paper.ODD_TIME:
        times = [text + ODD_MARK * (k in (0, 2, 3)) for k, text in enumerate(times)]
    return (_setting(setting), PAPER, *_added(added, share), count_text(merged), *times, str(paper.IMAGES[title]))


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


def _parameters_note(counted: Mapping[str, float]) -> str:
    """How large the networks are, and how large the paper says they are."""
    base, added = counted["base"] / 1e6, counted["residual"] / 1e6
    return (
        f"Parameters in millions, counted in the networks: SHARP {base:.2f}, of which inference uses "
        f"{counted['base_used'] / 1e6:.2f}; with Spackle {base + added:.2f}; Spackle alone {added:.2f} "
        f"({100 * counted['share']:.2f} %). The paper: {paper.PARAMETERS_M}, {paper.MERGED_PARAMETERS_M}, "
        f"{paper.ADDED_PARAMETERS_M} ({paper.ADDED_PARAMETERS_PERCENT} %)."
    )


def _grouped(found: Efficiency, rows: Callable[[str], Sequence[Cells]]) -> list[Line]:
    """The rows of each dataset under its title, with a rule above the first."""
    titles = dict.fromkeys([*paper.DATASETS, str(found.config["title"])])
    return [
        Line((EMPTY if number else title, *row), rule=not number)
        for title in titles
        for number, row in enumerate(rows(title))
    ]


def _setting(setting: str, pattern: str = "{}") -> str:
    """ "S1" for 0.3, or by the pattern "S1: disparity 0.3"; other disparities than the paper's have no such name."""
    if float(setting) not in paper.DISPARITIES:
        return f"disparity {setting}"
    return pattern.format(f"S{paper.DISPARITIES.index(float(setting)) + 1}", setting)


def _added(added: float | None, percent: float | None) -> Cells:
    return count_text(added), EMPTY if percent is None else f"{percent:.2f}"


def _setup(found: Efficiency) -> str:
    """The view, the base, the weights and the machine, for every caption."""
    base, residual = found.config["base"], found.config["residual"]
    hardware, versions = found.config["hardware"], found.config["versions"]
    precision = found.measured[0]["facts"]["notes"].get("precision")
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
    facts = {image["name"]: image["facts"] for image in found.measured}
    if cold := [name for name, known in facts.items() if not known["warm"]]:
        notes.append(f"The base of {', '.join(cold)} was timed at its first prediction in a process: it was not warm.")
    if loads := [float(known["load"]) for known in facts.values() if known["load"] is not None]:
        notes.append(
            f"Load of the machine before each image (with this benchmark in it): median {statistics.median(loads):.1f},"
            f" {min(loads):.1f} to {max(loads):.1f}; above the number of cores, other processes made times longer."
        )
    if failed := [image["name"] for image in found.images if image["problem"] is not None]:
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
