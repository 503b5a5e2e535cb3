"""What a run says to whoever started it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from spackle.training.checkpoint import Progress


@dataclasses.dataclass(frozen=True)
class Watch:
    """How a run talks to whoever started it."""

    step: Callable[[int, dict[str, float]], None]  # steps done, and their mean numbers since it was last called
    validated: Callable[[Progress], None]
    saved: Callable[[Progress], None]  # a checkpoint is on the disk
    stop: Callable[[], bool]  # whether somebody wants it to end after this step


class Means:
    """Numbers of several steps, on their way to a line."""

    def __init__(self) -> None:
        self.sums: dict[str, float] = {}
        self.count = 0
        self.stopped = False

    def add(self, numbers: dict[str, float]) -> None:
        """One more step."""
        self.stopped = numbers.pop("stop") > 0
        self.count += 1
        for name, value in numbers.items():
            self.sums[name] = self.sums.get(name, 0.0) + value

    def take(self) -> dict[str, float]:
        """The means, and an end to them."""
        means = {name: total / self.count for name, total in self.sums.items()}
        self.sums, self.count = {}, 0
        return means
