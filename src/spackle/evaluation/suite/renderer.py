"""The CPU renderer: its stages, a whole call, the naive loop beside it, and a few sets on a remembered drawing."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.evaluation.suite.clock import TOTAL, Lap, Times, measure
from spackle.evaluation.suite.counts import PIXEL, drawing_needs
from spackle.evaluation.suite.naive import naive_render
from spackle.evaluation.suite.scenes import SIDE, photo_scene
from spackle.evaluation.suite.values import Found, Need, Row, Target
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer, touched_tiles
from spackle.render.binning import list_tiles, sort_by_depth
from spackle.render.pipeline import Canvas, blend, project, wanted_tiles
from spackle.render.project import KernelCamera
from spackle.render.protocol import Rendering

STAGES = ("project", "sort", "bin", "blend")
CALL, RATIO = "whole call: RGB, depth, alpha", "naive over ours"
CALL_MS, FASTER = Target(400.0), Target(2.2, at_most=False)
ADDED, SETS = 0.05, 3  # a band of the picture this wide, in so many sets, is what is drawn on top
SAME = 1e-5  # of the two renderers' mean difference


def renderer_section(runs: int, side: int = SIDE) -> Found:
    """Everything about drawing one view of a scene of SHARP's size."""
    scene, camera = photo_scene(side)
    check_twins(scene, camera)
    times = measure(
        runs,
        {
            "ours": lambda lap: stages(scene, camera, lap),
            "call": lambda _: CpuRenderer().render(scene, camera),
            "naive": lambda lap: naive_render(scene, camera, lap),
        },
    )
    needs = drawing_needs([scene], KernelCamera.of(camera, 0.0))
    rows = [Row(stage, times["ours", stage], need=needs[stage]) for stage in STAGES]
    whole = functools.reduce(operator.add, needs.values())
    rows.append(Row(CALL, times["call", TOTAL], need=whole, target=CALL_MS))
    rows += [Row(f"naive: {stage}", times["naive", stage]) for stage in STAGES]
    rows.append(Row("naive: whole call", times["naive", TOTAL]))
    pairs = zip(times["naive", TOTAL], times["call", TOTAL], strict=True)
    rows.append(Row(RATIO, tuple(naive / ours for naive, ours in pairs), "×", target=FASTER))
    redrawn, facts = _redrawing(runs, scene, camera)
    return Found((*rows, *redrawn), {"gaussians": len(scene), "width": camera.width, "height": camera.height, **facts})


def stages(scene: Gaussians, camera: Camera, lap: Lap) -> None:
    """What `spackle.render.pipeline.draw` does, step by step."""
    view = KernelCamera.of(camera, 0.0)
    wanted = wanted_tiles(view, None)
    canvas = Canvas.prepare(view, None, False)
    splats, spans = project([scene], view, wanted)
    lap("project")
    order = sort_by_depth(splats.keys, splats.ids, spans)
    lap("sort")
    lists = list_tiles(order, splats.boxes, wanted)
    lap("bin")
    blend(splats, lists, wanted, canvas)
    lap("blend")


def check_twins(scene: Gaussians, camera: Camera) -> None:
    """RuntimeError where the two do not draw the same: a comparison would mean nothing."""
    difference = float((CpuRenderer().render(scene, camera).rgb - naive_render(scene, camera)).abs().mean())
    if not difference < SAME:
        raise RuntimeError(f"the two renderers disagree: rgb differs by {difference} on average")


def _redrawing(runs: int, scene: Gaussians, camera: Camera) -> tuple[list[Row], dict[str, int]]:
    """A few sets more: on the drawing that the renderer remembers, in their tiles anew, and all of it anew."""
    more = band(scene, camera)
    tiles = torch.stack([touched_tiles(part, camera) for part in more]).any(0)
    keeper = CpuRenderer()
    under = keeper.render(scene, camera)
    sets = [scene, *more]

    def redraw(renderer: CpuRenderer) -> Rendering:
        return renderer.render(sets, camera, tiles=tiles, onto=under)

    if not torch.equal(redraw(keeper).rgb, redraw(CpuRenderer()).rgb):
        raise RuntimeError("a remembered drawing and a new one differ")
    calls: dict[str, Callable[[], Rendering]] = {
        "remembered": lambda: redraw(keeper),
        "anew": lambda: redraw(CpuRenderer()),
        "all": lambda: CpuRenderer().render(sets, camera),
    }
    times: Times = measure(runs, {name: lambda _, call=call: call() for name, call in calls.items()})  # type: ignore[misc]
    need = redraw_need([scene], more, camera, tiles)
    pairs = zip(times["anew", TOTAL], times["remembered", TOTAL], strict=True)
    rows = [
        Row("redraw with a few sets more, remembered", times["remembered", TOTAL], need=need),
        Row("redraw of the same tiles, anew", times["anew", TOTAL]),
        Row("redraw of all tiles, anew", times["all", TOTAL]),
        Row("same tiles anew over remembered", tuple(anew / kept for anew, kept in pairs), "×"),
    ]
    return rows, {"redraw_sets": len(more), "redraw_gaussians": sum(map(len, more)), "redraw_tiles": int(tiles.sum())}


def band(scene: Gaussians, camera: Camera) -> list[Gaussians]:
    """Copies of the Gaussians in an upright band in the middle of the picture, in a few sets."""
    u = camera.project(scene.means)[0][:, 0] / camera.width
    edges = [0.5 - ADDED / 2 + ADDED * k / SETS for k in range(SETS + 1)]
    return [scene.select((u >= edges[k]) & (u < edges[k + 1])) for k in range(SETS)]


def redraw_need(there: list[Gaussians], more: list[Gaussians], camera: Camera, tiles: Tensor) -> Need:
    """What is new is projected, sorted and dealt out; the wanted tiles are blended, all others copied."""
    view, wanted = KernelCamera.of(camera, 0.0), tiles.numpy()
    new = drawing_needs(more, view, wanted)
    blended = drawing_needs([*there, *more], view, wanted)["blend"]
    copied = Need(2.0 * PIXEL * camera.width * camera.height)
    return new["project"] + new["sort"] + new["bin"] + blended + copied
