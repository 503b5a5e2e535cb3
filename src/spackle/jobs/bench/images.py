"""`spackle bench`: what Spackle costs in Gaussians and in time on a dataset, in the paper's tables of efficiency."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from spackle.bases.open import BaseError, kind_of
from spackle.errors import InputError
from spackle.evaluation.case import Case
from spackle.evaluation.efficiency import Clock, Parameters, count_parameters
from spackle.evaluation.efficiency_cells import SIDE
from spackle.evaluation.efficiency_results import Bill, ImageCost
from spackle.evaluation.efficiency_tables import efficiency_tables
from spackle.evaluation.results import IMAGES, begin, stem_of, write_json, write_text
from spackle.evaluation.run import inputs_digest, problem_of
from spackle.evaluation.setup import Bench, metrics_device, open_evaluation
from spackle.evaluation.table import to_latex, to_markdown
from spackle.jobs.bench.image import time_image
from spackle.jobs.bench.options import BenchOptions, check_bench_options
from spackle.machine import hardware, versions
from spackle.output_folder import alone_in, results_folder
from spackle.progress import Reporter
from spackle.signals import asked_to_stop

RESULTS, MARKDOWN, LATEX = "bench.json", "bench.md", "bench.tex"
SHARED = ("dataset", "title", "terms", "images", "disparities", "base", "residual")  # of an evaluation's configuration


def bench(options: BenchOptions, output: Path, reporter: Reporter) -> str:
    """Time a dataset, or go on with that.

    Args:
        options: what, how often.
        output: a folder; bench.json, bench.md, bench.tex and images/ go there. It belongs to one machine: times of
            two do not go together.
        reporter: says what is passed over, and with -v each image's figures.

    Returns:
        "complete", or "stopped" where Ctrl-C came.

    Raises:
        InputError: options, a dataset or a folder that cannot be used; another benchmark in `output`.
    """
    check_bench_options(options)
    cases, tools, whole = open_evaluation(options.evaluation)
    config = {"kind": "bench", **{name: whole[name] for name in SHARED}}
    config |= {"view": SIDE, "runs": options.runs, "base_runs": options.base_times}
    network = kind_of(options.base.base).network
    device = torch.device(metrics_device(options.evaluation) if network else "cpu")
    config["base"] |= {"device": device.type}
    config |= {"hardware": hardware(device), "versions": versions()}
    with results_folder(output, (RESULTS, MARKDOWN, LATEX)), alone_in(output, "benchmark"):
        begin(output, config)
        return _Benchmark(options, cases, output, tools, reporter, config, Clock(device)).run()


@dataclasses.dataclass
class _Benchmark:
    """The images of a dataset and how far they have come."""

    options: BenchOptions
    cases: Sequence[Case]
    output: Path
    tools: Bench
    reporter: Reporter
    config: Mapping[str, Any]
    clock: Clock
    warm: bool = False  # something was predicted in this process

    def run(self) -> str:
        """Do what is missing; "complete" or "stopped"."""
        images: list[ImageCost] = []
        with self.reporter.stage("images", {}) as step, asked_to_stop(alone=True) as stop:
            for index, case in enumerate(self.cases):
                if stop():
                    self.reporter.say("stopped; the same command goes on from here")
                    return "stopped"
                path = self.output / IMAGES / f"{stem_of(index, case.name)}.json"
                inputs = inputs_digest(case)
                images.append(_load(path, inputs) or self._measure(case, inputs, path))
                step(index + 1, len(self.cases))
        self._finish(Bill(self.config, tuple(images)), count_parameters())
        return "complete"

    def _measure(self, case: Case, inputs: str, path: Path) -> ImageCost:
        """One image; a problem of its own is its record, which the next run tries again."""
        try:
            image = time_image(case, self.options, self.tools, self.clock, self.warm)
            self.warm = True
        except BaseError:
            raise
        except InputError as error:
            problem = problem_of(case, error, self.options.root)
            self.reporter.say(f"passed over: {problem}")
            return ImageCost(case.name, problem=problem)
        write_json({"inputs": inputs, "image": image.plain()}, path)
        for view in image.views:
            found = view.figures()
            times = f"{found['base_ms']:,.0f} ms, with Spackle {found['spackle_ms']:,.0f}"
            self.reporter.detail(f"  {case.name}, {view.setting}: {times}, {view.added:,} Gaussians added")
        return image

    def _finish(self, bill: Bill, parameters: Parameters) -> None:
        """Everything that is made of all images; bench.json comes last and vouches for the rest."""
        if not bill.measured:
            raise InputError(
                f"{self.options.root}: none of {len(bill.images)} images gave figures (the lines above say why)"
            )
        tables = efficiency_tables(bill, parameters)
        write_text(to_markdown(tables), self.output / MARKDOWN)
        write_text(to_latex(tables), self.output / LATEX)
        counted = {**dataclasses.asdict(parameters), "share": parameters.share}
        write_json({"parameters": counted, **bill.plain()}, self.output / RESULTS)
        title, n = bill.config["title"], len(bill.measured)
        overheads = ", ".join(
            f"{setting}: {100 * bill.spread(setting, 'overhead').median:.2f} %" for setting in bill.settings
        )
        self.reporter.say(f"{title}: {n} of {len(bill.images)} images, overhead {overheads} -> {self.output}")
        self.reporter.result({"folder": self.output, "images": len(bill.images), "measured": n})


def _load(path: Path, inputs: str) -> ImageCost | None:
    """What an earlier run found; None where it is not there, or about other files."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return ImageCost.of(content["image"]) if content["inputs"] == inputs else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
