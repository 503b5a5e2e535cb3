"""`spackle bench --suite`: every stage timed, section by section, in one folder that a later run goes on with."""

from __future__ import annotations

import dataclasses
import functools
import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

import spackle
from spackle.bases.lift import lift
from spackle.bases.open import BaseSettings, open_base
from spackle.bases.sharp import SharpBase
from spackle.digest import weights_digest
from spackle.errors import InputError, check_name
from spackle.evaluation import suite_stages as stages
from spackle.evaluation.bench import check_runs, load_part, write_part
from spackle.evaluation.motorcycle import load_motorcycle
from spackle.evaluation.results import begin, write_json, write_text
from spackle.evaluation.suite_scenes import SIDE, holed_scene
from spackle.evaluation.table import EMPTY, Line, Table, to_markdown
from spackle.evaluation.timing import MS, Section, Timing, timed
from spackle.machine import hardware, versions, without_nan
from spackle.output_folder import alone_in, results_folder
from spackle.progress import Reporter
from spackle.render import get_renderer
from spackle.residual.network import load_residual
from spackle.signals import asked_to_stop

PARTS = "sections"
RESULTS, MARKDOWN = "suite.json", "suite.md"
SIDES = (64, 8192)
LIMITS = "limits"
TITLES = {
    LIMITS: "Matrix products and copies of memory: the most that any stage can reach",
    "renderer": "CPU renderer: one view of a scene of SHARP's size",
    "completion": "Completion of one view of a scene of SHARP's size",
    "photo": "Completion of one view of a real photo with depth (Motorcycle)",
    "video": "A video of a real photo with depth (Motorcycle), as one scene and frame by frame",
    "sharp": "SHARP: photo to scene",
}
SHARP = BaseSettings("sharp")
COLUMNS = ("what", "median", "quartiles", "runs", "limit", "time over limit")


@dataclasses.dataclass(frozen=True)
class SuiteOptions:
    """The choices of `spackle bench --suite`."""

    only: Sequence[str] = ()  # sections; none: all of them
    runs: int = 5
    base_runs: int | None = None  # of SHARP; None: 1
    base: BaseSettings = SHARP  # its device is that of everything but the renderer's section; auto: the processor
    sharp: bool = False  # its section was asked for
    residual: Path | None = None  # weights; None: the seeds alone
    side: int = SIDE  # pixels along the made scenes; a smaller one makes all small, for trying it out

    def check(self) -> None:
        """InputError for an option that cannot be used."""
        for name in self.only:
            check_name("--only", name, tuple(TITLES))
        check_runs(self.runs, self.base_runs)
        if not (SIDES[0] <= self.side <= SIDES[1] and self.side % 2 == 0):
            raise InputError(f"--side must be an even number between {SIDES[0]} and {SIDES[1]}, got {self.side}")
        base = self.base
        get_renderer("cpu" if base.device == "auto" else base.device)
        if base.named != "sharp":
            raise InputError(f"--base {base.name}: the suite times no other base than sharp: leave the option out")
        for option, file in (("--residual", self.residual), ("-c", base.checkpoint)):
            if file is not None and not file.is_file():
                raise InputError(f"{option} {file}: no such file: check the name")
        if self.sharp:
            base.check()

    @property
    def device(self) -> torch.device:
        """Where networks run, and what draws completions and videos."""
        return torch.device("cuda" if self.base.device == "cuda" else "cpu")


def run_suite(options: SuiteOptions, output: Path, reporter: Reporter) -> str:
    """Time everything that can be timed here, or go on with that; "complete", or "stopped" where Ctrl-C came.

    Writes suite.json, suite.md and sections/ into `output`. The folder belongs to one machine, one commit and one set
    of options but for `only` and SHARP's: times of two do not go together.

    Raises:
        InputError: options or a folder that cannot be used; another suite in `output`.
    """
    options.check()
    config = _configuration(options)
    found: dict[str, Section] = {}
    not_run: dict[str, str] = {}
    with results_folder(output, (RESULTS, MARKDOWN)), alone_in(output, "benchmark"):
        begin(output, config, PARTS)
        with asked_to_stop(alone=True) as stop:
            for name in TITLES:
                path, inputs = output / PARTS / f"{name}.json", _inputs(name, options)
                there = load_part(path, inputs, Section.of)
                if there is not None:
                    found[name] = there
                elif options.only and name not in (*options.only, LIMITS):
                    not_run[name] = "not asked for (--only)"
                elif stop():
                    reporter.say("stopped; the same command goes on from here")
                    return "stopped"
                else:
                    try:
                        found[name] = _run(name, options, reporter)
                    except InputError as error:
                        not_run[name] = str(error)
                        reporter.say(f"{name}: not run: {error}")
                        continue
                    write_part(path, inputs, without_nan(dataclasses.asdict(found[name])))
        about = ", ".join(f"{key} {value}" for key, value in {**config["hardware"], **config["versions"]}.items())
        head = f"# Speed\n\n{about}; commit {config['commit']}; {config['runs']} runs.\n\n"
        write_text(head + to_markdown(suite_tables(found, not_run)), output / MARKDOWN)
        content = {"config": config, "not_run": not_run, "sections": {name: _plain(found, name) for name in found}}
        write_json(without_nan(content), output / RESULTS)
    reporter.say(f"{len(found)} of {len(TITLES)} sections -> {output / MARKDOWN}")
    return "complete"


def _inputs(name: str, options: SuiteOptions) -> dict[str, Any] | None:
    """Everything that decides a section's figures besides the suite's configuration; None: the section is not asked."""
    base = options.base
    if name != "sharp":
        return {}
    if not options.sharp or (options.only and name not in options.only):
        return None
    settings = {"precision": base.precision, "low_memory": base.low_memory, "windows": base.windows}
    weights = weights_digest(base.files["checkpoint"])
    return {"weights": weights, **settings, "compiled": base.compiled, "runs": options.base_runs or 1}


def _run(name: str, options: SuiteOptions, reporter: Reporter) -> Section:
    """Measure a section; InputError where it cannot be run here, and why."""
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
    with reporter.stage(name, {}):
        one, seconds = timed(functools.partial(_section, name, options))
    reporter.say(f"{name}: {len(one.rows)} figures in {seconds:,.0f} s")
    return dataclasses.replace(one, facts={**one.facts, "load_before": load, "seconds": round(seconds, 1)})


def _section(name: str, options: SuiteOptions) -> Section:
    runs, side, device = options.runs, options.side, options.device
    if name == LIMITS:
        return stages.limits_section(runs, device, min(1.0, side / SIDE))
    if name == "renderer":
        return stages.renderer_section(runs, side)
    if name == "sharp":
        if not options.sharp:
            raise InputError("no weights: -c FILE names some, --base sharp takes those that are installed")
        photo = stages.sharp_photo()
        base = open_base(dataclasses.replace(options.base, device=device.type)).load(photo).load()
        assert isinstance(base, SharpBase)
        return stages.sharp_section(options.base_runs or 1, base, photo, device)
    renderer = get_renderer(device.type)
    network = None if options.residual is None else load_residual(options.residual)
    if name == "completion":
        return stages.completion_section(runs, *holed_scene(side), renderer, network, device)
    pair = load_motorcycle()
    lifting = functools.partial(lift, pair.left, pair.depth, pair.left_camera)
    if name == "photo":
        found = lifting()
        return stages.completion_section(runs, found.gaussians, found.camera, renderer, network, device)
    return stages.video_section(runs, lifting, renderer, network, stages.FRAMES if side >= SIDE else 4, device)


def _configuration(options: SuiteOptions) -> dict[str, Any]:
    """Everything that decides the figures of all sections, ready for JSON; nothing of where files lie."""
    machine = {"commit": commit(), "hardware": hardware(options.device), "versions": versions()}
    weights = options.residual and weights_digest(options.residual)
    return {"kind": "suite", **machine, "runs": options.runs, "side": options.side, "residual": weights}


def commit() -> str:
    """Of the checkout that this package runs from, with a + where files were changed since; "unknown" without one."""
    git = ["git", "-C", str(Path(spackle.__file__).parent)]
    try:  # a project that this package is only installed into does not track it
        subprocess.run([*git, "ls-files", "--error-unmatch", "__init__.py"], capture_output=True, check=True)
        found = [*git, "describe", "--always", "--dirty=+", "--exclude=*"]
        return subprocess.run(found, capture_output=True, check=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def suite_tables(found: Mapping[str, Section], not_run: Mapping[str, str]) -> list[Table]:
    """A table for each section that was run, and a line for each that was not, with the reason."""
    tables = []
    for name, one in found.items():
        items = {k: f"{v:.4g}" if isinstance(v, float) else str(v) for k, v in one.facts.items() if v is not None}
        facts = ", ".join(f"{key} {text}" for key, text in items.items())
        lines = tuple(Line(_cells(row, limit_ms(row, found.get(LIMITS)))) for row in one.rows)
        tables.append(Table(name, f"{TITLES[name]}. {facts}.", COLUMNS, (("", len(COLUMNS)),), lines))
    if not_run:
        lines = tuple(Line((name, TITLES[name], f"not run: {why}")) for name, why in not_run.items())
        tables.append(Table("not run", "Sections without figures.", ("section", "what", "why"), (("", 3),), lines))
    return tables


def limit_ms(row: Timing, limits: Section | None) -> float | None:
    """The least time of a row: operations at the matrix product's rate, or bytes at the copy's; None if not counted."""
    if limits is None or not (row.flops or row.bytes):
        return None
    product = limits.row(stages.PRODUCT.format(row.dtype)).values
    return MS * max(row.flops / max(product), row.bytes / max(limits.row(stages.COPY).values)) / 1e9


def _plain(found: Mapping[str, Section], name: str) -> dict[str, Any]:
    """A section ready for JSON, with medians, quartiles and limits beside the values."""
    content, rows = dataclasses.asdict(found[name]), found[name].rows
    for plain, row in zip(content["rows"], rows, strict=True):
        low, median, high = row.quartiles
        plain |= {"median": median, "quartiles": [low, high], "limit_ms": limit_ms(row, found.get(LIMITS))}
    return content


def _cells(row: Timing, limit: float | None) -> tuple[str, ...]:
    low, median, high = row.quartiles
    over = (EMPTY, EMPTY) if limit is None else (f"{_number(limit)} ms", f"{median / limit:.1f}×")
    return row.name, f"{_number(median)} {row.unit}", f"{_number(low)} – {_number(high)}", str(len(row.values)), *over


def _number(value: float) -> str:
    """Three digits at least, without a power of ten where one can do without."""
    size = abs(value)
    if size >= 100 or value == 0:
        return f"{value:,.0f}"
    return f"{value:.1f}" if size >= 10 else f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"
