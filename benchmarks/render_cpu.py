"""How long the CPU renderer takes for a scene of the size that a photo gives, stage by stage.

    python benchmarks/render_cpu.py [--runs N] [--json FILE] [--only SECTION ...]

The first section is that of `spackle bench --suite`, without the machine's limits beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from spackle.evaluation.suite.clock import Lap, Task, measure
from spackle.evaluation.suite.renderer import renderer_section
from spackle.evaluation.suite.scenes import SIDE, photo_scene
from spackle.evaluation.suite.values import Row
from spackle.gaussians import Gaussians
from spackle.machine import hardware, versions
from spackle.render import CpuRenderer

AUX = 32768  # Gaussians that want gradients, over a frozen base

Rows = list[Row]


def forward_section(runs: int) -> Rows:
    """The renderer's stages, a call of it, a naive renderer beside it, and a few sets on a remembered drawing."""
    return list(renderer_section(runs).rows)


def backward_section(runs: int) -> Rows:
    """Gradients for every Gaussian, and for a few over a frozen base."""
    scene, camera = photo_scene()
    middle = len(scene) // 4
    few = scene.select(slice(middle, middle + AUX))

    def task(frozen: Gaussians, learned: Gaussians) -> Task:
        leaf = Gaussians(*(t.clone().requires_grad_() for t in learned.tensors))

        def stages(lap: Lap) -> None:
            view = CpuRenderer().render([frozen, leaf], camera)
            lap("forward")
            loss = view.rgb.sum() + view.depth.sum() + view.alpha.sum()
            torch.autograd.grad(loss, leaf.tensors)
            lap("backward")

        return stages

    times = measure(runs, {"all": task(Gaussians.empty(), scene), "few": task(scene, few)})
    return [Row(f"{name}: {stage}", values) for (name, stage), values in times.items()]


def compile_section(runs: int) -> Rows:
    """The first call in a fresh process, imports excluded: with an empty compile cache, and with a full one."""
    del runs  # one is enough
    code = """if True:
        import time, torch
        from spackle.camera import Camera
        from spackle.gaussians import Gaussians
        from spackle.render import CpuRenderer
        shapes = ((9, 3), (9, 4), (9, 3), (9,), (9, 3))
        scene = Gaussians(*(torch.rand(shape).requires_grad_() for shape in shapes))
        start = time.perf_counter()
        CpuRenderer().render(scene.detach(), Camera.from_focal(50.0, 40, 40))
        middle = time.perf_counter()
        CpuRenderer().render(scene, Camera.from_focal(50.0, 40, 40)).rgb.sum().backward()
        print(1e3 * (middle - start), 1e3 * (time.perf_counter() - middle))
    """
    rows: Rows = []
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold", "warm"):
            environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
            output = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
            forward, backward = map(float, output.stdout.split())
            rows += [Row(f"{name}: forward", (forward,)), Row(f"{name}: backward", (backward,))]
    return rows


SECTIONS: dict[str, Callable[[int], Rows]] = {
    "forward": forward_section,
    "backward": backward_section,
    "compile": compile_section,
}


def main() -> None:
    """Run the sections, print a table, and write it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7, help="timed runs, of which the median counts")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="sections to run")
    arguments = parser.parse_args()
    machine = {**hardware(torch.device("cpu")), **versions()}
    report: dict[str, Any] = {"machine": machine, "runs": arguments.runs}
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    print(f"{SIDE * SIDE // 2:,} Gaussians, {SIDE}×{SIDE} pixels, {arguments.runs} runs, milliseconds")
    for name in arguments.only:
        rows = SECTIONS[name](arguments.runs)
        report[name] = {row.name: {"median": row.median, "best": min(row.values), "unit": row.unit} for row in rows}
        print(f"\n{name}: {SECTIONS[name].__doc__}\n{'median':>54}{'best':>10}")
        for row in rows:
            print(f"  {row.name:<42}{row.median:>10.1f}{min(row.values):>10.1f} {'' if row.unit == 'ms' else row.unit}")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
