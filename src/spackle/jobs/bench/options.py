"""The choices of `spackle bench`, and which of them cannot be."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from spackle.bases.open import kind_of
from spackle.errors import InputError
from spackle.evaluation.paper import DISPARITIES
from spackle.evaluation.setup import BASE, EvaluateOptions, check_evaluate_options
from spackle.jobs.options import PredictOptions

MAX_RUNS = 1000


@dataclasses.dataclass(frozen=True)
class BenchOptions:
    """The choices of `spackle bench`."""

    dataset: str
    root: Path
    disparities: Sequence[float] = DISPARITIES
    base: PredictOptions = BASE
    limit: int | None = None  # so many images, spread over the dataset
    runs: int = 5  # of what comes after the base
    base_runs: int | None = None  # predictions of an image; None: one of SHARP, which takes long, else `runs`

    @property
    def base_times(self) -> int:
        """How often the base of an image is timed."""
        return self.base_runs or (1 if kind_of(self.base.base).slow else self.runs)

    @property
    def evaluation(self) -> EvaluateOptions:
        """The same views as an evaluation without metrics."""
        return EvaluateOptions(
            self.dataset,
            self.root,
            methods=("spackle",),
            disparities=self.disparities,
            metrics=(),
            base=self.base,
            limit=self.limit,
        )


def check_bench_options(options: BenchOptions) -> None:
    """InputError for an option that cannot be used, whatever the images."""
    check_evaluate_options(options.evaluation)
    for name, value in (("--runs", options.runs), ("--base-runs", options.base_runs)):
        if value is not None and not 1 <= value <= MAX_RUNS:
            raise InputError(f"{name} must be between 1 and {MAX_RUNS}, got {value}")
