"""`spackle bench`: count the added Gaussians and time the stages on a dataset, for the paper's efficiency tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from spackle.bases import BasePrediction
from spackle.bases.sharp.base import PARAMETER_COUNT
from spackle.bases.sharp.encoder import FULL_SIZE
from spackle.bases.sharp.network import SharpNetwork
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.paper.evaluation.case import Case, load_case
from spackle.paper.evaluation.evaluate import EvaluateOptions, Evaluation, open_evaluation
from spackle.paper.evaluation.folder import ROWS, measure_images, write_rows
from spackle.paper.evaluation.measurements import BASE_STAGES, COMPLETION_STAGES, NOTE, Measurement
from spackle.paper.evaluation.methods import make_method
from spackle.paper.evaluation.protocols import large_views
from spackle.paper.evaluation.tables import make_tables, write_tables
from spackle.residual import ResidualNet
from spackle.runtime.device import hardware_facts, package_versions
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.scene_fill import FillContext

FILES = ("bench.md", "bench.tex")
# Keys of an evaluation's configuration that a benchmark's configuration has, too.
SHARED = (
    "dataset",
    "title",
    "terms",
    "images",
    "side",
    "disparities",
    "base",
    "residual",
    "device",
)
TOTAL_STAGE = "total"
MS_PER_S = 1000.0
CPU = torch.device("cpu")
TIMED = ("paper", "spackle")  # the methods that are timed

EndStage = Callable[[str], None]
TimedTask = Callable[[EndStage], Any]
RunValues = npt.NDArray[np.float64]  # one value per run
Times = dict[tuple[str, str], RunValues]  # (task, stage) → milliseconds


def bench(
    options: EvaluateOptions, runs: int, base_runs: int | None, output: Path, reporter: Reporter
) -> str:
    """Time a dataset, or resume an earlier run; returns "complete", or "stopped" after Ctrl-C.

    Writes rows.jsonl, bench.md, bench.tex and images/ into `output`. A folder holds the times of one machine only.
    Later stages are timed `runs` times, the base `base_runs` times. If `base_runs` is None, SHARP is timed
    once, because it is slow, and other bases `runs` times.

    Raises:
        InputError: options, dataset or folder cannot be used, `output` holds another benchmark, or memory is too small
            for the base.
    """
    evaluation, slow = open_evaluation(options), options.base.resolved_name == "sharp"
    config: dict[str, Any] = {"kind": "bench", "protocol": "bench", "methods": list(TIMED)}
    config |= {name: evaluation.config[name] for name in SHARED}
    config |= {"runs": runs, "base_runs": base_runs or (1 if slow else runs)}
    config["base"] |= {"device": options.device.type if options.base.uses_network else "cpu"}
    config |= {"hardware": hardware_facts(options.device), "versions": package_versions()}
    about = {"parameters": count_parameters(evaluation.network)}
    with results_folder(output, (ROWS, *FILES), locked=True):

        def measure_one(index: int, case: Case) -> tuple[list[Measurement], list[Path]]:
            return time_case(case, evaluation, config), []

        run = measure_images(
            evaluation.cases, measure_one, output, config, about, options.root, reporter
        )
        if run is None:
            return "stopped"
        write_tables(make_tables([run]), output, FILES, f":{run.title}-bench".lower())
        write_rows(run.rows, output / ROWS)
    count, total = len(run.measured), len(run.images)
    reporter.log(f"{run.title}: {count} of {total} images -> {output}")
    reporter.result({"folder": output, "images": total, "measured": count})
    return "complete"


def time_case(case: Case, evaluation: Evaluation, config: Mapping[str, Any]) -> list[Measurement]:
    """Time all settings of an image.

    Raises:
        InputError: a file cannot be used, the case lacks depth, or Gaussians are not finite.
        BaseError: the base would fail for every image.
    """
    options, device = evaluation.options, evaluation.renderer.device
    loaded = load_case(case, options.max_side)
    opened = evaluation.open(loaded)
    opened.load(loaded.full)  # not timed
    # SHARP on a CPU takes a minute, of which compiling kernels is a small part: the first prediction is timed.
    warm = options.base.resolved_name == "sharp" and config["base"]["device"] == "cpu"
    latest: dict[str, BasePrediction] = {}
    predict = {"": lambda _: latest.update(base=opened.predict(loaded.full)[0])}
    seconds = (
        time_tasks(config["base_runs"], predict, device, warm=warm)["", TOTAL_STAGE] / MS_PER_S
    )
    prediction = latest["base"]
    context = evaluation.context(prediction)
    facts: dict[str, Any] = {"width": loaded.photo.width, "height": loaded.photo.height}
    facts |= {"base_gaussians": len(prediction.gaussians)}
    facts |= {f"{NOTE}{name}": value for name, value in prediction.notes.items()}
    image = Measurement(config["title"], case.name, "", "", "", "", None)
    rows = [image._replace(metric=metric, value=value) for metric, value in facts.items()]
    added: dict[str, int] = {}

    def complete(camera: Camera, method: str, lap: EndStage) -> None:
        added[method] = len(complete_view_in_stages(context, camera, lap, method))

    for view in large_views(prediction, options.disparities, options.max_side):
        tasks = {method: partial(complete, view.camera, method) for method in TIMED}
        times = time_tasks(config["runs"], tasks, device)
        for method, count in added.items():
            stages = {
                stage: values / MS_PER_S
                for (name, stage), values in times.items()
                if name == method
            }
            row = image._replace(setting=view.setting, view=view.name, method=method)
            numbers = view_numbers(len(context.base), count, stages | {"base": seconds})
            rows += [row._replace(metric=metric, value=value) for metric, value in numbers.items()]
    return rows


def view_numbers(base: int, added: int, seconds: Mapping[str, RunValues]) -> dict[str, float]:
    """A view's numbers for tables, from counts of Gaussians and the seconds of each stage in each run.

    Returns counts, milliseconds (medians over runs), shares (not percent) and views per second.
    """
    before, extra = (
        sum(MS_PER_S * float(np.median(seconds[stage])) for stage in stages)
        for stages in (BASE_STAGES, COMPLETION_STAGES)
    )
    return {
        "aux": added,
        "aux_share": added / base,
        "merged": base + added,
        "base_ms": before,
        "spackle_ms": before + extra,
        "overhead": extra / before,
        "base_fps": MS_PER_S / before,
        "spackle_fps": MS_PER_S / (before + extra),
    }


def count_parameters(residual: ResidualNet | None) -> dict[str, float]:
    """Parameters of SHARP's checkpoint (702.31 M), of its part for inference and of the residual; the residual's share.

    Inference uses neither SHARP's classifiers nor the part that aligns depths.
    """
    with torch.device("meta"):
        used = sum(p.numel() for p in SharpNetwork(FULL_SIZE).parameters())
    extra = 0 if residual is None else sum(p.numel() for p in residual.parameters())
    return {
        "base": PARAMETER_COUNT,
        "base_used": used,
        "residual": extra,
        "share": extra / PARAMETER_COUNT,
    }


# --- the clock


def time_tasks(
    runs: int, tasks: Mapping[str, TimedTask], device: torch.device = CPU, *, warm: bool = False
) -> Times:
    """Time each task (stage "total") and each stage of a task in milliseconds, in each run.

    A task gets a function and calls it with a stage's name when the stage ends; stages of the same name within a run
    add up. A stage ends when the device has done its work. The tasks take turns, so that a busy machine slows all
    tasks alike. Unless the tasks are `warm`, an untimed run comes first, for compilation and warm-up.
    """

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return MS_PER_S * time.perf_counter()

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
            laps[TOTAL_STAGE] = now() - start
            for stage, milliseconds in laps.items() if run else ():
                times.setdefault((name, stage), []).append(milliseconds)
    return {key: np.array(values) for key, values in times.items()}


@torch.no_grad()
def complete_view_in_stages(
    context: FillContext, camera: Camera, lap: EndStage, method: str = "spackle"
) -> Gaussians:
    """A view's aux Gaussians; calls `lap` after the stages "view", "photo" and "completion"."""
    context = context.placed
    before = context.renderer.render(context.base, camera)
    lap("view")
    fill = make_method(method, [camera], context)
    lap("photo")
    aux = fill(camera, before).aux
    lap("completion")
    assert aux is not None
    return aux
