"""Stereo pairs in Middlebury's layout, results of an evaluation, and a stand-in for pyiqa."""

from __future__ import annotations

import json
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from spackle.evaluation.rows import Row, Run

WIDTH, HEIGHT, FOCAL = 72, 48, 60.0
NEAR_PX, FAR_PX = 10, 4  # disparities of the box and of the wall
BASELINE = 0.2


def write_pfm(path: Path, values: NDArray[np.float32]) -> None:
    head = f"Pf\n{values.shape[1]} {values.shape[0]}\n-1.0\n".encode()
    path.write_bytes(head + values[::-1].astype("<f4").tobytes())


def write_boxes(folder: Path, seed: int) -> None:
    """Write a stereo pair of a box before a wall."""
    rng = np.random.default_rng(seed)
    hue, phase = rng.uniform(0.3, 0.7, 3), rng.uniform(0, 6, 3)
    left, top = int(rng.integers(20, 30)), int(rng.integers(8, 16))
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    box = (x >= left) & (x < left + 22) & (y >= top) & (y < top + 24)

    def wall(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return hue + 0.15 * np.sin(np.stack([0.3 * x, 0.2 * x + 0.3 * y, 0.4 * y], axis=-1) + phase)

    def front(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return 1 - hue + 0.15 * np.cos(np.stack([0.5 * y, 0.3 * x, 0.4 * x], axis=-1))

    beside = (x >= left - NEAR_PX) & (x < left + 22 - NEAR_PX) & (y >= top) & (y < top + 24)
    photos = [np.where(box[..., None], front(x), wall(x))]
    photos += [np.where(beside[..., None], front(x + NEAR_PX), wall(x + FAR_PX))]
    first, second = (np.round(255 * photo.clip(0, 1)).astype(np.uint8) for photo in photos)
    folder.mkdir(parents=True)
    Image.fromarray(first).save(folder / "left.png")
    Image.fromarray(second).save(folder / "right.png")
    write_pfm(folder / "disp.pfm", np.where(box, NEAR_PX, FAR_PX).astype(np.float32))
    names = {"left": "left.png", "right": "right.png", "disparity": "disp.pfm"}
    lens = {"focal_px": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "doffs_px": 0, "baseline_m": BASELINE}
    (folder / "scene.json").write_text(json.dumps(names | lens))


Figures = Mapping[str, Mapping[str, float | None]]  # method, metric


def results(title: str, near: bool, figures: Callable[[int], Figures], count: int = 2, name: str = "scene_{}") -> Run:
    """An evaluation of `count` images with the metrics `figures(image)`, and of one image that could not be read."""
    config: dict[str, Any] = {
        "kind": "evaluate",
        "title": title,
        "terms": f"cite {title}",
        "protocol": "near-view" if near else "large-view",
        "methods": list(figures(0)),
        "base": {"title": "rgbd", "says": "the dataset's own depth", "weights": None},
        "disparities": None if near else [0.3, 0.4, 0.5],
        "second_views": "all" if near else None,
        "side": 1280,
        "residual": {"weights": "shipped", "sha256": "0123456789", "precision": "bfloat16"},
    }
    states = {"niqe": "pyiqa 9.9", "clipiqa": "not run: pyiqa is not installed", "dists": "pyiqa 9.9"}
    rows = []
    for image in range(count):
        known = Row(title, name.format(image), "", "", "", "base_gaussians", 50000)
        rows.append(known)
        for setting in Run(config, ()).settings:
            for method, measured in figures(image).items():
                for view in ("left", "right"):
                    rows += [Row(title, known.image, setting, view, method, *one) for one in measured.items()]
    return Run(
        config, [*rows, Row(title, "gone", "", "", "", "problem", "gone.png: <b>damaged</b>")], {"metrics": states}
    )


def fake_pyiqa(patch: pytest.MonkeyPatch, create: Callable[..., object]) -> None:
    module = types.ModuleType("pyiqa")
    module.__dict__.update(__version__="9.9", create_metric=create)
    patch.setitem(sys.modules, "pyiqa", module)
