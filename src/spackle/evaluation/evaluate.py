"""`spackle evaluate` and `spackle tables`: datasets into rows, tables, contact sheets and a page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.errors import InputError
from spackle.evaluation.case import Case, LoadedCase, load_case
from spackle.evaluation.folder import ROWS, from_root, image_file, load_run, measure_images, write_rows
from spackle.evaluation.methods import make_method
from spackle.evaluation.metrics import NOTICE
from spackle.evaluation.pictures import BEST, WORST, save_picture, write_sheets
from spackle.evaluation.plots import check_matplotlib
from spackle.evaluation.protocols import INPUT, Alignment, align, large_views, measure_views, to_base
from spackle.evaluation.report import REPORT, make_report
from spackle.evaluation.rows import NOTE, REMARK, Row
from spackle.evaluation.setup import EvaluateOptions, Evaluation, open_evaluation
from spackle.evaluation.table import NOT_RUN
from spackle.evaluation.tables import FILES, make_tables, write_tables
from spackle.files import write_whole
from spackle.folders import results_folder
from spackle.gaussians import Gaussians
from spackle.machine import hardware, versions
from spackle.progress import Reporter, counted
from spackle.residual import hole_mask


def evaluate(options: EvaluateOptions, output: Path, reporter: Reporter, html: bool = False) -> str:
    """Evaluate a dataset, or resume that: "complete", or "stopped" by Ctrl-C.

    Writes rows.jsonl, tables.md, tables.tex, worst.png, best.png and images/ into `output`, and report.html with
    `html`. InputError for options, a dataset or a folder that cannot be used, for another evaluation in `output`, and
    for too little memory.
    """
    if html:
        check_matplotlib("--html")
    evaluation = open_evaluation(options)
    _log_missing(evaluation, reporter)
    about = {"versions": versions(), "machine": hardware(options.device)}
    with results_folder(output, (ROWS, WORST, BEST, *FILES, *([REPORT] if html else [])), alone=True):

        def measure(index: int, case: Case, metrics: Sequence[str]) -> tuple[list[Row], list[Path]]:
            rows, pictures = measure_case(case, evaluation, metrics)
            for remark in (row.value for row in rows if row.metric == REMARK):
                reporter.log(f"{case.name}: {remark}")
            files = [image_file(output, index, case.name, f".{name}.webp") for name in pictures]
            for file, picture in zip(files, pictures.values(), strict=True):
                save_picture(picture, file)
            return rows, files

        shared = evaluation.config, about, options.root, reporter, evaluation.metrics
        run = measure_images(evaluation.cases, measure, output, *shared)
        if run is None:
            return "stopped"
        write_tables(make_tables([run]), output, suffix=run.label_suffix)
        write_sheets(run, output)
        if html:
            write_whole(output / REPORT, make_report([(run, output)]).encode())
        write_rows(run.rows, output / ROWS)
    count, problems = len(run.measured), len(run.problems)
    more = f", {problems} passed over" if problems else ""
    reporter.log(f"{run.title}: {counted(count, 'image')}{more} -> {output}")
    reporter.result({"folder": output, "images": count + problems, "measured": count})
    return "complete"


def _log_missing(evaluation: Evaluation, reporter: Reporter) -> None:
    """Log why metrics are not run, and pyiqa's terms where it measures."""
    reasons: dict[str, list[str]] = {}
    for name, state in evaluation.metrics.items():
        if state.startswith(NOT_RUN):
            reasons.setdefault(state, []).append(name)
    for state, names in reasons.items():
        reporter.log(f"{', '.join(names)}: {state}")
    if evaluation.gauges.published:
        reporter.log(NOTICE)


def measure_case(
    case: Case, evaluation: Evaluation, metrics: Sequence[str] = ()
) -> tuple[list[Row], dict[str, Tensor]]:
    """An image's figures, those of `metrics` among them, and pictures [H, W, 3]: the photo, a view by each method.

    InputError for a file that cannot be used or is missing; BaseError where no image can be worked on.
    """
    options = evaluation.options
    if options.near and not case.seconds and case.problem is None:
        raise InputError(f"{case.name}: has no second photo")
    loaded = load_case(case, options.max_side)
    prediction = evaluation.open(loaded).predict(loaded.full)[0]
    alignment = _align(loaded, prediction, evaluation, not options.base.network) if options.near else None
    if alignment:
        lenses = loaded.camera, prediction.camera, alignment.scale
        views = [view._replace(camera=to_base(view.camera, *lenses)) for view in loaded.seconds]
    else:
        views = large_views(prediction, options.disparities, options.max_side)

    def direct_ft() -> tuple[Gaussians, float]:
        """The other base, and what its cameras' paths are to be multiplied by."""
        assert evaluation.direct is not None
        other = evaluation.direct.predict(loaded.full)[0]
        if alignment is None:
            return other.gaussians, 1.0
        return other.gaussians, alignment.scale / _align(loaded, other, evaluation, False).scale

    context = evaluation.context(prediction)
    methods = {name: make_method(name, context, evaluation.inpainter, direct_ft) for name in options.methods}
    image = Row(str(evaluation.config["title"]), case.name, "", "", "", "", None)
    gauges = dataclasses.replace(evaluation.gauges, metrics=metrics)
    rows, pictures = measure_views(image, context, views, methods, gauges)
    facts = {
        "width": loaded.photo.width,
        "height": loaded.photo.height,
        "focal_px": round(prediction.camera.focal[0], 3),
        "base_gaussians": len(prediction.gaussians),
        **{f"{NOTE}{name}": value for name, value in prediction.notes.items()},
        **{f"alignment_{name}": value for name, value in (dataclasses.asdict(alignment) if alignment else {}).items()},
    }
    known = [image._replace(metric=metric, value=value) for metric, value in facts.items()]
    for lack in loaded.lacks:
        remark = f"without one of its second photos: {from_root(lack, options.root)}"
        known.append(image._replace(metric=REMARK, value=remark))
    return [*known, *rows], pictures | {INPUT: loaded.photo.rgb}


@torch.no_grad()
def _align(loaded: LoadedCase, prediction: BasePrediction, evaluation: Evaluation, is_truth: bool) -> Alignment:
    """The base's scale, by what it sees at the photo's own camera."""
    view = evaluation.renderer.render(prediction.gaussians, prediction.camera)
    return align(loaded.case, view.depth, ~hole_mask(view.alpha), base_is_truth=is_truth)


def merge_tables(folders: Sequence[Path], output: Path, reporter: Reporter, html: bool = False) -> None:
    """Write the tables of several finished evaluations and benchmarks into `output`, and report.html with `html`.

    InputError for a folder without results, results that do not go together, or an output that cannot be written to.
    """
    if html:
        check_matplotlib("--html")
    runs = [load_run(folder) for folder in folders]
    tables = make_tables(runs, whole=True)  # what does not go together is refused before anything is written
    files = (*FILES, *([REPORT] if html else []))
    with results_folder(output, files, alone=True):
        write_tables(tables, output)
        if html:
            write_whole(output / REPORT, make_report(list(zip(runs, folders, strict=True)), whole=True).encode())
    names = ", ".join(f"{run.title} ({run.config['protocol']}, {run.base})" for run in runs)
    reporter.log(f"{names} -> {', '.join(str(output / name) for name in files)}")
