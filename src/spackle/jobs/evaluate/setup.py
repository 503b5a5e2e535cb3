"""What an evaluation works with, set up once for all images, and what that is called in its results."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import spackle
from spackle.bases.sharp import SharpBase
from spackle.choose import BaseError
from spackle.errors import InputError
from spackle.evaluation.case import Case, EvalDataset
from spackle.evaluation.datasets import get_dataset
from spackle.evaluation.figures import OWN
from spackle.evaluation.methods import make_method
from spackle.evaluation.protocols import Gauges
from spackle.evaluation.pyiqa_metrics import DEFINITIONS, open_metrics
from spackle.jobs.bases import NETWORKS, kind_of, public_name, says_of, title_of
from spackle.jobs.dataset.options import base_digest, weights_digest
from spackle.jobs.evaluate.case import Bench
from spackle.jobs.evaluate.options import EvaluateOptions, for_base
from spackle.jobs.options import PredictOptions
from spackle.jobs.request import digest_of
from spackle.jobs.setup import set_up
from spackle.precision import pick_dtype
from spackle.render import get_renderer
from spackle.residual.weights import load_residual
from spackle.training.features import FeatureNet, load_features

NO_FEATURES = "not run: weights: give SqueezeNet's with --features FILE"


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
    weights = {"weights": base_digest(base), "precision": base.precision}
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
