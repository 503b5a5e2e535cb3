"""`spackle bench`: what Spackle costs in Gaussians and in time on a dataset, in the paper's tables of efficiency."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from spackle.bases import BasePrediction
from spackle.bases.sharp.base import unused_shapes
from spackle.bases.sharp.encoder import FULL
from spackle.bases.sharp.network import SharpNetwork
from spackle.camera import Camera
from spackle.evaluation.case import Case, Viewpoint, load_case
from spackle.evaluation.folder import ROWS, measure_images, write_rows
from spackle.evaluation.protocols import large_views
from spackle.evaluation.rows import BASE_PATH, EXTRA, NOTE, STAGES, Row
from spackle.evaluation.setup import EvaluateOptions, Evaluation, open_evaluation
from spackle.evaluation.tables import make_tables, write_tables
from spackle.folders import results_folder
from spackle.gaussians import Gaussians
from spackle.machine import hardware, load_average, versions
from spackle.progress import Reporter
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet
from spackle.scene_fill import FillContext, fill_view

FILES = ("bench.md", "bench.tex")
SHARED = (
    "dataset",
    "title",
    "terms",
    "images",
    "side",
    "disparities",
    "base",
    "residual",
)  # of an evaluation's configuration
TOTAL = "total"
MS = 1000.0
CPU = torch.device("cpu")
SIDE = "right"  # the end of the swipe where the second camera of Middlebury's and Booster's pairs stands

Lap = Callable[[str], None]
Task = Callable[[Lap], Any]
Values = npt.NDArray[np.float64]  # one a run
Times = dict[tuple[str, str], Values]  # (task, stage) → milliseconds


def bench(options: EvaluateOptions, runs: int, base_runs: int | None, output: Path, reporter: Reporter) -> str:
    """Time a dataset, or go on with that; "complete", or "stopped" where Ctrl-C came.

    Writes rows.jsonl, bench.md, bench.tex and images/ into `output`. The folder belongs to one machine: times of two do
    not go together. Everything behind the base is timed `runs` times, the base `base_runs` times (None: once for SHARP,
    which takes long, else `runs` times).

    Raises:
        InputError: options, a dataset or a folder that cannot be used; another benchmark in `output`; too little
            memory for the base.
    """
    evaluation, slow = open_evaluation(options), options.base.named == "sharp"
    device = options.device if options.base.network else torch.device("cpu")
    config: dict[str, Any] = {"kind": "bench", "protocol": "bench", "methods": ["spackle"]}
    config |= {name: evaluation.config[name] for name in SHARED}
    config |= {"view": SIDE, "runs": runs, "base_runs": base_runs or (1 if slow else runs)}
    config["base"] |= {"device": device.type}
    config |= {"hardware": hardware(device), "versions": versions()}
    about = {"parameters": count_parameters(evaluation.network)}
    timed: list[str] = []  # an image of this process, after which it is warm

    def time_next(index: int, case: Case) -> tuple[list[Row], list[Path]]:
        rows = time_case(case, evaluation, config, bool(timed))
        timed.append(case.name)
        return rows, []

    with results_folder(output, (ROWS, *FILES), alone=True):
        run = measure_images(evaluation.cases, time_next, output, config, about, options.root, reporter)
        if run is None:
            return "stopped"
        write_tables(make_tables([run]), output, FILES)
        write_rows(run.rows, output / ROWS)
    overheads = {s: statistics.median(run.numbers("overhead", s)) for s in run.settings}
    listed = ", ".join(f"{setting}: {100 * overhead:.2f} %" for setting, overhead in overheads.items())
    count, total = len(run.measured), len(run.images)
    reporter.log(f"{run.title}: {count} of {total} images, overhead {listed} -> {output}")
    reporter.result({"folder": output, "images": total, "measured": count})
    return "complete"


def time_case(case: Case, evaluation: Evaluation, config: Mapping[str, Any], warm: bool) -> list[Row]:
    """All settings of an image; `warm`: something was predicted before in this process.

    Raises:
        InputError: a file that cannot be used, depth that the case lacks, or Gaussians that are not finite.
        BaseError: no image can be worked on.
    """
    load, device, options = load_average(), torch.device(config["base"]["device"]), evaluation.options
    loaded = load_case(dataclasses.replace(case, seconds=()), options.max_side)
    opened = evaluation.open(loaded)
    opened.load(loaded.full)  # before the clock starts
    latest: dict[str, BasePrediction] = {}
    # Compiling kernels is a small part of SHARP's first prediction on a processor, which takes a minute.
    counts = warm or (options.base.named == "sharp" and device.type == "cpu")
    times = measure(
        config["base_runs"], {"": lambda _: latest.update(base=opened.predict(loaded.full)[0])}, device, warm=counts
    )
    seconds, prediction = (times["", TOTAL] / MS).tolist(), latest["base"]
    context = evaluation.context(prediction)
    facts: dict[str, Any] = {"width": loaded.photo.width, "height": loaded.photo.height, "load": load}
    facts |= {"warm": int(warm or not counts), "base_gaussians": len(prediction.gaussians)}
    facts |= {f"{NOTE}{name}": value for name, value in prediction.notes.items()}
    rows = [Row(config["title"], case.name, "", "", "", metric, value) for metric, value in facts.items()]
    for view in large_views(prediction, options.disparities, options.max_side):
        if view.name == SIDE:
            figures = time_view(seconds, context, view, config["runs"], device)
            row = Row(config["title"], case.name, view.setting, SIDE, "spackle", "", None)
            rows += [row._replace(metric=metric, value=value) for metric, value in figures]
    return rows


def time_view(
    base_s: Sequence[float], context: FillContext, view: Viewpoint, runs: int, device: torch.device
) -> list[tuple[str, float]]:
    """A view's figures; the base, on `device`, took `base_s` seconds."""
    added = 0

    def complete(lap: Lap) -> None:
        nonlocal added
        added = len(complete_in_laps(context, view.camera, lap))

    times = measure(runs, {"": complete}, device)
    none = np.zeros(runs)  # of a view without holes, which is not rendered again
    stages = {name: (times.get(("", name), none) / MS).tolist() for name in STAGES if name != "base"}
    return view_figures(len(context.base), added, {"base": base_s, **stages})


def view_figures(base: int, added: int, seconds: Mapping[str, Sequence[float]]) -> list[tuple[str, float]]:
    """Every figure of the tables that comes of a view's Gaussians and of the seconds of each run of `STAGES`.

    Counts, milliseconds (medians of runs), shares (not percent), views a second; and each run's milliseconds.
    """
    stages = {name: MS * statistics.median(seconds[name]) for name in STAGES}
    before, extra = (sum(stages[name] for name in names) for names in (BASE_PATH, EXTRA))
    figures = {
        "aux": added,
        "aux_share": added / base,
        "merged": base + added,
        "base_ms": before,
        "spackle_ms": before + extra,
        "extra_ms": extra,
        "overhead": extra / before,
        "overhead_of_view": extra / stages["view"],
        "base_fps": MS / before,
        "spackle_fps": MS / (before + extra),
        **{f"{name}_stage_ms": ms for name, ms in stages.items()},
    }
    each = [(f"{name}_run_ms", MS * value) for name, values in seconds.items() for value in values]
    return [*figures.items(), *each]


def count_parameters(residual: ResidualNet | None) -> dict[str, float]:
    """Of SHARP as its checkpoint has it, 702.31 M; of that used by inference; of the residual; and its share.

    SHARP's are counted in the network, without weights. Inference needs neither SHARP's classifiers nor the part that
    aligns depths.
    """
    with torch.device("meta"):
        used = sum(p.numel() for p in SharpNetwork(FULL).parameters())
    extra = 0 if residual is None else sum(p.numel() for p in residual.parameters())
    base = used + sum(map(math.prod, unused_shapes(FULL).values()))
    return {"base": base, "base_used": used, "residual": extra, "share": extra / base}


# --- the clock


def measure(runs: int, tasks: Mapping[str, Task], device: torch.device = CPU, *, warm: bool = False) -> Times:
    """Milliseconds of each task (its stage "total") and of its stages, each of which it ends by calling its argument.

    The tasks take turns, so a busy machine slows all of them alike. Laps of one name within a run add up. A stage ends
    when the device has done its work. One run more, which compiles and warms up, comes first, unless they are `warm`.
    """

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return MS * time.perf_counter()

    times: dict[tuple[str, str], list[float]] = {}
    for run in range(1 if warm else 0, runs + 1):
        for name, task in tasks.items():
            laps: dict[str, float] = {}
            start = last = now()

            def lap(stage: str, laps: dict[str, float] = laps) -> None:
                nonlocal last
                end = now()
                laps[stage] = laps.get(stage, 0.0) + end - last
                last = end

            task(lap)
            laps[TOTAL] = now() - start
            for stage, milliseconds in laps.items() if run else ():
                times.setdefault((name, stage), []).append(milliseconds)
    return {key: np.array(values) for key, values in times.items()}


@dataclasses.dataclass(frozen=True)
class _LappedRenderer:
    """A `Renderer` whose renders are laps, told apart from the completion around them."""

    renderer: Renderer
    lap: Lap

    def __getattr__(self, name: str) -> Any:
        return getattr(self.renderer, name)

    def render(self, gaussians: Gaussians | Sequence[Gaussians], camera: Camera, **options: Any) -> Rendering:
        self.lap("completion")
        drawn = self.renderer.render(gaussians, camera, **options)
        self.lap("rerender")
        return drawn


@torch.no_grad()
def complete_in_laps(context: FillContext, camera: Camera, lap: Lap) -> Gaussians:
    """A view's aux Gaussians; laps "view", "photo", "completion" and, where there are holes, "rerender"."""
    context = context.placed
    before = context.renderer.render(context.base, camera)
    lap("view")
    guard = context.photo_guard()
    lap("photo")
    inside = dataclasses.replace(context, renderer=_LappedRenderer(context.renderer, lap))
    aux = fill_view(inside, camera, [guard], before).aux
    lap("completion")
    return aux
