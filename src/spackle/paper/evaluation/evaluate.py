"""`spackle evaluate` and `spackle tables`: measure a dataset, and write numbers and tables.

`evaluate` runs a whole evaluation, `measure_case` measures one photo, `merge_tables` joins
evaluations.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.paper.evaluation.alignment import align, camera_in_base_scene
from spackle.paper.evaluation.case import Case, LoadedCase, Viewpoint, load_case
from spackle.paper.evaluation.evaluation import Evaluation, open_evaluation
from spackle.paper.evaluation.folder import (
    MEASUREMENTS_FILE,
    ImageResults,
    ImageWorker,
    RunPlan,
    load_run,
    measure_images,
    metrics_of_earlier_run,
    write_measurements,
)
from spackle.paper.evaluation.measurements import (
    NOTE_PREFIX,
    REMARK_METRIC,
    Measurement,
    Run,
    Value,
    image_measurement,
)
from spackle.paper.evaluation.methods import Fill, make_method
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.paper.evaluation.pictures import (
    BEST_SHEET_FILE,
    WORST_SHEET_FILE,
    picture_file,
    save_picture,
    write_contact_sheets,
)
from spackle.paper.evaluation.plots import check_matplotlib
from spackle.paper.evaluation.protocols import INPUT_PICTURE, Method, large_views, measure_views
from spackle.paper.evaluation.published_metrics import LICENCE_NOTICE
from spackle.paper.evaluation.report import REPORT_FILE, make_report, means_table
from spackle.paper.evaluation.table import NOT_RUN, to_plain_lines
from spackle.paper.evaluation.tables import LATEX_FILE, MARKDOWN_FILE, make_tables, write_tables
from spackle.residual import hole_mask
from spackle.runtime.device import hardware_facts, package_versions
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.plugins import is_plugin, load_function
from spackle.runtime.progress import Reporter, pluralized
from spackle.runtime.worker_options import WorkerOptions, check_like_command
from spackle.scene_fill import FillContext


def evaluate(
    options: EvaluateOptions, output: Path, reporter: Reporter, html: bool = False
) -> Run | None:
    """Evaluate a dataset, or resume an earlier run.

    Writes rows.jsonl (all numbers), tables.md, tables.tex, worst.png, best.png and images/ into
    `output`, and with `html` also report.html.

    Args:
        options: what to evaluate.
        output: the folder for the results.
        reporter: gets progress and a table of means.
        html: whether to write report.html, which needs matplotlib.

    Returns:
        The results; None after Ctrl-C.

    Raises:
        InputError: options, dataset or folder cannot be used, `output` holds another evaluation, or
            memory is too small.
    """
    if html:
        check_matplotlib("`html`")
    # A resumed run measures the metrics of the earlier run, too, so that none is lost.
    earlier_metrics = metrics_of_earlier_run(output)
    evaluation = open_evaluation(options, earlier_metrics)
    _report_missing_metrics(evaluation, earlier_metrics, output, reporter)

    plan = RunPlan(
        cases=evaluation.cases,
        root=options.root,
        output=output,
        config=evaluation.config,
        about={
            "versions": package_versions(),
            "machine": hardware_facts(options.device),
            "metrics": evaluation.metric_states,
        },
    )
    workers = WorkerOptions.of_command(
        options.workers, options.threads, options.base.device, options.ray, len(plan.cases)
    )

    def open_worker() -> ImageWorker:
        """The worker of this process, whose networks are open already."""
        return _worker_of(evaluation, plan, reporter.verbose)

    # Networks do not travel between processes, so each opens its own.
    open_elsewhere = functools.partial(
        _open_worker, options, earlier_metrics, plan, reporter.verbose
    )
    files = [MEASUREMENTS_FILE, WORST_SHEET_FILE, BEST_SHEET_FILE, MARKDOWN_FILE, LATEX_FILE]
    if html:
        files.append(REPORT_FILE)

    with results_folder(output, files, locked=True):
        run = measure_images(
            plan, open_worker if workers.in_this_process else open_elsewhere, reporter, workers
        )
        if run is None:
            return None

        label_suffix = f":{run.title}-{options.protocol}".lower()
        write_tables(make_tables([run]), output, label_suffix=label_suffix)
        write_contact_sheets(run, output)
        if html:
            write_atomic(output / REPORT_FILE, make_report([(run, output)]).encode())

        # Last, because this file says that the results are complete.
        write_measurements(run.measurements, output / MEASUREMENTS_FILE)

    _report_results(run, output, reporter)
    return run


def _report_missing_metrics(
    evaluation: Evaluation, earlier_metrics: Sequence[str], output: Path, reporter: Reporter
) -> None:
    """Log which metrics cannot be measured, and the licence of those that pyiqa measures.

    Raises:
        InputError: a metric cannot be measured that an earlier run in the folder has measured; its
            numbers would be lost.
    """
    for name, state in evaluation.metric_states.items():
        if not state.startswith(NOT_RUN):
            continue
        if name in earlier_metrics:
            raise InputError(
                f"{output}: holds the metric {name}, which cannot be measured now: {state}"
            )
        reporter.log(f"{name}: {state}")

    if evaluation.suite.published:
        reporter.log(LICENCE_NOTICE)


def _report_results(run: Run, output: Path, reporter: Reporter) -> None:
    """Log a table of means, and how many images were measured."""
    # Users look for the means first; the files in `output` have the details.
    for line in to_plain_lines(means_table(run, run.measurements)):
        reporter.log(line)

    measured_count = len(run.measured_images)
    problem_count = len(run.problems)
    passed_over = f", {problem_count} passed over" if problem_count else ""
    reporter.log(f"{run.title}: {pluralized(measured_count, 'image')}{passed_over} -> {output}")
    reporter.result(
        {"folder": output, "images": measured_count + problem_count, "measured": measured_count}
    )


def _open_worker(
    options: EvaluateOptions, earlier_metrics: Sequence[str], plan: RunPlan, verbose: bool
) -> ImageWorker:
    """Open the evaluation in a worker process.

    Args:
        options: what to evaluate.
        earlier_metrics: metrics that an earlier run has measured.
        plan: the images, and what determines the results on the machine of the command.
        verbose: whether to say how long each image took.

    Raises:
        InputError: this machine would give other results than that of the command.
    """
    evaluation = open_evaluation(options, earlier_metrics)
    check_like_command(
        {**plan.config, "metrics": plan.about["metrics"]},
        {**evaluation.config, "metrics": evaluation.metric_states},
    )
    return _worker_of(evaluation, plan, verbose)


def _worker_of(evaluation: Evaluation, plan: RunPlan, verbose: bool) -> ImageWorker:
    """What measures images with an evaluation's networks, and saves pictures of each."""
    measure = functools.partial(_measure_and_save_pictures, evaluation, plan.output)
    return ImageWorker(plan, measure, verbose)


def _measure_and_save_pictures(
    evaluation: Evaluation, output: Path, index: int, case: Case, reporter: Reporter
) -> ImageResults:
    """Measure an image, and save its pictures in images/.

    Args:
        evaluation: networks and metrics.
        output: the folder of the results.
        index: the image's place in the dataset.
        case: the image.
        reporter: gets the remarks on the image.

    Raises:
        InputError: a file is missing or cannot be used.
    """
    measurements, pictures = measure_case(case, evaluation)

    # A metric that fails leaves the same remark for each view.
    remarks = [
        measurement.value for measurement in measurements if measurement.metric == REMARK_METRIC
    ]
    for remark in dict.fromkeys(remarks):
        reporter.log(f"{case.name}: {remark}")

    files = []
    for name, picture in pictures.items():
        file = picture_file(output, index, case.name, name)
        save_picture(picture, file)
        files.append(file)
    return ImageResults(measurements, files)


def measure_case(case: Case, evaluation: Evaluation) -> tuple[list[Measurement], dict[str, Tensor]]:
    """Measure an image.

    Args:
        case: the photo with what is known about it.
        evaluation: options, networks and metrics.

    Returns:
        measurements: numbers of the image, and of each view by each method.
        pictures: [H, W, 3] sRGB 0..1 by name: the photo ("input"), and the view with the largest
            hole: by each method, its hole ("hole"), and the true picture ("truth") if known.

    Raises:
        InputError: a file is missing or cannot be used.
        BaseError: every image would fail, for instance because memory is too small.
    """
    options = evaluation.options
    loaded = load_case(case, options.max_side)
    if options.compares_with_photos and not case.second_views:
        raise InputError(f"{case.name}: has no second photo")
    # `predict` also returns which base made the prediction, but an evaluation has only one.
    prediction, _ = evaluation.base_of_case(loaded).predict(loaded.full_photo)

    # `scale` is dataset depth / base depth: second photos have cameras in the dataset's unit.
    scale = None
    if options.compares_with_photos:
        scale = _scale_of_base(loaded, prediction, evaluation)
        viewpoints = _near_views(loaded, prediction, scale)
    else:
        viewpoints = large_views(prediction, options.disparities, options.max_side)

    # All methods start from the same Gaussians.
    context = evaluation.fill_context(prediction)
    methods = methods_of_case(evaluation, loaded, context, scale)
    title = str(evaluation.config["title"])
    measurements, pictures = measure_views(
        title, case.name, context, viewpoints, methods, evaluation.suite
    )
    pictures[INPUT_PICTURE] = loaded.photo.rgb

    # Numbers of the whole image. A base may add notes, such as its network's number format.
    facts: dict[str, Value] = {
        "width": loaded.photo.width,
        "height": loaded.photo.height,
        "focal_px": round(prediction.camera.focal[0], 3),  # thousandths of a pixel are enough
        "base_gaussians": len(prediction.gaussians),
    }
    for name, value in prediction.notes.items():
        facts[f"{NOTE_PREFIX}{name}"] = value
    if scale is not None:
        facts["scale"] = scale

    image_measurements = [
        image_measurement(title, case.name, name, value) for name, value in facts.items()
    ]
    return [*image_measurements, *measurements], pictures


def _near_views(loaded: LoadedCase, prediction: BasePrediction, scale: float) -> list[Viewpoint]:
    """The viewpoints of a case's second photos in the base's scene.

    Args:
        loaded: the case, with cameras in the dataset's unit.
        prediction: the base's Gaussians and its camera of the photo, in the base's unit.
        scale: dataset depth / base depth.
    """
    return [
        view._replace(
            camera=camera_in_base_scene(view.camera, loaded.camera, prediction.camera, scale)
        )
        for view in loaded.second_viewpoints
    ]


@torch.no_grad()
def _scale_of_base(loaded: LoadedCase, prediction: BasePrediction, evaluation: Evaluation) -> float:
    """Dataset depth / base depth, from the base's depth at the photo's camera.

    InputError if too few pixels have known depth in both.
    """
    if not evaluation.options.base.uses_network:  # the base is the dataset's depth
        return 1.0
    # The depth of Gaussians is that of their rendering; in holes it is unknown.
    rendering = evaluation.renderer.render(prediction.gaussians, prediction.camera)
    return align(loaded.case, rendering.depth, ~hole_mask(rendering.alpha))


def methods_of_case(
    evaluation: Evaluation, loaded: LoadedCase, context: FillContext, scale: float | None
) -> dict[str, Method]:
    """The compared methods by name, for the views of one photo.

    A method is one way to render new views of the photo. It gets the cameras of all views of a
    setting (a size of the camera move), and returns a function that fills one of these views.

    Args:
        evaluation: the options name the methods.
        loaded: the photo.
        context: the base's Gaussians, the renderer and the residual network.
        scale: dataset depth / base depth, for near views.
    """

    @functools.cache
    def tuned_gaussians() -> tuple[Gaussians, float]:
        """Gaussians by the fine-tuned base, for the method direct-ft; predicted only once."""
        return _predict_by_tuned_base(evaluation, loaded, scale)

    def built_in_method(name: str, cameras: Sequence[Camera]) -> Fill:
        """One of `METHODS`, for all views of a setting."""
        own_context = context
        if name == "dense":
            own_context = dataclasses.replace(context, network=evaluation.dense_network)
        return make_method(name, cameras, own_context, evaluation.inpainter, tuned_gaussians)

    def plugin_method(name: str, cameras: Sequence[Camera]) -> Fill:
        """A method of another package, named `package.module:Name`, for all views of a setting."""
        fill: Fill = load_function(name, "methods")(cameras, context)
        return fill

    methods: dict[str, Method] = {}
    for name in evaluation.options.methods:
        make_fill = plugin_method if is_plugin(name) else built_in_method
        methods[name] = functools.partial(make_fill, name)
    return methods


def _predict_by_tuned_base(
    evaluation: Evaluation, loaded: LoadedCase, scale: float | None
) -> tuple[Gaussians, float]:
    """A photo's Gaussians by the fine-tuned base of the method direct-ft.

    Args:
        evaluation: has the fine-tuned base.
        loaded: the photo.
        scale: dataset depth / depth of the base that is not fine-tuned, for near views; else None.

    Returns:
        gaussians: in the fine-tuned base's own unit of length.
        unit: the factor that converts camera positions to this unit.
    """
    assert evaluation.tuned_base is not None
    prediction, _ = evaluation.tuned_base.predict(loaded.full_photo)
    if scale is None:  # large views are cameras of the base's scene, whatever its unit
        return prediction.gaussians, 1.0
    # Fine-tuning may have changed the base's unit of length, so its scale is found anew.
    tuned_scale = _scale_of_base(loaded, prediction, evaluation)
    return prediction.gaussians, scale / tuned_scale


def merge_tables(
    folders: Sequence[Path], output: Path, reporter: Reporter, html: bool = False
) -> None:
    """Write joint tables of finished evaluations and benchmarks into `output`.

    Args:
        folders: results of `spackle evaluate` and `spackle bench`.
        output: the folder for tables.md and tables.tex.
        reporter: gets a line about what was written.
        html: whether to write report.html, too, which needs matplotlib.

    Raises:
        InputError: a folder has no results, results cannot share tables, or the output cannot be
            written to.
    """
    if html:
        check_matplotlib("`html`")
    runs = [load_run(folder) for folder in folders]

    # Before files are written, because this raises for results that cannot share tables.
    tables = make_tables(runs, with_unmeasured=True)

    files = [MARKDOWN_FILE, LATEX_FILE]
    if html:
        files.append(REPORT_FILE)
    with results_folder(output, files, locked=True):
        write_tables(tables, output)
        if html:
            sources = list(zip(runs, folders, strict=True))
            page = make_report(sources, with_unmeasured=True)
            write_atomic(output / REPORT_FILE, page.encode())

    names = [f"{run.title} ({run.config['protocol']}, {run.base_title})" for run in runs]
    paths = [str(output / file) for file in files]
    reporter.log(f"{', '.join(names)} -> {', '.join(paths)}")
