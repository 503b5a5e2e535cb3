"""`spackle evaluate` and `spackle tables`: datasets into figures, tables, contact sheets and a page."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.bases.open import BaseError
from spackle.bases.protocol import BasePrediction
from spackle.errors import InputError
from spackle.evaluation import report, results
from spackle.evaluation.alignment import Alignment, align, to_base
from spackle.evaluation.case import Case, LoadedCase, load_case
from spackle.evaluation.methods import make_method
from spackle.evaluation.metrics import NOTICE, definitions
from spackle.evaluation.plots import check_matplotlib
from spackle.evaluation.protocols import NEAR, Wanted, large_views, measure
from spackle.evaluation.results import ImageResult, Run, begin, image_file, load_part, save_part, write_json, write_text
from spackle.evaluation.setup import EvaluateOptions, Evaluation, open_evaluation
from spackle.evaluation.sheets import CASES, TRUTH, rank, sheet, strip
from spackle.evaluation.table import to_latex, to_markdown
from spackle.evaluation.tables import NOT_RUN, make_tables
from spackle.files import as_recorded, atomic_path, digest_of, file_records, fingerprint, results_folder
from spackle.formats import save_png
from spackle.machine import hardware, versions
from spackle.progress import Reporter
from spackle.residual import hole_mask
from spackle.signals import asked_to_stop

TABLES = (results.MARKDOWN, results.LATEX)


def evaluate(options: EvaluateOptions, output: Path, reporter: Reporter, html: bool = False) -> str:
    """Evaluate a dataset, or resume that: "complete", or "stopped" by Ctrl-C.

    Writes results.json, times.json, tables.md, tables.tex, worst.png, best.png and images/ into `output`, and
    report.html with `html`. InputError for options, a dataset or a folder that cannot be used, for another evaluation
    in `output`, and for too little memory.
    """
    if html:
        check_matplotlib("--html")
    evaluation = open_evaluation(options)
    _log_missing(evaluation, reporter)
    files = (results.RESULTS, results.TIMES, results.WORST, results.BEST, *TABLES, *([report.REPORT] if html else []))
    with results_folder(output, files, alone=True):
        begin(output, evaluation.config)
        records = _do_images(evaluation, output, reporter)
        if records is None:
            reporter.log("stopped; the same command goes on from here")
            return "stopped"
        _finish(evaluation, records, output, reporter, html)
    return "complete"


def _log_missing(evaluation: Evaluation, reporter: Reporter) -> None:
    """Log why metrics are not run, and pyiqa's terms where it measures."""
    reasons: dict[str, list[str]] = {}
    for name, state in evaluation.config["metrics"].items():
        if state.startswith(NOT_RUN):
            reasons.setdefault(state, []).append(name)
    for state, names in reasons.items():
        reporter.log(f"{', '.join(names)}: {state}")
    if evaluation.gauges.published:
        reporter.log(NOTICE)


def _do_images(evaluation: Evaluation, output: Path, reporter: Reporter) -> list[tuple[ImageResult, float]] | None:
    """Do what is missing: each image's record and seconds; None where Ctrl-C came."""
    cases, found, begun = evaluation.cases, [], False
    with reporter.stage("images") as step, asked_to_stop(alone=True) as stop:
        for index, case in enumerate(cases):
            if stop():
                return None
            inputs = inputs_digest(case)
            one = _load(output, index, case, inputs)
            if one is None:
                if index and not begun:
                    reporter.log(f"{output}: going on, {index} of {len(cases)} images are done")
                begun = True
                try:
                    one = _do_image(evaluation, index, case, inputs, output, reporter)
                except BaseError:
                    raise
                except InputError as error:  # the next run tries it again
                    problem = problem_of(case, error, evaluation.options.root)
                    reporter.log(f"passed over: {problem}")
                    one = ImageResult(case.name, problem=problem), 0.0
            found.append(one)
            step(index + 1, len(cases))
    return found


def _load(output: Path, index: int, case: Case, inputs: str) -> tuple[ImageResult, float] | None:
    """What an earlier run found of an image, and in how many seconds; None where it is to be done."""
    file = image_file(output, index, case.name, ".json")
    part = load_part(file, inputs)
    if part is None or not as_recorded(file.parent, file.name, part.get("files")):
        return None
    try:
        return ImageResult.of(part["record"]), float(part["seconds"])
    except (KeyError, TypeError, ValueError):
        return None


def _do_image(
    evaluation: Evaluation, index: int, case: Case, inputs: str, output: Path, reporter: Reporter
) -> tuple[ImageResult, float]:
    """Examine an image and save its record and pictures."""
    start = time.perf_counter()
    record, pictures = examine(case, evaluation)
    for remark in record.remarks:
        reporter.log(f"{case.name}: {remark}")
    seconds = round(time.perf_counter() - start, 3)
    files = {name: image_file(output, index, case.name, f".{name}.webp") for name in pictures}
    for name, picture in pictures.items():
        report.save_picture(picture, files[name])
    joined, part = (image_file(output, index, case.name, suffix) for suffix in (".png", ".json"))
    save_png(strip(pictures), joined)
    records = file_records(part.parent, [*files.values(), joined])
    save_part(part, inputs, {"record": dataclasses.asdict(record), "seconds": seconds, "files": records})
    reporter.detail(f"  {case.name}: {seconds:.1f} s")
    return record, seconds


def examine(case: Case, evaluation: Evaluation) -> tuple[ImageResult, dict[str, Tensor]]:
    """All figures of an image, and what is shown of it: a picture of one view by each method, and the truth.

    InputError for a file that cannot be used or is missing; BaseError where no image can be worked on.
    """
    options = evaluation.options
    if options.near and not case.seconds and case.problem is None:
        raise InputError(f"{case.name}: has no second photo")
    loaded = load_case(case if options.near else dataclasses.replace(case, seconds=()))
    prediction = evaluation.open(loaded).predict(loaded.full)[0]
    alignment = _align(loaded, prediction, evaluation, not options.base.kind.network) if options.near else None
    if alignment:
        cameras = [to_base(v.camera, loaded.camera, prediction.camera, alignment.scale) for v in loaded.seconds]
        wanted = [Wanted(NEAR, v.name, c, v.rgb) for v, c in zip(loaded.seconds, cameras, strict=True)]
    else:
        wanted = large_views(prediction, options.disparities)

    def direct_ft() -> tuple[BasePrediction, float]:
        """The other base, and what its cameras' paths are to be multiplied by."""
        assert evaluation.direct is not None
        other = evaluation.direct.predict(loaded.full)[0]
        if alignment is None:
            return other, 1.0
        return other, alignment.scale / _align(loaded, other, evaluation, False).scale

    parts = (evaluation.network, direct_ft, options.base.precision, evaluation.inpainter)
    methods = {name: make_method(name, *parts) for name in options.methods}
    measured = measure(prediction, wanted, methods, evaluation.gauges, evaluation.renderer)
    facts: dict[str, Any] = {
        "width": loaded.photo.width,
        "height": loaded.photo.height,
        "focal_px": round(prediction.camera.focal[0], 3),
        "base_gaussians": len(prediction.gaussians),
        "notes": prediction.notes,
        "alignment": dataclasses.asdict(alignment) if alignment else None,
        "shown": {"setting": measured.shown.setting, "view": measured.shown.name},
    }
    lacks = [f"without one of its second photos: {_from_root(lack, options.root)}" for lack in loaded.lacks]
    record = ImageResult(case.name, facts, tuple(measured.rows), remarks=(*lacks, *measured.remarks))
    truth = {} if measured.shown.truth is None else {TRUTH: measured.shown.truth}
    return record, measured.pictures | truth


@torch.no_grad()
def _align(loaded: LoadedCase, prediction: BasePrediction, evaluation: Evaluation, is_truth: bool) -> Alignment:
    """The base's scale, by what it sees at the photo's own camera."""
    view = evaluation.renderer.render(prediction.gaussians, prediction.camera)
    return align(loaded.case, view.depth, ~hole_mask(view.alpha), base_is_truth=is_truth)


def problem_of(case: Case, error: InputError, root: Path) -> str:
    """Why a case is passed over, in one line that begins with its name: a photo may be the second one of several."""
    problem = _from_root(str(error), root)
    return problem if problem.startswith(case.name) else f"{case.name}: {problem}"


def _from_root(problem: str, root: Path) -> str:
    """A line about a file of a dataset, whose name does not say where that was unpacked."""
    return " ".join(problem.replace(f"{root}/", "").splitlines())


def inputs_digest(case: Case) -> str:
    """What the photos of a case hold, in one digest; a missing one has its turn later."""
    parts = []
    for path in (case.photo, *(second.photo for second in case.seconds)):
        try:
            parts.append(fingerprint(path, "photo"))
        except InputError:
            parts.append("none")
    return digest_of(parts)


def _finish(
    evaluation: Evaluation, found: Sequence[tuple[ImageResult, float]], output: Path, reporter: Reporter, html: bool
) -> None:
    """Write everything that is made of all images; results.json comes last and vouches for the rest."""
    run, options = Run(evaluation.config, tuple(record for record, _ in found)), evaluation.options
    if not run.measured:
        raise InputError(f"{options.root}: none of {len(found)} images gave figures (the lines above say why)")
    _write_tables([run], output)
    if ranking := rank(run):
        strips = {case.name: image_file(output, k, case.name, ".png") for k, case in enumerate(evaluation.cases)}
        for name, order in ((results.BEST, ranking.names), (results.WORST, ranking.names[::-1])):
            with atomic_path(output / name) as temporary:
                sheet(run, ranking, order[:CASES], strips).save(temporary)
    seconds, machine = {record.name: spent for record, spent in found}, hardware(options.device)
    total = round(sum(seconds.values()), 3)
    write_json({"hardware": machine, "total": total, "seconds": seconds}, output / results.TIMES)
    if html:
        page = report.make_report([report.source_of(run, output, versions(), machine)], report.find_bench([output]))
        write_text(page, output / report.REPORT)
    about = {"versions": versions(), "definitions": definitions(options.wanted_metrics)}
    write_json(about | run.plain(), output / results.RESULTS)
    count, passed = len(run.measured), len(found) - len(run.measured)
    more = f", {passed} passed over" if passed else ""
    reporter.log(f"{run.title}: {count} image{'s' if count > 1 else ''}{more} -> {output}")
    reporter.result({"folder": output, "images": len(found), "measured": count})


def _write_tables(runs: Sequence[Run], output: Path) -> None:
    tables = make_tables(runs)
    write_text(to_markdown(tables), output / results.MARKDOWN)
    write_text(to_latex(tables), output / results.LATEX)


def merge_tables(folders: Sequence[Path], output: Path, reporter: Reporter, html: bool = False) -> None:
    """Write the tables of several finished evaluations into `output`, and report.html with `html`.

    With `html` a folder may hold a bench.json alone. InputError for a folder without results, results that do not go
    together, or an output that cannot be written to.
    """
    if not folders:
        raise InputError("no results: name the folders that `spackle evaluate` wrote")
    measured = list(folders)
    if html:
        check_matplotlib("--html")
        idle = [f for f in folders if (f / report.BENCH).is_file() and not (f / results.RESULTS).exists()]
        measured = [folder for folder in folders if folder not in idle] or measured
    sources = [report.load_source(folder) for folder in measured]
    runs = [source.run for source in sources]
    make_tables(runs)  # what does not go together is refused before anything is written
    files = (*TABLES, *([report.REPORT] if html else []))
    with results_folder(output, files, alone=True):
        _write_tables(runs, output)
        if html:
            write_text(report.make_report(sources, report.find_bench(folders)), output / report.REPORT)
    names = ", ".join(f"{run.title} ({run.config['protocol']}, {run.base})" for run in runs)
    reporter.log(f"{names} -> {', '.join(str(output / name) for name in files)}")
