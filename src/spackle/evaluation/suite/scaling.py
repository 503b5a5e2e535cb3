"""How drawing time grows with the number of Gaussians and of pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from spackle.camera import Camera
from spackle.evaluation.suite.clock import TOTAL, measure
from spackle.evaluation.suite.scenes import SIDE, photo_scene
from spackle.evaluation.suite.values import Found, Row
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer

STEPS = 6  # each twice the one before: a range of 32
GAUSSIANS, PIXELS = "gaussians", "pixels"


def scaling_section(runs: int, side: int = SIDE) -> Found:
    """Whole calls for random parts of a scene at its full size, and for the whole scene at smaller sizes.

    Gaussians stay as large as they are where there are fewer of them; pictures show the same where they are smaller.
    """
    scene, camera = photo_scene(side)
    shuffled = scene.select(torch.randperm(len(scene), generator=torch.Generator().manual_seed(1)))
    parts = [shuffled.select(slice(0, len(scene) >> step)) for step in reversed(range(STEPS))]
    smaller = [round(side / math.sqrt(2**step)) for step in reversed(range(STEPS))]
    views = [camera.resized(width, width) for width in smaller]
    sizes = {GAUSSIANS: [len(part) for part in parts], PIXELS: [width * width for width in smaller]}
    points: dict[str, list[tuple[Gaussians, Camera]]] = {
        GAUSSIANS: [(part, camera) for part in parts],
        PIXELS: [(scene, view) for view in views],
    }
    rows: list[Row] = []
    for what, cases in points.items():
        times = measure(
            runs,
            {str(k): lambda _, case=case: CpuRenderer().render(*case) for k, case in enumerate(cases)},  # type: ignore[misc]
        )
        values = [times[str(k), TOTAL] for k in range(len(cases))]
        rows += [Row(f"{size:,} {what}", found) for size, found in zip(sizes[what], values, strict=True)]
        fits = tuple(exponent(sizes[what], run) for run in zip(*values, strict=True))
        rows.append(Row(f"exponent of {what}", fits, ""))
    return Found(tuple(rows), {**sizes, "side": side})


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """The slope of a straight line through log time against log size, by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
