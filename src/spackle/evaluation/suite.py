"""`spackle bench --suite`: every stage timed, section by section, in one folder that a later run goes on with."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from spackle.bases.lift import lift
from spackle.bases.open import BaseSettings, open_base
from spackle.bases.sharp import SharpBase
from spackle.errors import InputError, check_name
from spackle.evaluation import suite_sections as sections
from spackle.evaluation.bench import check_runs
from spackle.evaluation.efficiency import Record
from spackle.evaluation.motorcycle import load_motorcycle
from spackle.evaluation.results import begin, load_part, save_part, write_json, write_text
from spackle.evaluation.suite_sections import SIDE, Section, holed_scene
from spackle.evaluation.table import EMPTY, Line, Table, to_markdown
from spackle.files import results_folder
from spackle.image import Photo
from spackle.machine import commit, hardware, load_average, versions, without_nan
from spackle.progress import Reporter
from spackle.render import get_renderer
from spackle.residual.network import load_residual
from spackle.signals import asked_to_stop
from spackle.weights import weights_digest

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
COLUMNS = ("what", "median", "quartiles", "runs", "limit", "time over limit")


@dataclasses.dataclass(frozen=True)
class SuiteOptions:
    """The choices of `spackle bench --suite`."""

    only: Sequence[str] = ()  # sections; none: all of them
    runs: int = 5
    device: str = "auto"  # of everything but the renderer's section; auto: the processor
    sharp: BaseSettings | None = None  # None: its section is not asked for
    base_runs: int | None = None  # of SHARP; None: 1
    residual: Path | None = None  # weights; None: the seeds alone
    side: int = SIDE  # pixels along the synthetic scenes; a smaller one makes all small, for trying it out

    def check(self) -> None:
        """InputError for an option that cannot be used."""
        for name in self.only:
            check_name("--only", name, tuple(TITLES))
        check_runs(self.runs, self.base_runs)
        if not (SIDES[0] <= self.side <= SIDES[1] and self.side % 2 == 0):
            raise InputError(f"--side must be an even number between {SIDES[0]} and {SIDES[1]}, got {self.side}")
        get_renderer("cpu" if self.device == "auto" else self.device)
        if self.sharp is not None and self.sharp.named != "sharp":
            raise InputError(
                f"--base {self.sharp.name}: the suite times no other base than sharp: leave the option out"
            )
        checkpoint = None if self.sharp is None else self.sharp.checkpoint
        for option, file in (("--residual", self.residual), ("-c", checkpoint)):
            if file is not None and not file.is_file():
                raise InputError(f"{option} {file}: no such file: check the name")
        if self.sharp is not None:
            self.sharp.check()


def run_suite(options: SuiteOptions, output: Path, reporter: Reporter) -> str:
    """Time everything that can be timed here, or go on with that; "complete", or "stopped" where Ctrl-C came.

    Writes suite.json, suite.md and sections/ into `output`. The folder belongs to one machine, one commit and one set
    of options but for `only` and SHARP's: times of two do not go together.

    Raises:
        InputError: options or a folder that cannot be used; another suite in `output`.
    """
    options.check()
    device = torch.device("cuda" if options.device == "cuda" else "cpu")
    weights = options.residual and weights_digest(options.residual)
    config: Record = {"kind": "suite", "commit": commit(), "hardware": hardware(device), "versions": versions()}
    config |= {"runs": options.runs, "side": options.side, "residual": weights}
    found: dict[str, Record] = {}
    not_run: dict[str, str] = {}
    with results_folder(output, (RESULTS, MARKDOWN), alone=True):
        begin(output, config, PARTS)
        with asked_to_stop(alone=True) as stop:
            for name in TITLES:
                path, inputs = output / PARTS / f"{name}.json", _inputs(name, options)
                there = load_part(path, inputs)
                if there is not None:
                    found[name] = there
                elif options.only and name not in (*options.only, LIMITS):
                    not_run[name] = "not asked for (--only)"
                elif stop():
                    reporter.log("stopped; the same command goes on from here")
                    return "stopped"
                else:
                    load, start = load_average(), time.perf_counter()
                    try:
                        with reporter.stage(name):
                            rows, facts = _section(name, options, device, found)
                    except InputError as error:
                        not_run[name] = str(error)
                        reporter.log(f"{name}: not run: {error}")
                        continue
                    seconds = time.perf_counter() - start
                    reporter.log(f"{name}: {len(rows)} figures in {seconds:,.0f} s")
                    facts |= {"load_before": load, "seconds": round(seconds, 1)}
                    found[name] = without_nan({"rows": [plain_row(row) for row in rows], "facts": facts})
                    save_part(path, inputs, found[name])
        about = ", ".join(f"{key} {value}" for key, value in {**config["hardware"], **config["versions"]}.items())
        head = f"# Speed\n\n{about}; commit {config['commit']}; {config['runs']} runs.\n\n"
        write_text(head + to_markdown(suite_tables(found, not_run)), output / MARKDOWN)
        write_json(without_nan({"config": config, "not_run": not_run, "sections": found}), output / RESULTS)
    reporter.log(f"{len(found)} of {len(TITLES)} sections -> {output / MARKDOWN}")
    return "complete"


def _inputs(name: str, options: SuiteOptions) -> Record | None:
    """Everything that decides a section's figures besides the suite's configuration; None: the section is not asked."""
    base = options.sharp
    if name != "sharp":
        return {}
    if base is None or (options.only and name not in options.only):
        return None
    settings = {"precision": base.precision, "windows": base.windows}
    weights = weights_digest(base.files["checkpoint"])
    return {"weights": weights, **settings, "compiled": base.compiled, "runs": options.base_runs or 1}


def _section(name: str, options: SuiteOptions, device: torch.device, found: Mapping[str, Record]) -> Section:
    """Measure a section; InputError where it cannot be run here, and why."""
    runs, side = options.runs, options.side
    if name == LIMITS:
        return sections.limits_section(runs, device, min(1.0, side / SIDE))
    peaks = {row["name"]: 1e6 * max(row["values"]) for row in found[LIMITS]["rows"]}
    if name == "renderer":
        return sections.renderer_section(runs, side, peaks)
    if name == "sharp":
        if options.sharp is None:
            raise InputError("no weights: -c FILE names some, --base sharp takes those that are installed")
        photo = Photo(torch.rand(SIDE, SIDE, 3), 1.2 * SIDE, "", Path("photo.png"))
        base = open_base(dataclasses.replace(options.sharp, device=device.type)).load(photo).load()
        assert isinstance(base, SharpBase)
        return sections.sharp_section(options.base_runs or 1, base, photo, peaks, device)
    renderer = get_renderer(device.type)
    network = None if options.residual is None else load_residual(options.residual)
    if name == "completion":
        return sections.completion_section(runs, *holed_scene(side), renderer, network, device)
    pair = load_motorcycle()
    lifting = functools.partial(lift, pair.left, pair.depth, pair.left_camera)
    if name == "video":
        return sections.video_section(runs, lifting, renderer, network, sections.FRAMES if side >= SIDE else 4, device)
    base_scene = lifting()
    return sections.completion_section(runs, base_scene.gaussians, base_scene.camera, renderer, network, device)


def plain_row(row: sections.SuiteRow) -> Record:
    """A row ready for JSON, with median and quartiles beside the values."""
    low, median, high = np.quantile(row.values, [0.25, 0.5, 0.75]).tolist()
    return {**row._asdict(), "values": row.values.tolist(), "median": median, "quartiles": [low, high]}


def suite_tables(found: Mapping[str, Record], not_run: Mapping[str, str]) -> list[Table]:
    """A table for each section that was run, and a line for each that was not, with the reason."""
    tables = []
    for name, section in found.items():
        items = {
            k: f"{v:.4g}" if isinstance(v, float) else str(v) for k, v in section["facts"].items() if v is not None
        }
        facts = ", ".join(f"{key} {text}" for key, text in items.items())
        lines = tuple(Line(_cells(**row)) for row in section["rows"])
        tables.append(Table(name, f"{TITLES[name]}. {facts}.", COLUMNS, (("", len(COLUMNS)),), lines))
    if not_run:
        lines = tuple(Line((name, TITLES[name], f"not run: {why}")) for name, why in not_run.items())
        tables.append(Table("not run", "Sections without figures.", ("section", "what", "why"), (("", 3),), lines))
    return tables


def _cells(
    name: str, values: Sequence[float], unit: str, limit_ms: float | None, median: float, quartiles: Sequence[float]
) -> tuple[str, ...]:
    over = (EMPTY, EMPTY) if limit_ms is None else (f"{_number(limit_ms)} ms", f"{median / limit_ms:.1f}×")
    low, high = map(_number, quartiles)
    return name, f"{_number(median)} {unit}", f"{low} – {high}", str(len(values)), *over


def _number(value: float) -> str:
    """Three digits at least, without a power of ten where one can do without."""
    size = abs(value)
    if size >= 100 or value == 0:
        return f"{value:,.0f}"
    return f"{value:.1f}" if size >= 10 else f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"
