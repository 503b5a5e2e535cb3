"""Time the paper's method against SHARP: for both residual networks, at given shares of holes.

python benchmarks/paper_times.py sharp.safetensors [-o FOLDER] [--runs N] [--residual FILE ...]

`random_weights.py` makes the weights: SHARP's time depends on their number, not on their values.
Random weights place Gaussians anywhere, so the views are not of SHARP's Gaussians: they show a
synthetic scene of the same 1,179,648 Gaussians (boxes before a wall), seen from the disparities at
which 2, 10 and 20 % of the pixels are holes.

All tasks take turns within one process: the base, then each network at each share of holes, then
the base again, and so on; an untimed turn comes first. Each completion is compared with the base of
its own turn, in seconds and in CPU seconds: those of all threads, to which other programs on a busy
machine add less. Writes paper_times.json (every run) and paper_times.md after each turn.
"""

from __future__ import annotations

import argparse
import functools
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from suite import count_flops
from suite_scenes import commit, find_view, holed_scene

from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric
from spackle.cli.script_command import run_script
from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo, working_size
from spackle.paper.evaluation.bench import (
    COMPLETION_STAGES,
    MS_PER_S,
    EndStage,
    RunValues,
    TimedTask,
    complete_view_in_stages,
    time_tasks,
)
from spackle.paper.evaluation.options import LARGE_VIEW_SIDE_PX
from spackle.render import Renderer, get_renderer
from spackle.residual import MIN_AUX_GAUSSIANS, ResidualNet, hole_area_ratio
from spackle.residual.architectures import load_residual, open_residual, shipped_network
from spackle.residual.network import predict_deltas
from spackle.runtime.device import hardware_facts, package_versions, pick_device, pick_dtype
from spackle.runtime.files import write_atomic, write_json
from spackle.runtime.folders import make_folder
from spackle.scene_fill import FillContext

PHOTO_SIZE = (1536, 1152)  # pixels; 4:3, as most photos of the paper's datasets
HOLE_RATIOS = (0.02, 0.10, 0.20)  # about the mean HAR of LLFF at S1, ETH3D at S2, Tanks at S2
BASE = "base"
BASE_STAGES = ("network", "Gaussians", "view")


class View(NamedTuple):
    """A view of the synthetic scene."""

    hole_ratio: float  # HAR: the share of its pixels that are holes
    disparity: float
    camera: Camera


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path, help="weights of SHARP")
    parser.add_argument("-o", "--output", type=Path, default=Path("paper-times"))
    parser.add_argument("--runs", type=int, default=5, help="timed turns of all tasks")
    parser.add_argument(
        "--residual",
        type=Path,
        action="append",
        default=[],
        help="weights of a network; default: the shipped unet, and an untrained sharp-decoder",
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", choices=("auto", "fp32", "bf16"), default="auto")
    return parser.parse_args(arguments)


def open_networks(files: list[Path], device: torch.device) -> dict[str, ResidualNet]:
    """The networks to time, by the names of their architectures."""
    networks = [load_residual(file) for file in files]
    if not networks:
        shipped = shipped_network()
        networks = [shipped or open_residual("unet"), open_residual("sharp-decoder")]
    # The layout in memory in which convolutions are fastest.
    laid_out = [
        network.to(device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        for network in networks
    ]
    return {network.name: network for network in laid_out}


def find_views(scene: Gaussians, photo_camera: Camera, renderer: Renderer) -> list[View]:
    """The views of a scene with the shares of holes `HOLE_RATIOS`, of the size of large views."""
    view_size = working_size(*PHOTO_SIZE, LARGE_VIEW_SIDE_PX)
    view_camera = photo_camera.resized(*view_size)
    views = []
    for hole_ratio in HOLE_RATIOS:
        disparity, camera = find_view(scene, view_camera, renderer, hole_ratio)
        found = hole_area_ratio(renderer.render(scene, camera).alpha)
        views.append(View(found, disparity, camera))
    return views


def with_cpu_clock(
    name: str, task: TimedTask, cpu_seconds: dict[str, list[float]], end_stage: EndStage
) -> None:
    """Run a task, and add the CPU seconds of its stages to `cpu_seconds`, by "name/stage"."""
    last = time.process_time()

    def end_stage_of_both(stage: str) -> None:
        """Stop the times of a stage: the caller's, and the CPU's."""
        nonlocal last
        end_stage(stage)
        now = time.process_time()
        cpu_seconds.setdefault(f"{name}/{stage}", []).append(now - last)
        last = now

    start = time.perf_counter()
    task(end_stage_of_both)
    print(f"{name}: {time.perf_counter() - start:.1f} s", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Time everything, and write the results after each turn of all tasks."""
    options = parse(arguments)
    device = pick_device(options.device)
    make_folder(options.output)
    load_before = os.getloadavg()[0]

    # The networks come first, because their files may be missing.
    networks = open_networks(options.residual, device)

    # The base, and a photo of the shape of the scene's.
    sharp = SharpBase.load(options.checkpoint, precision=options.precision, device=device)
    width, height = PHOTO_SIZE
    pixels = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    photo = Photo(pixels, 1.2 * width, FocalSource.DATASET, Path("photo.png"))

    # The scene whose views are completed; it has as many Gaussians as SHARP predicts.
    renderer = get_renderer(device.type)
    scene, photo_camera = holed_scene(width, height)
    scene = scene.to(device)
    views = find_views(scene, photo_camera, renderer)
    print(f"views: {[(round(v.hole_ratio, 4), round(v.disparity, 3)) for v in views]}", flush=True)

    contexts = {
        name: FillContext(scene, photo_camera, renderer, network, precision=options.precision)
        for name, network in networks.items()
    }

    def predict_and_render(end_stage: EndStage) -> None:
        """What the base alone does: from the photo to its Gaussians, and to one view."""
        output = sharp.infer(photo)
        end_stage("network")
        to_metric(output, photo)
        end_stage("Gaussians")
        renderer.render(scene, views[0].camera)
        end_stage("view")

    added_counts: dict[str, int] = {}
    cpu_seconds: dict[str, list[float]] = {}

    def complete(network: str, view: View, name: str, end_stage: EndStage) -> None:
        """What the paper's method does: a view of the base, and its completion."""
        aux = complete_view_in_stages(contexts[network], view.camera, end_stage, "paper")
        added_counts[name] = len(aux)

    # The base, and each network at each share of holes.
    tasks: dict[str, TimedTask] = {BASE: predict_and_render}
    cases: dict[str, tuple[str, View]] = {}
    for view in views:
        for network in networks:
            name = f"{network}, HAR {view.hole_ratio:.1%}"
            cases[name] = (network, view)
            tasks[name] = functools.partial(complete, network, view, name)
    tasks = {
        name: functools.partial(with_cpu_clock, name, task, cpu_seconds)
        for name, task in tasks.items()
    }

    # Operations and steps are counted once, the times of all tasks in each turn.
    print("operations", flush=True)
    flops = {
        network: count_flops(lambda context=context: run_network(context, views[1].camera))  # type: ignore[misc]
        for network, context in contexts.items()
    }
    print({name: f"{value / 1e12:.3f} TFLOP" for name, value in flops.items()}, flush=True)
    time_tasks(1, tasks, device, warm=True)  # the untimed turn
    cpu_seconds.clear()
    profiles = {
        name: profile(contexts[network], view, device) for name, (network, view) in cases.items()
    }
    print(profiles, flush=True)

    dtype = str(pick_dtype(options.precision, device)).removeprefix("torch.")
    facts: dict[str, Any] = {
        **hardware_facts(device),
        **package_versions(),
        "commit": commit(),
        "precision": dtype,
        "gaussians": len(scene),
        "view": (views[0].camera.width, views[0].camera.height),
        "load_before": load_before,
        "flops": flops,
        "profiles_ms": profiles,
    }
    seconds: dict[str, list[float]] = {}
    for turn in range(options.runs):
        for (task, stage), values in time_tasks(1, tasks, device, warm=True).items():
            seconds.setdefault(f"{task}/{stage}", []).extend(values / MS_PER_S)
        facts |= {"turns": turn + 1, "load": os.getloadavg()[0], "added": added_counts}
        facts |= {"seconds": seconds, "cpu_seconds": cpu_seconds}
        write_json(facts, options.output / "paper_times.json")
        text = table(cases, facts)
        write_atomic(options.output / "paper_times.md", text.encode())
        print(text, flush=True)


def run_network(context: FillContext, camera: Camera) -> None:
    """Only the network, on the inputs that it names."""
    view = context.view(context.renderer.render(context.base, camera), camera)
    assert context.network is not None
    view.deltas(context.network, context.precision)


def profile(context: FillContext, view: View, device: torch.device) -> dict[str, float]:
    """Milliseconds of each step of the paper's method: medians of three runs after an untimed one.

    Args:
        context: the scene and the network.
        view: the view that is completed.
        device: where it is done.
    """
    network = context.network
    assert network is not None

    def steps(end_stage: EndStage) -> None:
        """The same steps as the method "paper", one after the other."""
        rendering = context.renderer.render(context.base, view.camera)
        end_stage("render of the base")
        completion = context.view(rendering, view.camera)
        cells = completion.cells(at_least=MIN_AUX_GAUSSIANS)
        mask = completion.mask
        end_stage("mask and features")
        _ = completion.initial
        end_stage("initial Gaussians")
        for name in network.inputs:
            completion.input(name)
            end_stage(f"input {name}")
        features = completion.network_input(network.inputs)
        end_stage("inputs joined")
        deltas = predict_deltas(network, features, mask, context.precision)
        end_stage("network")
        aux = completion.gaussians(cells, deltas)
        end_stage("Gaussians composed")
        context.renderer.render([context.base, aux.to(context.base.means.device)], view.camera)
        end_stage("render of the completed view")

    times = time_tasks(3, {"": steps}, device)
    return {stage: float(np.median(values)) for (_, stage), values in times.items()}


def added_ratios(clock: Mapping[str, list[float]], name: str) -> RunValues:
    """The time that completion adds over the base's, of each turn.

    `clock` has the seconds of each task and stage, by "task/stage".
    """
    base: RunValues = np.sum([clock[f"{BASE}/{stage}"] for stage in BASE_STAGES], axis=0)
    added: RunValues = np.sum([clock[f"{name}/{stage}"] for stage in COMPLETION_STAGES], axis=0)
    return added / base


def table(cases: Mapping[str, tuple[str, View]], facts: Mapping[str, Any]) -> str:
    """The results as Markdown.

    Args:
        cases: the network and the view of each task, by its name.
        facts: what paper_times.json holds.
    """
    lines = [
        f"{facts['cpu']}, {facts['threads']} threads, {facts['precision']}; {facts['turns']} "
        f"turns; load {facts['load_before']:.1f} to {facts['load']:.1f}; commit {facts['commit']}",
        "",
    ]
    for clock in ("seconds", "cpu_seconds"):
        for stage in BASE_STAGES:
            values = facts[clock][f"{BASE}/{stage}"]
            lines.append(f"- base, {stage}: median {np.median(values):.2f} {clock}")
    lines += [
        "",
        "| network | HAR | added Gaussians | added seconds | CPU seconds | over the base "
        "| by CPU seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, (network, view) in cases.items():
        texts = [network, f"{view.hole_ratio:.1%}", f"{facts['added'][name]:,}"]
        for clock in ("seconds", "cpu_seconds"):
            added = sum(np.array(facts[clock][f"{name}/{stage}"]) for stage in COMPLETION_STAGES)
            texts.append(f"{np.median(added):.2f}")
        for clock in ("seconds", "cpu_seconds"):
            ratios = added_ratios(facts[clock], name)
            texts.append(f"{np.median(ratios):.1%} ({ratios.min():.1%} to {ratios.max():.1%})")
        lines.append(f"| {' | '.join(texts)} |")
    lines += ["", "Steps, median of 3 runs, ms:", ""]
    for name, steps in facts["profiles_ms"].items():
        text = ", ".join(f"{step} {milliseconds:,.0f}" for step, milliseconds in steps.items())
        lines.append(f"- {name}: {text}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(run_script(main))
