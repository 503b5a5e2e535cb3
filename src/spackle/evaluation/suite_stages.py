"""The sections of `spackle bench --suite`: the machine's limits, rendering, completion, video, SHARP."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric, to_processor
from spackle.bases.sharp.layers import FULL
from spackle.camera import Camera
from spackle.camera_path import MAX_DISPARITY, DepthRange, extremes, trajectory
from spackle.device import pick_dtype
from spackle.errors import InputError
from spackle.evaluation.efficiency import EXTRA, complete_in_laps
from spackle.evaluation.naive_renderer import naive_render
from spackle.evaluation.suite_scenes import photo_scene
from spackle.evaluation.timing import CPU, MS, TOTAL, Lap, Section, Task, Timing, count_flops, measure
from spackle.formats import save_ply, save_video
from spackle.gaussians import Gaussians
from spackle.image import Photo
from spackle.render import CpuRenderer, Renderer, touched_tiles
from spackle.render.binning import list_tiles, sort_by_depth
from spackle.render.pipeline import Canvas, blend, project, wanted_tiles
from spackle.render.project import KernelCamera
from spackle.render.protocol import Rendering
from spackle.residual import Completer, Cues, ResidualNet, hole_area_ratio, make_seeds
from spackle.residual.network import predict_deltas
from spackle.residual.seeds import Rim

LIMIT_RUNS = 7  # at least: the best run counts
MATRIX_SIDE, COPY_MB = 2048, 256
PRODUCT, COPY = "matrix product, {}", "copy of memory"
RENDER_STAGES = ("project", "sort", "bin", "blend")
CALL, NAIVE_RATIO = "whole call: RGB, depth, alpha", "naive over ours"
TWIN_ERROR = 1e-5  # between the two renderers, on average
BAND, BAND_SETS = 0.05, 3  # what is redrawn: a band of the picture this wide, in so many sets
GAUSSIAN_BYTES, PIXEL_BYTES = 4 * (3 + 4 + 3 + 1 + 3), 4 * (3 + 1 + 1)
HOLES, HALVINGS, CLOSE = 0.05, 14, 0.01  # of the completed view; of the search for it, and its relative tolerance
RENDER, SHIELD, NETWORK, ADDED = "base render of the view", "photo's shield, once a photo", "network", "added time"
PLACE, REDRAW, IN_RENDERS = "mask, seeds, network, placing", "redraw", "added time over base render"
VIDEO_RUNS, FRAMES, DISPARITY = 3, 60, 0.3
LIFT, COMPLETE, DRAW, ENCODE = "photo and depth to Gaussians", "completion of the path", "frames drawn", "video encoded"
SCENE, SCRATCH = "one scene: photo to video", "frame by frame: photo to video"
EACH, SHIELDS = "frames rendered and completed, each by itself", "the photo's shield, for each of them"
SCENE_RATIO, KEPT_RATIO = "frame by frame over one scene", "the same, the photo's shield made once"
FORWARD, UNPROJECT, SAVE, WHOLE = "forward", "unprojection", "save as PLY", "photo to scene"


def limits_section(runs: int, device: torch.device = CPU, share: float = 1.0) -> Section:
    """Products of square matrices, 2·side³ operations each, and copies, whose bytes are read and written; best runs.

    `share` is of the full sizes.
    """
    runs, side, rows = max(runs, LIMIT_RUNS), round(share * MATRIX_SIDE), []
    for name, dtype in {"fp32": torch.float32, "bf16": torch.bfloat16}.items():
        a, b = (torch.rand(side, side, generator=torch.Generator().manual_seed(k)).to(device, dtype) for k in range(2))
        times = _time_calls(runs, {"": functools.partial(torch.mm, a, b, out=torch.empty_like(a))}, device)[""]
        rows.append(Timing(PRODUCT.format(name), tuple(2 * side**3 / (ms / MS) / 1e9 for ms in times), "GFLOP/s"))
    source = torch.zeros(round(share * COPY_MB * 2**20) // 4, device=device)
    times = _time_calls(runs, {"": functools.partial(torch.ones_like(source).copy_, source)}, device)[""]
    rows.append(Timing(COPY, tuple(2 * source.nbytes / (ms / MS) / 1e9 for ms in times), "GB/s"))
    return Section(tuple(rows), {"matrices": side, "copy_mb": share * COPY_MB})


def _time_calls(
    runs: int, calls: Mapping[str, Callable[[], object]], device: torch.device = CPU
) -> dict[str, tuple[float, ...]]:
    """Milliseconds of calls that take turns."""
    tasks: dict[str, Task] = {name: lambda _, call=call: call() for name, call in calls.items()}  # type: ignore[misc]
    times = measure(runs, tasks, device)
    return {name: times[name, TOTAL] for name in calls}


def renderer_section(runs: int, side: int) -> Section:
    """The CPU renderer on a scene of SHARP's size: stages, a whole call, the naive twin, a redraw.

    Raises:
        RuntimeError: the two renderers do not draw the same, so a comparison would mean nothing.
    """
    scene, camera = photo_scene(side)
    difference = float((CpuRenderer().render(scene, camera).rgb - naive_render(scene, camera)).abs().mean())
    if not difference < TWIN_ERROR:
        raise RuntimeError(f"the two renderers disagree: rgb differs by {difference} on average")
    tasks: dict[str, Task] = {
        "ours": lambda lap: render_in_laps(scene, camera, lap),
        "call": lambda _: CpuRenderer().render(scene, camera),
        "naive": lambda lap: naive_render(scene, camera, lap),
    }
    times = measure(runs, tasks)
    rows = [Timing(stage, times["ours", stage]) for stage in RENDER_STAGES]
    least = float(len(scene) * GAUSSIAN_BYTES + side * side * PIXEL_BYTES)  # read once, written once
    rows.append(Timing(CALL, times["call", TOTAL], bytes=least))
    rows += [Timing(f"naive: {stage}", times["naive", stage]) for stage in RENDER_STAGES]
    rows.append(Timing("naive: whole call", times["naive", TOTAL]))
    rows.append(Timing(NAIVE_RATIO, _ratios(times["naive", TOTAL], times["call", TOTAL]), "×"))
    redrawn, facts = _redraw(runs, scene, camera)
    return Section((*rows, *redrawn), {"gaussians": len(scene), "width": side, "height": side, **facts})


def render_in_laps(scene: Gaussians, camera: Camera, lap: Lap) -> None:
    """What `spackle.render.pipeline.draw` does, step by step."""
    view = KernelCamera.of(camera, 0.0)
    wanted = wanted_tiles(view, None)
    canvas = Canvas.prepare(view, None, False)
    splats, spans = project([scene], view, wanted)
    lap("project")
    order = sort_by_depth(splats.keys, splats.ids, spans)
    lap("sort")
    lists = list_tiles(order, splats.boxes, wanted)
    lap("bin")
    blend(splats, lists, wanted, canvas)
    lap("blend")


def _redraw(runs: int, scene: Gaussians, camera: Camera) -> tuple[list[Timing], dict[str, int]]:
    """A band of the scene again on top: on the drawing that the renderer remembers, in its tiles anew, and all anew."""
    u = camera.project(scene.means)[0][:, 0] / camera.width
    edges = [0.5 - BAND / 2 + BAND * k / BAND_SETS for k in range(BAND_SETS + 1)]
    more = [scene.select((u >= edges[k]) & (u < edges[k + 1])) for k in range(BAND_SETS)]
    tiles = torch.stack([touched_tiles(part, camera) for part in more]).any(0)
    keeper, sets = CpuRenderer(), [scene, *more]
    under = keeper.render(scene, camera)
    calls: dict[str, Callable[[], Rendering]] = {
        "remembered": lambda: keeper.render(sets, camera, tiles=tiles, onto=under),
        "anew": lambda: CpuRenderer().render(sets, camera, tiles=tiles, onto=under),
        "all": lambda: CpuRenderer().render(sets, camera),
    }
    if not torch.equal(calls["remembered"]().rgb, calls["anew"]().rgb):
        raise RuntimeError("a remembered drawing and a new one differ")
    times = _time_calls(runs, calls)
    rows = [
        Timing("redraw with a few sets more, remembered", times["remembered"]),
        Timing("redraw of the same tiles, anew", times["anew"]),
        Timing("redraw of all tiles, anew", times["all"]),
        Timing("same tiles anew over remembered", _ratios(times["anew"], times["remembered"]), "×"),
    ]
    facts = {"redraw_sets": BAND_SETS, "redraw_gaussians": sum(map(len, more)), "redraw_tiles": int(tiles.sum())}
    return rows, facts


def _ratios(over: tuple[float, ...], under: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(a / b for a, b in zip(over, under, strict=True))


def completion_section(
    runs: int,
    base: Gaussians,
    photo_camera: Camera,
    renderer: Renderer,
    network: ResidualNet | None,
    device: torch.device = CPU,
) -> Section:
    """One view, 5 % of which are holes, beside the base's render of it; without a network the seeds fill the holes."""
    disparity, camera = find_view(base, photo_camera, renderer)
    completer = Completer(base, photo_camera, renderer, network)
    before = renderer.render(base, camera)
    tasks: dict[str, Task] = {"view": lambda lap: complete_in_laps(completer, camera, lap)}
    if network is not None:
        cues = Cues.of(before)
        seeds = make_seeds(cues, camera, photo_camera)
        rim = Rim.of(cues, seeds, camera, photo_camera)
        ask = functools.partial(predict_deltas, network, cues, seeds, rim)
        tasks[NETWORK] = lambda _: ask()
    times = measure(runs, tasks, device)
    shield, place, redraw = (times["view", stage] for stage in EXTRA)
    added = tuple(map(sum, zip(place, redraw, strict=True)))
    rows = [Timing(RENDER, times["view", "view"]), Timing(SHIELD, shield), Timing(PLACE, place)]
    if network is not None:
        dtype = "bf16" if pick_dtype("auto", CPU) == torch.bfloat16 else "fp32"
        rows.append(Timing(NETWORK, times[NETWORK, TOTAL], flops=count_flops(ask), dtype=dtype))
    rows += [Timing(REDRAW, redraw), Timing(ADDED, added)]
    rows.append(Timing(IN_RENDERS, _ratios(added, times["view", "view"]), "×"))
    facts = {"gaussians": len(base), "width": camera.width, "height": camera.height, "disparity": disparity}
    facts |= {"holes": hole_area_ratio(before.alpha), "added": len(completer.complete_view(camera))}
    return Section(tuple(rows), facts)


def find_view(base: Gaussians, camera: Camera, renderer: Renderer, share: float = HOLES) -> tuple[float, Camera]:
    """The disparity at which a share of the view from the right is holes, by bisection; and that view.

    Raises:
        InputError: there is no such view.
    """
    even, depths = camera.even(), DepthRange.of(base)

    low, high = 0.0, MAX_DISPARITY
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        view = extremes(even, middle, depths)[1]
        found = hole_area_ratio(renderer.render(base, view).alpha)
        low, high = (middle, high) if found < share else (low, middle)
        if abs(found / share - 1) < CLOSE:
            return middle, view
    raise InputError(f"no view up to disparity {MAX_DISPARITY:g} has {share:.0%} holes")


def video_section(
    runs: int,
    lift: Callable[[], BasePrediction],
    renderer: Renderer,
    network: ResidualNet | None,
    frames: int = FRAMES,
    device: torch.device = CPU,
) -> Section:
    """A photo, which `lift` makes Gaussians of, to an MP4 along `rotate_forward`: as one scene, and frame by frame.

    Frame by frame, each is rendered and completed from scratch, its shield included, and shares nothing with the others
    but the photo's Gaussians. Lifting and encoding are the same in both ways, and count in both. At most `VIDEO_RUNS`.
    """
    prediction, aux = lift(), Gaussians.empty()
    depths = DepthRange.of(prediction.gaussians)
    path = trajectory("rotate_forward", prediction.camera.even(), DISPARITY, depths, frames)
    completer = Completer(prediction.gaussians, prediction.camera, renderer, network)

    def scene(lap: Lap) -> None:
        nonlocal aux
        base = lift()
        lap(LIFT)
        aux = Completer(base.gaussians, base.camera, renderer, network).complete_scene(path)
        lap(COMPLETE)
        with torch.no_grad():  # as bytes, so that all frames fit into memory
            views = (renderer.render([base.gaussians, aux], camera).rgb for camera in path)
            pictures: list[Tensor] = [(rgb * 255).round().to(torch.uint8) for rgb in views]
        lap(DRAW)
        with tempfile.TemporaryDirectory() as folder:
            save_video((picture / 255 for picture in pictures), Path(folder) / "video.mp4")
        lap(ENCODE)

    def scratch(lap: Lap) -> None:
        for camera in path:
            shield = completer.photo_guard()
            lap(SHIELDS)
            completer.completed_view(camera, [shield])
            lap(EACH)

    times = measure(min(runs, VIDEO_RUNS), {"scene": scene, "scratch": scratch}, device)
    scenes, lifts, codes = (np.array(times["scene", stage]) for stage in (TOTAL, LIFT, ENCODE))
    each, shields = (np.array(times["scratch", stage]) for stage in (EACH, SHIELDS))
    anew = lifts + each + shields + codes
    kept = anew - shields * (frames - 1) / frames
    rows = [Timing(name, times["scene", name]) for name in (LIFT, COMPLETE, DRAW, ENCODE)]
    rows += [
        Timing(SCENE, tuple(scenes)),
        Timing(EACH, tuple(each)),
        Timing(SHIELDS, tuple(shields)),
        Timing(SCRATCH, tuple(anew)),
    ]
    rows += [Timing(SCENE_RATIO, tuple(anew / scenes), "×"), Timing(KEPT_RATIO, tuple(kept / scenes), "×")]
    facts = {"gaussians": len(prediction.gaussians), "added": len(aux), "frames": frames, "disparity": DISPARITY}
    return Section(tuple(rows), {**facts, "width": path[0].width, "height": path[0].height})


def sharp_photo(side: int = FULL.side) -> Photo:
    """Any photo: SHARP's time does not depend on what it shows."""
    return Photo(torch.rand(side, side, 3), 1.2 * side, "", Path("photo.png"))


def sharp_section(runs: int, base: SharpBase, photo: Photo, device: torch.device = CPU) -> Section:
    """A photo to a scene on disk by SHARP, stage by stage."""
    count = 0

    def whole(lap: Lap) -> None:
        nonlocal count
        output = base.look(photo)
        lap(FORWARD)
        gaussians = to_processor(to_metric(output, photo))
        count = len(gaussians)
        lap(UNPROJECT)
        with tempfile.TemporaryDirectory() as folder:
            save_ply(gaussians, Path(folder) / "scene.ply", camera=photo.camera)
        lap(SAVE)

    # The run that is counted warms up; a compiled network hides its operations, and warms up within `measure`.
    flops = 0.0 if base.compiled else count_flops(lambda: whole(lambda name: None))
    times = measure(runs, {"sharp": whole}, device, warm=flops > 0)
    rows = [Timing(FORWARD, times["sharp", FORWARD], flops=flops, dtype=base.precision)]
    rows += [Timing(name, times["sharp", name]) for name in (UNPROJECT, SAVE)]
    rows.append(Timing(WHOLE, times["sharp", TOTAL]))
    facts = {
        "weights": base.weights,
        "precision": base.precision,
        "side": base.network.config.side,
        "windows": base.windows,
    }
    facts |= {"compiled": base.compiled, "compile_problem": base.compile_problem or None}
    return Section(tuple(rows), {**facts, "gaussians": count})
