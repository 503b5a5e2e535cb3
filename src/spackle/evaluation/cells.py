"""What the tables have in common: which runs stand where, and how numbers are written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from spackle.evaluation import paper
from spackle.evaluation.figures import METRICS, definitions
from spackle.evaluation.methods import METHODS
from spackle.evaluation.pyiqa_metrics import DEFINITIONS, NOTICE
from spackle.evaluation.results import Mean, Run
from spackle.evaluation.table import EMPTY

NOT_RUN = "not run"
PAPER_ROW = "{} (paper)"


def datasets(runs: Sequence[Run]) -> list[str]:
    """Titles: the paper's in its order, whether they were run or not, then others."""
    return list(dict.fromkeys([*paper.DATASETS, *(run.title for run in runs)]))


def runs_of(runs: Sequence[Run], title: str) -> list[Run]:
    return [run for run in runs if run.title == title]


def method_name(run: Run, method: str) -> str:
    """What a row is called; the base's name is always in it."""
    return f"{run.base} alone" if method == "base" else f"{METHODS[method].title} ({run.base})"


def share_of_paper(run: Run) -> str:
    """How many of the paper's images were measured."""
    wanted = paper.IMAGES.get(run.title)
    return str(len(run.measured)) if wanted is None else f"{len(run.measured)}/{wanted}"


def metric_text(mean: Mean, metric: str) -> str:
    """A mean of a metric; views without a finite value are shown."""
    figure = METRICS[metric]
    return with_bad(EMPTY if mean.value is None else figure.text(mean.value), mean.bad)


def with_bad(text: str, bad: int) -> str:
    return f"{text} ({bad} NaN)".strip() if bad else text


def count_text(value: float | None, digits: int = 0) -> str:
    return EMPTY if value is None else f"{value:,.{digits}f}"


def ratio_text(value: float | None) -> str:
    """Four digits, as in the paper; what would round to nothing keeps its first two."""
    if value is None:
        return EMPTY
    return f"{value:.1e}" if 0 < value < 0.5e-4 else f"{value:.4f}"


def percent_text(value: float | None) -> str:
    return EMPTY if value is None else f"{value:.2f}%"


def said(runs: Sequence[Run], metrics: Iterable[str] = ()) -> tuple[str, ...]:
    """Notes under a table: definitions, what was not run and why, what was passed over, terms of pyiqa."""
    names = tuple(metrics)
    notes = definitions(names)
    for run in runs:
        state = run.config["metrics"]
        notes += [f"{run.title}: {METRICS[name].title[:-2]} {state[name]}." for name in names if _idle(run, name)]
        passed = [record.name for record in run.records if record.problem is not None]
        if passed:
            more = f" and {len(passed) - 5} more" if len(passed) > 5 else ""
            listed = f"{', '.join(passed[:5])}{more}"
            notes.append(f"{run.title}: {len(passed)} of {len(run.records)} images gave no figures: {listed}.")
    if any(name in DEFINITIONS for name in names):
        notes.append(f"{NOTICE}.")
    return tuple(dict.fromkeys(notes))


def _idle(run: Run, metric: str) -> bool:
    return str(run.config["metrics"].get(metric, "")).startswith(NOT_RUN)


def bases(runs: Sequence[Run]) -> str:
    """Which base the rows stand on, for a caption."""
    says = dict.fromkeys(f"{run.base}: {run.config['base']['says']}" for run in runs)
    return f"Base {'; '.join(says)}." if says else "No run."


def methods_said(runs: Sequence[Run]) -> str:
    """What the rows are, and whose weights the residual has."""
    names = dict.fromkeys(method for run in runs for method in run.methods)
    rows = "; ".join(f"{METHODS[name].title}: {METHODS[name].says}" for name in names)
    return f"Rows: {rows}. Residual: {' and '.join(dict.fromkeys(_weights(run) for run in runs))}."


def _weights(run: Run) -> str:
    residual = run.config["residual"]
    digest = residual["sha256"]
    return f"{residual['weights']} weights {digest[:8]}" if digest else "no weights, seeds alone"
