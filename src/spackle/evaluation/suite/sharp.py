"""SHARP: a photo to a scene on disk, stage by stage."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch

from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric
from spackle.evaluation.suite.clock import CPU, TOTAL, Lap, measure
from spackle.evaluation.suite.counts import GAUSSIAN
from spackle.evaluation.suite.flops import counted
from spackle.evaluation.suite.scenes import picture
from spackle.evaluation.suite.values import Found, Need, Row
from spackle.formats import save_ply
from spackle.image import Photo

FORWARD, UNPROJECT, SAVE, WHOLE = "forward", "unprojection", "save as PLY", "photo to scene"
DELTAS = 4 * 14  # bytes
UNCOUNTED = f"Of '{UNPROJECT}' and '{SAVE}' the bytes alone are counted, not the operations."


def sharp_section(runs: int, base: SharpBase, device: torch.device = CPU) -> Found:
    """One photo, whose time does not depend on what it shows; a first run, in which operations are counted, is no run.

    Args:
        runs: that count.
        base: loaded.
        device: where it lies.
    """
    side = base.network.config.side
    photo = Photo(picture(side), 1.2 * side, "", Path("photo.png"))
    weights = sum(p.numel() * p.element_size() for p in base.network.parameters())
    count = 0

    def whole(lap: Lap) -> None:
        nonlocal count
        output = base.look(photo)
        lap(FORWARD)
        gaussians = to_metric(output, photo).to("cpu")
        count = len(gaussians)
        lap(UNPROJECT)
        with tempfile.TemporaryDirectory() as folder:
            save_ply(gaussians, Path(folder) / "scene.ply", camera=photo.camera)
        lap(SAVE)

    operations = counted(
        lambda: whole(lambda name: None)
    )  # those of the network: what follows has no products to speak of
    times = measure(runs, {"sharp": whole}, device, warm=True)
    needs = {
        FORWARD: Need(float(weights), {base.precision: operations}),
        UNPROJECT: Need(float(count * (DELTAS + GAUSSIAN + GAUSSIAN))),
        SAVE: Need(float(2 * count * GAUSSIAN)),
    }
    rows = [Row(name, times["sharp", name], need=need) for name, need in needs.items()]
    rows.append(Row(WHOLE, times["sharp", TOTAL]))
    facts = {"weights": base.weights, "precision": base.precision, "side": side, "gaussians": count}
    return Found(tuple(rows), facts, (UNCOUNTED,), device.type)
