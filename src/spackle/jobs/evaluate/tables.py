"""`spackle tables`: several evaluations in the same tables, and on one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spackle.errors import InputError
from spackle.evaluation.results import Run
from spackle.evaluation.table import to_latex, to_markdown
from spackle.evaluation.tables import make_tables
from spackle.jobs.evaluate.pictures import BENCH, REPORT, find_bench, load_source, write_report
from spackle.jobs.evaluate.store import LATEX, MARKDOWN, RESULTS, write_text
from spackle.jobs.inputs import results_folder
from spackle.jobs.progress import Reporter

TABLES = (MARKDOWN, LATEX)


def page(html: bool) -> tuple[str, ...]:
    """The name of the page, where one is wanted."""
    return (REPORT,) if html else ()


def write_tables(runs: Sequence[Run], output: Path) -> None:
    """tables.md and tables.tex."""
    tables = make_tables(runs)
    write_text(to_markdown(tables), output / MARKDOWN)
    write_text(to_latex(tables), output / LATEX)


def merge_tables(folders: Sequence[Path], output: Path, reporter: Reporter, html: bool = False) -> None:
    """The tables of several evaluations in one.

    Args:
        folders: outputs of `evaluate`, finished.
        output: a folder for the two files.
        reporter: says where they lie.
        html: write report.html too; a folder may then hold a bench.json alone.

    Raises:
        InputError: a folder without results, results that do not go together, or an output that cannot be written to.
    """
    if not folders:
        raise InputError("no results: name the folders that `spackle evaluate` wrote")
    measured = [folder for folder in folders if not (html and _only_bench(folder))]
    sources = [load_source(folder) for folder in measured or folders]
    runs = [source.run for source in sources]
    make_tables(runs)  # what does not go together is refused before anything is written
    files = (*TABLES, *page(html))
    with results_folder(output, files):
        write_tables(runs, output)
        if html:
            write_report(sources, find_bench(folders), output)
    self_said = ", ".join(f"{run.title} ({run.config['protocol']}, {run.base})" for run in runs)
    reporter.say(f"{self_said} -> {', '.join(str(output / name) for name in files)}")


def _only_bench(folder: Path) -> bool:
    return (folder / BENCH).is_file() and not (folder / RESULTS).exists()
