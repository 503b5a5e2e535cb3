"""The paper's own figures (paper.json, by the labels of its tables) as rows, to stand beside ours."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

from spackle.evaluation.rows import NEAR, Row, Run

PAPER: dict[str, Any] = json.loads(resources.files("spackle.evaluation").joinpath("paper.json").read_text("utf-8"))
IMAGES: dict[str, int] = PAPER["images"]  # of each dataset, in the order of the tables
SETTINGS: list[str] = PAPER["settings"]  # S1, S2, S3
DISPARITIES = tuple(map(float, SETTINGS))


@functools.cache
def paper_rows(label: str) -> tuple[Row, ...]:
    """A table's figures in our units: shares where the paper has percent. Near views where it has one setting."""
    rows = []
    for table in (table for table in PAPER["tables"] if table["label"] == label):
        metrics = table["metrics"]
        for dataset, method, *values in table["values"]:
            settings = SETTINGS if len(values) > len(metrics) else [NEAR]
            keys = [(setting, metric) for setting in settings for metric in metrics]
            for (setting, metric), value in zip(keys, values, strict=True):
                name = metric.removesuffix("_percent")
                rows.append(Row(dataset, "", setting, "", method, name, value if name == metric else value / 100))
    return tuple(rows)


def setting_title(setting: str, pattern: str = "{}") -> str:
    """ "S1" for "0.3", or by the pattern "{}: disparity {}"; other disparities than the paper's have no such name."""
    return pattern.format(f"S{SETTINGS.index(setting) + 1}", setting) if setting in SETTINGS else f"disparity {setting}"


def datasets(runs: Sequence[Run]) -> list[str]:
    """Titles: the paper's in its order, whether they were run or not, then others."""
    return list(dict.fromkeys([*IMAGES, *(run.title for run in runs)]))


def images_text(run: Run) -> str:
    """How many of the paper's images were measured."""
    wanted = IMAGES.get(run.title)
    return f"{len(run.measured)}" if wanted is None else f"{len(run.measured)}/{wanted}"
