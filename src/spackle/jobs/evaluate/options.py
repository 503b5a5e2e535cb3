"""The choices of `spackle evaluate`, and which of them cannot be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from spackle.errors import InputError
from spackle.evaluation.datasets import DATASETS
from spackle.evaluation.figures import DEFAULT_METRICS, METRICS, PROTOCOLS
from spackle.evaluation.methods import METHODS
from spackle.evaluation.paper import DISPARITIES
from spackle.jobs.bases import kind_of
from spackle.jobs.names import check_name
from spackle.jobs.options import PredictOptions, check_base_options
from spackle.precision import PRECISIONS
from spackle.trajectory import MAX_DISPARITY

BASE = PredictOptions(base="sharp")  # the paper's
DEFAULT_METHODS = ("base", "spackle")
MAX_LIMIT = 1_000_000
MAX_DISPARITIES = 6  # columns of a table


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """The choices of `spackle evaluate`."""

    dataset: str
    root: Path
    protocol: str = "large-view"
    methods: Sequence[str] = DEFAULT_METHODS
    disparities: Sequence[float] = DISPARITIES  # of the large views
    metrics: Sequence[str] | None = None  # the protocol's where None
    base: PredictOptions = BASE  # base, weights, residual, device
    direct_ft: Path | None = None  # weights of the method direct-ft
    features: Path | None = None  # SqueezeNet's weights, for the metric distance
    limit: int | None = None  # so many images, spread over the dataset
    download: bool = False  # pyiqa may fetch weights

    @property
    def near(self) -> bool:
        return self.protocol == "near-view"

    @property
    def wanted_metrics(self) -> tuple[str, ...]:
        """The metrics to measure, in the order of `METRICS`."""
        named = DEFAULT_METRICS[self.protocol] if self.metrics is None else self.metrics
        return tuple(name for name in METRICS if name in named)


def split_words(text: str) -> tuple[str, ...]:
    """ "a, b,c" as words; a word twice counts once."""
    return tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))


def parse_disparities(text: str) -> tuple[float, ...]:
    """ "0.3,0.4" or "0.3 0.4" as numbers; InputError for anything else."""
    try:
        return tuple(float(word) for word in split_words(",".join(text.split())))
    except ValueError as error:
        raise InputError(f"--disparity {text}: not numbers: give them with commas, such as 0.3,0.4,0.5") from error


def check_evaluate_options(options: EvaluateOptions) -> None:
    """InputError for an option that cannot be used, whatever the images."""
    check_name("--dataset", options.dataset, DATASETS)
    check_name("--protocol", options.protocol, PROTOCOLS)
    for method in options.methods:
        check_name("--methods", method, METHODS)
    for metric in options.metrics or ():
        check_name("--metrics", metric, METRICS)
        if METRICS[metric].truth and not options.near:
            raise InputError(f"--metrics {metric}: needs a true second view: add --protocol near-view")
    if not options.methods:
        raise InputError(f"--methods: none is given: choose of {', '.join(METHODS)}")
    _check_base(options)
    _check_disparities(options)
    if options.limit is not None and not 1 <= options.limit <= MAX_LIMIT:
        raise InputError(f"--limit must be between 1 and {MAX_LIMIT}, got {options.limit}")


def _check_base(options: EvaluateOptions) -> None:
    """The base's own options, and what the method direct-ft takes."""
    base = options.base
    kind_of(base.base)
    if base.precision not in PRECISIONS:
        raise InputError(f"--precision {base.precision}: unknown: there are {', '.join(PRECISIONS)}")
    check_base_options(for_base(base))
    if base.residual == "none":
        raise InputError("--residual none: there would be nothing to evaluate: add --methods base instead")
    if "direct-ft" in options.methods:
        if base.base != "sharp":
            raise InputError("--methods direct-ft: is a SHARP that was trained further: add --base sharp")
        if options.direct_ft is None:
            raise InputError(
                "--methods direct-ft: no weights: give --direct-ft FILE, which `spackle train --method direct-ft` made"
            )
    elif options.direct_ft is not None:
        raise InputError(f"--direct-ft {options.direct_ft}: no method takes it: add direct-ft to --methods")


def for_base(base: PredictOptions) -> PredictOptions:
    """The options without those that a base refuses for itself, and the residual's network takes here."""
    return dataclasses.replace(base, precision="auto") if "--precision" in kind_of(base.base).refuses else base


def _check_disparities(options: EvaluateOptions) -> None:
    if not 1 <= len(options.disparities) <= MAX_DISPARITIES:
        raise InputError(f"--disparity: give one to {MAX_DISPARITIES} numbers, got {len(options.disparities)}")
    for value in options.disparities:
        if not (math.isfinite(value) and 0 < value <= MAX_DISPARITY):
            raise InputError(f"--disparity {value:g}: must be above 0 and up to {MAX_DISPARITY:g}")
    if len(set(options.disparities)) < len(options.disparities):
        raise InputError("--disparity: the same number twice: leave one out")
