"""The suite's findings as tables: times, the two limits of each stage, and how far the times are from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from spackle.evaluation.suite import completion, renderer, sharp, video
from spackle.evaluation.suite.limits import Peaks
from spackle.evaluation.suite.scenes import SIDE
from spackle.evaluation.suite.values import Found, Row, Target
from spackle.evaluation.table import EMPTY, Line, Table

LIMITS, GPU_LIMITS = "limits", "gpu-limits"
TITLES = {
    LIMITS: "What the processor can do: matrix products, and copies of memory",
    "renderer": "CPU renderer: one view of a scene of SHARP's size",
    "scaling": "CPU renderer: a whole call against the number of Gaussians and of pixels",
    "completion": "Completion of one view of a scene of SHARP's size",
    "photo": "Completion of one view of a real photo with depth (Motorcycle)",
    "video": "A video of a real photo with depth (Motorcycle), as one scene and frame by frame",
    "sharp": "SHARP on the processor: photo to scene",
    "training": "Training of the residual on the processor",
    GPU_LIMITS: "What the GPU can do: matrix products, and copies of memory",
    "gpu-view": "GPU renderer (gsplat): views of a scene of SHARP's size",
    "gpu-completion": "Completion of one view, drawn by the GPU; the network is the processor's",
    "gpu-sharp": "SHARP on the GPU: photo to scene",
    "gpu-training": "Training of the residual on the GPU",
}
COLUMNS = (
    "what",
    "median",
    "quartiles",
    "runs",
    "target",
    "operations at peak",
    "bytes at bandwidth",
    "time over limit",
)
OF_SHARP = "added time of completion, % of SHARP's forward"
SMALL_SHARE = Target(1.0)


def suite_tables(found: Mapping[str, Found], not_run: Mapping[str, str]) -> list[Table]:
    """The targets, a table for each section that was run, and a line for each that was not.

    Args:
        found: by the sections' names.
        not_run: why, by the names of the others.
    """
    return [_targets(found), *(_section(name, found) for name in TITLES if name in found), *_not_run(not_run)]


def targets(found: Mapping[str, Found]) -> list[tuple[str, Row | None]]:
    """What is meant to be reached: each with its row, or None where it was not measured at the size it is meant for."""
    wanted = [
        ("renderer", renderer.CALL),
        ("renderer", renderer.RATIO),
        ("completion", completion.IN_RENDERS),
        ("photo", completion.IN_RENDERS),
        ("video", video.RATIO),
    ]
    rows: list[tuple[str, Row | None]] = []
    for section, name in wanted:
        there = section in found and _full_size(found[section], section)
        rows.append((f"{section}: {name}", found[section].row(name) if there else None))
    return [*rows, (OF_SHARP, _share_of_sharp(found))]


def _full_size(found: Found, section: str) -> bool:
    """Of synthetic scenes and videos only those of the whole size say something."""
    if section == "video":
        return bool(found.facts["frames"] == video.FRAMES)
    return section not in ("renderer", "completion") or found.facts["width"] == SIDE


def _share_of_sharp(found: Mapping[str, Found]) -> Row | None:
    """What completion adds, of SHARP's forward; None where one of them is not known, or not of SHARP's size."""
    if not {"completion", "sharp"} <= set(found) or found["sharp"].facts["side"] != SIDE:
        return None
    if not _full_size(found["completion"], "completion"):
        return None
    forward = found["sharp"].row(sharp.FORWARD).median
    values = found["completion"].row(completion.ADDED).values
    return Row(OF_SHARP, tuple(100 * value / forward for value in values), "%", target=SMALL_SHARE)


def _targets(found: Mapping[str, Found]) -> Table:
    lines = []
    for name, row in targets(found):
        cells = ("not measured", EMPTY, EMPTY) if row is None else (_value(row, row.median), *_target(row))
        lines.append(Line((name, *cells)))
    caption = f"Targets. They are meant for scenes of {SIDE} × {SIDE} pixels and videos of {video.FRAMES} frames."
    return Table("targets", caption, ("what", "median", "target", "reached"), (("", 4),), tuple(lines))


def _section(name: str, found: Mapping[str, Found]) -> Table:
    """A section's table."""
    one = found[name]
    limits = found.get(GPU_LIMITS if one.device == "cuda" else LIMITS)
    peaks = None if limits is None else Peaks.of(limits)
    lines = tuple(_line(row, peaks, _full_size(one, name)) for row in one.rows)
    facts = ", ".join(f"{key} {_fact(value)}" for key, value in one.facts.items() if value is not None)
    return Table(name, f"{TITLES[name]}. {facts}.", COLUMNS, (("", len(COLUMNS)),), lines, notes=tuple(one.notes))


def _not_run(not_run: Mapping[str, str]) -> list[Table]:
    """A line for each section that there is nothing of."""
    lines = tuple(Line((name, TITLES[name], f"not run: {not_run[name]}")) for name in TITLES if name in not_run)
    return (
        [Table("not run", "Sections without figures.", ("section", "what", "why"), (("", 3),), lines)] if lines else []
    )


def _line(row: Row, peaks: Peaks | None, judged: bool) -> Line:
    low, high = row.quartiles
    cells = [row.name, _value(row, row.median), f"{_number(low)} – {_number(high)}", str(len(row.values))]
    cells.append(": ".join(_target(row)) if row.target and judged else EMPTY)
    limits = row_limits(row, peaks)
    if limits is None:
        return Line((*cells, EMPTY, EMPTY, EMPTY))
    operations, memory = limits
    gap = f"{row.median / max(limits):.1f}×" if max(limits) > 0 else EMPTY
    return Line((*cells, f"{_number(operations)} ms", f"{_number(memory)} ms", gap))


def row_limits(row: Row, peaks: Peaks | None) -> tuple[float, float] | None:
    """Milliseconds of the operations at the peak, and of the bytes at the bandwidth; None where nobody counted."""
    return None if peaks is None or row.need is None or row.unit != "ms" else peaks.least_ms(row.need)


def _target(row: Row) -> tuple[str, str]:
    assert row.target is not None
    sign = "≤" if row.target.at_most else "≥"
    return f"{sign} {_number(row.target.value)} {row.unit}", "yes" if row.target.met(row.median) else "no"


def _value(row: Row, value: float) -> str:
    return f"{_number(value)} {row.unit}".rstrip()


def _number(value: float) -> str:
    """Three digits at least, without a power of ten where one can do without."""
    size = abs(value)
    if size >= 100 or value == 0:
        return f"{value:,.0f}"
    return f"{value:.1f}" if size >= 10 else f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def _fact(value: Any) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"{_fact(value[0])} to {_fact(value[-1])}" if value else EMPTY
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
