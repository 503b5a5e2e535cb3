"""`spackle bench --suite`: every stage timed, section by section, in one folder that a later run goes on with."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

import spackle
from spackle.digest import weights_digest
from spackle.errors import InputError
from spackle.evaluation.plots import has_matplotlib
from spackle.evaluation.results import begin, write_json, write_text
from spackle.evaluation.suite.limits import Peaks
from spackle.evaluation.suite.plot import scaling_svg
from spackle.evaluation.suite.tables import GPU_LIMITS, LIMITS, TITLES, row_limits, suite_tables, targets
from spackle.evaluation.suite.values import Found
from spackle.evaluation.table import to_markdown
from spackle.jobs.bench.suite_options import SuiteOptions, check_suite_options
from spackle.jobs.bench.suite_sections import Sections
from spackle.machine import hardware, versions, without_nan
from spackle.output_folder import alone_in, results_folder
from spackle.progress import Reporter
from spackle.signals import asked_to_stop

SECTIONS = "sections"
RESULTS, MARKDOWN, PLOT = "suite.json", "suite.md", "scaling.svg"


def bench_suite(options: SuiteOptions, output: Path, reporter: Reporter) -> str:
    """Time everything that can be timed here, or go on with that.

    Args:
        options: what, how often.
        output: a folder; suite.json, suite.md, scaling.svg and sections/ go there. It belongs to one machine, one
            commit and one set of options but for `only`, `compiled` and SHARP's: times of two do not go together.
        reporter: says what was measured, and what could not be.

    Returns:
        "complete", or "stopped" where Ctrl-C came.

    Raises:
        InputError: options or a folder that cannot be used; another suite in `output`.
    """
    check_suite_options(options)
    config = _configuration(options)
    with results_folder(output, (RESULTS, MARKDOWN, PLOT)), alone_in(output, "benchmark"):
        begin(output, config, SECTIONS)
        return _Suite(options, output, reporter, config).run()


@dataclasses.dataclass
class _Suite:
    """The sections and how far they have come."""

    options: SuiteOptions
    output: Path
    reporter: Reporter
    config: Mapping[str, Any]

    def run(self) -> str:
        """Do what is missing; "complete" or "stopped"."""
        sections, wanted = Sections(self.options), set(self.options.sections)
        needed = {LIMITS} | ({GPU_LIMITS} if any(name.startswith("gpu") for name in wanted) else set())
        found: dict[str, Found] = {}
        not_run: dict[str, str] = {}
        with asked_to_stop(alone=True) as stop:
            for name in TITLES:
                path, inputs = self.output / SECTIONS / f"{name}.json", sections.inputs(name)
                asked = name in wanted | needed
                there = _load(path, inputs if asked else None)
                if there is not None:
                    found[name] = there
                elif not asked:
                    not_run[name] = "not asked for (--only)"
                elif stop():
                    self.reporter.say("stopped; the same command goes on from here")
                    return "stopped"
                else:
                    self._measure(name, sections, path, inputs, found, not_run)
        self._finish(found, not_run)
        return "complete"

    def _measure(
        self,
        name: str,
        sections: Sections,
        path: Path,
        inputs: Mapping[str, Any] | None,
        found: dict[str, Found],
        not_run: dict[str, str],
    ) -> None:
        """One section into `found`, or into `not_run` and why."""
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
        start = time.perf_counter()
        try:
            with self.reporter.stage(name, {}):
                one = sections.run(name)
        except InputError as error:
            not_run[name] = str(error)
            self.reporter.say(f"{name}: not run: {error}")
            return
        seconds = round(time.perf_counter() - start, 1)
        facts = {**one.facts, "load_before": None if load is None else round(load, 2), "seconds": seconds}
        found[name] = dataclasses.replace(one, facts=facts)
        write_json({"inputs": inputs, "found": without_nan(found[name].plain())}, path)
        self.reporter.say(f"{name}: {len(one.rows)} figures in {seconds:,.0f} s")

    def _finish(self, found: Mapping[str, Found], not_run: Mapping[str, str]) -> None:
        """Everything that is made of all sections; suite.json comes last and vouches for the rest."""
        head = _head(self.config)
        if "scaling" in found and has_matplotlib():
            write_text(scaling_svg(found["scaling"]), self.output / PLOT)
            head += f"![Time against Gaussians and pixels]({PLOT})\n\n"
        write_text(head + to_markdown(suite_tables(found, not_run)), self.output / MARKDOWN)
        plain = {name: _with_limits(one, found) for name, one in found.items()}
        goals = {name: None if row is None else row.median for name, row in targets(found)}
        content = {"config": self.config, "targets": goals, "not_run": not_run, "sections": plain}
        write_json(without_nan(content), self.output / RESULTS)
        self.reporter.say(f"{len(found)} of {len(TITLES)} sections -> {self.output / MARKDOWN}")


def _with_limits(one: Found, found: Mapping[str, Found]) -> dict[str, Any]:
    """Ready for JSON, with the two limits of each row in milliseconds."""
    content = one.plain()
    limits = found.get(GPU_LIMITS if one.device == "cuda" else LIMITS)
    peaks = None if limits is None else Peaks.of(limits)
    for row, plain in zip(one.rows, content["rows"], strict=True):
        least = row_limits(row, peaks)
        plain["limits_ms"] = None if least is None else {"operations": least[0], "bytes": least[1]}
    return content


def _configuration(options: SuiteOptions) -> dict[str, Any]:
    """Everything that decides the figures of all sections, ready for JSON; nothing of where files lie."""
    residual = options.base.residual_file
    device = torch.device("cpu" if options.gpu_problem else "cuda")
    return {
        "kind": "suite",
        "commit": commit(),
        "hardware": hardware(device),
        "versions": versions(),
        "runs": options.runs,
        "side": options.side,
        "residual": None if residual is None else weights_digest(residual),
    }


def commit() -> str:
    """Of the checkout that this package runs from, with a + where files were changed since; "unknown" without one."""
    here = Path(spackle.__file__).parent
    command = ["git", "-C", str(here), "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        tracked = subprocess.run([*command[:3], "ls-files", "--error-unmatch", "__init__.py"], capture_output=True)
        found = subprocess.run(command, capture_output=True, text=True)
    except OSError:  # no git
        return "unknown"
    ours = tracked.returncode == 0 and found.returncode == 0  # and not that of a project it is installed into
    return found.stdout.strip() if ours else "unknown"


def _head(config: Mapping[str, Any]) -> str:
    """What the tables were measured on."""
    machine = ", ".join(f"{key} {value}" for key, value in config["hardware"].items())
    version = ", ".join(f"{key} {value}" for key, value in config["versions"].items())
    return f"# Speed\n\n{machine}; commit {config['commit']}; {version}; {config['runs']} runs.\n\n"


def _load(path: Path, inputs: Mapping[str, Any] | None) -> Found | None:
    """What an earlier run found; None where it is not there, or of other inputs than these (None: of any)."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Found.of(content["found"]) if inputs is None or content["inputs"] == inputs else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
