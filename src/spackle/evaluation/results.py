"""What an evaluation found, and its folder: a file for each finished image, so that a killed run goes on."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spackle.errors import InputError
from spackle.files import atomic_path, differences, make_folder, remove_half_written

IMAGES = "images"
CONFIG, RESULTS, TIMES = "config.json", "results.json", "times.json"
MARKDOWN, LATEX, WORST, BEST = "tables.md", "tables.tex", "worst.png", "best.png"
FORMAT = 1
KINDS = {  # of a configuration: the command, and what its folder holds
    None: ("evaluate", "an evaluation"),
    "bench": ("bench", "a benchmark"),
    "suite": ("bench --suite", "a suite"),
}


@dataclasses.dataclass(frozen=True)
class Row:
    """One view by one method."""

    setting: str  # "0.3" (a disparity), or "near"
    view: str
    method: str
    figures: Mapping[str, float | None]  # None where a figure is not finite


@dataclasses.dataclass(frozen=True)
class ImageResult:
    """One image: its rows, or why there are none."""

    name: str
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # sizes, counts, notes
    rows: tuple[Row, ...] = ()
    problem: str | None = None
    remarks: tuple[str, ...] = ()  # what went wrong beside that, such as a metric that failed

    @staticmethod
    def of(content: Mapping[str, Any]) -> ImageResult:
        """What `dataclasses.asdict` gave; KeyError or TypeError for anything else."""
        rows = tuple(Row(**row) for row in content["rows"])
        return ImageResult(**{**content, "rows": rows, "remarks": tuple(content["remarks"])})


@dataclasses.dataclass(frozen=True)
class Mean:
    """Of a figure over views."""

    value: float | None  # None where no view gave a number
    count: int  # views that did
    bad: int  # views whose figure was not finite: they are left out, and counted


@dataclasses.dataclass(frozen=True)
class Run:
    """A dataset under a protocol."""

    config: Mapping[str, Any]
    records: tuple[ImageResult, ...]

    @property
    def title(self) -> str:
        return str(self.config["title"])

    @property
    def near(self) -> bool:
        return bool(self.config["protocol"] == "near-view")

    @property
    def methods(self) -> Sequence[str]:
        return list(self.config["methods"])

    @property
    def base(self) -> str:
        return str(self.config["base"]["title"])

    @property
    def measured(self) -> list[ImageResult]:
        """The images that gave figures."""
        return [record for record in self.records if record.problem is None]

    @property
    def rows(self) -> list[Row]:
        """Of all images."""
        return [row for record in self.measured for row in record.rows]

    @property
    def base_gaussians(self) -> float | None:
        """Mean over the images; the same for all where the base is SHARP."""
        counts = [record.facts["base_gaussians"] for record in self.measured]
        return math.fsum(counts) / len(counts) if counts else None

    def mean(self, figure: str, method: str, setting: str) -> Mean:
        """Over all views of all images: each novel view counts once, as in the paper's "per novel view"."""
        own = [row.figures for row in self.rows if (row.method, row.setting) == (method, setting)]
        found = [value for figures in own if (value := figures.get(figure)) is not None]
        bad = sum(figure in figures for figures in own) - len(found)
        return Mean(math.fsum(found) / len(found) if found else None, len(found), bad)

    def plain(self) -> dict[str, Any]:
        """Ready for JSON: everything, and the means beside it."""
        means = [
            {"setting": setting, "method": method, "figure": figure} | dataclasses.asdict(mean)
            for setting in dict.fromkeys(row.setting for row in self.rows)
            for method in self.methods
            for figure in dict.fromkeys(name for row in self.rows for name in row.figures)
            if (mean := self.mean(figure, method, setting)).count + mean.bad
        ]
        problems = {record.name: record.problem for record in self.records if record.problem is not None}
        images = [dataclasses.asdict(record) for record in self.records]
        return {"config": dict(self.config), "problems": problems, "means": means, "images": images}


def begin(output: Path, config: Mapping[str, Any], parts: str = IMAGES) -> None:
    """Make a folder for this configuration (its "kind" is in `KINDS`); InputError if it holds another one."""
    make_folder(output / parts)
    remove_half_written(output, output / parts)
    path, kind = output / CONFIG, config.get("kind")
    if not path.exists():
        write_json({"format": FORMAT, **config}, path)
        return
    command, results = KINDS[kind]
    old = read_json(path)
    if not isinstance(old, dict) or old.pop("format", None) != FORMAT or old.get("kind") != kind:
        raise InputError(f"{path}: not of `spackle {command}`: choose another -o")
    if lines := differences(old, json.loads(json.dumps(config))):
        raise InputError(f"{output}: holds {results} of another kind ({'; '.join(lines)}): choose another -o")


def image_file(output: Path, index: int, name: str, suffix: str) -> Path:
    """One of an image's files: its record (.json), its strip (.png), or its picture by a method (.METHOD.webp)."""
    return output / IMAGES / f"{index:05d}-{re.sub(r'[^A-Za-z0-9.-]+', '_', name)[-80:]}{suffix}"


def save_part(path: Path, inputs: object, found: Mapping[str, Any]) -> None:
    """Write what one image or section gave, and of which inputs."""
    write_json({"inputs": inputs, "found": found}, path)


def load_part(path: Path, inputs: object) -> dict[str, Any] | None:
    """What an earlier run found; None where it is not there, or of other inputs than these (None: of any)."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return dict(content["found"]) if inputs in (None, content["inputs"]) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def load_run(folder: Path) -> Run:
    """The finished results in a folder; InputError where there are none."""
    path = folder / RESULTS
    if not path.is_file():
        state = "not finished: run its command again" if (folder / CONFIG).is_file() else "no results of an evaluation"
        raise InputError(f"{folder}: {state}: {RESULTS} is missing")
    content = read_json(path)
    try:
        run = Run(dict(content["config"]), tuple(ImageResult.of(image) for image in content["images"]))
        _ = (run.title, run.near, run.methods, run.base, run.base_gaussians)  # all are there
        return run
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not the results of `spackle evaluate`: run it again") from error


def read_json(path: Path) -> Any:
    """InputError where a file is not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read: it is damaged, or not JSON: choose another folder") from error


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Whole or not at all; the same content gives the same bytes."""
    write_text(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n", path)


def write_text(text: str, path: Path) -> None:
    """Whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
