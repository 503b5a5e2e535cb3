"""The paper's two tables of efficiency, its numbers beside those measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from spackle.evaluation import paper
from spackle.evaluation import paper_efficiency as published
from spackle.evaluation.efficiency import Parameters
from spackle.evaluation.efficiency_cells import (
    base_title,
    ms_text,
    notes,
    percent_text,
    rate_text,
    said,
    setting_title,
    share_text,
)
from spackle.evaluation.efficiency_results import Bill
from spackle.evaluation.efficiency_stages import parameters_table, stages_table
from spackle.evaluation.table import EMPTY, Line, Table
from spackle.evaluation.tables import PAPER_ROW, count_text

Cells = tuple[str, ...]

PAPER = PAPER_ROW.format("SHARP")
EXPANDED: Cells = ("Dataset", "Setting", "From", "Added GS", "Added GS (%)", "Merged GS", "base time (ms)")
EXPANDED += ("Spackle time (ms)", "Time overhead", "base FPS", "Spackle FPS", "n")


def efficiency_tables(bill: Bill, parameters: Parameters) -> list[Table]:
    """All of them; `bill` has one image that was measured, or more."""
    return [_overhead_table(bill), _expanded_table(bill), stages_table(bill), parameters_table(parameters)]


def _overhead_table(bill: Bill) -> Table:
    """Added Gaussians and median times (tab:efficiency_gaussian_overhead)."""
    lines = [line for title in _titles(bill) for line in _added_lines(bill, title)]
    lines.append(Line(("Average", PAPER, *_paper_average(bill)), rule=True))
    pad = [EMPTY] * 2 * len(bill.settings)
    lines.append(Line(("Runtime efficiency", EMPTY, *pad), rule=True))
    for name, figure, text, theirs in (
        ("Median time of the base (ms)", "base_ms", (ms_text, ms_text), published.MEDIAN_BASE_MS),
        ("Median time with Spackle (ms)", "spackle_ms", (ms_text, ms_text), published.MEDIAN_SPACKLE_MS),
        ("Median time overhead", "overhead", (share_text, percent_text), published.MEDIAN_OVERHEAD_PERCENT),
    ):
        ours = [cell for setting in bill.settings for cell in (text[0](bill.spread(setting, figure).median), EMPTY)]
        lines.append(Line((name, base_title(bill), *ours)))
        lines.append(Line((EMPTY, PAPER, *_at_settings(bill, theirs, text[1]))))
    return Table(
        "tab:efficiency_gaussian_overhead",
        "Efficiency and Gaussian overhead. Counts are means over images. Times are medians: ours over the images of "
        f"{bill.config['title']}, the paper's over its six datasets. {said(bill)}",
        ("Dataset", "From", *("Added GS", "Added GS (%)") * len(bill.settings)),
        (("", 2), *((setting_title(setting, "{}: disparity {}"), 2) for setting in bill.settings)),
        tuple(lines),
        words=2,
        notes=notes(bill),
    )


def _expanded_table(bill: Bill) -> Table:
    """Counts, times and rates of each setting (tab:expanded_efficiency_gaussian_overhead)."""
    lines: list[Line] = []
    for title in _titles(bill):
        rows: list[Cells] = []
        for setting in bill.settings:
            rows += [_our_row(bill, setting)] if title == bill.config["title"] else []
            rows += [_paper_row(title, setting)] if _has_paper(title, setting) else []
        lines += [Line((title if not number else EMPTY, *row), rule=not number) for number, row in enumerate(rows)]
    marked = any(published.ODD_MARK in cell for line in lines for cell in line.cells)
    odd = (f"{published.ODD_NOTE}.",) if marked else ()
    return Table(
        "tab:expanded_efficiency_gaussian_overhead",
        "Expanded efficiency and Gaussian overhead. Ours: counts are means and the rest are medians over images; FPS "
        f"is one over the whole time from the photo to the view. {said(bill)}",
        EXPANDED,
        (("", len(EXPANDED)),),
        tuple(lines),
        words=3,
        notes=(*notes(bill), *odd),
    )


def _titles(bill: Bill) -> list[str]:
    return list(dict.fromkeys([*paper.DATASETS, str(bill.config["title"])]))


def _has_paper(title: str, setting: str) -> bool:
    return published.time_at(title, float(setting)) is not None


def _added_lines(bill: Bill, title: str) -> list[Line]:
    """A dataset's added Gaussians: ours where it is the one that was run, and the paper's."""
    rows: list[Cells] = []
    if title == bill.config["title"]:
        means = [(bill.spread(s, "added").mean, 100 * bill.spread(s, "share").mean) for s in bill.settings]
        rows.append((base_title(bill), *(cell for pair in means for cell in _added_cells(*pair))))
    if title in paper.GAUSSIANS:
        theirs = [paper.at(paper.GAUSSIANS[title], float(setting))[:2] for setting in bill.settings]
        rows.append((PAPER, *(cell for added, share in theirs for cell in _added_cells(added, share))))
    return [Line((title if not number else EMPTY, *row), rule=not number) for number, row in enumerate(rows)]


def _added_cells(added: float | None, percent: float | None) -> tuple[str, str]:
    return count_text(added), EMPTY if percent is None else f"{percent:.2f}"


def _paper_average(bill: Bill) -> list[str]:
    cells: list[str] = []
    for setting in bill.settings:
        index = published.setting_index(float(setting))
        both = (
            (None, None) if index is None else (published.AVERAGE_ADDED[index], published.AVERAGE_SHARE_PERCENT[index])
        )
        cells += _added_cells(*both)
    return cells


def _at_settings(bill: Bill, values: Sequence[float], text: Callable[[float], str]) -> list[str]:
    """The paper's numbers of S1, S2, S3, in the first of two columns each."""
    indices = [published.setting_index(float(setting)) for setting in bill.settings]
    return [cell for index in indices for cell in (EMPTY if index is None else text(values[index]), EMPTY)]


def _our_row(bill: Bill, setting: str) -> Cells:
    def middle(figure: str) -> float:
        return bill.spread(setting, figure).median

    added, share, merged = (bill.spread(setting, figure).mean for figure in ("added", "share", "merged"))
    wanted = paper.IMAGES.get(str(bill.config["title"]))
    count = str(len(bill.measured)) if wanted is None else f"{len(bill.measured)}/{wanted}"
    times = (ms_text(middle("base_ms")), ms_text(middle("spackle_ms")), share_text(middle("overhead")))
    rates = (rate_text(middle("base_fps")), rate_text(middle("spackle_fps")))
    return (
        setting_title(setting),
        base_title(bill),
        *_added_cells(added, 100 * share),
        count_text(merged),
        *times,
        *rates,
        count,
    )


def _paper_row(title: str, setting: str) -> Cells:
    row = published.time_at(title, float(setting))
    assert row is not None
    added, share, merged = paper.at(paper.GAUSSIANS[title], float(setting))
    mark = published.ODD_MARK if (title, float(setting)) == published.ODD else ""
    times = (ms_text(row.base_ms) + mark, ms_text(row.spackle_ms), percent_text(row.overhead_percent) + mark)
    rates = (rate_text(row.base_fps) + mark, rate_text(row.spackle_fps))
    count = str(paper.IMAGES[title])
    return (setting_title(setting), PAPER, *_added_cells(added, share), count_text(merged), *times, *rates, count)
