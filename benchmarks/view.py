"""Seconds from a scene's file to its first bytes in a browser: `python benchmarks/view.py [--count N] [--runs N]`."""

from __future__ import annotations

import argparse
import http.client
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch

from spackle.camera import Camera
from spackle.formats import load_ply, load_ply_base_count, load_ply_camera, save_ply
from spackle.gaussians import Gaussians
from spackle.viewer import PageScene, page_files, page_scene
from spackle.viewer.server import ViewerServer

T = TypeVar("T")


def median(work: Callable[[], T], runs: int) -> tuple[float, T]:
    """Median wall time of `work`, after one run that does not count, and what it returns."""
    times, result = [], work()
    for _ in range(runs):
        start = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - start)
    return statistics.median(times), result


def fetch(port: int, path: str) -> tuple[float, float, bytes]:
    """Seconds to the first byte and to the last, and the body."""
    connection = http.client.HTTPConnection("127.0.0.1", port)
    start = time.perf_counter()
    connection.request("GET", path)
    answer = connection.getresponse()
    body = answer.read(1)
    first = time.perf_counter() - start
    body += answer.read()
    connection.close()
    return first, time.perf_counter() - start, body


def no_photos(*_: Any) -> NoReturn:
    raise RuntimeError("nothing is sent here")


def random_scene(count: int) -> tuple[Gaussians, Camera]:
    """Gaussians in front of a camera, as many as SHARP makes."""
    torch.manual_seed(0)
    means = torch.randn(count, 3) + torch.tensor([0.0, 0.0, 6.0])
    scales, opacities, colors = torch.rand(count, 3) * 0.02 + 1e-3, torch.rand(count), torch.rand(count, 3)
    return Gaussians(means, torch.randn(count, 4), scales, opacities, colors), Camera.from_focal(1300, 1536, 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_200_000, help="Gaussians, a tenth of them aux")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    scene, camera = random_scene(options.count)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        save_ply(scene, path, camera=camera, base_count=options.count * 9 // 10)
        load, (gaussians, lens, count) = median(
            lambda: (load_ply(path), load_ply_camera(path), load_ply_base_count(path)), options.runs
        )
    assert lens is not None

    def make() -> PageScene:
        return page_scene("scene.ply", gaussians.select(slice(0, count)), gaussians.select(slice(count, None)), lens)

    page, page_of_scene = median(make, options.runs)
    print(f"{options.count} Gaussians, {platform.machine()}, {os.cpu_count()} cores, medians of {options.runs}")
    print(f"load {load:.3f} s  page_scene {page:.3f} s")
    with ViewerServer(page_files(), no_photos) as server:
        start = time.perf_counter()
        shown = server.show(page_of_scene)
        print(f"show {time.perf_counter() - start:.3f} s")
        layers = json.loads(fetch(server.port, shown)[2])["layers"]
        files = [f"{shown.removesuffix('.json')}/{layer['file']}" for layer in layers]
        for name in ("/", "/viewer.js", "/viewer.css", "/scene.json", shown, *files):
            first, whole, body = fetch(server.port, name)
            print(f"{name:<24} {len(body) / 1e6:8.3f} MB  first byte {first:.4f} s  all {whole:.4f} s")


if __name__ == "__main__":
    main()
