"""Size, time and faithfulness of every export format: `python benchmarks/export.py [SCENE.ply] [--count N] [--runs N]`.

Without a scene: Gaussians as SHARP lays them out, two layers of a grid, with positions, sizes, directions, colours and
opacities that vary as a photo's do. The PSNR is between a render of the scene and one of the file read back by
splat-transform, where the environment names it (SPLAT_TRANSFORM, see docs/formats.md), from the photo's eye and aside.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from spackle.camera import Camera
from spackle.camera_path import DepthRange, max_offset
from spackle.formats import load_ply, load_ply_camera, save_ply
from spackle.formats.scene_files import SceneFile
from spackle.formats.spz import decode_spz
from spackle.gaussians import Gaussians
from spackle.jobs.export import WRITERS
from spackle.render import CpuRenderer


def grid_scene(count: int) -> tuple[Gaussians, Camera]:
    """A waving floor, walls and a sky 60 m away, in two layers of a square grid, and the camera of the photo."""
    side = int(math.sqrt(count / 2))
    generator = torch.Generator().manual_seed(0)
    camera = Camera.from_focal(side * 0.9, side, side)
    rays = camera.unproject(camera.pixel_centers(), torch.ones(side, side)).reshape(-1, 3)
    x, y = rays[:, 0], rays[:, 1]
    depth = 3 + torch.sin(5 * x) * 0.5 + torch.where((4 * x).floor() % 2 > 0, 2.0, 0.0)
    depth = torch.where(y > 0.15, 0.6 / y.clamp_min(0.1), depth)
    depth = torch.where(y < -0.35, 60.0, depth)
    layers = []
    for offset in (1.0, 1.03):
        noise = [torch.randn(side * side, width, generator=generator) for width in (3, 4, 3, 1, 3)]
        means = rays * depth[:, None] * offset * (1 + 1e-4 * noise[0])
        sizes = (depth / camera.focal[0])[:, None] * torch.tensor([0.8, 0.8, 0.2]) * (0.2 * noise[2]).exp()
        quats = torch.tensor([1.0, 0, 0, 0]) + 0.15 * noise[1]
        waves = torch.stack([torch.sin(9 * x + 4 * y), torch.cos(7 * y), torch.sin(30 * x * y)], dim=1)
        colors = (0.35 + 0.25 * waves + 0.03 * noise[4]).clamp(0.001, 1)
        layers.append(Gaussians(means, quats, sizes, (1.5 + 1.5 * noise[3][:, 0]).sigmoid(), colors))
    return Gaussians.cat(layers), camera


def seconds(work: Callable[[], object], runs: int) -> tuple[float, float]:
    """Median wall and CPU seconds of `work`, after one run that does not count."""
    wall, cpu = [], []
    for _ in range(runs + 1):
        start = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    return statistics.median(wall[1:]), statistics.median(cpu[1:])


def read_back(path: Path) -> Gaussians | None:
    """The scene of a file, as splat-transform reads it; SPZ without it by our own reader."""
    command = os.environ.get("SPLAT_TRANSFORM")
    if path.name.endswith((".glb", ".html")):
        return None
    if path.name.endswith(".ply") and not path.name.endswith(".compressed.ply"):
        return load_ply(path)
    if command is None:
        return decode_spz(path.read_bytes()) if path.suffix == ".spz" else None
    plain = path.with_name(f"{path.name}.back.ply")
    subprocess.run(["node", command, "-q", "-w", str(path), str(plain)], check=True, capture_output=True)
    return load_ply(plain)


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    """Of images in 0..1."""
    return -10 * math.log10(max(1e-12, float((a - b).double().square().mean())))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--count", type=int, default=1_179_648, help="Gaussians: SHARP's number by default")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--side", type=int, default=768, help="longer side of the renders that are compared")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        if options.scene:
            gaussians, camera = load_ply(options.scene), load_ply_camera(options.scene)
            camera = camera or Camera.from_focal(1000, 1280, 960)
            save_ply(gaussians, path, camera=camera)
        else:
            gaussians, camera = grid_scene(options.count)
            save_ply(gaussians, path, camera=camera, base_count=len(gaussians))
        report(SceneFile.load(path), camera, Path(folder), options.runs, options.side)


def report(scene: SceneFile, camera: Camera, folder: Path, runs: int, side: int) -> None:
    """One line a format."""
    factor = min(1.0, side / max(camera.width, camera.height))
    camera = camera.resized(round(camera.width * factor), round(camera.height * factor))
    depths = DepthRange.of(scene.gaussians)
    eye = torch.tensor([max_offset(camera, 0.3, depths), 0.0, 0.0])
    views = [camera, camera.looking(eye, torch.tensor([0.0, 0.0, depths.focus]))]
    renderer = CpuRenderer()
    expected = [renderer.render(scene.gaussians, view).rgb for view in views]
    plain = scene.path.stat().st_size
    array = np.random.default_rng(0).random(10_000_000, dtype=np.float32) + 1
    _, unit = seconds(lambda: np.log(array), 5)
    print(f"{len(scene.gaussians)} Gaussians, {platform.machine()}, {os.cpu_count()} cores")
    print(f"ten million np.log: {unit:.3f} s of CPU")
    print("| format | MB | of the PLY | seconds | CPU | PSNR photo | PSNR aside |\n|---|---:|---:|---:|---:|---:|---:|")
    for suffix, writer in WRITERS.items():
        path = folder / f"out{suffix}"
        wall, cpu = seconds(lambda writer=writer, path=path: writer(scene, path), runs)  # type: ignore[misc]
        size, found = path.stat().st_size, read_back(path)
        shown = ["–", "–"]
        if found:
            drawn = [renderer.render(found, view).rgb for view in views]
            shown = [f"{psnr(a, b):.1f}" for a, b in zip(drawn, expected, strict=True)]
        cells = [suffix, f"{size / 1e6:.1f}", f"1/{plain / size:.1f}", f"{wall:.2f}", f"{cpu:.2f}", *shown]
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
