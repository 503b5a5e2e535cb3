"""A table of texts, written as Markdown and LaTeX; the template report.html writes it as HTML."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable, Sequence

EMPTY = ""  # a cell without a number
NOT_RUN = "not run"  # the name of an empty row
BEST = "**"  # put around the text of the best cell
Cells = Sequence[str]
Text = Callable[[float], str]


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells under column heads of one or two levels."""

    label: str  # the label in the paper's source, if the paper has the table
    title: str
    caption: str
    heads: Sequence[
        tuple[str, str]
    ]  # for each column the head of its group ("" without a group) and the column's head
    bodies: Sequence[Sequence[Cells]]  # groups of rows, with a rule between groups
    words: int = 1  # text columns on the left; the first of several shows a group's name in the group's first row
    notes: Sequence[str] = ()


def _ratio(value: float) -> str:
    """Four decimals, as in the paper; two significant digits where four decimals would show zero."""
    return f"{value:.1e}" if 0 < value < 0.5e-4 else f"{value:.4f}"


# Overheads below 10 % have two decimals: readers ask whether the overhead is below 1 %.
TEXTS: dict[str, Text] = {
    "count": "{:,.0f}".format,
    "hundredths": "{:,.2f}".format,
    "tenths": "{:,.1f}".format,
    "ratio": _ratio,
    "share": lambda value: f"{100 * value:.2f}",
    "percent": lambda value: f"{100 * value:.2f}%",
    "tenths %": lambda value: f"{100 * value:.1f}%",
    "overhead": lambda value: f"{100 * value:.2f}%" if value < 0.1 else f"{100 * value:.1f}%",
    "rate": lambda value: f"{value:.3f}" if value >= 0.1 else f"{value:.3g}",
}


def mark_best(values: Sequence[float | None], texts: Sequence[str], lower: bool) -> list[str]:
    """Make the best value's text bold, and all texts equal to that text; if all are equal, none becomes bold."""
    known = {value: text for value, text in zip(values, texts, strict=True) if value is not None}
    if len(set(known.values())) < 2:
        return list(texts)
    best = known[min(known) if lower else max(known)]
    return [f"{BEST}{text}{BEST}" if text == best else text for text in texts]


def groups(heads: Sequence[tuple[str, str]]) -> list[tuple[str, int]]:
    """The name of each upper head and the number of columns below it."""
    return [
        (name, len(list(columns)))
        for name, columns in itertools.groupby(heads, key=lambda head: head[0])
    ]


def markdown(table: Table) -> str:
    """A table in Markdown; a column's head begins with the head of its group."""
    head = [f"{group}: {column}" if group else column for group, column in table.heads]
    lines = [
        f"**{table.title}** (`{table.label}`). {table.caption}",
        "",
        _row(head),
        "|" + "---|" * len(head),
    ]
    lines += [_row(cells) for rows in table.bodies for cells in rows]
    lines += ["", *(f"- {note}" for note in table.notes)] if table.notes else []
    return "\n".join(lines) + "\n"


def plain(table: Table) -> list[str]:
    """A table as lines for a terminal, without title and notes; numbers are right-aligned."""
    heads = [head.replace("\N{NO-BREAK SPACE}", " ") for _, head in table.heads]
    rows = [heads, *(cells for rows in table.bodies for cells in rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = "<" * table.words + ">" * (len(widths) - table.words)
    shapes = list(zip(sides, widths, strict=True))
    return [
        "  ".join(f"{c:{side}{wide}}" for c, (side, wide) in zip(r, shapes, strict=True)).rstrip()
        for r in rows
    ]


def _row(cells: Cells) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


SIGNS = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "$": r"\$", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "×": r"$\times$",
    "±": r"$\pm$", "−": "$-$", "–": "--", "…": r"\ldots{}", "σ": r"$\sigma$", "<": "$<$", ">": "$>$", "≥": r"$\geq$",
    "†": r"$\dagger$", "‡": r"$\ddagger$", "→": r"$\to$",
}  # fmt: skip


def tex(text: str) -> str:
    """Escape text for LaTeX; characters that its fonts lack become "?", and text between ** becomes bold."""
    safe = "".join(SIGNS.get(sign, sign if " " <= sign <= "\u017f" else "?") for sign in text)
    return re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", safe)


def latex(table: Table, suffix: str = "") -> str:
    """A table in LaTeX, for booktabs and graphicx; the label ends with `suffix`, and notes are below the table."""
    shape = "l" * table.words + "c" * (len(table.heads) - table.words)
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        r"\scriptsize",
        rf"\caption{{{tex(table.caption)}}}",
    ]
    lines += [
        rf"\label{{{table.label}{suffix}}}\smallskip",
        r"\resizebox{\textwidth}{!}{",
        rf"\begin{{tabular}}{{{shape}}}",
        r"\toprule",
    ]
    column, over, rules = 1, [], []
    for name, count in groups(table.heads):
        over.append(
            rf"\multicolumn{{{count}}}{{c}}{{{tex(name)}}}" if name else " & ".join([""] * count)
        )
        rules += [rf"\cmidrule(lr){{{column}-{column + count - 1}}}"] if name else []
        column += count
    lines += [" & ".join(over) + r" \\", *rules] if rules else []
    lines.append(" & ".join(tex(head) for _, head in table.heads) + r" \\")
    for rows in table.bodies:
        lines += [r"\midrule", *(" & ".join(map(tex, cells)) + r" \\" for cells in rows)]
    lines += [r"\bottomrule", r"\end{tabular}", "}"]
    lines += (
        [rf"\par\smallskip\parbox{{\textwidth}}{{\tiny {tex(' '.join(table.notes))}}}"]
        if table.notes
        else []
    )
    return "\n".join([*lines, r"\end{table*}"]) + "\n"
