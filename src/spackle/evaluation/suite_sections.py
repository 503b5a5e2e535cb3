"""The sections of `spackle bench --suite`: limits of the machine, rendering, completion, video, SHARP; their scenes."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from spackle.bases.protocol import BasePrediction
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric, to_processor
from spackle.camera import Camera
from spackle.camera_path import MAX_DISPARITY, DepthRange, extremes, trajectory
from spackle.errors import InputError
from spackle.evaluation.efficiency import EXTRA
from spackle.evaluation.naive_renderer import naive_render
from spackle.evaluation.timing import CPU, MS, TOTAL, Lap, Task, Values, complete_in_laps, measure
from spackle.formats import save_ply, save_video
from spackle.gaussians import Gaussians
from spackle.image import Photo
from spackle.render import CpuRenderer, Renderer
from spackle.render.binning import list_tiles, sort_by_depth
from spackle.render.pipeline import blend, project, wanted_tiles
from spackle.render.project import KernelCamera
from spackle.residual import ResidualNet, hole_area_ratio
from spackle.scene_fill import FillContext, fill_scene, fill_view

LIMIT_RUNS = 7  # at least: the best run counts
MATRIX_SIDE, COPY_MB = 2048, 256
PRODUCT, COPY = "matrix product, {}", "copy of memory"
RENDER_STAGES = ("project", "sort", "bin", "blend")
GAUSSIAN_BYTES, PIXEL_BYTES = 4 * (3 + 4 + 3 + 1 + 3), 4 * (3 + 1 + 1)
HOLES, HALVINGS, CLOSE = 0.05, 14, 0.01  # of the completed view; of the search for it, and its relative tolerance
VIDEO_RUNS, FRAMES, DISPARITY = 3, 60, 0.3
LIFT, COMPLETE, DRAW, ENCODE = "photo and depth to Gaussians", "completion of the path", "frames drawn", "video encoded"
EACH, GUARDS = "frames rendered and completed, each by itself", "the photo's occlusion guard, for each of them"
FORWARD, UNPROJECT, SAVE = "forward", "unprojection", "save as PLY"

SIDE = 1536  # pixels along SHARP's picture
CELL = 2
# Boxes in front of the wall: left, top, right, bottom as shares of the picture, and their depth in metres.
# They cover less than a tenth, so that paths look at the wall.
BOXES = ((0.15, 0.20, 0.30, 0.40, 3.5), (0.60, 0.35, 0.80, 0.55, 3.0), (0.35, 0.70, 0.50, 0.80, 4.0))
WALL_M = 6.0
BEHIND = 1.02  # the second layer's depth over the first's
SPREAD_PX = 1.3

Peaks = Mapping[str, float]  # a row of the limits → its best run, operations or bytes a millisecond


class SuiteRow(NamedTuple):
    """One measured figure."""

    name: str
    values: Values
    unit: str = "ms"
    limit_ms: float | None = None  # the least time that it needs, at the measured limit that holds for it


Section = tuple[list[SuiteRow], dict[str, Any]]  # figures; sizes and settings, ready for JSON


def limits_section(runs: int, device: torch.device = CPU, share: float = 1.0) -> Section:
    """Products of square matrices, 2·side³ operations each, and copies, whose bytes are read and written; best runs.

    `share` is of the full sizes.
    """
    side = round(share * MATRIX_SIDE)
    rows: list[SuiteRow] = []

    def add(name: str, unit: str, amount: float, task: Task) -> None:
        times = measure(max(runs, LIMIT_RUNS), {name: task}, device)[name, TOTAL]
        rows.append(SuiteRow(name, amount / (times / MS) / 1e9, unit))

    for name, dtype in {"fp32": torch.float32, "bf16": torch.bfloat16}.items():
        a, b = (torch.rand(side, side, generator=torch.Generator().manual_seed(k)).to(device, dtype) for k in range(2))
        product = functools.partial(torch.mm, a, b, out=torch.empty_like(a))
        add(PRODUCT.format(name), "GFLOP/s", 2 * side**3, lambda _, product=product: product())  # type: ignore[misc]
    source = torch.zeros(round(share * COPY_MB * 2**20) // 4, device=device)
    target = torch.ones_like(source)
    add(COPY, "GB/s", 2 * source.nbytes, lambda _: target.copy_(source))
    return rows, {"matrices": side, "copy_mb": share * COPY_MB}


def renderer_section(runs: int, side: int, peaks: Peaks) -> Section:
    """The CPU renderer on a scene of SHARP's size: stages, a whole call, the naive twin, which draws the same."""
    scene, camera = photo_scene(side)
    tasks: dict[str, Task] = {
        "ours": lambda lap: render_in_laps(scene, camera, lap),
        "call": lambda _: CpuRenderer().render(scene, camera),
        "naive": lambda lap: naive_render(scene, camera, lap),
    }
    times = measure(runs, tasks)
    call, naive = times["call", TOTAL], times["naive", TOTAL]
    least = len(scene) * GAUSSIAN_BYTES + side * side * PIXEL_BYTES  # bytes that are read once or written once
    rows = [SuiteRow(stage, times["ours", stage]) for stage in RENDER_STAGES]
    rows.append(SuiteRow("whole call: RGB, depth, alpha", call, limit_ms=least / peaks[COPY]))
    rows += [SuiteRow(f"naive: {stage}", times["naive", stage]) for stage in RENDER_STAGES]
    rows += [SuiteRow("naive: whole call", naive), SuiteRow("naive over ours", naive / call, "×")]
    return rows, {"gaussians": len(scene), "width": side, "height": side}


def render_in_laps(scene: Gaussians, camera: Camera, lap: Lap) -> None:
    """What `spackle.render.pipeline.draw` does, step by step."""
    view = KernelCamera.of(camera, 0.0)
    wanted = wanted_tiles(view, None)
    splats, spans = project([scene], view, wanted)
    lap("project")
    order = sort_by_depth(splats.keys, splats.ids, spans)
    lap("sort")
    lists = list_tiles(order, splats.boxes, wanted)
    lap("bin")
    blend(splats, lists, view, wanted, None, False)
    lap("blend")


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
    context = FillContext(base, photo_camera, renderer, network)
    times = measure(runs, {"": lambda lap: complete_in_laps(context, camera, lap)}, device)
    render, guard, place, redraw = (times["", stage] for stage in ("view", *EXTRA))
    names = (
        "base render of the view",
        "photo's occlusion guard, once a photo",
        "mask, seeds, network, placing",
        "redraw",
    )
    rows = [SuiteRow(name, values) for name, values in zip(names, (render, guard, place, redraw), strict=True)]
    rows.append(SuiteRow("added time", place + redraw))
    rows.append(SuiteRow("added time over base render", (place + redraw) / render, "×"))
    facts = {"gaussians": len(base), "width": camera.width, "height": camera.height, "disparity": disparity}
    holes = hole_area_ratio(renderer.render(base, camera).alpha)
    return rows, {**facts, "holes": holes, "added": len(fill_view(context, camera).aux)}


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
    """A photo, which `lift` makes Gaussians of, to an MP4 along `rotate-forward`: as one scene, and frame by frame.

    Frame by frame, each is rendered and completed from scratch, its occlusion guard included, and shares nothing with
    the others but the photo's Gaussians. Lifting and encoding are the same in both ways, and count in both. At most
    `VIDEO_RUNS`.
    """
    prediction, aux = lift(), Gaussians.empty()
    depths = DepthRange.of(prediction.gaussians)
    path = trajectory("rotate-forward", prediction.camera.even(), DISPARITY, depths, frames)
    context = FillContext(prediction.gaussians, prediction.camera, renderer, network)

    def scene(lap: Lap) -> None:
        nonlocal aux
        base = lift()
        lap(LIFT)
        aux = fill_scene(FillContext(base.gaussians, base.camera, renderer, network), path).aux
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
            guard = context.photo_guard()
            lap(GUARDS)
            fill_view(context, camera, [guard])
            lap(EACH)

    times = measure(min(runs, VIDEO_RUNS), {"scene": scene, "scratch": scratch}, device)
    whole, each, guards = times["scene", TOTAL], times["scratch", EACH], times["scratch", GUARDS]
    anew = times["scene", LIFT] + each + guards + times["scene", ENCODE]
    kept = anew - guards * (frames - 1) / frames
    rows = [SuiteRow(name, times["scene", name]) for name in (LIFT, COMPLETE, DRAW, ENCODE)]
    rows += [SuiteRow("one scene: photo to video", whole), SuiteRow(EACH, each), SuiteRow(GUARDS, guards)]
    rows.append(SuiteRow("frame by frame: photo to video", anew))
    rows.append(SuiteRow("frame by frame over one scene", anew / whole, "×"))
    rows.append(SuiteRow("the same, the photo's occlusion guard made once", kept / whole, "×"))
    facts = {"gaussians": len(prediction.gaussians), "added": len(aux), "frames": frames, "disparity": DISPARITY}
    return rows, {**facts, "width": path[0].width, "height": path[0].height}


def sharp_section(runs: int, base: SharpBase, photo: Photo, peaks: Peaks, device: torch.device = CPU) -> Section:
    """A photo to a scene on disk by SHARP, stage by stage; its time does not depend on what the photo shows."""
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
    times = measure(runs, {"": whole}, device, warm=flops > 0)
    least = flops / peaks[PRODUCT.format(base.precision)] if flops else None
    rows = [SuiteRow(FORWARD, times["", FORWARD], limit_ms=least)]
    rows += [
        SuiteRow(UNPROJECT, times["", UNPROJECT]),
        SuiteRow(SAVE, times["", SAVE]),
        SuiteRow("photo to scene", times["", TOTAL]),
    ]
    facts = {"weights": base.weights, "precision": base.precision, "side": base.network.config.side}
    facts |= {"windows": base.windows, "compiled": base.compiled, "compile_problem": base.compile_problem or None}
    return rows, {**facts, "gaussians": count}


def count_flops(call: Callable[[], Any]) -> float:
    """Operations of the products, convolutions and attention in a call: two for each multiplication and addition."""

    def attention(query: Any, key: Any, value: Any, *rest: Any, **more: Any) -> Any:
        return sdpa_flop_count(query, key, value)  # type: ignore[no-untyped-call]

    flash = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu  # which PyTorch does not count
    with FlopCounterMode(display=False, custom_mapping={flash: attention}) as counter:
        call()
    return float(counter.get_total_flops())


def photo_scene(side: int = SIDE) -> tuple[Gaussians, Camera]:
    """Two layers of (side/2)² Gaussians, aligned with the pixels of a photo, over smooth but varied depths.

    Opacities lie between 0.04 and 0.99, so that more Gaussians are drawn than a surface would need.
    """
    generator = torch.Generator().manual_seed(0)
    camera, uv, xs, ys, grid = _pixels(side)
    layers, n = [], grid * grid
    for layer in range(2):
        waves = 1.5 * torch.sin(9 * xs / grid) * torch.cos(7 * ys / grid)
        z = 3 + 2 * layer + waves + 0.05 * torch.rand(grid, grid, generator=generator)
        scales = (0.6 + 0.8 * torch.rand(n, 3, generator=generator)) * z.reshape(n, 1) / camera.focal[0]
        quats, opacities = torch.randn(n, 4, generator=generator), 0.04 + 0.95 * torch.rand(n, generator=generator)
        colors = torch.rand(n, 3, generator=generator)
        layers.append(Gaussians(camera.unproject(uv, z).reshape(n, 3), quats, scales, opacities, colors))
    return Gaussians.cat(layers), camera


def holed_scene(side: int = SIDE) -> tuple[Gaussians, Camera]:
    """As many Gaussians, closed as the photo's camera sees them: boxes before a wall, which show holes from aside."""
    camera, uv, xs, ys, grid = _pixels(side)
    n, depth = grid * grid, torch.full((grid, grid), WALL_M)
    for left, top, right, bottom, metres in BOXES:
        depth[int(top * grid) : int(bottom * grid), int(left * grid) : int(right * grid)] = metres
    hues = (0.4, 0.45, 0.55)
    waves = [0.5 + hue * torch.sin(20 * k * xs / grid + 3 * depth + k * ys / 9) / 2 for k, hue in enumerate(hues, 1)]
    quats, colors = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1), torch.stack(waves, dim=-1).reshape(n, 3)
    layers = []
    for z in (depth, BEHIND * depth):
        scales = (SPREAD_PX * z.reshape(n, 1) / camera.focal[0]).expand(n, 3).contiguous()
        layers.append(Gaussians(camera.unproject(uv, z).reshape(n, 3), quats, scales, torch.full((n,), 0.99), colors))
    return Gaussians.cat(layers), camera


def _pixels(side: int) -> tuple[Camera, Tensor, Tensor, Tensor, int]:
    """The photo's camera; centres of its cells [g, g, 2]; their columns and rows [g, g]; how many there are a side."""
    grid = side // CELL
    ys, xs = torch.meshgrid(torch.arange(grid), torch.arange(grid), indexing="ij")
    uv = (torch.stack([xs, ys], dim=-1) + 0.5) * (side / grid)
    return Camera.from_focal(1.2 * side, side, side), uv, xs, ys, grid
