"""`spackle evaluate`: a dataset to figures, tables, contact sheets and a page, in any number of runs."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from spackle.choose import BaseError
from spackle.errors import InputError
from spackle.evaluation.case import Case
from spackle.evaluation.cells import NOT_RUN
from spackle.evaluation.figures import definitions
from spackle.evaluation.pyiqa_metrics import NOTICE
from spackle.evaluation.results import Record, Run
from spackle.evaluation.sheets import CASES, rank, sheet, strip
from spackle.formats import atomic_path, save_png
from spackle.jobs.evaluate.case import Bench, examine, from_root
from spackle.jobs.evaluate.options import EvaluateOptions, check_evaluate_options
from spackle.jobs.evaluate.pictures import find_bench, picture_suffix, save_picture, source_of, write_report
from spackle.jobs.evaluate.setup import metrics_device, open_evaluation
from spackle.jobs.evaluate.store import (
    BEST,
    IMAGES,
    RESULTS,
    TIMES,
    WORST,
    begin,
    load_record,
    save_record,
    stem_of,
    write_json,
)
from spackle.jobs.evaluate.tables import TABLES, page, write_tables
from spackle.jobs.inputs import alone_in, results_folder
from spackle.jobs.machine import hardware, versions
from spackle.jobs.progress import Reporter
from spackle.jobs.request import digest_of, fingerprint
from spackle.jobs.stopping import asked_to_stop


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
            save_picture(picture, self._file(index, picture_suffix(name)))
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
