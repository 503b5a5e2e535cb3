"""What an evaluation found: a row for each view and method, and means over them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from spackle.errors import InputError


@dataclasses.dataclass(frozen=True)
class Row:
    """One view by one method."""

    setting: str  # "0.3" (a disparity), or "near"
    view: str
    method: str
    figures: Mapping[str, float | None]  # None where a figure is not finite


@dataclasses.dataclass(frozen=True)
class Record:
    """One image: its rows, or why there are none."""

    name: str
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # sizes, counts, notes
    rows: tuple[Row, ...] = ()
    problem: str | None = None
    remarks: tuple[str, ...] = ()  # what went wrong beside that, such as a metric that failed

    def plain(self) -> dict[str, Any]:
        """Ready for JSON."""
        return dataclasses.asdict(self)

    @staticmethod
    def of(content: Mapping[str, Any]) -> Record:
        """What `plain` gave; KeyError or TypeError for anything else."""
        rows = tuple(Row(**row) for row in content["rows"])
        return Record(**{**content, "rows": rows, "remarks": tuple(content["remarks"])})


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
    records: tuple[Record, ...]

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
    def measured(self) -> list[Record]:
        """The images that gave figures."""
        return [record for record in self.records if record.problem is None]

    def mean(self, figure: str, method: str, setting: str) -> Mean:
        """Over all views of all images: each novel view counts once, as in the paper's "per novel view"."""
        values = [
            row.figures[figure]
            for record in self.measured
            for row in record.rows
            if row.method == method and row.setting == setting and figure in row.figures
        ]
        found = [value for value in values if value is not None]
        value = math.fsum(found) / len(found) if found else None
        return Mean(value, len(found), len(values) - len(found))

    @property
    def base_gaussians(self) -> float | None:
        """Mean over the images; the same for all where the base is SHARP."""
        counts = [record.facts["base_gaussians"] for record in self.measured]
        return math.fsum(counts) / len(counts) if counts else None

    def plain(self) -> dict[str, Any]:
        """Ready for JSON: everything, and the means beside it."""
        settings = list(dict.fromkeys(row.setting for record in self.measured for row in record.rows))
        names = list(dict.fromkeys(name for r in self.measured for row in r.rows for name in row.figures))
        means = [
            {"setting": setting, "method": method, "figure": figure} | dataclasses.asdict(mean)
            for setting in settings
            for method in self.methods
            for figure in names
            if (mean := self.mean(figure, method, setting)).count + mean.bad
        ]
        problems = {record.name: record.problem for record in self.records if record.problem is not None}
        images = [record.plain() for record in self.records]
        return {"config": dict(self.config), "problems": problems, "means": means, "images": images}

    @staticmethod
    def of(content: Any, where: str) -> Run:
        """What `plain` gave; InputError, naming `where`, for anything else."""
        try:
            run = Run(dict(content["config"]), tuple(Record.of(image) for image in content["images"]))
            _ = (run.title, run.near, run.methods, run.base, run.base_gaussians)  # all are there
            return run
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{where}: not the results of `spackle evaluate`: run it again") from error
