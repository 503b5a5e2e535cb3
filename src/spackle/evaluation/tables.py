"""All tables of some runs."""

from __future__ import annotations

from collections.abc import Sequence

from spackle.errors import InputError
from spackle.evaluation.large_tables import gaussians_table, holes_table, quality_table
from spackle.evaluation.near_tables import ablation_table, detail_table, near_table
from spackle.evaluation.results import Run
from spackle.evaluation.table import Table


def make_tables(runs: Sequence[Run]) -> list[Table]:
    """The paper's tables, and one of ours, for the protocols that were run; the paper's numbers beside them.

    Raises:
        InputError: a dataset twice under one protocol with the same base, or different disparities.
    """
    tables: list[Table] = []
    large = [run for run in runs if not run.near]
    near = [run for run in runs if run.near]
    for protocol in (large, near):
        _check(protocol)
    if large:
        disparities = list(large[0].config["disparities"])
        if any(list(run.config["disparities"]) != disparities for run in large):
            raise InputError("the results have different disparities: make their tables apart")
        tables += [make(large, disparities) for make in (quality_table, holes_table, gaussians_table)]
    if near:
        tables += [make(near) for make in (near_table, detail_table, ablation_table)]
    return tables


def _check(runs: Sequence[Run]) -> None:
    seen: set[tuple[str, str]] = set()
    for run in runs:
        if (run.title, run.base) in seen:
            raise InputError(
                f"two results for {run.title} under {run.config['protocol']} with the base {run.base}: give one of them"
            )
        seen.add((run.title, run.base))
