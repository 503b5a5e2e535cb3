"""The tables of an evaluation as HTML, from the same values as those in Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from spackle.evaluation.report.markup import Html, escaped, joined, tag
from spackle.evaluation.table import BEST, EMPTY, Line, Table
from spackle.evaluation.tables import NOT_RUN, PAPER_ROW

TITLES = {
    "tab:large_view_nr_iqa": "Quality of large views, without a truth",
    "tab:controlled_disocclusion": "Hole Area Ratio before and after",
    "tab:expanded_efficiency_gaussian_overhead": "Gaussians added and merged",
    "tab:near_view": "Distance from true second photos",
    "tab:near_view_holes": "Against true second photos, in the hole and outside",
    "tab:mask_guided_init": "Dense grid against mask guided",
}
PAPER = PAPER_ROW.format("")


def table_html(table: Table) -> Html:
    """A table with its title, its caption and its notes."""
    title = TITLES.get(table.label, table.label)
    head = [_groups(table)] if any(name for name, _ in table.groups) else []
    columns = [
        tag("th", text, scope="col", class_="word" if k + 1 < table.words else None)
        for k, text in enumerate(table.columns[table.words - 1 :])
    ]
    whole = tag(
        "table", tag("thead", *head, tag("tr", *columns)), *(_body(table, group) for group in _grouped(table.lines))
    )
    notes = [tag("ul", *(tag("li", note) for note in table.notes), class_="notes")] if table.notes else []
    return tag(
        "figure",
        tag("h3", title, " ", tag("code", table.label)),
        tag("div", whole, class_="scroll", tabindex="0", role="region", aria_label=title),
        tag("figcaption", table.caption),
        *notes,
        class_="table",
    )


def _groups(table: Table) -> Html:
    """The upper level of the head."""
    cells, dropped = [], table.words - 1  # a dataset's name has a row of its own, and no column
    for name, count in table.groups:
        width, dropped = count - dropped, 0
        cells.append(tag("th", name, colspan=width, scope="colgroup") if name else tag("td", colspan=width))
    return tag("tr", *cells)


def _grouped(lines: Sequence[Line]) -> list[list[Line]]:
    """Lines between two rules."""
    number = 0
    numbered = []
    for line in lines:
        number += line.rule
        numbered.append((number, line))
    return [[line for _, line in group] for _, group in groupby(numbered, key=lambda pair: pair[0])]


def _body(table: Table, lines: Sequence[Line]) -> Html:
    """A group of rows. Where a table has datasets, the name stands above its rows: on a phone it costs no width."""
    rows = []
    if table.words > 1:
        name = tag("th", tag("span", lines[0].cells[0]), colspan=len(table.columns) - 1, scope="rowgroup")
        rows.append(tag("tr", name, class_="group"))
    idle = any(line.cells[table.words - 1] == NOT_RUN for line in lines)
    rows += [_row(line.cells[table.words - 1 :]) for line in lines]
    return tag("tbody", *rows, class_="idle" if idle else None)


def _row(cells: Sequence[str]) -> Html:
    kind = "paper" if cells[0].endswith(PAPER) else "none" if cells[0] == NOT_RUN else None
    return tag("tr", tag("th", cells[0], scope="row"), *(tag("td", _cell(text)) for text in cells[1:]), class_=kind)


def _cell(text: str) -> Html:
    """The best of a column is strong."""
    if len(text) > 2 * len(BEST) and text.startswith(BEST) and text.endswith(BEST):
        return tag("strong", text.removeprefix(BEST).removesuffix(BEST))
    return escaped(text)


def facts_html(facts: Mapping[str, Any]) -> Html:
    """Names and values, nested ones further in, as they lie in a JSON file."""
    pairs = [
        joined([tag("dt", str(key).replace("_", " ")), tag("dd", _value(value))])
        for key, value in facts.items()
        if value not in (None, EMPTY, {})
    ]
    return tag("dl", *pairs)


def _value(value: Any) -> Html:
    if isinstance(value, Mapping):
        return facts_html(value)
    if isinstance(value, (list, tuple)):
        if value and all(isinstance(item, Mapping) for item in value):
            return _records(value)
        return escaped(", ".join(str(item) for item in value))
    return escaped(f"{value:.6g}" if isinstance(value, float) else str(value))


def _records(records: Sequence[Mapping[str, Any]]) -> Html:
    """Things of one kind, a row for each."""
    keys = dict.fromkeys(key for record in records for key in record)
    head = tag("tr", *(tag("th", str(key).replace("_", " "), scope="col") for key in keys))
    rows = [tag("tr", *(tag("td", _value(record.get(key, EMPTY))) for key in keys)) for record in records]
    return tag("div", tag("table", tag("thead", head), tag("tbody", *rows)), class_="scroll")
