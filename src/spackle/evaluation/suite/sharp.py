"""SHARP: a photo to a scene on disk, stage by stage."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric, to_processor
from spackle.evaluation.suite.clock import CPU, TOTAL, Lap, measure
from spackle.evaluation.suite.counts import GAUSSIAN
from spackle.evaluation.suite.flops import counted
from spackle.evaluation.suite.scenes import picture
from spackle.evaluation.suite.values import Found, Need, Row
from spackle.formats import save_ply
from spackle.image import Photo

FORWARD, UNPROJECT, SAVE, WHOLE = "forward", "unprojection", "save as PLY", "photo to scene"
COMPILED = f"{FORWARD}, compiled"
DELTAS = 4 * 14  # bytes
UNCOUNTED = f"Of '{UNPROJECT}' and '{SAVE}' the bytes alone are counted, not the operations."


def sharp_section(
    runs: int, base: SharpBase, device: torch.device = CPU, *, compiled: bool = False, windows: Sequence[int] = ()
) -> Found:
    """One photo, whose time does not depend on what it shows; a first run, in which operations are counted, is no run.

    Args:
        runs: that count.
        base: loaded.
        device: where it lies.
        compiled: time its forward through `torch.compile`, too.
        windows: time its forward with so many windows at once, too.
    """
    side = base.network.config.side
    photo = Photo(picture(side), 1.2 * side, "", Path("photo.png"))
    weights = sum(p.numel() * p.element_size() for p in base.network.parameters())
    count = 0

    def whole(lap: Lap) -> None:
        nonlocal count
        output = base.look(photo)
        lap(FORWARD)
        gaussians = to_processor(to_metric(output, photo))
        count = len(gaussians)
        lap(UNPROJECT)
        with tempfile.TemporaryDirectory() as folder:
            save_ply(gaussians, Path(folder) / "scene.ply", camera=photo.camera)
        lap(SAVE)

    operations = counted(
        lambda: whole(lambda name: None)
    )  # those of the network: what follows has no products to speak of
    variants, notes = _variants(base, photo, compiled, windows)
    looks = {name: lambda _, one=one: one.look(photo) for name, one in variants.items()}
    times = measure(runs, {"sharp": whole, **looks}, device, warm=True)
    needs = {
        FORWARD: Need(float(weights), {base.precision: operations}),
        UNPROJECT: Need(float(count * (DELTAS + GAUSSIAN + GAUSSIAN))),
        SAVE: Need(float(2 * count * GAUSSIAN)),
    }
    rows = [Row(name, times["sharp", name], need=need) for name, need in needs.items()]
    rows.append(Row(WHOLE, times["sharp", TOTAL]))
    rows += [Row(name, times[name, TOTAL], need=needs[FORWARD]) for name in variants]
    facts = {"weights": base.weights, "precision": base.precision, "side": side, "windows": base.windows}
    return Found(tuple(rows), {**facts, "gaussians": count}, (UNCOUNTED, *notes), device.type)


def _variants(
    base: SharpBase, photo: Photo, compiled: bool, windows: Sequence[int]
) -> tuple[dict[str, SharpBase], list[str]]:
    """The same network run in other ways; what takes its time once has taken it."""
    found = {f"{FORWARD}, {count} windows at once": SharpBase(base.network, windows=count) for count in windows}
    if compiled:
        found[COMPILED] = SharpBase(base.network, windows=base.windows, compiled=True)
    for one in found.values():
        one.look(photo)
    problem = found[COMPILED].compile_problem if compiled else "not asked for (--compile)"
    if not problem:
        return found, []
    return {name: one for name, one in found.items() if name != COMPILED}, [f"{COMPILED}: not run: {problem}"]
