"""`spackle bench`: count added Gaussians and time the stages, for the paper's tables of costs.

`bench` runs a whole benchmark, `time_case` times one photo, `time_tasks` is the clock.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from spackle.bases import Base, BasePrediction
from spackle.bases.open import OpenedBase
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo
from spackle.paper.evaluation.case import Case, Viewpoint, load_case
from spackle.paper.evaluation.evaluation import Evaluation, open_evaluation
from spackle.paper.evaluation.folder import (
    MEASUREMENTS_FILE,
    ImageResults,
    ImageWorker,
    RunPlan,
    measure_images,
    write_measurements,
)
from spackle.paper.evaluation.measurements import (
    BASE_PARAMETERS,
    NOTE_PREFIX,
    RESIDUAL_PARAMETERS,
    Measurement,
    Run,
    Value,
    image_measurement,
)
from spackle.paper.evaluation.methods import make_method
from spackle.paper.evaluation.options import TIMED_METHODS, BenchOptions, EvaluateOptions
from spackle.paper.evaluation.protocols import large_views
from spackle.paper.evaluation.tables import make_tables, write_tables
from spackle.residual import ResidualNet
from spackle.runtime.device import hardware_facts, package_versions
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.runtime.worker_options import this_process
from spackle.scene_fill import FillContext
from spackle.scene_fill.context import PhotoRendering

MARKDOWN_FILE = "bench.md"
LATEX_FILE = "bench.tex"

# What a benchmark's configuration has in common with that of an evaluation with the same options.
CONFIG_KEYS_OF_EVALUATION = (
    "dataset",
    "title",
    "terms",
    "about_scenes",  # only of scenes that somebody made in a dataset's layout
    "images",
    "side",
    "disparities",
    "base",
    "residual",
    "code",  # only if code of other packages is used
    "device",
)

# The stages of a view without Spackle: from the photo to the base's Gaussians on the renderer's
# device; and the rendering of the view, which Spackle needs as well, to find the holes in it.
BASE_STAGES = ("base", "view")
# The stages that Spackle adds: what a method needs of the photo's own view; and all from the mask
# to the completed view, with its rendering.
COMPLETION_STAGES = ("photo", "completion")
TOTAL_STAGE = "total"  # all stages of a task

MS_PER_S = 1000.0
CPU = torch.device("cpu")

EndStage = Callable[[str], None]  # is called with the name of a stage when the stage ends
TimedTask = Callable[[EndStage], Any]
RunValues = npt.NDArray[np.float64]  # one value for each timed run
Times = dict[tuple[str, str], RunValues]  # from (task, stage) to milliseconds


def bench(options: BenchOptions, output: Path, reporter: Reporter) -> Run | None:
    """Time a dataset, or resume an earlier run.

    Writes rows.jsonl (all numbers), bench.md, bench.tex and images/ into `output`. A folder holds
    the times of one machine only.

    Args:
        options: what to time, and how often.
        output: the folder for the results.
        reporter: gets progress.

    Returns:
        The results; None after Ctrl-C.

    Raises:
        InputError: options, dataset or folder cannot be used, `output` holds another benchmark, or
            memory is too small for the base.
    """
    # The networks are opened as for an evaluation, so that both measure the same.
    evaluation = open_evaluation(options.as_evaluation)
    config = _configuration(options, evaluation)
    plan = RunPlan(
        cases=evaluation.cases,
        root=options.root,
        output=output,
        config=config,
        about={},  # the configuration has machine and versions
    )

    def measure(index: int, case: Case, reporter: Reporter) -> ImageResults:
        """The times of one image; a benchmark has no pictures, and no remarks to report."""
        measurements = time_case(
            case, evaluation, runs=options.runs, base_runs=options.timed_runs_of_base
        )
        return ImageResults(measurements, files=[])

    files = (MEASUREMENTS_FILE, MARKDOWN_FILE, LATEX_FILE)
    with results_folder(output, files, locked=True):
        # By this process alone: others beside it would make everything slower.
        worker = ImageWorker(plan, measure, reporter.verbose)
        run = measure_images(plan, lambda: worker, reporter, this_process())
        if run is None:
            return None
        write_tables(
            make_tables([run]),
            output,
            markdown_file=MARKDOWN_FILE,
            latex_file=LATEX_FILE,
            label_suffix=f":{run.title}-bench".lower(),
        )
        # Last, because this file says that the results are complete.
        write_measurements(run.measurements, output / MEASUREMENTS_FILE)

    measured_count = len(run.measured_images)
    image_count = len(run.images)
    reporter.log(f"{run.title}: {measured_count} of {image_count} images -> {output}")
    reporter.result({"folder": output, "images": image_count, "measured": measured_count})
    return run


def _configuration(options: BenchOptions, evaluation: Evaluation) -> dict[str, Any]:
    """Everything that determines the times, ready for JSON: also machine and versions.

    A later run in the same folder must have the same configuration; tables show it.
    """
    # A base without a network lifts a depth map, which needs no GPU.
    device = evaluation.options.device
    base_device = device.type if options.base.uses_network else "cpu"

    config: dict[str, Any] = {"kind": "bench", "protocol": "bench", "methods": list(TIMED_METHODS)}
    config |= {
        name: evaluation.config[name]
        for name in CONFIG_KEYS_OF_EVALUATION
        if name in evaluation.config
    }
    config |= {
        "base": evaluation.config["base"] | {"device": base_device},
        "runs": options.runs,
        "base_runs": options.timed_runs_of_base,
        "hardware": hardware_facts(device),
        "versions": package_versions(),
    }
    return config


def time_case(
    case: Case, evaluation: Evaluation, *, runs: int, base_runs: int
) -> list[Measurement]:
    """Time the base on a photo, and the completion of the photo's views, at all settings.

    Args:
        case: the photo.
        evaluation: networks and options; its settings are sizes of the camera move.
        runs: how often each stage after the base is timed.
        base_runs: how often the base, which makes the photo's Gaussians, is timed.

    Returns:
        Counts of Gaussians, and times; those of views for each method of `TIMED_METHODS`.

    Raises:
        InputError: a file cannot be used, the case lacks depth, or Gaussians are not finite.
        BaseError: every image would fail, for instance because memory is too small.
    """
    options = evaluation.options
    loaded = load_case(case, options.max_side)
    base = evaluation.base_of_case(loaded)
    loaded_base = base.load(loaded.full_photo)  # loading the network is not timed

    timed_base = _time_base(base, loaded.full_photo, evaluation, base_runs)
    prediction = timed_base.prediction
    context = evaluation.fill_context(prediction)
    title = str(evaluation.config["title"])

    facts: dict[str, Value] = {
        "width": loaded.photo.width,
        "height": loaded.photo.height,
        "base_gaussians": len(prediction.gaussians),
        **_parameter_facts(loaded_base, evaluation.network, options),
    }
    # A base may add notes, such as its network's number format.
    for name, value in prediction.notes.items():
        facts[f"{NOTE_PREFIX}{name}"] = value

    measurements = [
        image_measurement(title, case.name, name, value) for name, value in facts.items()
    ]
    for view in large_views(prediction, options.disparities, options.max_side):
        for method in _time_view(view, context, evaluation.renderer.device, runs):
            # A user who sees a new view of a photo has also waited for the base. The base was timed
            # once for all views, so each view gets the same seconds of it.
            numbers = view_numbers(
                base_count=len(context.base),
                added_count=method.added_count,
                seconds=method.seconds | {"base": timed_base.seconds},
            )
            for metric, number in numbers.items():
                measurement = Measurement(
                    dataset=title,
                    image=case.name,
                    setting=view.setting,
                    view=view.name,
                    method=method.name,
                    metric=metric,
                    value=number,
                )
                measurements.append(measurement)
    return measurements


class _TimedBase(NamedTuple):
    """A photo's Gaussians, and the seconds in which the base made them, in each run."""

    prediction: BasePrediction
    seconds: RunValues


def _time_base(
    base: OpenedBase, photo: Photo, evaluation: Evaluation, base_runs: int
) -> _TimedBase:
    """Time the base, the network (or depth map) that turns a photo into Gaussians.

    Args:
        base: the base, with its network loaded.
        photo: the photo at its stored size.
        evaluation: its options say which base this is and where it runs.
        base_runs: the number of timed runs.
    """
    options = evaluation.options
    prediction: BasePrediction | None = None

    def predict(end_stage: EndStage) -> None:
        """The task, which has no stages; it keeps its latest result."""
        nonlocal prediction
        # `predict` also returns which base made the prediction, but a benchmark has only one.
        prediction, _ = base.predict(photo)
        # The Gaussians cannot be rendered before they are where the renderer is.
        prediction.gaussians.to(evaluation.renderer.device)

    # An untimed first run keeps the compilation of kernels out of the times. SHARP on a CPU needs
    # none: a prediction takes a minute, and compilation is a small part of it.
    is_warm = options.base.resolved_name == "sharp" and options.device.type == "cpu"
    device = evaluation.renderer.device
    times = time_tasks(base_runs, {"base": predict}, device, warm=is_warm)
    assert prediction is not None
    return _TimedBase(prediction, times["base", TOTAL_STAGE] / MS_PER_S)


class _TimedMethod(NamedTuple):
    """The cost of a view by one method."""

    name: str
    added_count: int  # of Gaussians
    seconds: dict[str, RunValues]  # of each stage


def _time_view(
    view: Viewpoint, context: FillContext, device: torch.device, runs: int
) -> list[_TimedMethod]:
    """Time the completion of a view by each method of `TIMED_METHODS`.

    Args:
        view: the view.
        context: the base's Gaussians, the renderer and the residual network.
        device: whose work is waited for when a stage ends.
        runs: the number of timed runs.
    """
    added_counts: dict[str, int] = {}

    def complete(method: str, end_stage: EndStage) -> None:
        """Complete the view by a method, and count the Gaussians that it adds."""
        aux = complete_view_in_stages(context, view.camera, end_stage, method)
        added_counts[method] = len(aux)

    # The methods take turns, so that a busy machine slows both alike.
    tasks = {method: functools.partial(complete, method) for method in TIMED_METHODS}
    times = time_tasks(runs, tasks, device)

    timed_methods = []
    for method in TIMED_METHODS:
        seconds = {
            stage: milliseconds / MS_PER_S
            for (task, stage), milliseconds in times.items()
            if task == method
        }
        timed_methods.append(_TimedMethod(method, added_counts[method], seconds))
    return timed_methods


def view_numbers(
    base_count: int, added_count: int, seconds: Mapping[str, RunValues]
) -> dict[str, float]:
    """A view's numbers for tables.

    Args:
        base_count: the number of the base's Gaussians.
        added_count: the number of Gaussians that the method added.
        seconds: for each stage of `BASE_STAGES` and `COMPLETION_STAGES` the seconds in each run.

    Returns:
        "aux" counts the added Gaussians, "merged" all of the view; "aux_share" is added over base.
        "base_ms" is the time for a view of the base alone, "spackle_ms" that for a completed view,
        in milliseconds, each the sum of the medians of its stages. "overhead" is the time that
        completion adds, as a fraction of "base_ms". "fps" are views per second.
    """
    # Medians, because a busy machine makes some runs far too long.
    base_ms = sum(_median_ms(seconds[stage]) for stage in BASE_STAGES)
    completion_ms = sum(_median_ms(seconds[stage]) for stage in COMPLETION_STAGES)
    return {
        "aux": added_count,
        "aux_share": added_count / base_count,
        "merged": base_count + added_count,
        "base_ms": base_ms,
        "spackle_ms": base_ms + completion_ms,
        "overhead": completion_ms / base_ms,
        "base_fps": MS_PER_S / base_ms,
        "spackle_fps": MS_PER_S / (base_ms + completion_ms),
    }


def _median_ms(seconds: RunValues) -> float:
    """The median of seconds, in milliseconds."""
    return MS_PER_S * float(np.median(seconds))


def count_parameters(owner: object) -> int | None:
    """The number of parameters in the networks of a base or of another object.

    Args:
        owner: a PyTorch network, or an object whose attributes are networks or lists of networks.
            A parameter that several networks share counts once.

    Returns:
        The number; None if the object holds no PyTorch network.
    """
    attributes = [owner] if isinstance(owner, nn.Module) else list(vars(owner).values())
    networks = []
    for value in attributes:
        # The base lite keeps its two networks in a list.
        items = value if isinstance(value, list | tuple) else [value]
        networks += [item for item in items if isinstance(item, nn.Module)]
    if not networks:
        return None

    parameters = {
        id(parameter): parameter.numel()
        for network in networks
        for parameter in network.parameters()
    }
    return sum(parameters.values())


def _parameter_facts(
    base: Base | None, residual: ResidualNet | None, options: EvaluateOptions
) -> dict[str, Value]:
    """The numbers of parameters of the networks that ran for an image, for its measurements.

    A number is 0 without a network; that of a base is None if its network is none of PyTorch's, and
    so cannot be counted.
    """
    base_count: int | None = 0
    if options.base.uses_network and base is not None:
        base_count = count_parameters(base)
    residual_count = 0 if residual is None else count_parameters(residual)
    return {BASE_PARAMETERS: base_count, RESIDUAL_PARAMETERS: residual_count}


# --- the clock


def time_tasks(
    runs: int, tasks: Mapping[str, TimedTask], device: torch.device = CPU, *, warm: bool = False
) -> Times:
    """Time tasks and their stages.

    A task gets a function and calls it with a stage's name when the stage ends; stages of the same
    name within a run add up. The tasks take turns, so that a busy machine slows all tasks alike.

    Args:
        runs: the number of timed runs of each task.
        tasks: the tasks, by name.
        device: a stage ends when this device has done its work.
        warm: whether the tasks have run before; if not, an untimed run comes first, which compiles
            kernels and fills caches.

    Returns:
        For each task and stage the milliseconds in each run; the stage "total" is the whole task.
    """
    untimed_runs = 0 if warm else 1
    times: dict[tuple[str, str], list[float]] = {}
    for run in range(untimed_runs + runs):
        for name, task in tasks.items():
            stage_times = _time_stages(task, device)
            # The first run compiles kernels, and its times would say nothing about later ones.
            if run < untimed_runs:
                continue
            for stage, milliseconds in stage_times.items():
                times.setdefault((name, stage), []).append(milliseconds)
    return {key: np.array(values) for key, values in times.items()}


def _time_stages(task: TimedTask, device: torch.device) -> dict[str, float]:
    """Run a task once; the milliseconds of each of its stages, and of the whole task ("total")."""
    stage_times: dict[str, float] = {}
    start = _now_ms(device)
    stage_start = start

    def end_stage(stage: str) -> None:
        """Add the time since the last stage's end to this stage's time."""
        nonlocal stage_start
        end = _now_ms(device)
        stage_times[stage] = stage_times.get(stage, 0.0) + end - stage_start
        stage_start = end

    task(end_stage)
    stage_times[TOTAL_STAGE] = _now_ms(device) - start
    return stage_times


def _now_ms(device: torch.device) -> float:
    """The time in milliseconds, once the device has done the work that it was given."""
    # A GPU works on while Python goes on.
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return MS_PER_S * time.perf_counter()


@torch.no_grad()
def complete_view_in_stages(
    context: FillContext, camera: Camera, end_stage: EndStage, method: str = "spackle"
) -> Gaussians:
    """Complete a view of a scene, with a call of `end_stage` after each stage.

    The stages are "view" (the base is rendered from the view), "photo" (the base is rendered from
    the photo's camera) and "completion" (from the mask to the completed view).

    Args:
        context: the base's Gaussians, the renderer and the residual network.
        camera: the view.
        end_stage: stops the time of a stage.
        method: "paper" or "spackle".

    Returns:
        The Gaussians that the method adds for the view.
    """
    # Nothing of an earlier run or view may help: the cache of the photo's rendering starts empty,
    # and the Gaussians are new tensors (of the same memory), which the GPU renderer has not
    # prepared yet.
    context = context.on_renderer_device
    base = Gaussians(*(tensor.detach() for tensor in context.base.tensors))
    context = dataclasses.replace(context, base=base, photo_cache=PhotoRendering())
    base_rendering = context.renderer.render(context.base, camera)
    end_stage("view")

    # Making the method renders the base from the photo's camera, which is the stage "photo".
    fill = make_method(method, [camera], context)
    end_stage("photo")

    aux = fill(camera, base_rendering).aux
    end_stage("completion")
    assert aux is not None
    return aux
