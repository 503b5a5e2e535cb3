"""Stereo pairs in Middlebury's layout, results of an evaluation, and a stand-in for pyiqa."""

from __future__ import annotations

import shutil
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from helpers import DATA
from spackle.paper.evaluation.measurements import Measurement, Run

WIDTH, HEIGHT = 72, 48


def write_boxes(folder: Path, seed: int) -> None:
    """Write a stereo pair of a box before a wall; the disparities are 10 and 4 pixels."""
    shutil.copytree(DATA / "boxes" / str(seed), folder)


Figures = Mapping[str, Mapping[str, float | None]]  # method, metric


def results(
    title: str,
    near: bool,
    figures: Callable[[int], Figures],
    count: int = 2,
    name: str = "scene_{}",
) -> Run:
    """An evaluation of `count` images with the metrics `figures(image)`, and of one image that
    could not be read.
    """
    config: dict[str, Any] = {
        "kind": "evaluate",
        "title": title,
        "terms": f"cite {title}",
        "protocol": "near-view" if near else "large-view",
        "methods": list(figures(0)),
        "base": {"name": "rgbd", "says": "the dataset's own depth", "weights": None},
        "disparities": None if near else [0.3, 0.4, 0.5],
        "second_views": "all" if near else None,
        "side": 1280,
        "residual": {"weights": "shipped", "sha256": "0123456789", "precision": "bfloat16"},
    }
    states = {
        "niqe": "pyiqa 9.9",
        "clipiqa": "not run: pyiqa is not installed",
        "dists": "pyiqa 9.9",
    }
    rows = []
    for image in range(count):
        known = Measurement(title, name.format(image), "", "", "", "base_gaussians", 50000)
        rows.append(known)
        for setting in Run(config, ()).settings:
            for method, measured in figures(image).items():
                for view in ("left", "right"):
                    rows += [
                        Measurement(title, known.image, setting, view, method, *one)
                        for one in measured.items()
                    ]
    return Run(
        config,
        [*rows, Measurement(title, "gone", "", "", "", "problem", "gone.png: <b>damaged</b>")],
        {"metrics": states},
    )


def fake_pyiqa(patch: pytest.MonkeyPatch, create: Callable[..., object]) -> None:
    module = types.ModuleType("pyiqa")
    module.__dict__.update(__version__="9.9", create_metric=create)
    patch.setitem(sys.modules, "pyiqa", module)
