"""The choices of `spackle evaluate`, and which of them cannot be.

What an evaluation works with, set up once for all images, and what that is called in its results.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

import spackle
from spackle.bases.open import NETWORKS, BaseError, kind_of
from spackle.bases.sharp import SharpBase
from spackle.camera_path import MAX_DISPARITY
from spackle.choose import Load
from spackle.dataset.options import base_digest
from spackle.device import PRECISIONS, pick_dtype
from spackle.digest import digest_of, weights_digest
from spackle.errors import InputError, check_name
from spackle.evaluation.case import Case, EvalDataset
from spackle.evaluation.datasets import DATASETS, get_dataset
from spackle.evaluation.methods import METHODS, make_method
from spackle.evaluation.metrics import DEFAULT_METRICS, DEFINITIONS, METRICS, OWN, PROTOCOLS, open_metrics
from spackle.evaluation.paper import DISPARITIES
from spackle.evaluation.protocols import Gauges
from spackle.jobs.bases import public_name, says_of, title_of
from spackle.jobs.options import PredictOptions, check_base_options
from spackle.jobs.setup import set_up
from spackle.render import Renderer, get_renderer
from spackle.residual import ResidualNet
from spackle.residual.network import load_residual
from spackle.training.features import FeatureNet, load_features

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


NO_FEATURES = "not run: weights: give SqueezeNet's with --features FILE"


@dataclasses.dataclass(frozen=True)
class Bench:
    """What is set up once for all images."""

    options: EvaluateOptions
    renderer: Renderer
    base: Load | None  # None: the dataset's depth is the base
    network: ResidualNet | None
    direct: Load | None  # the base of the method direct-ft
    gauges: Gauges
    states: Mapping[str, str]  # metric → who measures it, or why nobody does


def open_evaluation(options: EvaluateOptions) -> tuple[list[Case], Bench, dict[str, Any]]:
    """A dataset's cases, what they share, and the configuration; InputError where one of them cannot be used."""
    dataset = get_dataset(options.dataset)
    cases = _spread(dataset.cases(options.root), options.limit)
    _check_cases(cases, options)
    bench = _open_bench(options)
    return cases, bench, _configuration(options, dataset, cases, bench)


def _spread(cases: Sequence[Case], limit: int | None) -> list[Case]:
    """So many of them, evenly over their order; all where there is no limit."""
    if limit is None or limit >= len(cases):
        return list(cases)
    return [cases[(2 * k + 1) * len(cases) // (2 * limit)] for k in range(limit)]


def _open_bench(options: EvaluateOptions) -> Bench:
    """Load what all images share; networks of a base are loaded with the first image.

    Raises:
        InputError: weights or a package that cannot be used.
    """
    base = options.base
    network = None if base.residual_file is None else load_residual(base.residual_file)
    direct = None
    if options.direct_ft is not None:
        path = _there(options.direct_ft, "--direct-ft")
        direct = functools.cache(lambda: _load_direct(path, base))
    features = _features(options)
    wanted = options.wanted_metrics
    published = open_metrics(
        [name for name in wanted if name in DEFINITIONS], metrics_device(options), options.download
    )
    states = dict.fromkeys(wanted, OWN)
    states |= dict.fromkeys(published.metrics, f"pyiqa {published.version}")
    states |= {name: f"not run: {reason}" for name, reason in published.missing.items()}
    if "distance" in wanted and features is None:
        states["distance"] = NO_FEATURES
    if "inpaint2d" in options.methods:
        _check_opencv()
    return Bench(
        options,
        get_renderer(base.device),
        set_up(for_base(base)).base if kind_of(base.base).network else None,
        network,
        direct,
        Gauges(wanted, published.metrics, features),
        states,
    )


def _configuration(
    options: EvaluateOptions, dataset: EvalDataset, cases: Sequence[Case], bench: Bench
) -> dict[str, Any]:
    """Everything that decides the figures, ready for JSON; nothing of where files lie."""
    base = options.base
    names = digest_of([case.name for case in cases])
    about = {"name": public_name(base.base), "title": title_of(base.base), "says": says_of(base.base, base.checkpoint)}
    weights = {"weights": base_digest(base.base_files), "precision": base.precision}
    residual = base.residual_file and weights_digest(base.residual_file)
    return {
        "spackle": spackle.__version__,
        "dataset": dataset.name,
        "title": dataset.title,
        "terms": dataset.terms,
        "images": {"count": len(cases), "limit": options.limit, "names": names},
        "protocol": options.protocol,
        "disparities": None if options.near else list(options.disparities),
        "base": about | weights | {"device": metrics_device(options)},
        "methods": list(options.methods),
        "residual": {"weights": "given" if base.residual not in (None, "seeds") else base.residual_weights}
        | {"sha256": residual, "precision": _residual_precision(base)},
        "direct_ft": None if options.direct_ft is None else weights_digest(options.direct_ft),
        "features": None if options.features is None else weights_digest(options.features),
        "metrics": bench.states,
    }


def _residual_precision(base: PredictOptions) -> str | None:
    """What the residual's network computes in here; None without one."""
    if base.residual_file is None:
        return None
    return str(pick_dtype(base.precision, torch.device("cpu"))).removeprefix("torch.")


def _check_cases(cases: Sequence[Case], options: EvaluateOptions) -> None:
    """InputError where not one of them has what is needed."""
    where = f"{options.root}: {options.dataset}"
    if not cases:
        raise InputError(f"{where}: no images: check the folder")
    if all(case.problem for case in cases):
        return  # each is named in its turn
    if options.near and not any(case.seconds for case in cases):
        raise InputError(f"{where}: has no second photos: take --protocol large-view")
    if not kind_of(options.base.base).network and not any(case.depth or case.points for case in cases):
        raise InputError(f"{where}: has no depth of any kind, which --base rgbd takes: take {', '.join(NETWORKS)}")


def _features(options: EvaluateOptions) -> FeatureNet | None:
    """SqueezeNet, where its weights are given and wanted."""
    if options.features is None or "distance" not in options.wanted_metrics:
        return None
    return load_features("squeezenet", _there(options.features, "--features"))


def _there(path: Path, option: str) -> Path:
    if not path.is_file():
        raise InputError(f"{option} {path}: no such file: check the name")
    return path


def _load_direct(path: Path, base: PredictOptions) -> SharpBase:
    """The base of the method direct-ft, at the precision of the other one."""
    device = None if base.device == "auto" else base.device
    try:
        return SharpBase.load(path, precision=base.precision, low_memory=base.low_memory, device=device)
    except InputError as error:
        raise BaseError(f"--direct-ft {error}") from error


def _check_opencv() -> None:
    """InputError where the method inpaint2d has no OpenCV, before any work."""
    try:
        make_method("inpaint2d", None)
    except InputError as error:
        raise InputError(
            "--methods inpaint2d: needs a package: pip install 'spackle-nvs[opencv]', or leave the method out"
        ) from error


def metrics_device(options: EvaluateOptions) -> str:
    """Where networks run."""
    named = options.base.device
    return ("cuda" if torch.cuda.is_available() else "cpu") if named == "auto" else named
