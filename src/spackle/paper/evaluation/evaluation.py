"""An opened evaluation: a dataset's cases, and the networks and metrics that they share."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from rich.filesize import decimal

import spackle
from spackle.bases import BasePrediction
from spackle.bases.depth import RgbdBase
from spackle.bases.open import OpenedBase, open_base, wrap_loaded_base
from spackle.bases.settings import describe_base
from spackle.inpaint import Inpainter, InpainterOptions, get_inpainter
from spackle.paper.evaluation.case import (
    MAX_SPREAD_VIEWS,
    Case,
    LoadedCase,
    SecondView,
    SecondViews,
    known_depth,
)
from spackle.paper.evaluation.datasets import find_dataset, find_scenes, read_cases
from spackle.paper.evaluation.datasets.labels import read_label
from spackle.paper.evaluation.datasets.multiview import evenly_spaced_items
from spackle.paper.evaluation.metric_suite import MetricSuite
from spackle.paper.evaluation.metrics import DEFAULT_METRICS, METRICS
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.paper.evaluation.published_metrics import PUBLISHED_METRICS, open_published_metrics
from spackle.paper.evaluation.table import NOT_RUN
from spackle.paper.training.feature_networks import load_features
from spackle.render import Renderer, get_renderer
from spackle.residual import ResidualNet
from spackle.residual.architectures import load_residual
from spackle.runtime.device import pick_dtype
from spackle.runtime.digests import json_digest
from spackle.runtime.plugins import plugin_digests
from spackle.scene_fill import FillContext
from spackle.weights import (
    PUBLISHED_WEIGHTS,
    installed_weights,
    weights_digest,
    weights_digests,
)

OWN_METRIC = "own"  # how a metric is measured that no other package measures


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A dataset's cases (photos with what is known about them), and what all cases share."""

    options: EvaluateOptions
    cases: Sequence[Case]
    base: OpenedBase  # turns photos into Gaussians; `base_of_case` is the one to use
    tuned_base: OpenedBase | None  # for the method direct-ft
    network: ResidualNet | None  # makes the Gaussians that are added
    dense_network: ResidualNet | None  # the same for the method dense
    inpainter: Inpainter | None  # for the method inpaint2d
    renderer: Renderer
    suite: MetricSuite
    # Everything that determines the renders, ready for JSON, without paths.
    config: dict[str, Any]
    # For each chosen metric what measures it, or "not run" and the reason.
    metric_states: dict[str, str]

    def base_of_case(self, loaded: LoadedCase) -> OpenedBase:
        """The base that makes a case's Gaussians: a network, or the case's own known depth.

        Raises:
            InputError: the base is no network, and the case has neither depth nor points.
        """
        if self.options.base.uses_network:
            return self.base
        return wrap_loaded_base(RgbdBase(known_depth(loaded.case)))

    def fill_context(self, prediction: BasePrediction) -> FillContext:
        """What the methods need for filling the holes in views of a predicted scene."""
        return FillContext.of(
            prediction, self.renderer, self.network, precision=self.options.base.precision
        )


def open_evaluation(options: EvaluateOptions, earlier_metrics: Sequence[str] = ()) -> Evaluation:
    """Check the options, and open the dataset, networks and metrics.

    The base's network is loaded later, with the first image.

    Args:
        options: what to evaluate.
        earlier_metrics: metrics that an earlier run has measured; they are measured besides the
            options' metrics, so that a resumed run loses none.

    Raises:
        InputError: an option, the dataset, weights or a package cannot be used.
    """
    # What fails fast comes first: options, files of the dataset, weights, packages.
    options.check()
    cases = _cases_to_evaluate(options)
    network = options.fill.load_network()
    dense_network = network
    if options.dense_residual is not None:
        dense_network = load_residual(options.dense_residual)

    inpainter = None
    if "inpaint2d" in options.methods:
        inpainter_options = InpainterOptions(device=options.device.type)
        inpainter = get_inpainter(options.inpainter, inpainter_options)

    # The method direct-ft is the same base with other weights.
    tuned_base = None
    if options.direct_ft is not None:
        tuned_base = open_base(dataclasses.replace(options.base, checkpoint=options.direct_ft))

    suite, metric_states = _open_metrics(options, earlier_metrics)
    renderer = get_renderer(options.base.device)
    return Evaluation(
        options=options,
        cases=cases,
        base=open_base(options.settings_of_base),
        tuned_base=tuned_base,
        network=network,
        dense_network=dense_network,
        inpainter=inpainter,
        renderer=renderer,
        suite=suite,
        config=_configuration(options, cases, inpainter, renderer),
        metric_states=metric_states,
    )


def _cases_to_evaluate(options: EvaluateOptions) -> list[Case]:
    """The dataset's cases, at most `options.limit`, each with the second photos to compare with.

    InputError if the dataset's files cannot be used.
    """
    cases = read_cases(options.dataset, options.root)
    if options.limit is not None and options.limit < len(cases):
        cases = evenly_spaced_items(cases, options.limit)

    # Second photos that are not compared are dropped, so that they are not read.
    chosen_cases = []
    for case in cases:
        second_views: Sequence[SecondView] = ()
        if options.compares_with_photos:  # large views are not compared with photos
            second_views = choose_second_views(case.second_views, options.chosen_second_views)
        chosen_cases.append(dataclasses.replace(case, second_views=tuple(second_views)))
    return chosen_cases


def choose_second_views(views: Sequence[SecondView], choice: SecondViews) -> Sequence[SecondView]:
    """The second photos of a case that are compared.

    `views` are all other photos of the scene, the nearest camera first.
    """
    if choice == "adjacent":
        return [view for view in views if view.is_adjacent]
    if choice == "nearest":
        return [view for view in views if view.is_among_nearest]
    # Evenly spaced in the order of distances, so that their mean stands for that of all.
    if choice == "spread" and len(views) > MAX_SPREAD_VIEWS:
        return evenly_spaced_items(views, MAX_SPREAD_VIEWS)
    return views


def _open_metrics(
    options: EvaluateOptions, earlier_metrics: Sequence[str]
) -> tuple[MetricSuite, dict[str, str]]:
    """Load the metrics of an evaluation.

    Args:
        options: which metrics, and the weights that some need.
        earlier_metrics: further metrics, which an earlier run has measured.

    Returns:
        suite: the metrics, ready to use.
        states: for each metric what measures it, or "not run" and the reason.
    """
    # None means all metrics that the protocol allows; an empty list means none.
    chosen = DEFAULT_METRICS[options.protocol] if options.metrics is None else options.metrics
    chosen = [*chosen, *earlier_metrics]
    names = tuple(name for name in METRICS if name in chosen)  # in the order of the tables
    published_names = [name for name in names if name in PUBLISHED_METRICS]

    # The metric "distance" compares features: what a network (SqueezeNet) finds in two pictures.
    features = None
    features_file = options.features or installed_weights("squeezenet")
    if features_file is not None:
        features = load_features("squeezenet", features_file)

    published, published_states = open_published_metrics(
        published_names, options.device.type, options.download_metrics
    )
    states = dict.fromkeys(names, OWN_METRIC) | published_states
    # Without the weights of the features' network there is no distance.
    if "distance" in names:
        if features_file is None:
            states["distance"] = (
                f"{NOT_RUN}: no weights of SqueezeNet on this machine: `spackle weights get "
                f"squeezenet` ({decimal(PUBLISHED_WEIGHTS['squeezenet'].bytes)}, BSD) downloads "
                "them, `features` FILE takes a local copy"
            )
        else:
            digest_start = weights_digest(features_file)[:16]
            states["distance"] = f"{OWN_METRIC}, weights {digest_start}"
    return MetricSuite(names, published, features), states


def _configuration(
    options: EvaluateOptions,
    cases: Sequence[Case],
    inpainter: Inpainter | None,
    renderer: Renderer,
) -> dict[str, Any]:
    """Everything that determines the renders, ready for JSON, without paths.

    A later run in the same folder must have the same configuration; tables and reports show it.

    Args:
        options: what is evaluated.
        cases: the dataset's cases; their number and names are recorded.
        inpainter: of the method inpaint2d.
        renderer: its device is recorded.
    """
    dataset = find_dataset(options.dataset)
    scenes = find_scenes(options.dataset, options.root)
    label = read_label(dataset, list(scenes.values()), options.root)
    names_digest = json_digest([case.name for case in cases])

    # Weights are recorded by digest, because paths differ between machines.
    direct_ft = None
    if options.direct_ft is not None:
        direct_ft = weights_digest(options.direct_ft)

    config: dict[str, Any] = {
        "kind": "evaluate",
        "spackle": spackle.__version__,
        "dataset": options.dataset,
        "title": label.title,
        "terms": label.terms,  # of use of the photos
        "images": {"count": len(cases), "limit": options.limit, "names": names_digest},
        "protocol": options.protocol,
        "side": options.max_side,  # the long side of views, in pixels
        "disparities": None if options.compares_with_photos else list(options.disparities),
        "second_views": options.chosen_second_views if options.compares_with_photos else None,
        "base": _base_configuration(options),
        "device": renderer.device.type,  # where renderer and networks run
        "methods": list(options.methods),
        "residual": _residual_configuration(options, renderer),
        "direct_ft": direct_ft,
    }
    if label.about:
        config["about_scenes"] = label.about
    if options.dense_residual is not None:
        config["dense_residual"] = weights_digest(options.dense_residual)
    # Code of other packages, by which results may change; there is a record only if there is any.
    code = plugin_digests(options.plugin_names)
    if code:
        config["code"] = code
    if inpainter is not None:
        weights = {name: weights_digest(file) for name, file in inpainter.weight_files.items()}
        config["inpainter"] = {
            "name": inpainter.name,
            "version": inpainter.version,
            "weights": weights,
        }
    return config


def _base_configuration(options: EvaluateOptions) -> dict[str, Any]:
    """What config.json records about the base, which turns photos into Gaussians."""
    base = options.base
    digests = weights_digests(base.model_files)
    return {
        "name": base.public_name,
        # In notes below tables.
        "says": describe_base(base.public_name, digests, base.description),
        "weights": digests,
        "precision": base.precision,
    }


def _residual_configuration(options: EvaluateOptions, renderer: Renderer) -> dict[str, Any]:
    """What config.json records about the residual network: its weights and its precision."""
    weights_file = options.fill.weights_file
    if weights_file is None:  # no network changes the first guess of the Gaussians that fill holes
        return {"weights": "initial", "sha256": None, "precision": None}

    # "auto" becomes the number format that the hardware multiplies fastest.
    dtype = pick_dtype(options.base.precision, renderer.device)
    return {
        "weights": "shipped" if options.residual is None else "given",
        "sha256": weights_digest(weights_file),
        "precision": str(dtype).removeprefix("torch."),
    }
