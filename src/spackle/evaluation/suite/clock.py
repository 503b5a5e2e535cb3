"""Timing of tasks that take turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import torch

TOTAL = "total"
MS = 1000.0

Lap = Callable[[str], None]
Task = Callable[[Lap], Any]
Times = dict[tuple[str, str], tuple[float, ...]]  # (task, stage) → milliseconds, one a run

CPU = torch.device("cpu")


def measure(runs: int, tasks: Mapping[str, Task], device: torch.device = CPU, *, warm: bool = False) -> Times:
    """Milliseconds of each task (its stage "total") and of its stages, each of which it ends by calling its argument.

    The tasks take turns, so that a busy machine slows all of them alike. A first turn, which compiles and warms up,
    does not count. Laps of one name within a run add up.

    Args:
        runs: that count.
        tasks: by their names.
        device: on a GPU a stage ends when its work is done, and not when it has been handed over.
        warm: they ran before, so that the first turn counts, too.
    """
    times: dict[tuple[str, str], list[float]] = {}
    for run in range(1 if warm else 0, runs + 1):
        for name, task in tasks.items():
            laps = _laps(task, device)
            for stage, milliseconds in laps.items() if run else ():
                times.setdefault((name, stage), []).append(milliseconds)
    return {key: tuple(values) for key, values in times.items()}


def _laps(task: Task, device: torch.device) -> dict[str, float]:
    """Milliseconds of one run's stages, and of the whole of it."""
    laps: dict[str, float] = {}
    _wait(device)
    start = last = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal last
        _wait(device)
        now = time.perf_counter()
        laps[stage] = laps.get(stage, 0.0) + MS * (now - last)
        last = now

    task(lap)
    _wait(device)
    return {**laps, TOTAL: MS * (time.perf_counter() - start)}


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
