"""What a section of the suite found: rows of measured values, and what each of them needs at least."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Need:
    """What a stage cannot do without: floating-point operations by their type, and bytes of memory read or written."""

    bytes: float = 0.0
    operations: Mapping[str, float] = dataclasses.field(default_factory=dict)  # "fp32", "fp64", "bf16" → how many

    def __add__(self, other: Need) -> Need:
        """Of both, one after the other."""
        kinds = {**self.operations, **other.operations}
        counts = {kind: self.operations.get(kind, 0.0) + other.operations.get(kind, 0.0) for kind in kinds}
        return Need(self.bytes + other.bytes, counts)


@dataclasses.dataclass(frozen=True)
class Target:
    """Where a value is meant to be."""

    value: float
    at_most: bool = True

    def met(self, median: float) -> bool:
        return median <= self.value if self.at_most else median >= self.value


@dataclasses.dataclass(frozen=True)
class Row:
    """One thing that was measured, several times."""

    name: str
    values: tuple[float, ...]  # one a run
    unit: str = "ms"
    need: Need | None = None  # None: nobody counted
    target: Target | None = None

    @property
    def median(self) -> float:
        return float(np.median(self.values))

    @property
    def quartiles(self) -> tuple[float, float]:
        low, high = np.quantile(self.values, [0.25, 0.75])
        return float(low), float(high)


@dataclasses.dataclass(frozen=True)
class Found:
    """What a section found."""

    rows: tuple[Row, ...]
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # sizes, shares, settings: ready for JSON
    notes: tuple[str, ...] = ()  # what could not be measured, and why
    device: str = "cpu"  # whose peaks the limits are taken from

    def row(self, name: str) -> Row:
        """KeyError where there is none."""
        found = {row.name: row for row in self.rows}
        return found[name]

    def plain(self) -> dict[str, Any]:
        """Ready for JSON, medians and quartiles beside the values."""
        spreads = [{"median": row.median, "quartiles": list(row.quartiles)} for row in self.rows]
        content = dataclasses.asdict(self)
        content["rows"] = [{**row, **spread} for row, spread in zip(content["rows"], spreads, strict=True)]
        return content

    @staticmethod
    def of(content: Mapping[str, Any]) -> Found:
        """What `plain` gave; KeyError or TypeError for anything else."""
        rows = tuple(_row(row) for row in content["rows"])
        return Found(rows, dict(content["facts"]), tuple(content["notes"]), str(content["device"]))


def _row(content: Mapping[str, Any]) -> Row:
    need, target = content["need"], content["target"]
    return Row(
        content["name"],
        tuple(map(float, content["values"])),
        content["unit"],
        None if need is None else Need(**need),
        None if target is None else Target(**target),
    )
