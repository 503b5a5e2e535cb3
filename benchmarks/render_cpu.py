"""How long the CPU renderer takes for a scene of the size that a photo gives, stage by stage.

    python benchmarks/render_cpu.py [--runs N] [--json FILE] [--only SECTION ...]

Each section is a function from the number of runs to lists of milliseconds by name; to add one, write
it and name it in SECTIONS.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from llvmlite.binding import get_host_cpu_name

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.render.pipeline import Canvas, blend, project, wanted_tiles
from spackle.render.project import View, covariance
from spackle.render.protocol import ALPHA_MAX, ALPHA_MIN, NEAR_PLANE, TILE, TRANSMITTANCE_STOP
from spackle.render.sort import sort_by_depth
from spackle.render.tiles import list_tiles
from spackle.threads import thread_count

PHOTO = 1536  # pixels along a side
GRID = 768  # Gaussians along a side, in each of two layers
AUX = 32768  # Gaussians that want gradients, over a frozen base


def photo_scene() -> tuple[Gaussians, Camera]:
    """Two layers of GRID² Gaussians, aligned with the pixels of a photo, over smooth but varied depths."""
    generator = torch.Generator().manual_seed(0)
    camera = Camera.from_focal(1.2 * PHOTO, PHOTO, PHOTO)
    ys, xs = torch.meshgrid(torch.arange(GRID), torch.arange(GRID), indexing="ij")
    uv = (torch.stack([xs, ys], dim=-1) + 0.5) * (PHOTO / GRID)
    layers = []
    for layer in range(2):
        waves = 1.5 * torch.sin(9 * xs / GRID) * torch.cos(7 * ys / GRID)
        z = 3 + 2 * layer + waves + 0.05 * torch.rand(GRID, GRID, generator=generator)
        n = GRID * GRID
        sigma = 0.6 + 0.8 * torch.rand(n, 3, generator=generator)  # pixels
        layers.append(
            Gaussians(
                camera.unproject(uv, z).reshape(n, 3),
                torch.randn(n, 4, generator=generator),
                sigma * z.reshape(n, 1) / camera.focal[0],
                0.04 + 0.95 * torch.rand(n, generator=generator),
                torch.rand(n, 3, generator=generator),
            )
        )
    return Gaussians.cat(layers), camera


Lap = Callable[[str], None]
Times = dict[str, list[float]]


def measure(runs: int, **tasks: Callable[[Lap], object]) -> Times:
    """Milliseconds of each task and of its stages, each of which it ends by calling its argument with a name.

    The tasks take turns, so that a busy machine slows all of them alike. A first turn, which compiles
    and warms up, does not count.
    """
    times: Times = {}
    for run in range(runs + 1):
        for task, function in tasks.items():
            marks = [("", time.perf_counter())]
            function(lambda name, marks=marks: marks.append((name, time.perf_counter())))  # type: ignore[misc]
            end = time.perf_counter()
            spans = {f"{task}: {b[0]}": b[1] - a[1] for a, b in itertools.pairwise(marks)}
            spans[f"{task}, total"] = end - marks[0][1]
            for name, seconds in spans.items() if run else ():
                times.setdefault(name, []).append(1e3 * seconds)
    return times


# Sections ------------------------------------------------------------------------------------------


def forward_section(runs: int) -> Times:
    """The renderer's stages, a call of it, one that draws a tenth of the tiles, and a naive renderer beside it."""
    scene, camera = photo_scene()

    def stages(lap: Lap) -> None:
        view = View.of(camera, 0.0)
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

    full = CpuRenderer().render(scene, camera)
    tiles = torch.rand(PHOTO // TILE, PHOTO // TILE, generator=torch.Generator().manual_seed(0)) < 0.1
    difference = (full.rgb - naive_render(scene, camera)).abs().mean()
    if not difference < 1e-5:
        raise RuntimeError(f"the two renderers disagree: rgb differs by {difference} on average")
    times = measure(
        runs,
        ours=stages,
        call=lambda _: CpuRenderer().render(scene, camera),
        tenth=lambda _: CpuRenderer().render(scene, camera, tiles=tiles, onto=full),
        naive=lambda lap: naive_render(scene, camera, lap),
    )
    pairs = zip(times["naive, total"], times["ours, total"], strict=True)
    return times | {"naive / ours (a ratio)": [naive / ours for naive, ours in pairs]}


def backward_section(runs: int) -> Times:
    """Gradients for every Gaussian, and for a few over a frozen base."""
    scene, camera = photo_scene()
    middle = len(scene) // 4
    few = scene.select(slice(middle, middle + AUX))

    def task(frozen: Gaussians, learned: Gaussians) -> Callable[[Lap], None]:
        leaf = Gaussians(*(t.clone().requires_grad_() for t in learned.tensors))

        def stages(lap: Lap) -> None:
            view = CpuRenderer().render([frozen, leaf], camera)
            lap("forward")
            loss = view.rgb.sum() + view.depth.sum() + view.alpha.sum()
            torch.autograd.grad(loss, leaf.tensors)
            lap("backward")

        return stages

    return measure(runs, all=task(Gaussians.empty(), scene), few=task(scene, few))


def compile_section(runs: int) -> Times:
    """The first call in a fresh process, imports excluded: with an empty compile cache, and with a full one."""
    del runs  # one is enough
    code = """if True:
        import time, torch
        from spackle.camera import Camera
        from spackle.gaussians import Gaussians
        from spackle.render import CpuRenderer
        shapes = ((9, 3), (9, 4), (9, 3), (9,), (9, 3))
        scene = Gaussians(*(torch.rand(shape).requires_grad_() for shape in shapes))
        start = time.perf_counter()
        CpuRenderer().render(scene.detach(), Camera.from_focal(50.0, 40, 40))
        middle = time.perf_counter()
        CpuRenderer().render(scene, Camera.from_focal(50.0, 40, 40)).rgb.sum().backward()
        print(1e3 * (middle - start), 1e3 * (time.perf_counter() - middle))
    """
    results: Times = {}
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold", "warm"):
            environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
            output = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
            forward, backward = map(float, output.stdout.split())
            results |= {f"{name}: forward": [forward], f"{name}: backward": [backward]}
    return results


SECTIONS: dict[str, Callable[[int], Times]] = {
    "forward": forward_section,
    "backward": backward_section,
    "compile": compile_section,
}


# The naive renderer --------------------------------------------------------------------------------


def naive_render(scene: Gaussians, camera: Camera, lap: Lap = lambda name: None) -> torch.Tensor:
    """What one writes first: tile by tile, Gaussian by Gaussian, pixel by pixel. Returns rgb [H, W, 3]."""
    means, quats, scales, opacities, colors = (t.numpy() for t in scene.tensors)
    view = View.of(camera, 0.0)
    splats, boxes = naive_project(means, quats, scales, opacities, view.lens, view.pose, view.width, view.height)
    lap("project")
    order = np.argsort(splats[:, 2], kind="stable")
    lap("sort")
    starts, ids = naive_bin(order, boxes, *view.tiles)
    lap("bin")
    images = naive_blend(splats, boxes, opacities, colors, starts, ids, view.width, view.height)
    lap("blend")
    return torch.from_numpy(images[..., :3])


@numba.njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]
def naive_project(means, quats, scales, opacities, lens, pose, width, height):  # type: ignore[no-untyped-def]
    """Centre, depth and inverse covariance [N, 6], and boxes of pixels [N, 4]."""
    n = len(means)
    splats, boxes = np.empty((n, 6), np.float32), np.zeros((n, 4), np.int32)
    for i in numba.prange(n):
        x, y, z = pose[:, 0] * means[i, 0] + pose[:, 1] * means[i, 1] + pose[:, 2] * means[i, 2] + pose[:, 3]
        splats[i, 2] = z
        if z < NEAR_PLANE or opacities[i] < ALPHA_MIN:
            continue
        xx, xy, yy, det = covariance(x / z, y / z, 1 / z, quats[i], scales[i], lens, pose, 0.0)
        if det <= 0:
            continue
        u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        splats[i, 0], splats[i, 1] = u, v
        splats[i, 3], splats[i, 4], splats[i, 5] = yy / det, -xy / det, xx / det
        reach = 2 * math.log(opacities[i] / ALPHA_MIN)
        rx, ry = math.sqrt(reach * xx), math.sqrt(reach * yy)
        boxes[i, 0], boxes[i, 1] = max(0, math.floor(u - rx)), min(width, math.floor(u + rx) + 1)
        boxes[i, 2], boxes[i, 3] = max(0, math.floor(v - ry)), min(height, math.floor(v + ry) + 1)
    return splats, boxes


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def naive_bin(order, boxes, rows, columns):  # type: ignore[no-untyped-def]
    """Lists of Gaussians per tile, front to back."""
    starts = np.zeros(rows * columns + 1, np.int64)
    for i in order:
        for row in range(boxes[i, 2] // TILE, (boxes[i, 3] + TILE - 1) // TILE):
            for column in range(boxes[i, 0] // TILE, (boxes[i, 1] + TILE - 1) // TILE):
                starts[row * columns + column + 1] += 1
    starts = np.cumsum(starts)
    ends, ids = starts.copy(), np.empty(starts[-1], np.int32)
    for i in order:
        for row in range(boxes[i, 2] // TILE, (boxes[i, 3] + TILE - 1) // TILE):
            for column in range(boxes[i, 0] // TILE, (boxes[i, 1] + TILE - 1) // TILE):
                ids[ends[row * columns + column]] = i
                ends[row * columns + column] += 1
    return starts, ids


@numba.njit(parallel=True, fastmath=True, cache=True)  # type: ignore[untyped-decorator]
def naive_blend(splats, boxes, opacities, colors, starts, ids, width, height):  # type: ignore[no-untyped-def]
    """Blend into [H, W, 5]: sRGB, depth and alpha."""
    images = np.zeros((height, width, 5), np.float32)
    columns = (width + TILE - 1) // TILE
    for tile in numba.prange(len(starts) - 1):
        top, left = tile // columns * TILE, tile % columns * TILE
        bottom, right = min(top + TILE, height), min(left + TILE, width)
        full = np.zeros((TILE, TILE), np.bool_)
        for k in range(starts[tile], starts[tile + 1]):
            i = ids[k]
            for py in range(max(top, boxes[i, 2]), min(bottom, boxes[i, 3])):
                for px in range(max(left, boxes[i, 0]), min(right, boxes[i, 1])):
                    if full[py - top, px - left]:
                        continue
                    dx, dy = np.float32(px + 0.5) - splats[i, 0], np.float32(py + 0.5) - splats[i, 1]
                    square = splats[i, 3] * dx * dx + splats[i, 5] * dy * dy
                    power = np.float32(-0.5) * square - splats[i, 4] * dx * dy
                    alpha = min(np.float32(ALPHA_MAX), opacities[i] * np.exp(power))
                    if alpha < np.float32(ALPHA_MIN):
                        continue
                    pixel = images[py, px]
                    light = np.float32(1) - pixel[4]
                    if light * (np.float32(1) - alpha) <= np.float32(TRANSMITTANCE_STOP):
                        full[py - top, px - left] = True
                        continue
                    weight = alpha * light
                    pixel[0] += weight * colors[i, 0]
                    pixel[1] += weight * colors[i, 1]
                    pixel[2] += weight * colors[i, 2]
                    pixel[3] += weight * splats[i, 2]
                    pixel[4] += weight
        for py in range(top, bottom):
            for px in range(left, right):
                pixel = images[py, px]
                pixel[3] = pixel[3] / pixel[4] if pixel[4] > 0 else np.float32(0)
                for channel in range(3):
                    value = min(max(pixel[channel], np.float32(0)), np.float32(1))
                    power = np.float32(1.055) * value ** np.float32(1 / 2.4) - np.float32(0.055)
                    pixel[channel] = np.float32(12.92) * value if value <= np.float32(0.0031308) else power
    return images


# The table -----------------------------------------------------------------------------------------


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor() or platform.machine(),
        "core": get_host_cpu_name(),
        "cores": os.cpu_count(),
        "threads": thread_count(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
    }


def main() -> None:
    """Run the sections, print a table, and write it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7, help="timed runs, of which the median counts")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="sections to run")
    arguments = parser.parse_args()
    numba.set_num_threads(min(thread_count(), numba.config.NUMBA_NUM_THREADS))
    report: dict[str, Any] = {"machine": machine(), "runs": arguments.runs}
    print(", ".join(f"{key} {value}" for key, value in report["machine"].items()))
    print(f"{2 * GRID * GRID:,} Gaussians, {PHOTO}×{PHOTO} pixels, {arguments.runs} runs, milliseconds")
    for name in arguments.only:
        times = SECTIONS[name](arguments.runs)
        report[name] = {key: {"median": statistics.median(v), "best": min(v)} for key, v in times.items()}
        print(f"\n{name}: {SECTIONS[name].__doc__}\n{'median':>46}{'best':>10}")
        for key, value in report[name].items():
            print(f"  {key:<34}{value['median']:>10.1f}{value['best']:>10.1f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
