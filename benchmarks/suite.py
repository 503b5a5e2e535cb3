"""Time every stage on this machine: hardware limits, the renderer, completion, a video, SHARP.

python benchmarks/suite.py [-o FOLDER] [--only SECTION,...] [--runs N] [--device cuda] [-c SHARP.pt]
[--residual FILE]

Needs no dataset and no weights; SHARP is timed if -c gives a file, as made by `random_weights.py`.
Writes suite.json (every run's value) and suite.md after each section. A section that cannot run
here is listed with its reason. Tasks that are compared take turns within one process, after one
untimed turn, which compiles.
"""

from __future__ import annotations

import argparse
import functools
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from naive_renderer import naive_render
from suite_scenes import SIDE, commit, find_view, holed_scene, photo_scene
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.bases.open import open_base
from spackle.bases.settings import BaseSettings
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric
from spackle.cli.script_command import run_script
from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo
from spackle.core.trajectories import trajectory_cameras
from spackle.formats import save_ply
from spackle.paper.evaluation.bench import (
    COMPLETION_STAGES,
    CPU,
    MS_PER_S,
    TOTAL_STAGE,
    EndStage,
    RunValues,
    TimedTask,
    complete_view_in_stages,
    time_tasks,
)
from spackle.paper.evaluation.datasets.stereo import load_motorcycle
from spackle.render import CpuRenderer, Renderer, get_renderer
from spackle.render.blend import blend_tiles
from spackle.render.drawing import (
    GAUSSIANS_PER_CHUNK,
    TILES_PER_CHUNK,
    project,
    tiles_to_draw,
)
from spackle.render.project import KernelCamera
from spackle.render.protocol import near_plane
from spackle.render.tile_lists import list_tiles, sort_tiles
from spackle.residual import ResidualNet, hole_area_ratio
from spackle.residual.architectures import load_residual
from spackle.runtime.device import hardware_facts, package_versions, parallel_for_chunks
from spackle.runtime.errors import InputError, check_name
from spackle.runtime.files import check_file, write_atomic, write_json
from spackle.runtime.folders import make_folder
from spackle.scene_fill import FillContext, fill_scene, fill_view
from spackle.video.encoding import save_video

LIMIT_RUNS = 7  # the least number of runs, of which the fastest counts
MATRIX_SIDE, COPY_MB = 2048, 256
PRODUCT, COPY = "matrix product, {}", "copy of memory"
RENDER_STAGES = ("project", "bin", "sort", "blend")
GAUSSIAN_BYTES, PIXEL_BYTES = 4 * (3 + 4 + 3 + 1 + 3), 4 * (3 + 1 + 1)
VIDEO_RUNS, FRAMES, DISPARITY = 3, 60, 0.3
LIFT, COMPLETE, DRAW, ENCODE = (
    "photo and depth to Gaussians",
    "completion of the path",
    "frames drawn",
    "video encoded",
)
EACH, GUARDS = (
    "frames rendered and completed, each by itself",
    "the photo's occlusion guard, for each of them",
)
FORWARD, UNPROJECT, SAVE = "forward", "unprojection", "save as PLY"

# for each measured limit, its best run in operations or bytes per millisecond
Peaks = Mapping[str, float]


class Timed(NamedTuple):
    """One measured figure."""

    name: str
    values: RunValues
    unit: str = "ms"
    limit_ms: float | None = None  # the least possible time, at the measured limit that applies


Section = tuple[list[Timed], dict[str, Any]]  # the figures; and sizes and settings, ready for JSON


def limits_section(runs: int, device: torch.device = CPU, share: float = 1.0) -> Section:
    """Time products of square matrices, 2·side³ operations each, and copies, whose bytes are read
    and written.

    `share` scales the sizes.
    """
    side = round(share * MATRIX_SIDE)
    figures: list[Timed] = []

    def add(name: str, unit: str, amount: float, task: TimedTask) -> None:
        times = time_tasks(max(runs, LIMIT_RUNS), {name: task}, device)[name, TOTAL_STAGE]
        figures.append(Timed(name, amount / (times / MS_PER_S) / 1e9, unit))

    for name, dtype in {"fp32": torch.float32, "bf16": torch.bfloat16}.items():
        a, b = (
            torch.rand(side, side, generator=torch.Generator().manual_seed(k)).to(device, dtype)
            for k in range(2)
        )
        product = functools.partial(torch.mm, a, b, out=torch.empty_like(a))
        add(PRODUCT.format(name), "GFLOP/s", 2 * side**3, lambda _, product=product: product())  # type: ignore[misc]
    source = torch.zeros(round(share * COPY_MB * 2**20) // 4, device=device)
    target = torch.ones_like(source)
    add(COPY, "GB/s", 2 * source.nbytes, lambda _: target.copy_(source))
    return figures, {"matrices": side, "copy_mb": share * COPY_MB}


def renderer_section(runs: int, side: int, peaks: Peaks) -> Section:
    """Time the CPU renderer on a scene of SHARP's size: its stages, a whole call, and the naive
    renderer.
    """
    scene, camera = photo_scene(side)
    tasks: dict[str, TimedTask] = {
        "ours": lambda lap: render_in_laps(scene, camera, lap),
        "call": lambda _: CpuRenderer().render(scene, camera),
        "naive": lambda lap: naive_render(scene, camera, lap),
    }
    times = time_tasks(runs, tasks)
    call, naive = times["call", TOTAL_STAGE], times["naive", TOTAL_STAGE]
    # bytes that must be read or written once
    least = len(scene) * GAUSSIAN_BYTES + side * side * PIXEL_BYTES
    figures = [Timed(stage, times["ours", stage]) for stage in RENDER_STAGES]
    figures.append(Timed("whole call: RGB, depth, alpha", call, limit_ms=least / peaks[COPY]))
    figures += [Timed(f"naive: {stage}", times["naive", stage]) for stage in RENDER_STAGES]
    figures += [Timed("naive: whole call", naive), Timed("naive over ours", naive / call, "×")]
    return figures, {"gaussians": len(scene), "width": side, "height": side}


def render_in_laps(scene: Gaussians, camera: Camera, lap: EndStage) -> None:
    """Draw as `spackle.render.drawing.draw` does; `lap` gets each step's name at its end."""
    view = KernelCamera.of(camera, 0.0, near_plane([scene], camera))
    drawn_tiles = tiles_to_draw(view, None)  # all
    splats = project([scene], view, drawn_tiles)
    lap("project")
    lists = list_tiles(splats.boxes, drawn_tiles, GAUSSIANS_PER_CHUNK)
    lap("bin")
    tiles = np.flatnonzero(drawn_tiles)
    parallel_for_chunks(
        lambda a, b: sort_tiles(a, b, tiles, lists, splats.records), len(tiles), TILES_PER_CHUNK
    )
    lap("sort")
    # sRGB, depth and alpha; linear colour is not kept, so it has no rows.
    size = (camera.height, camera.width)
    images = tuple(np.zeros(shape, np.float32) for shape in ((*size, 3), size, size, (0, 0, 3)))
    parallel_for_chunks(
        lambda a, b: blend_tiles(a, b, tiles, lists, splats.records, images),
        len(tiles),
        TILES_PER_CHUNK,
    )
    lap("blend")


def completion_section(
    runs: int,
    base: Gaussians,
    photo_camera: Camera,
    renderer: Renderer,
    network: ResidualNet | None,
    device: torch.device = CPU,
) -> Section:
    """Time the completion of a view with 5 % holes, and the base's rendering; if `network` is None,
    by the initial Gaussians alone.
    """
    disparity, camera = find_view(base, photo_camera, renderer)
    context = FillContext(base, photo_camera, renderer, network)
    times = time_tasks(
        runs, {"": lambda lap: complete_view_in_stages(context, camera, lap)}, device
    )
    render, guard, added = (times["", stage] for stage in ("view", *COMPLETION_STAGES))
    figures = [
        Timed("base render of the view", render),
        Timed("photo's occlusion guard, once a photo", guard),
        Timed("added time", added),
        Timed("added time over base render", added / render, "×"),
    ]
    holes = hole_area_ratio(renderer.render(base, camera).alpha)
    facts = {
        "gaussians": len(base),
        "width": camera.width,
        "height": camera.height,
        "disparity": disparity,
    }
    return figures, {**facts, "holes": holes, "added": len(fill_view(context, camera).aux)}


def video_section(
    runs: int,
    lift: Callable[[], BasePrediction],
    renderer: Renderer,
    network: ResidualNet | None,
    frames: int = FRAMES,
    device: torch.device = CPU,
) -> Section:
    """Time a photo to an MP4 along `rotate-forward`: as one scene, and frame by frame.

    Frame by frame, each frame is rendered and completed from scratch, including its occlusion
    guard; frames share only the photo's Gaussians. Lifting and encoding are the same in both ways,
    and included in both.

    Args:
        runs: number of timed runs, of which there are at most `VIDEO_RUNS`.
        lift: makes the photo's Gaussians.
        renderer: draws the frames.
        network: the residual; None: the initial Gaussians alone.
        frames: of the video.
        device: of network and renderer.
    """
    prediction = lift()
    aux = Gaussians.empty()
    depths = prediction.depth_range
    path = trajectory_cameras("rotate-forward", prediction.camera.even(), DISPARITY, depths, frames)
    context = FillContext.of(prediction, renderer, network)

    def scene(lap: EndStage) -> None:
        """From the photo to the video, with one set of Gaussians for all frames."""
        nonlocal aux
        base = lift()
        lap(LIFT)
        aux = fill_scene(FillContext.of(base, renderer, network), path).aux
        lap(COMPLETE)
        with torch.no_grad():  # frames as bytes, so that all fit into memory
            views = (renderer.render([base.gaussians, aux], camera).rgb for camera in path)
            pictures: list[Tensor] = [(rgb * 255).round().to(torch.uint8) for rgb in views]
        lap(DRAW)
        with tempfile.TemporaryDirectory() as folder:
            save_video((picture / 255 for picture in pictures), Path(folder) / "video.mp4")
        lap(ENCODE)

    def scratch(lap: EndStage) -> None:
        """All frames, each with Gaussians and an occlusion guard of its own."""
        for camera in path:
            guard = context.photo_guard()
            lap(GUARDS)
            fill_view(context, camera, [guard])
            lap(EACH)

    times = time_tasks(min(runs, VIDEO_RUNS), {"scene": scene, "scratch": scratch}, device)
    whole = times["scene", TOTAL_STAGE]
    each = times["scratch", EACH]
    guards = times["scratch", GUARDS]
    anew = times["scene", LIFT] + each + guards + times["scene", ENCODE]
    kept = anew - guards * (frames - 1) / frames  # as if one guard served all frames
    figures = [Timed(name, times["scene", name]) for name in (LIFT, COMPLETE, DRAW, ENCODE)]
    figures += [Timed("one scene: photo to video", whole), Timed(EACH, each), Timed(GUARDS, guards)]
    figures.append(Timed("frame by frame: photo to video", anew))
    figures.append(Timed("frame by frame over one scene", anew / whole, "×"))
    figures.append(Timed("the same, the photo's occlusion guard made once", kept / whole, "×"))
    facts = {
        "gaussians": len(prediction.gaussians),
        "added": len(aux),
        "frames": frames,
        "disparity": DISPARITY,
    }
    return figures, {**facts, "width": path[0].width, "height": path[0].height}


def sharp_section(
    runs: int, base: SharpBase, photo: Photo, peaks: Peaks, device: torch.device = CPU
) -> Section:
    """Time a photo to a scene on disk by SHARP, by stage.

    The time does not depend on the photo's content.

    Args:
        runs: number of timed runs.
        base: SHARP, on `device`.
        photo: any photo.
        peaks: operations and bytes that the machine does in a millisecond, from `limits_section`.
        device: where it runs.
    """
    count = 0

    def whole(lap: EndStage) -> None:
        nonlocal count
        output = base.infer(photo)
        lap(FORWARD)
        gaussians = to_metric(output, photo)
        count = len(gaussians)
        lap(UNPROJECT)
        with tempfile.TemporaryDirectory() as folder:
            save_ply(gaussians, Path(folder) / "scene.ply", camera=photo.camera)
        lap(SAVE)

    flops = count_flops(lambda: whole(lambda name: None))
    times = time_tasks(runs, {"": whole}, device, warm=True)  # counting has warmed up
    least = flops / peaks[PRODUCT.format(base.precision)]
    figures = [Timed(FORWARD, times["", FORWARD], limit_ms=least)]
    figures += [Timed(name, times["", name]) for name in (UNPROJECT, SAVE)]
    figures.append(Timed("photo to scene", times["", TOTAL_STAGE]))
    facts = {"weights": base.weights, "precision": base.precision, "side": base.network.config.side}
    facts |= {"windows": base.windows_per_batch}
    return figures, {**facts, "gaussians": count}


def count_flops(call: Callable[[], Any]) -> float:
    """Count operations in a call's products, convolutions and attention: a multiply-add is two."""

    def attention(query: Any, key: Any, value: Any, *rest: Any, **more: Any) -> Any:
        return sdpa_flop_count(query, key, value)  # type: ignore[no-untyped-call]

    flash = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu  # PyTorch does not count it
    with FlopCounterMode(display=False, custom_mapping={flash: attention}) as counter:
        call()
    return float(counter.get_total_flops())


def section(name: str, options: argparse.Namespace, peaks: Peaks) -> Section:
    """Measure a section of `TITLES`; InputError, with the reason, if it cannot run here."""
    runs, side, device = options.runs, options.side, torch.device(options.device)
    if name == "limits":
        return limits_section(runs, device, min(1.0, side / SIDE))
    if name == "renderer":
        return renderer_section(runs, side, peaks)
    if name == "sharp":
        if options.checkpoint is None:
            raise InputError("no weights: name them by -c FILE")
        photo = Photo(torch.rand(SIDE, SIDE, 3), 1.2 * SIDE, FocalSource.DATASET, Path("photo.png"))
        settings = BaseSettings(
            name="sharp",
            checkpoint=options.checkpoint,
            device=device.type,
            windows_per_batch=options.windows,
            precision=options.precision,
        )
        base = open_base(settings).load(photo)
        assert isinstance(base, SharpBase)
        return sharp_section(options.base_runs, base, photo, peaks, device)
    renderer = get_renderer(device.type)
    residual = None if options.residual is None else load_residual(options.residual)
    if name == "completion":
        return completion_section(runs, *holed_scene(side), renderer, residual, device)
    pair = load_motorcycle()
    lifting = functools.partial(lift_rgbd, pair.left, pair.depth, pair.left_camera)
    if name == "video":
        return video_section(
            runs, lifting, renderer, residual, FRAMES if side >= SIDE else 4, device
        )
    scene = lifting()
    return completion_section(runs, scene.gaussians, scene.camera, renderer, residual, device)


TITLES = {
    "limits": "Matrix products and copies of memory: the most that any stage can reach",
    "renderer": "CPU renderer: one view of a scene of SHARP's size",
    "completion": "Completion of one view of a scene of SHARP's size",
    "photo": "Completion of one view of a real photo with depth (Motorcycle)",
    "video": "A video of a real photo with depth (Motorcycle), as one scene and frame by frame",
    "sharp": "SHARP: photo to scene",
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("bench-suite"))
    parser.add_argument("--only", default=",".join(TITLES), help=f"sections: {', '.join(TITLES)}")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument(
        "--side",
        type=int,
        default=SIDE,
        help="pixels along the synthetic scenes, even; for a trial",
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", help="of all but the renderer's section"
    )
    parser.add_argument(
        "--residual",
        type=Path,
        help="weights of the residual; default: the initial Gaussians alone",
    )
    parser.add_argument("-c", "--checkpoint", type=Path, help="weights of SHARP")
    parser.add_argument("--base-runs", type=int, default=1, help="of SHARP")
    parser.add_argument(
        "--precision", choices=("auto", "fp32", "bf16"), default="auto", help="of SHARP"
    )
    parser.add_argument("--windows", type=int, help="of SHARP, at once")
    options = parser.parse_args(arguments)
    chosen = ["limits", *(name for name in options.only.split(",") if name != "limits")]
    for name in chosen:
        check_name("--only", name, tuple(TITLES))
    for file in (options.checkpoint, options.residual):
        if file is not None:
            check_file(file, "file of weights")
    make_folder(options.output)
    about = {**hardware_facts(torch.device(options.device)), **package_versions()}
    record: dict[str, Any] = {
        "commit": commit(),
        "about": about,
        "runs": options.runs,
        "sections": {},
    }
    lines = [
        f"# Speed\n\n{', '.join(f'{k} {v}' for k, v in about.items())}; commit {commit()}; "
        f"{options.runs} runs."
    ]
    peaks: dict[str, float] = {}
    for name in chosen:
        load, start = round(os.getloadavg()[0], 2), time.perf_counter()
        try:
            figures, facts = section(name, options, peaks)
        except InputError as error:
            figures, facts = [], {"not run": str(error)}
        if name == "limits":
            peaks |= {figure.name: 1e6 * float(figure.values.max()) for figure in figures}
        facts |= {"load_before": load, "seconds": round(time.perf_counter() - start, 1)}
        values = [{**figure._asdict(), "values": figure.values.tolist()} for figure in figures]
        record["sections"][name] = {"figures": values, "facts": facts}
        lines.append(_table(name, figures, facts))
        print(f"{name}: {len(figures)} figures in {facts['seconds']} s", file=sys.stderr)
        write_atomic(options.output / "suite.md", ("\n\n".join(lines) + "\n").encode())
        write_json(record, options.output / "suite.json")


def _table(name: str, figures: list[Timed], facts: Mapping[str, Any]) -> str:
    known = {
        key: f"{value:.4g}" if isinstance(value, float) else value for key, value in facts.items()
    }
    about = ", ".join(f"{key} {value}" for key, value in known.items() if value is not None)
    rows = (
        ["what | median | quartiles | limit | time over limit", "---|---|---|---|---"]
        if figures
        else []
    )
    for what, values, unit, limit in figures:
        low, median, high = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
        over = " | " if limit is None else f"{_number(limit)} ms | {median / limit:.1f}×"
        rows.append(
            f"{what} | {_number(median)} {unit} | {_number(low)} – {_number(high)} | {over}"
        )
    return "\n".join(
        [f"**{name}.** {TITLES[name]}. {about}.", "", *(f"| {row} |" for row in rows)]
    ).rstrip()


def _number(value: float) -> str:
    """Format with at least three digits, without an exponent if possible."""
    if not math.isfinite(value) or abs(value) >= 100 or value == 0:
        return f"{value:,.0f}"
    return (
        f"{value:.1f}"
        if abs(value) >= 10
        else f"{value:.2f}"
        if abs(value) >= 0.1
        else f"{value:.2g}"
    )


if __name__ == "__main__":
    sys.exit(run_script(main))
