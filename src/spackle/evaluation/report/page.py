"""The page itself: one file that needs nothing else, the same bytes for the same results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from spackle.evaluation import paper
from spackle.evaluation.report.gallery import gallery
from spackle.evaluation.report.markup import Html, joined, tag
from spackle.evaluation.report.plots import plots_of
from spackle.evaluation.report.source import Source
from spackle.evaluation.report.summary import findings
from spackle.evaluation.report.tables import facts_html, table_html
from spackle.evaluation.table import Table
from spackle.evaluation.tables import method_name

# Nothing is fetched from anywhere, whatever a name in the results says.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
SECTIONS = {"summary": "Summary", "plots": "Plots", "pictures": "Pictures", "tables": "Tables", "setup": "Setup"}


def make_report(sources: Sequence[Source], tables: Sequence[Table], bench: Mapping[str, Any] | None = None) -> str:
    """A report as HTML.

    Args:
        sources: evaluations; at least one.
        tables: what `make_tables` made of them.
        bench: what a benchmark wrote, shown as it is.
    """
    titles = dict.fromkeys(source.run.title for source in sources)
    title = f"Spackle: evaluation on {', '.join(titles)}"
    sections = {
        "summary": joined([_summary(source) for source in sources]),
        "plots": joined([_plots(source) for source in sources]),
        "pictures": gallery(sources),
        "tables": joined([_switch(), *(table_html(table) for table in tables)]),
        "setup": joined([*(_setup(source) for source in sources), *([_speed(bench)] if bench else [])]),
    }
    links = tag("nav", *(tag("a", name, href=f"#{key}") for key, name in SECTIONS.items()), aria_label="Sections")
    parts = [tag("section", tag("h2", SECTIONS[key]), inside, id=key) for key, inside in sections.items()]
    body = tag("body", tag("header", tag("h1", title), links), tag("main", *parts), tag("script", _asset("report.js")))
    return f'<!DOCTYPE html>\n<html lang="en">\n{_head(title)}\n{body}\n</html>\n'


def _head(title: str) -> Html:
    return tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=POLICY),
        tag("meta", name_="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name_="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", _asset("report.css")),
    )


def _asset(name: str) -> Html:
    """A file of ours, of which nothing is escaped."""
    return Html(resources.files("spackle.evaluation.report").joinpath(name).read_text(encoding="utf-8"))


def _summary(source: Source) -> Html:
    run = source.run
    wanted = paper.IMAGES.get(run.title)
    counted = f"{len(run.measured)} image{'' if len(run.measured) == 1 else 's'}"
    beside = f" (the paper has {wanted})" if wanted else ""
    rows = "; ".join(method_name(run, method) for method in run.methods)
    about = f"{counted}{beside}. Base: {run.config['base']['says']}. Methods: {rows}."
    lines = [tag("li", line) for line in findings(run)]
    return joined([tag("h3", source.name), tag("p", about), tag("ul", *lines) if lines else Html("")])


def _plots(source: Source) -> Html:
    return joined([tag("h3", source.name), tag("div", *plots_of(source.run), class_="plots")])


def _switch() -> Html:
    box = tag("input", type="checkbox", id="run-only")
    return tag("p", tag("label", box, " Only the datasets that were run"), class_="switch")


def _setup(source: Source) -> Html:
    run = source.run
    parts = [tag("h3", source.name), facts_html({**run.config, "versions": source.versions, "machine": source.machine})]
    problems = [f"{record.name}: {record.problem}" for record in run.records if record.problem is not None]
    remarks = [f"{record.name}: {'; '.join(record.remarks)}" for record in run.records if record.remarks]
    for title, lines in (("Images without figures", problems), ("Remarks", remarks)):
        parts += [tag("h4", title), tag("ul", *(tag("li", line) for line in lines))] if lines else []
    return joined(parts)


def _speed(bench: Mapping[str, Any]) -> Html:
    """What `spackle bench` found, without the times of each image."""
    whole = {key: value for key, value in bench.items() if key != "images"}
    return joined([tag("h3", "Speed"), facts_html(whole)])
