"""`spackle bench`: what Spackle costs in Gaussians and in time on a dataset, in the paper's tables of efficiency."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spackle.bases.open import BaseError
from spackle.bases.protocol import BasePrediction
from spackle.bases.sharp.checkpoint import unused_shapes
from spackle.bases.sharp.layers import FULL
from spackle.bases.sharp.network import SharpNetwork
from spackle.camera import Camera
from spackle.errors import InputError
from spackle.evaluation.case import Case, load_case
from spackle.evaluation.efficiency import SIDE, STAGES, Efficiency, Record, efficiency_tables, view_cost
from spackle.evaluation.protocols import large_views
from spackle.evaluation.results import begin, image_file, load_part, save_part, write_json, write_text
from spackle.evaluation.run import inputs_digest, problem_of
from spackle.evaluation.setup import EvaluateOptions, Evaluation, open_evaluation
from spackle.evaluation.table import to_latex, to_markdown
from spackle.evaluation.timing import MS, TOTAL, Lap, Task, complete_in_laps, measure
from spackle.files import results_folder
from spackle.machine import hardware, load_average, versions
from spackle.progress import Reporter
from spackle.residual import ResidualNet
from spackle.scene_fill import FillContext
from spackle.signals import asked_to_stop

RESULTS, MARKDOWN, LATEX = "bench.json", "bench.md", "bench.tex"
SHARED = ("dataset", "title", "terms", "images", "disparities", "base", "residual")  # of an evaluation's configuration
TIMES = "{base_ms:,.0f} ms, with Spackle {spackle_ms:,.0f}, {added:,} Gaussians added"  # of a view
MAX_RUNS = 1000


def bench(options: EvaluateOptions, runs: int, base_runs: int | None, output: Path, reporter: Reporter) -> str:
    """Time a dataset, or go on with that; "complete", or "stopped" where Ctrl-C came.

    Writes bench.json, bench.md, bench.tex and images/ into `output`. The folder belongs to one machine: times of two do
    not go together. Everything behind the base is timed `runs` times, the base `base_runs` times (None: once for SHARP,
    which takes long, else `runs` times).

    Raises:
        InputError: options, a dataset or a folder that cannot be used; another benchmark in `output`; too little
            memory for the base.
    """
    check_runs(runs, base_runs)
    tools, kind = open_evaluation(options), options.base.kind
    device = options.device if kind.network else torch.device("cpu")
    config = {"kind": "bench", **{name: tools.config[name] for name in SHARED}}
    config |= {"view": SIDE, "runs": runs, "base_runs": base_runs or (1 if kind.slow else runs)}
    config["base"] |= {"device": device.type}
    config |= {"hardware": hardware(device), "versions": versions()}
    images: list[Record] = []
    warm = False  # whether this process has predicted something
    with results_folder(output, (RESULTS, MARKDOWN, LATEX), alone=True):
        begin(output, config)
        with reporter.stage("images") as step, asked_to_stop(alone=True) as stop:
            for index, case in enumerate(tools.cases):
                if stop():
                    reporter.log("stopped; the same command goes on from here")
                    return "stopped"
                path, inputs = image_file(output, index, case.name, ".json"), inputs_digest(case)
                image = load_part(path, inputs)
                if image is None:
                    try:
                        image = time_image(case, tools, config, warm)
                    except BaseError:  # no other image would fare better; too little memory is one, too
                        raise
                    except InputError as error:  # the next run tries it again
                        problem = problem_of(case, error, options.root)
                        reporter.log(f"passed over: {problem}")
                        image = {"name": case.name, "facts": {}, "problem": problem, "views": []}
                    else:
                        warm = True
                        save_part(path, inputs, image)
                        for view in image["views"]:
                            reporter.detail(f"  {case.name}, {view['setting']}: {TIMES.format(**view['figures'])}")
                images.append(image)
                step(index + 1, len(tools.cases))
        _finish(Efficiency(config, images), options, output, reporter)
    return "complete"


def time_image(case: Case, tools: Evaluation, config: Mapping[str, Any], warm: bool) -> Record:
    """All settings of an image, see `Efficiency`; `warm`: something was predicted before in this process.

    Raises:
        InputError: a file that cannot be used, depth that the case lacks, or Gaussians that are not finite.
        BaseError: no image can be worked on.
    """
    load, device = load_average(), torch.device(config["base"]["device"])
    loaded = load_case(dataclasses.replace(case, seconds=()))
    opened = tools.open(loaded).load(loaded.full)  # a network is loaded before the clock starts
    latest: dict[str, BasePrediction] = {}
    # Compiling kernels is a small part of SHARP's first prediction on a processor, which takes a minute.
    counts = warm or (tools.options.base.kind.slow and device.type == "cpu")
    predict: dict[str, Task] = {"": lambda _: latest.update(base=opened.predict()[0])}
    seconds = (measure(config["base_runs"], predict, device, warm=counts)["", TOTAL] / MS).tolist()
    found = latest["base"]
    views = large_views(found, tools.options.disparities)
    precision = tools.options.base.precision
    context = FillContext(found.gaussians, found.camera, tools.renderer, tools.network, precision=precision)
    wanted = [view for view in views if view.name == SIDE]
    costs = [time_view(seconds, context, view.setting, view.camera, config["runs"], device) for view in wanted]
    facts = {"width": loaded.photo.width, "height": loaded.photo.height, "load": load, "warm": warm or not counts}
    return {"name": case.name, "facts": {**facts, "notes": found.notes}, "problem": None, "views": costs}


def time_view(
    base_s: Sequence[float], context: FillContext, setting: str, camera: Camera, runs: int, device: torch.device
) -> Record:
    """The cost of one view, which the tables call by `setting`; the base, on `device`, took `base_s` seconds."""
    added = 0

    def view(lap: Lap) -> None:
        nonlocal added
        added = len(complete_in_laps(context, camera, lap))

    times = measure(runs, {"": view}, device)
    none = np.zeros(runs)  # of a view without holes, which is not rendered again
    stages = {name: (times.get(("", name), none) / MS).tolist() for name in STAGES if name != "base"}
    return view_cost(setting, len(context.base), added, {"base": base_s, **stages})


def _finish(found: Efficiency, options: EvaluateOptions, output: Path, reporter: Reporter) -> None:
    """Write everything that is made of all images; bench.json comes last and vouches for the rest."""
    total, measured, parameters = len(found.images), len(found.measured), count_parameters()
    if not measured:
        raise InputError(f"{options.root}: none of {total} images gave figures (the lines above say why)")
    tables = efficiency_tables(found, parameters)
    write_text(to_markdown(tables), output / MARKDOWN)
    write_text(to_latex(tables), output / LATEX)
    write_json({"parameters": parameters, **found.plain()}, output / RESULTS)
    overheads = ", ".join(f"{s}: {100 * found.spread(s, 'overhead').median:.2f} %" for s in found.settings)
    reporter.log(f"{found.config['title']}: {measured} of {total} images, overhead {overheads} -> {output}")
    reporter.result({"folder": output, "images": total, "measured": measured})


def count_parameters() -> dict[str, float]:
    """Of SHARP as its checkpoint has it, 702.31 M; of that used by inference; of the residual, 8.02 M; and its share.

    They are counted in the networks, without weights. Inference needs neither SHARP's classifiers nor the part that
    aligns depths.
    """
    with torch.device("meta"):
        used, residual = (sum(p.numel() for p in n.parameters()) for n in (SharpNetwork(FULL), ResidualNet()))
    base = used + sum(map(math.prod, unused_shapes(FULL).values()))
    return {"base": base, "base_used": used, "residual": residual, "share": residual / base}


def check_runs(runs: int, base_runs: int | None) -> None:
    """InputError for counts that cannot be."""
    for name, value in (("--runs", runs), ("--base-runs", base_runs)):
        if value is not None and not 1 <= value <= MAX_RUNS:
            raise InputError(f"{name} must be between 1 and {MAX_RUNS}, got {value}")
