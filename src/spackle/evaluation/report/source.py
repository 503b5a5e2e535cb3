"""What a report is made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from spackle.evaluation.results import Run


@dataclasses.dataclass(frozen=True)
class Source:
    """An evaluation, and what lies beside its figures."""

    run: Run
    pictures: Callable[[int], Mapping[str, bytes]]  # of the image at that place in `run.records`: method → WebP
    versions: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    machine: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def name(self) -> str:
        """To stand above what is this evaluation's."""
        return f"{self.run.title}, {'near' if self.run.near else 'large'} views, base {self.run.base}"
