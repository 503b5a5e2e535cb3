"""Names that people type, and what they may have meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from spackle.errors import InputError
from spackle.trajectory import TrajectoryKind


def check_name(option: str, name: str, known: Iterable[str]) -> None:
    """InputError for a name that there is not, with the nearest one."""
    names = list(known)
    if name in names:
        return
    near = difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.5)
    advice = f"did you mean {near[0]}? There" if near else "there"
    raise InputError(f"{option} {name}: unknown: {advice} are {', '.join(names)}")


def spelled(kind: TrajectoryKind) -> str:
    """A trajectory as --trajectory spells it, and as everything does that a person reads."""
    return kind.replace("_", "-")
