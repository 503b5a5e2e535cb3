"""What a GPU draws."""

from __future__ import annotations

from collections.abc import Callable

import torch

from spackle.camera_path import DepthRange, trajectory
from spackle.evaluation.suite.clock import TOTAL, measure
from spackle.evaluation.suite.scenes import SIDE, photo_scene
from spackle.evaluation.suite.values import Found, Row
from spackle.render import GsplatRenderer

BATCH = 4
VIEW, VIEWS, HOME = "one view", f"{BATCH} views in one call", "one view, images back on the processor"
DISPARITY = 0.3


def gpu_view_section(runs: int, renderer: GsplatRenderer, side: int = SIDE) -> Found:
    """A view of a scene of SHARP's size that lies on the GPU; and several at once; and one of Gaussians in main memory.

    Args:
        runs: that count.
        renderer: on its own device.
        side: of the scene's picture.
    """
    scene, camera = photo_scene(side)
    there = scene.to(renderer.device)
    cameras = trajectory("swipe", camera, DISPARITY, DepthRange.of(scene), BATCH)
    calls: dict[str, Callable[[], object]] = {
        VIEW: lambda: renderer.render(there, camera),
        VIEWS: lambda: renderer.render_batch(there, cameras),
        HOME: lambda: renderer.render(scene, camera),
    }
    with torch.no_grad():
        times = measure(runs, {name: lambda _, call=call: call() for name, call in calls.items()}, renderer.device)  # type: ignore[misc]
    rows = [Row(name, times[name, TOTAL]) for name in calls]
    rows.append(Row(f"a view, of {BATCH} in one call", tuple(ms / BATCH for ms in times[VIEWS, TOTAL])))
    note = "Nobody counted what gsplat's kernels need at least."
    return Found(tuple(rows), {"gaussians": len(scene), "width": side, "height": side}, (note,), renderer.device.type)
