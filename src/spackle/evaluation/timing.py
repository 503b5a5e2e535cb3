"""Timing of tasks that take turns, and the rows of figures that come of it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

T = TypeVar("T")

TOTAL = "total"
MS = 1000.0
CPU = torch.device("cpu")

Lap = Callable[[str], None]
Task = Callable[[Lap], Any]
Times = dict[tuple[str, str], tuple[float, ...]]  # (task, stage) → milliseconds, one a run


@dataclasses.dataclass(frozen=True)
class Timing:
    """One measured figure, and the least that it needs where that is known by a formula."""

    name: str
    values: tuple[float, ...]  # one a run
    unit: str = "ms"
    flops: float = 0.0  # floating-point operations of a run, in `dtype`
    dtype: str = "fp32"
    bytes: float = 0.0  # read and written in a run

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """The lower quartile, the median and the upper quartile."""
        low, middle, high = (float(value) for value in np.quantile(self.values, [0.25, 0.5, 0.75]))
        return low, middle, high


@dataclasses.dataclass(frozen=True)
class Section:
    """One section of the suite."""

    rows: tuple[Timing, ...]
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # sizes and settings, ready for JSON

    def row(self, name: str) -> Timing:
        """KeyError where there is none."""
        return {row.name: row for row in self.rows}[name]

    @staticmethod
    def of(content: Mapping[str, Any]) -> Section:
        """The section of `dataclasses.asdict`'s JSON; KeyError or TypeError for anything else."""
        rows = tuple(Timing(**{**row, "values": tuple(map(float, row["values"]))}) for row in content["rows"])
        return Section(rows, dict(content["facts"]))


def measure(runs: int, tasks: Mapping[str, Task], device: torch.device = CPU, *, warm: bool = False) -> Times:
    """Milliseconds of each task (its stage "total") and of its stages, each of which it ends by calling its argument.

    The tasks take turns, so a busy machine slows all of them alike. Laps of one name within a run add up. A stage ends
    when the device has done its work. One run more, which compiles and warms up, comes first, unless they are `warm`.
    """
    times: dict[tuple[str, str], list[float]] = {}
    for run in range(1 if warm else 0, runs + 1):
        for name, task in tasks.items():
            laps = _laps(task, device)
            for stage, milliseconds in laps.items() if run else ():
                times.setdefault((name, stage), []).append(milliseconds)
    return {key: tuple(values) for key, values in times.items()}


def _laps(task: Task, device: torch.device) -> dict[str, float]:
    """Milliseconds of one run's stages, and of the whole run."""
    laps: dict[str, float] = {}
    start = last = now(device)

    def lap(stage: str) -> None:
        nonlocal last
        end = now(device)
        laps[stage] = laps.get(stage, 0.0) + MS * (end - last)
        last = end

    task(lap)
    return {**laps, TOTAL: MS * (now(device) - start)}


def now(device: torch.device = CPU) -> float:
    """Seconds, once the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def timed(call: Callable[[], T], device: torch.device = CPU) -> tuple[T, float]:
    """What a call gives, and its seconds."""
    start = now(device)
    result = call()
    return result, now(device) - start


def count_flops(call: Callable[[], Any]) -> float:
    """Operations of the products, convolutions and attention in a call: two for each multiplication and addition."""

    def attention(query: Any, key: Any, value: Any, *rest: Any, **more: Any) -> Any:
        return sdpa_flop_count(query, key, value)  # type: ignore[no-untyped-call]

    # PyTorch counts attention on GPUs alone.
    mapping = {torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: attention}
    with FlopCounterMode(display=False, custom_mapping=mapping) as counter:
        call()
    return float(counter.get_total_flops())
