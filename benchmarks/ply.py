"""Seconds to write and read a scene as PLY, medians: `python benchmarks/ply.py [--count N] [--runs N]`."""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from spackle.formats import load_ply, save_ply
from spackle.gaussians import Gaussians


def median_seconds(work: Callable[[], object], runs: int) -> float:
    """Median wall time of `work`, after one run that does not count."""
    times = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_179_648, help="Gaussians: SHARP's number by default")
    parser.add_argument("--runs", type=int, default=7)
    options = parser.parse_args()
    torch.manual_seed(0)
    n = options.count
    scene = Gaussians(torch.randn(n, 3), torch.randn(n, 4), torch.rand(n, 3) + 1e-3, torch.rand(n), torch.rand(n, 3))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        write = median_seconds(lambda: save_ply(scene, path), options.runs)
        read = median_seconds(lambda: load_ply(path), options.runs)
        megabytes = path.stat().st_size / 1e6
    print(f"{n} Gaussians, {megabytes:.0f} MB, {platform.machine()}, {os.cpu_count()} cores, medians of {options.runs}")
    print(f"write {write:.3f} s  read {read:.3f} s")


if __name__ == "__main__":
    main()
