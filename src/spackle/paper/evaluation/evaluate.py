"""`spackle evaluate` and `spackle tables`: evaluate datasets; write rows, tables, contact sheets and an HTML page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import spackle
from spackle.bases import BasePrediction
from spackle.bases.depth import RgbdBase
from spackle.bases.open import OpenedBase, open_base, wrap_loaded_base
from spackle.bases.settings import BaseSettings
from spackle.core.gaussians import Gaussians
from spackle.core.photo import MAX_WORKING_SIDE_PX
from spackle.core.trajectories import MAX_DISPARITY
from spackle.inpaint import Inpainter, InpainterOptions, get_inpainter
from spackle.paper.evaluation.case import Case, LoadedCase, known_depth, load_case
from spackle.paper.evaluation.datasets import DATASETS, read_cases
from spackle.paper.evaluation.datasets.multiview import spaced
from spackle.paper.evaluation.folder import (
    ROWS,
    earlier_metrics,
    image_file,
    load_run,
    measure_images,
    write_rows,
)
from spackle.paper.evaluation.measurements import DISPARITIES, NOTE, REMARK, Measurement
from spackle.paper.evaluation.method_descriptions import METHODS
from spackle.paper.evaluation.methods import make_method
from spackle.paper.evaluation.metrics import (
    DEFAULT_METRICS,
    DEFINITIONS,
    METRICS,
    NOTICE,
    OWN,
    open_metrics,
)
from spackle.paper.evaluation.pictures import BEST, WORST, save_picture, write_sheets
from spackle.paper.evaluation.protocols import (
    INPUT,
    MetricSuite,
    align,
    large_views,
    measure_views,
    to_base,
)
from spackle.paper.evaluation.report import REPORT, check_matplotlib, make_report, means_table
from spackle.paper.evaluation.table import NOT_RUN, plain
from spackle.paper.evaluation.tables import FILES, make_tables, write_tables
from spackle.paper.training.feature_networks import load_features
from spackle.pipeline import FillOptions
from spackle.render import Renderer, get_renderer
from spackle.residual import ResidualNet, hole_mask
from spackle.runtime.device import hardware_facts, package_versions, pick_device, pick_dtype
from spackle.runtime.digests import json_digest
from spackle.runtime.errors import InputError, check_name
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter, pluralized
from spackle.scene_fill import FillContext
from spackle.weights import weights_digest, weights_digests

BASE = BaseSettings(name="sharp")
LARGE_SIDE = 1280  # long side of the paper's large views: the paper adds (1280 / 1536)² of HAR × grid at 1536


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """The options of `spackle evaluate`."""

    dataset: str
    root: Path
    protocol: str = "large-view"
    methods: Sequence[str] = ("base", "paper", "spackle")
    disparities: Sequence[float] = DISPARITIES  # of the large views
    metrics: Sequence[str] | None = None  # None: all metrics of the protocol
    base: BaseSettings = BASE  # the paper's; precision and device also apply to the residual
    residual: str | None = None  # a file, or "seeds"; None: the shipped weights, if any
    direct_ft: Path | None = None  # weights of the method direct-ft
    inpainter: str = "opencv"  # of the method inpaint2d
    features: Path | None = None  # SqueezeNet's weights, for the metric distance
    second_views: str = "all"  # which second photos near-view uses: "all" or "nearest"
    side: int | None = (
        None  # long side of the views; None: the paper's, 1280 for large views, 1536 for near ones
    )
    limit: int | None = None  # the number of images, spread over the dataset
    download: bool = False  # pyiqa may fetch weights

    @property
    def near(self) -> bool:
        return self.protocol == "near-view"

    @property
    def max_side(self) -> int:
        """The long side of the views, in pixels."""
        return self.side or (MAX_WORKING_SIDE_PX if self.near else LARGE_SIDE)

    @property
    def device(self) -> torch.device:
        """The device of networks."""
        return pick_device(None if self.base.device == "auto" else self.base.device)

    @property
    def opened(self) -> BaseSettings:
        """The base's settings. If a base has no precision option, only the residual uses the precision."""
        without = self.base.resolved_name in ("rgbd", "lite")
        return dataclasses.replace(self.base, precision="auto") if without else self.base

    def check(self) -> None:
        """InputError if an option cannot be used; the images are not looked at."""
        check_name("dataset", self.dataset, DATASETS)
        for method in self.methods:
            check_name("methods", method, METHODS)
        for metric in self.metrics or ():
            check_name("metrics", metric, METRICS)
            if METRICS[metric].truth and not self.near:
                raise InputError(
                    f"--metrics {metric}: needs a true second view: add --protocol near-view"
                )
        if not self.methods:
            raise InputError(f"--methods: none is given: choose from {', '.join(METHODS)}")
        self.opened.check(allow_auto=False)
        if self.residual == "none":
            raise InputError("--residual none: leaves the holes open: give --methods base instead")
        if "direct-ft" in self.methods and (self.base.name != "sharp" or self.direct_ft is None):
            raise InputError(
                "--methods direct-ft: is SHARP after further training: add --base sharp, and --direct-ft FILE with the "
                "weights of `spackle train --method direct-ft`"
            )
        for value in self.disparities:
            if not 0 < value <= MAX_DISPARITY:  # also refuses NaN
                raise InputError(
                    f"--disparity {value:g}: must be above 0 and up to {MAX_DISPARITY:g}"
                )
        if not self.disparities:
            raise InputError("--disparity: give at least one number")


def split_words(text: str) -> tuple[str, ...]:
    """Split "a, b,c" into words, and drop repetitions."""
    return tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))


def parse_disparities(text: str) -> tuple[float, ...]:
    """Read "0.3,0.4" as numbers, and drop repetitions; InputError for other text."""
    try:
        return tuple(dict.fromkeys(map(float, split_words(text))))
    except ValueError as error:
        raise InputError(
            f"--disparity {text}: not numbers: give numbers with commas, such as 0.3,0.4,0.5"
        ) from error


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """A dataset's cases, and the objects that all cases share."""

    options: EvaluateOptions
    cases: Sequence[Case]
    base: OpenedBase  # see `open`
    direct: OpenedBase | None  # for the method direct-ft
    network: ResidualNet | None
    inpainter: Inpainter | None  # for the method inpaint2d
    renderer: Renderer
    gauges: MetricSuite
    config: dict[str, Any]  # everything that determines the renders, ready for JSON, without paths
    metrics: dict[
        str, str
    ]  # for each wanted metric the package that measures it, or why the metric is not run

    def open(self, loaded: LoadedCase) -> OpenedBase:
        """The base of a case: a network, or else the case's depth or points; InputError if there is none."""
        network = self.options.base.uses_network
        return self.base if network else wrap_loaded_base(RgbdBase(known_depth(loaded.case)))

    def context(self, prediction: BasePrediction) -> FillContext:
        """The context in which the holes of a photo's views are filled."""
        fill = self.renderer, self.network
        return FillContext(
            prediction.gaussians, prediction.camera, *fill, precision=self.options.base.precision
        )


def open_evaluation(options: EvaluateOptions, more_metrics: Sequence[str] = ()) -> Evaluation:
    """Check the options and open base, networks and metrics; a base's networks are loaded with the first image.

    `more_metrics` are measured besides the options' metrics. InputError if an option, the dataset, weights or a
    package cannot be used.
    """
    options.check()
    base, cases = options.base, _cases_of(options)
    network, direct, features, inpainter = (
        FillOptions(residual=options.residual).load_network(),
        None,
        None,
        None,
    )
    if "inpaint2d" in options.methods:
        inpainter = get_inpainter(options.inpainter, InpainterOptions(device=options.device.type))
    if options.direct_ft is not None:
        direct = open_base(dataclasses.replace(base, checkpoint=options.direct_ft))
    if options.features is not None:
        features = load_features("squeezenet", options.features)
    named = [
        *(DEFAULT_METRICS[options.protocol] if options.metrics is None else options.metrics),
        *more_metrics,
    ]
    wanted = tuple(name for name in METRICS if name in named)
    published = [name for name in wanted if name in DEFINITIONS]
    metrics, states = open_metrics(published, options.device.type, options.download)
    states = dict.fromkeys(wanted, OWN) | states
    if "distance" in wanted:
        states["distance"] = f"{NOT_RUN}: weights: give SqueezeNet's with --features FILE"
        if options.features is not None:
            states["distance"] = f"{OWN}, weights {weights_digest(options.features)[:16]}"
    renderer = get_renderer(base.device)
    config = _configuration(options, cases, inpainter, renderer)
    gauges = MetricSuite(wanted, metrics, features)
    return Evaluation(
        options,
        cases,
        open_base(options.opened),
        direct,
        network,
        inpainter,
        renderer,
        gauges,
        config,
        states,
    )


def _cases_of(options: EvaluateOptions) -> list[Case]:
    """The cases to evaluate, with the second views to compare."""
    cases, limit = read_cases(options.dataset, options.root), options.limit
    if limit is not None and limit < len(cases):
        cases = spaced(cases, limit)
    if not options.near:
        cases = [dataclasses.replace(case, seconds=()) for case in cases]
    elif options.second_views == "nearest":
        cases = [
            dataclasses.replace(case, seconds=tuple(s for s in case.seconds if s.near))
            for case in cases
        ]
    return cases


def _configuration(
    options: EvaluateOptions, cases: Sequence[Case], inpainter: Inpainter | None, renderer: Renderer
) -> dict[str, Any]:
    """Everything that determines the renders, ready for JSON, without paths."""
    base, dataset, fill = (
        options.base,
        DATASETS[options.dataset],
        FillOptions(residual=options.residual),
    )
    precision = str(pick_dtype(base.precision, renderer.device)).removeprefix("torch.")
    config: dict[str, Any] = {
        "kind": "evaluate",
        "spackle": spackle.__version__,
        "dataset": dataset.name,
        "title": dataset.title,
        "terms": dataset.terms,
        "images": {
            "count": len(cases),
            "limit": options.limit,
            "names": json_digest([case.name for case in cases]),
        },
        "protocol": options.protocol,
        "side": options.max_side,
        "disparities": None if options.near else list(options.disparities),
        "second_views": options.second_views if options.near else None,
        "base": {
            "name": base.public_name,
            "title": "SHARP" if base.resolved_name == "sharp" else base.public_name,
            "says": base.description,
            "weights": weights_digests(base.model_files),
            "precision": base.precision,
        },
        "device": renderer.device.type,  # of the renderer, the residual and the base's network
        "methods": list(options.methods),
        "residual": {
            "weights": "seeds"
            if fill.weights_file is None
            else "shipped"
            if options.residual is None
            else "given",
            "sha256": None if fill.weights_file is None else weights_digest(fill.weights_file),
            "precision": None if fill.weights_file is None else precision,
        },
        "direct_ft": None if options.direct_ft is None else weights_digest(options.direct_ft),
    }
    if inpainter is not None:
        weights = {name: weights_digest(file) for name, file in inpainter.weight_files.items()}
        config["inpainter"] = {
            "name": inpainter.name,
            "version": inpainter.version,
            "weights": weights,
        }
    return config


def evaluate(options: EvaluateOptions, output: Path, reporter: Reporter, html: bool = False) -> str:
    """Evaluate a dataset, or resume an earlier run; returns "complete", or "stopped" after Ctrl-C.

    Writes rows.jsonl, tables.md, tables.tex, worst.png, best.png and images/ into `output`, and with `html` also
    report.html. InputError if options, dataset or folder cannot be used, if `output` holds another evaluation, or if
    memory is too small.
    """
    if html:
        check_matplotlib("--html")
    earlier = earlier_metrics(output)
    evaluation = open_evaluation(options, earlier)
    for name, state in evaluation.metrics.items():
        if state.startswith(NOT_RUN):
            if name in earlier:
                raise InputError(
                    f"{output}: holds the metric {name}, which cannot be measured now: {state}"
                )
            reporter.log(f"{name}: {state}")
    if evaluation.gauges.published:
        reporter.log(NOTICE)
    about = {
        "versions": package_versions(),
        "machine": hardware_facts(options.device),
        "metrics": evaluation.metrics,
    }
    with results_folder(
        output, (ROWS, WORST, BEST, *FILES, *([REPORT] if html else [])), locked=True
    ):

        def measure(index: int, case: Case) -> tuple[list[Measurement], list[Path]]:
            rows, pictures = measure_case(case, evaluation)
            for remark in dict.fromkeys(row.value for row in rows if row.metric == REMARK):
                reporter.log(f"{case.name}: {remark}")
            files = [image_file(output, index, case.name, f".{name}.webp") for name in pictures]
            for file, picture in zip(files, pictures.values(), strict=True):
                save_picture(picture, file)
            return rows, files

        run = measure_images(
            evaluation.cases, measure, output, evaluation.config, about, options.root, reporter
        )
        if run is None:
            return "stopped"
        write_tables(make_tables([run]), output, suffix=f":{run.title}-{options.protocol}".lower())
        write_sheets(run, output)
        if html:
            write_atomic(output / REPORT, make_report([(run, output)]).encode())
        write_rows(run.rows, output / ROWS)
    count, problems = len(run.measured), len(run.problems)
    more = f", {problems} passed over" if problems else ""
    for line in plain(means_table(run, run.rows)):
        reporter.log(line)
    reporter.log(f"{run.title}: {pluralized(count, 'image')}{more} -> {output}")
    reporter.result({"folder": output, "images": count + problems, "measured": count})
    return "complete"


def measure_case(case: Case, evaluation: Evaluation) -> tuple[list[Measurement], dict[str, Tensor]]:
    """Measure an image. Returns its rows, and pictures [H, W, 3]: the photo and the views of `measure_views`.

    InputError if a file is missing or cannot be used; BaseError if the base would fail for every image.
    """
    options = evaluation.options
    loaded = load_case(case, options.max_side)
    if options.near and not case.seconds:
        raise InputError(f"{case.name}: has no second photo")
    prediction = evaluation.open(loaded).predict(loaded.full)[0]
    if options.near:
        scale = _align(loaded, prediction, evaluation)
        frames = loaded.camera, prediction.camera, scale
        views = [view._replace(camera=to_base(view.camera, *frames)) for view in loaded.seconds]
    else:
        views = large_views(prediction, options.disparities, options.max_side)

    @cache
    def direct_ft() -> tuple[Gaussians, float]:
        """The Gaussians of direct FT, and the factor that converts camera positions to the unit of these Gaussians."""
        assert evaluation.direct is not None
        other = evaluation.direct.predict(loaded.full)[0]
        return other.gaussians, scale / _align(loaded, other, evaluation) if options.near else 1.0

    context = evaluation.context(prediction)
    method = partial(
        make_method, context=context, inpainter=evaluation.inpainter, direct_ft=direct_ft
    )
    methods = {name: partial(method, name) for name in options.methods}
    image = Measurement(str(evaluation.config["title"]), case.name, "", "", "", "", None)
    rows, pictures = measure_views(image, context, views, methods, evaluation.gauges)
    facts = {
        "width": loaded.photo.width,
        "height": loaded.photo.height,
        "focal_px": round(prediction.camera.focal[0], 3),
        "base_gaussians": len(prediction.gaussians),
        **{f"{NOTE}{name}": value for name, value in prediction.notes.items()},
        **({"scale": scale} if options.near else {}),
    }
    known = [image._replace(metric=metric, value=value) for metric, value in facts.items()]
    return [*known, *rows], pictures | {INPUT: loaded.photo.rgb}


@torch.no_grad()
def _align(loaded: LoadedCase, prediction: BasePrediction, evaluation: Evaluation) -> float:
    """The scale between base and dataset, from the base's depth at the photo's camera."""
    if not evaluation.options.base.uses_network:  # the base is the dataset's depth
        return 1.0
    view = evaluation.renderer.render(prediction.gaussians, prediction.camera)
    return align(loaded.case, view.depth, ~hole_mask(view.alpha))


def merge_tables(
    folders: Sequence[Path], output: Path, reporter: Reporter, html: bool = False
) -> None:
    """Write joint tables of finished evaluations and benchmarks into `output`; with `html`, write report.html too.

    InputError if a folder has no results, results cannot share tables, or the output cannot be written to.
    """
    if html:
        check_matplotlib("--html")
    runs = [load_run(folder) for folder in folders]
    tables = make_tables(
        runs, whole=True
    )  # raises for results that cannot share tables, before files are written
    files = (*FILES, *([REPORT] if html else []))
    with results_folder(output, files, locked=True):
        write_tables(tables, output)
        if html:
            write_atomic(
                output / REPORT,
                make_report(list(zip(runs, folders, strict=True)), whole=True).encode(),
            )
    names = ", ".join(f"{run.title} ({run.config['protocol']}, {run.base})" for run in runs)
    reporter.log(f"{names} -> {', '.join(str(output / name) for name in files)}")
