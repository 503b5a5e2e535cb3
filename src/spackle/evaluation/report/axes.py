"""The axes of a plot: where a value stands, and which values are written beside the axis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

STEPS = (1, 2, 2.5, 5, 10)


@dataclasses.dataclass(frozen=True)
class Axis:
    """From the left to the right, or from below upwards."""

    title: str  # with the unit
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    log: bool = False

    def at(self, value: float) -> float:
        """0 at the axis's beginning, 1 at its end; what a logarithmic axis cannot have stands at the beginning."""
        if not self.log:
            return (value - self.low) / (self.high - self.low)
        return (math.log10(max(value, self.low)) - math.log10(self.low)) / math.log10(self.high / self.low)


def linear(title: str, values: Iterable[float], origin: bool = True, count: int = 5) -> Axis:
    """Round numbers around the values.

    Args:
        title: with the unit.
        values: that have to be on the axis; at least one.
        origin: begin at 0.
        count: about so many steps.
    """
    known = list(values)
    low, high = (0.0 if origin else min(known)), max(known)
    step = _round_step((high - low) / count) if high > low else 1.0
    first, last = math.floor(low / step + 1e-9), max(math.ceil(high / step - 1e-9), math.floor(low / step + 1e-9) + 1)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    digits += abs(step * 10**digits - round(step * 10**digits)) > 1e-6  # steps of 0.25
    places = [float(f"{k * step:.12g}") for k in range(first, last + 1)]  # 0.3 and not 0.30000000000000004
    return Axis(title, places[0], places[-1], tuple((place, f"{place:.{digits}f}") for place in places))


def percent_decades(title: str, shares: Iterable[float]) -> Axis:
    """Decades of a share, written in percent. Zeros stand below the lowest decade, at a tick of their own."""
    known = list(shares)
    positive = [share for share in known if share > 0]
    low = math.floor(math.log10(min(positive, default=0.1)) + 1e-9)
    high = max(math.ceil(math.log10(max(positive, default=1.0)) - 1e-9), low + 1)
    ticks = [(10.0**k, f"{100 * 10.0**k:.{max(0, -k - 2)}f} %") for k in range(low, high + 1)]
    if len(positive) < len(known):
        ticks.insert(0, (10.0 ** (low - 1), "0"))
    return Axis(title, ticks[0][0], ticks[-1][0], tuple(ticks), log=True)


def _round_step(step: float) -> float:
    """The next larger round number."""
    power: float = 10.0 ** math.floor(math.log10(step))
    return next(power * nice for nice in STEPS if power * nice >= step * (1 - 1e-9))
