"""One image of an evaluation: load, predict, look from elsewhere, measure.

What an evaluation's folder holds for a report: pictures of each image, and a page of them.

`spackle tables`: several evaluations in the same tables, and on one page.

`spackle evaluate`: a dataset to figures, tables, contact sheets and a page, in any number of runs.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.bases.lift import RgbdBase
from spackle.bases.open import BaseError
from spackle.bases.protocol import Base, BasePrediction
from spackle.choose import Load
from spackle.digest import digest_of, fingerprint
from spackle.errors import InputError
from spackle.evaluation.alignment import Alignment, align, to_base
from spackle.evaluation.case import Case, LoadedCase, known_depth, load_case
from spackle.evaluation.methods import make_method
from spackle.evaluation.metrics import NOTICE, definitions
from spackle.evaluation.plots import check_matplotlib
from spackle.evaluation.protocols import NEAR, Wanted, large_views, measure
from spackle.evaluation.report import (
    BENCH,
    REPORT,
    find_bench,
    load_source,
    picture_file,
    save_picture,
    source_of,
    write_report,
)
from spackle.evaluation.results import (
    BEST,
    IMAGES,
    LATEX,
    MARKDOWN,
    RESULTS,
    TIMES,
    WORST,
    Record,
    Run,
    begin,
    load_record,
    save_record,
    stem_of,
    write_json,
    write_text,
)
from spackle.evaluation.setup import Bench, EvaluateOptions, check_evaluate_options, metrics_device, open_evaluation
from spackle.evaluation.sheets import CASES, TRUTH, rank, sheet, strip
from spackle.evaluation.table import to_latex, to_markdown
from spackle.evaluation.tables import NOT_RUN, make_tables
from spackle.formats import atomic_path, save_png
from spackle.machine import hardware, versions
from spackle.output_folder import alone_in, results_folder
from spackle.progress import Reporter
from spackle.residual import hole_mask
from spackle.signals import asked_to_stop


def examine(case: Case, bench: Bench) -> tuple[Record, dict[str, Tensor]]:
    """All figures of an image, and what is shown of it: a picture of one view by each method, and the truth.

    Raises:
        InputError: a file that cannot be used, or something that the protocol needs and the case lacks.
        BaseError: no image can be worked on.
    """
    near = bench.options.near
    if near and not case.seconds and case.problem is None:
        raise InputError(f"{case.name}: has no second photo")
    loaded = load_case(case if near else dataclasses.replace(case, seconds=()))
    prediction = _predict(loaded, bench)
    alignment = _align(loaded, prediction, bench, bench.base is None) if near else None
    try:
        wanted = _near_views(loaded, prediction, alignment) if alignment else large_views(prediction, _moves(bench))
    except ValueError as error:
        raise InputError(f"{case.name}: no camera path: {error}: check depth and focal length") from error

    def direct_ft() -> tuple[BasePrediction, float]:
        """The other base, and what its cameras' paths are to be multiplied by."""
        assert bench.direct is not None
        other = _of_network(bench.direct).predict(loaded.full)
        if alignment is None:
            return other, 1.0
        return other, alignment.scale / _align(loaded, other, bench, False).scale

    methods = {
        name: make_method(name, bench.network, direct_ft, bench.options.base.precision)
        for name in bench.options.methods
    }
    measured = measure(prediction, wanted, methods, bench.gauges, bench.renderer)
    facts: dict[str, Any] = {
        "width": loaded.photo.width,
        "height": loaded.photo.height,
        "focal_px": round(prediction.camera.focal[0], 3),
        "base_gaussians": len(prediction.gaussians),
        "notes": prediction.notes,
        "alignment": dataclasses.asdict(alignment) if alignment else None,
        "shown": {"setting": measured.shown.setting, "view": measured.shown.name},
    }
    lacks = [f"without one of its second photos: {from_root(lack, bench.options.root)}" for lack in loaded.lacks]
    record = Record(case.name, facts, tuple(measured.rows), remarks=(*lacks, *measured.remarks))
    truth = {} if measured.shown.truth is None else {TRUTH: measured.shown.truth}
    return record, measured.pictures | truth


def from_root(problem: str, root: Path) -> str:
    """A line about a file of a dataset, whose name does not say where that was unpacked."""
    return " ".join(problem.replace(f"{root}/", "").splitlines())


def _moves(bench: Bench) -> tuple[float, ...]:
    return tuple(bench.options.disparities)


def _predict(loaded: LoadedCase, bench: Bench) -> BasePrediction:
    """The base's Gaussians; InputError where a case has no depth for a base that takes it."""
    if bench.base is not None:
        return _of_network(bench.base).predict(loaded.full)
    return RgbdBase(known_depth(loaded.case)).predict(loaded.full)


def _of_network(load: Load) -> Base:
    """A base, loaded; BaseError where it cannot be, since no other image could be worked on either."""
    try:
        return load()
    except BaseError:
        raise
    except InputError as error:
        raise BaseError(str(error)) from error


@torch.no_grad()
def _align(loaded: LoadedCase, prediction: BasePrediction, bench: Bench, is_truth: bool) -> Alignment:
    """The base's scale, by what it sees at the photo's own camera."""
    view = bench.renderer.render(prediction.gaussians, prediction.camera)
    return align(loaded.case, view.depth, ~hole_mask(view.alpha), base_is_truth=is_truth)


def _near_views(loaded: LoadedCase, prediction: BasePrediction, alignment: Alignment) -> list[Wanted]:
    """The true second photos, and the base's world from their cameras."""
    return [
        Wanted(NEAR, view.name, to_base(view.camera, loaded.camera, prediction.camera, alignment.scale), view.rgb)
        for view in loaded.seconds
    ]


TABLES = (MARKDOWN, LATEX)


def page(html: bool) -> tuple[str, ...]:
    """The name of the page, where one is wanted."""
    return (REPORT,) if html else ()


def write_tables(runs: Sequence[Run], output: Path) -> None:
    """tables.md and tables.tex."""
    tables = make_tables(runs)
    write_text(to_markdown(tables), output / MARKDOWN)
    write_text(to_latex(tables), output / LATEX)


def merge_tables(folders: Sequence[Path], output: Path, reporter: Reporter, html: bool = False) -> None:
    """The tables of several evaluations in one.

    Args:
        folders: outputs of `evaluate`, finished.
        output: a folder for the two files.
        reporter: says where they lie.
        html: write report.html too; a folder may then hold a bench.json alone.

    Raises:
        InputError: a folder without results, results that do not go together, or an output that cannot be written to.
    """
    if not folders:
        raise InputError("no results: name the folders that `spackle evaluate` wrote")
    if html:
        check_matplotlib("--html")
    measured = [folder for folder in folders if not (html and _only_bench(folder))]
    sources = [load_source(folder) for folder in measured or folders]
    runs = [source.run for source in sources]
    make_tables(runs)  # what does not go together is refused before anything is written
    files = (*TABLES, *page(html))
    with results_folder(output, files):
        write_tables(runs, output)
        if html:
            write_report(sources, find_bench(folders), output)
    self_said = ", ".join(f"{run.title} ({run.config['protocol']}, {run.base})" for run in runs)
    reporter.say(f"{self_said} -> {', '.join(str(output / name) for name in files)}")


def _only_bench(folder: Path) -> bool:
    return (folder / BENCH).is_file() and not (folder / RESULTS).exists()


def evaluate(options: EvaluateOptions, output: Path, reporter: Reporter, html: bool = False) -> str:
    """Evaluate a dataset, or go on with that.

    Args:
        options: what on what.
        output: a folder; results.json, times.json, tables.md, tables.tex, worst.png, best.png and images/ go there.
        reporter: says what is passed over.
        html: write report.html too.

    Returns:
        "complete", or "stopped" where Ctrl-C came.

    Raises:
        InputError: options, a dataset or a folder that cannot be used; another evaluation in `output`.
    """
    check_evaluate_options(options)
    if html:
        check_matplotlib("--html")
    cases, bench, config = open_evaluation(options)
    _say_what_is_missing(bench, reporter)
    with results_folder(output, (RESULTS, TIMES, WORST, BEST, *TABLES, *page(html))), alone_in(output, "evaluation"):
        begin(output, config)
        return _Evaluation(cases, output, bench, reporter, config, html).run()


def _say_what_is_missing(bench: Bench, reporter: Reporter) -> None:
    """A line for each reason why metrics are not run, and pyiqa's terms where it is at work."""
    reasons: dict[str, list[str]] = {}
    for name, state in bench.states.items():
        if state.startswith(NOT_RUN):
            reasons.setdefault(state, []).append(name)
    for state, names in reasons.items():
        reporter.say(f"{', '.join(names)}: {state}")
    if bench.gauges.published:
        reporter.say(NOTICE)


@dataclasses.dataclass
class _Evaluation:
    """The images of a dataset and how far they have come."""

    cases: Sequence[Case]
    output: Path
    bench: Bench
    reporter: Reporter
    config: dict[str, Any]
    html: bool

    def run(self) -> str:
        """Do what is missing; "complete" or "stopped"."""
        records: list[Record] = []
        seconds: dict[str, float] = {}
        begun = False
        with self.reporter.stage("images", {}) as step, asked_to_stop(alone=True) as stop:
            for index, case in enumerate(self.cases):
                if stop():
                    self.reporter.say("stopped; the same command goes on from here")
                    return "stopped"
                inputs = inputs_digest(case)
                found = load_record(self._file(index, ".json"), inputs)
                if found is None or not self._file(index, ".png").is_file():
                    if index and not begun:
                        self.reporter.say(f"{self.output}: going on, {index} of {len(self.cases)} images are done")
                    begun, found = True, self._examine(index, case, inputs)
                records.append(found[0])
                seconds[case.name] = found[1]
                step(index + 1, len(self.cases))
        self._finish(Run(self.config, tuple(records)), seconds)
        return "complete"

    def _examine(self, index: int, case: Case, inputs: str) -> tuple[Record, float]:
        """One image; a problem of its own is its record, which the next run tries again."""
        start = time.perf_counter()
        try:
            record, pictures = examine(case, self.bench)
        except BaseError:
            raise
        except InputError as error:
            problem = problem_of(case, error, self.bench.options.root)
            self.reporter.say(f"passed over: {problem}")
            return Record(case.name, problem=problem), 0.0
        for remark in record.remarks:
            self.reporter.say(f"{case.name}: {remark}")
        seconds = round(time.perf_counter() - start, 3)
        for name, picture in pictures.items():
            save_picture(picture, picture_file(self.output, index, case.name, name))
        save_png(strip(pictures), self._file(index, ".png"))
        save_record(record, inputs, seconds, self._file(index, ".json"))
        self.reporter.detail(f"  {case.name}: {seconds:.1f} s")
        return record, seconds

    def _file(self, index: int, suffix: str) -> Path:
        return self.output / IMAGES / (stem_of(index, self.cases[index].name) + suffix)

    def _finish(self, run: Run, seconds: dict[str, float]) -> None:
        """Everything that is made of all images; results.json comes last and vouches for the rest."""
        if not run.measured:
            raise InputError(
                f"{self.bench.options.root}: none of {len(run.records)} images gave figures (the lines above say why)"
            )
        write_tables([run], self.output)
        self._write_sheets(run)
        total = round(sum(seconds.values()), 3)
        machine = hardware(torch.device(metrics_device(self.bench.options)))
        write_json({"hardware": machine, "total": total, "seconds": seconds}, self.output / TIMES)
        if self.html:
            source = source_of(run, self.output, versions(), machine)
            write_report([source], find_bench([self.output]), self.output)
        about = {"versions": versions(), "definitions": definitions(self.bench.options.wanted_metrics)}
        write_json({**about, **run.plain()}, self.output / RESULTS)
        passed = len(run.records) - len(run.measured)
        more = f", {passed} passed over" if passed else ""
        counted = f"{len(run.measured)} image{'s' if len(run.measured) > 1 else ''}"
        self.reporter.say(f"{run.title}: {counted}{more} -> {self.output}")
        self.reporter.result({"folder": self.output, "images": len(run.records), "measured": len(run.measured)})

    def _write_sheets(self, run: Run) -> None:
        """worst.png begins with the worst image, best.png with the best."""
        ranking = rank(run)
        if ranking is None:
            return
        strips = {case.name: self._file(index, ".png") for index, case in enumerate(self.cases)}
        for name, order in ((BEST, ranking.names), (WORST, ranking.names[::-1])):
            with atomic_path(self.output / name) as temporary:
                sheet(run, ranking, order[:CASES], strips).save(temporary)


def problem_of(case: Case, error: InputError, root: Path) -> str:
    """Why a case is passed over, in one line that begins with its name: a photo may be the second one of several."""
    problem = from_root(str(error), root)
    return problem if problem.startswith(case.name) else f"{case.name}: {problem}"


def inputs_digest(case: Case) -> str:
    """What the photos of a case hold, in one digest; a missing one has its turn later."""
    parts = []
    for path in (case.photo, *(second.photo for second in case.seconds)):
        try:
            parts.append(fingerprint(path, "photo"))
        except InputError:
            parts.append("none")
    return digest_of(parts)
