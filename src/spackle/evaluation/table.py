"""A table as values, and as Markdown and LaTeX."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence

EMPTY = ""  # not run, or nothing that could be
BEST = "**"  # around a cell's text


@dataclasses.dataclass(frozen=True)
class Line:
    """A row of cells; a rule above it where it opens a new group."""

    cells: tuple[str, ...]
    rule: bool = False


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells under a head of one or two levels."""

    label: str  # as in the paper's source, where the paper has it
    caption: str
    columns: tuple[str, ...]
    groups: tuple[tuple[str, int], ...]  # heads over so many columns each; "" over those that have none
    lines: tuple[Line, ...]
    words: int = 1  # columns of text on the left
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        widths = {len(line.cells) for line in self.lines} | {len(self.columns), sum(count for _, count in self.groups)}
        if len(widths) > 1:
            raise ValueError(f"table {self.label}: rows of different lengths: {sorted(widths)}")


def mark_best(values: Sequence[float | None], texts: Sequence[str], lower: bool) -> list[str]:
    """The texts, the best one and what prints like it set off; none where all that have a value print alike."""
    known = {value: text for value, text in zip(values, texts, strict=True) if value is not None}
    if len(set(known.values())) < 2:
        return list(texts)
    best = known[min(known) if lower else max(known)]
    return [f"{BEST}{text}{BEST}" if text == best else text for text in texts]


def to_markdown(tables: Sequence[Table]) -> str:
    """One after the other; a group's head is put before the heads of its columns."""
    return "\n".join(_markdown(table) for table in tables)


def _markdown(table: Table) -> str:
    over = [name for name, count in table.groups for _ in range(count)]
    head = [f"{group}: {column}" if group else column for group, column in zip(over, table.columns, strict=True)]
    lines = [f"**{table.label}.** {table.caption}", "", _row(head), "|" + "---|" * len(head)]
    lines += [_row(line.cells) for line in table.lines]
    lines += ["", *(f"- {note}" for note in table.notes)] if table.notes else []
    return "\n".join(lines) + "\n"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


SIGNS = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "$": r"\$", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "×": r"$\times$",
    "±": r"$\pm$", "−": "$-$", "–": "--", "…": r"\ldots{}", "σ": r"$\sigma$", "<": "$<$", ">": "$>$", "≥": r"$\geq$",
}  # fmt: skip


def tex(text: str) -> str:
    """Plain text for LaTeX; what stands between ** is bold."""
    safe = "".join(SIGNS.get(sign, sign) for sign in text)
    return re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", safe)


def to_latex(tables: Sequence[Table]) -> str:
    """For a document with the packages booktabs and graphicx."""
    return "% needs \\usepackage{booktabs,graphicx}\n" + "\n".join(_latex(table) for table in tables)


def _latex(table: Table) -> str:
    shape = "l" * table.words + "c" * (len(table.columns) - table.words)
    caption = " ".join([table.caption, *table.notes])
    lines = [r"\begin{table*}[t]", r"\centering", r"\scriptsize", rf"\caption{{{tex(caption)}}}"]
    lines += [rf"\label{{{table.label}}}", r"\resizebox{\textwidth}{!}{", rf"\begin{{tabular}}{{{shape}}}", r"\toprule"]
    lines += _heads(table.groups)
    lines += [" & ".join(tex(column) for column in table.columns) + r" \\", r"\midrule"]
    for number, line in enumerate(table.lines):
        lines += [r"\midrule"] if line.rule and number else []
        lines.append(" & ".join(tex(cell) for cell in line.cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", "}", r"\end{table*}"]) + "\n"


def _heads(groups: Sequence[tuple[str, int]]) -> list[str]:
    """The upper level of the head with its rules; nothing where no column has one."""
    if not any(name for name, _ in groups):
        return []
    cells, rules, column = [], [], 1
    for name, count in groups:
        cells.append(rf"\multicolumn{{{count}}}{{c}}{{{tex(name)}}}" if name else " & ".join([""] * count))
        rules += [rf"\cmidrule(lr){{{column}-{column + count - 1}}}"] if name else []
        column += count
    return [" & ".join(cells) + r" \\", *rules]
