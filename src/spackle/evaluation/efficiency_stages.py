"""Two tables of our own: where the time of a view goes, and how large the networks are."""

from __future__ import annotations

from collections.abc import Callable

from spackle.evaluation import paper_efficiency as published
from spackle.evaluation.efficiency import Parameters
from spackle.evaluation.efficiency_cells import ms_text, notes, quartiles_text, said, setting_title, share_text
from spackle.evaluation.efficiency_results import BASE_PATH, EXTRA, STAGES, Bill
from spackle.evaluation.table import Line, Table


def stages_table(bill: Bill) -> Table:
    """Where the time goes."""
    spreads: list[tuple[str, str, Callable[[float], str], bool]] = [
        (title, f"{name}_stage_ms", ms_text, name == EXTRA[0]) for name, title in STAGES.items()
    ]
    spreads += [
        (f"base path: the first {len(BASE_PATH)}", "base_ms", ms_text, True),
        (f"Spackle's own: the other {len(EXTRA)}", "extra_ms", ms_text, False),
        ("overhead, of the whole base path", "overhead", share_text, True),
        ("overhead, of the render of the view", "overhead_of_view", share_text, False),
    ]
    lines = []
    for title, figure, text, rule in spreads:
        cells = [quartiles_text(bill.spread(setting, figure), text) for setting in bill.settings]
        lines.append(Line((title, *cells), rule))
    return Table(
        "tab:efficiency_stages",
        f"Stages on {bill.config['title']} in milliseconds: median over images [quartiles]. The render at the photo's "
        f"camera is needed once a photo, however many views are asked for. {said(bill)}",
        ("Stage", *(setting_title(setting, "{}: disparity {}") for setting in bill.settings)),
        (("", 1 + len(bill.settings)),),
        tuple(lines),
        notes=notes(bill),
    )


def parameters_table(parameters: Parameters) -> Table:
    """How large the networks are."""
    both = parameters.base + parameters.residual
    rows = (
        ("SHARP", f"{parameters.base / 1e6:.2f}", f"{published.PARAMETERS_M:.2f}"),
        ("SHARP and Spackle", f"{both / 1e6:.2f}", f"{published.MERGED_PARAMETERS_M:.2f}"),
        ("Spackle alone", f"{parameters.residual / 1e6:.2f}", f"{published.ADDED_PARAMETERS_M:.2f}"),
        ("Spackle, % of SHARP", f"{100 * parameters.share:.2f}", f"{published.ADDED_PARAMETERS_PERCENT:.2f}"),
    )
    return Table(
        "tab:efficiency_parameters",
        "Parameters in millions, counted in the networks: SHARP's as its checkpoint has them, of which inference uses "
        f"{parameters.base_used / 1e6:.2f}. The same whatever base was timed.",
        ("Network", "counted", "paper"),
        (("", 3),),
        tuple(Line(row) for row in rows),
    )
