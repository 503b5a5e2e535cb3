"""A table of texts, and how to write it as Markdown, LaTeX and plain lines.

The template report.html writes tables as HTML.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable, Sequence

NO_NUMBER = ""  # the entry of a table for which there is no number
NOT_RUN = "not run"  # the name of a row that stands for results that do not exist
BOLD_MARK = "**"  # before and after the text of the best entry of a column

RowTexts = Sequence[str]  # a row of a table: a text for each column
NumberFormat = Callable[[float], str]


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of texts under column heads of one or two levels."""

    label: str  # the label in the paper's source, if the paper has the table
    title: str
    caption: str
    # For each column the head of its group ("" without a group), and its own head. Empty: no column
    # could be measured, and the notes say why.
    heads: Sequence[tuple[str, str]]
    # Groups of rows, with a rule between groups.
    bodies: Sequence[Sequence[RowTexts]]
    # The number of columns on the left with words instead of numbers. If there are several, the
    # first shows the group's name in the group's first row.
    word_columns: int = 1
    notes: Sequence[str] = ()


def _ratio(value: float) -> str:
    """Four decimals, as in the paper; two significant digits where this would show zero."""
    would_show_zero = 0 < value < 0.5e-4
    return f"{value:.1e}" if would_show_zero else f"{value:.4f}"


def _overhead(value: float) -> str:
    """A share as percent, with two decimals below 10 %: readers ask if it is below 1 %."""
    return f"{100 * value:.2f}%" if value < 0.1 else f"{100 * value:.1f}%"


def _rate(value: float) -> str:
    """Three decimals; three significant digits for small values."""
    return f"{value:.3f}" if value >= 0.1 else f"{value:.3g}"


# How tables write numbers of different kinds.
NUMBER_FORMATS: dict[str, NumberFormat] = {
    "count": "{:,.0f}".format,
    "hundredths": "{:,.2f}".format,
    "tenths": "{:,.1f}".format,
    "ratio": _ratio,
    "share": lambda value: f"{100 * value:.2f}",
    "percent": lambda value: f"{100 * value:.2f}%",
    "tenths %": lambda value: f"{100 * value:.1f}%",
    "overhead": _overhead,
    "rate": _rate,
}


def mark_best(
    values: Sequence[float | None], texts: Sequence[str], lower_is_better: bool
) -> list[str]:
    """The texts of a column's numbers, with the best number's text between ** (bold).

    All texts that look like the best are marked, although their numbers may differ in digits that
    are not shown. If all texts are equal, none is marked.

    Args:
        values: the numbers; None where there is none.
        texts: the number's texts.
        lower_is_better: whether the smallest number is the best.
    """
    # Readers see texts, not numbers: if all look alike, none is the best.
    text_of_value = {
        value: text for value, text in zip(values, texts, strict=True) if value is not None
    }
    if len(set(text_of_value.values())) < 2:
        return list(texts)

    best_value = min(text_of_value) if lower_is_better else max(text_of_value)
    best_text = text_of_value[best_value]
    return [f"{BOLD_MARK}{text}{BOLD_MARK}" if text == best_text else text for text in texts]


def group_widths(heads: Sequence[tuple[str, str]]) -> list[tuple[str, int]]:
    """The upper heads of a table, each with the number of columns below it, from left to right.

    `heads` has for each column the head of its group ("" without a group), and its own head.
    """
    # A group's columns stand side by side, and "" stands for columns without a group.
    neighbours = itertools.groupby(heads, key=lambda head: head[0])
    return [(group, len(list(columns))) for group, columns in neighbours]


def to_markdown(table: Table) -> str:
    """A table in Markdown, with title, caption and notes."""
    notes = [f"- {note}" for note in table.notes]
    intro = f"**{table.title}** (`{table.label}`). {table.caption}"
    if not table.heads:
        return "\n".join([intro, "", "No column could be measured:", "", *notes]) + "\n"

    # Markdown tables have one line of heads, so a group's head is repeated in each of its columns.
    heads = [f"{group}: {head}" if group else head for group, head in table.heads]
    lines = [
        intro,
        "",
        _markdown_row(heads),
        "|" + "---|" * len(heads),
    ]
    lines += [_markdown_row(texts) for rows in table.bodies for texts in rows]

    if notes:
        lines += ["", *notes]
    return "\n".join(lines) + "\n"


def _markdown_row(texts: RowTexts) -> str:
    """A row of a Markdown table; vertical bars in the texts are escaped."""
    escaped_texts = [text.replace("|", "\\|") for text in texts]
    return "| " + " | ".join(escaped_texts) + " |"


def to_plain_lines(table: Table) -> list[str]:
    """A table as lines for a terminal, without title and notes; numbers are right-aligned."""
    # Heads keep words together for web pages; a terminal needs no such care.
    heads = [head.replace("\N{NO-BREAK SPACE}", " ") for _, head in table.heads]
    rows = [heads, *(texts for body in table.bodies for texts in body)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    lines = []
    for texts in rows:
        padded_texts = []
        for column, (text, width) in enumerate(zip(texts, widths, strict=True)):
            is_words = column < table.word_columns
            padded_texts.append(text.ljust(width) if is_words else text.rjust(width))
        lines.append("  ".join(padded_texts).rstrip())
    return lines


# LaTeX for characters that mean something to LaTeX, or that its fonts lack.
LATEX_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "$": r"\$",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\to$", "×": r"$\times$", "±": r"$\pm$",
    "−": "$-$", "–": "--", "…": r"\ldots{}", "σ": r"$\sigma$", "<": "$<$", ">": "$>$",
    "≥": r"$\geq$", "†": r"$\dagger$", "‡": r"$\ddagger$",
}  # fmt: skip


# What a label should not have: LaTeX's own characters, which the title of a user's photos may have.
UNSAFE_IN_LABELS = re.compile(r"[^\w:. -]+")


def escape_latex(text: str) -> str:
    """Escape a text for LaTeX; text between ** becomes bold.

    Characters that LaTeX's fonts lack become "?": all beyond Latin Extended-A.
    """

    def escape_character(character: str) -> str:
        """LaTeX for one character."""
        if character in LATEX_ESCAPES:
            return LATEX_ESCAPES[character]
        is_in_fonts = " " <= character <= "\u017f"  # the end of Latin Extended-A
        return character if is_in_fonts else "?"

    escaped_text = "".join(escape_character(character) for character in text)
    return re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", escaped_text)


def to_latex(table: Table, label_suffix: str = "") -> str:
    """A table in LaTeX across both columns of a page, with its notes below.

    The document needs the packages booktabs and graphicx.

    Args:
        table: the table.
        label_suffix: the end of its label, which lets a document include several files of tables.
    """
    # A comment, because LaTeX has no table without columns.
    if not table.heads:
        reasons = [escape_latex(note) for note in table.notes]
        return "".join(f"% {line}\n" for line in (f"{table.label}: no column", *reasons))

    # One letter for each column: words are left-aligned, numbers centred.
    number_columns = len(table.heads) - table.word_columns
    shape = "l" * table.word_columns + "c" * number_columns
    label = UNSAFE_IN_LABELS.sub("-", f"{table.label}{label_suffix}")
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        r"\scriptsize",
        rf"\caption{{{escape_latex(table.caption)}}}",
        rf"\label{{{label}}}\smallskip",
        r"\resizebox{\textwidth}{!}{",
        rf"\begin{{tabular}}{{{shape}}}",
        r"\toprule",
    ]
    # Group heads, if any, are a line above the columns' own heads.
    lines += _latex_group_heads(table.heads)
    lines.append(_latex_row([head for _, head in table.heads]))

    for rows in table.bodies:
        lines.append(r"\midrule")
        lines += [_latex_row(texts) for texts in rows]
    lines += [r"\bottomrule", r"\end{tabular}", "}"]

    if table.notes:
        notes = escape_latex(" ".join(table.notes))
        lines.append(rf"\par\smallskip\parbox{{\textwidth}}{{\tiny {notes}}}")
    lines.append(r"\end{table*}")
    return "\n".join(lines) + "\n"


def _latex_row(texts: RowTexts) -> str:
    """A row of a LaTeX table."""
    return " & ".join(map(escape_latex, texts)) + r" \\"


def _latex_group_heads(heads: Sequence[tuple[str, str]]) -> list[str]:
    """The upper line of a LaTeX table's heads, and a rule below each; empty if there are no groups.

    `heads` has for each column the head of its group ("" without a group), and its own head.
    """
    # A rule below a group's head shows which columns belong to it.
    group_heads = []
    rules = []
    first_column = 1  # LaTeX counts columns from 1
    for group, width in group_widths(heads):
        if group:
            group_heads.append(rf"\multicolumn{{{width}}}{{c}}{{{escape_latex(group)}}}")
            rules.append(rf"\cmidrule(lr){{{first_column}-{first_column + width - 1}}}")
        else:
            group_heads.append(" & ".join([""] * width))  # empty columns
        first_column += width

    if not rules:
        return []
    return [" & ".join(group_heads) + r" \\", *rules]
