"""Completing one view, stage by stage, beside the base render of that view."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.device import Precision, pick_dtype
from spackle.evaluation.suite.clock import CPU, TOTAL, Task, measure
from spackle.evaluation.suite.counts import FLOAT, GAUSSIAN, PIXEL, drawing_needs
from spackle.evaluation.suite.fill import (
    CUES,
    NETWORK,
    PLACE,
    REDRAW,
    RENDER,
    HoledView,
    Look,
    check_fill,
    fill,
    find_view,
)
from spackle.evaluation.suite.flops import network_need
from spackle.evaluation.suite.renderer import redraw_need
from spackle.evaluation.suite.values import Found, Need, Row, Target
from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.render.project import KernelCamera
from spackle.residual import CELL, ResidualNet, hole_area_ratio
from spackle.residual.compose import DELTA_CHANNELS
from spackle.residual.network import STRIDE, compile_network, predict_deltas
from spackle.residual.sparse import crops_around

SHARE = 0.05  # of the view's pixels that are holes
STAGES = (CUES, NETWORK, PLACE, REDRAW)
ADDED, IN_RENDERS, SHIELD = "added time: the four stages above", "added time over base render", "photo's shield"
LIGHT = Target(2.0)  # renders of the base alone
CELL_FLOATS = (3 + 1 + 1) + (2 + 1 + 2 + 3) + (3 + 3 + 1)  # of cues, seeds and rim
COMPILED = "network, compiled, around the holes"
UNCOUNTED = f"Of '{CUES}' and '{PLACE}' the bytes alone are counted, not the operations: the true limit is higher."
PRECISIONS: tuple[Precision, ...] = ("fp32", "bf16")


def completion_section(
    runs: int,
    base: Gaussians,
    photo_camera: Camera,
    renderer: Renderer,
    network: ResidualNet | None,
    *,
    share: float = SHARE,
    compiled: bool = False,
    device: torch.device = CPU,
) -> Found:
    """One view at a share of holes.

    Args:
        runs: that count.
        base: the photo's Gaussians.
        photo_camera: the photo's.
        renderer: draws everything.
        network: None: the seeds alone fill the holes.
        share: of the view's pixels that are holes.
        compiled: time the network through `torch.compile`, too.
        device: of the renderer.
    """
    disparity, camera = find_view(base, photo_camera, renderer, share)
    view = HoledView(base, photo_camera, camera, renderer, network)
    shield = view.completer.photo_guard()
    looks, after = check_fill(view, shield)
    tasks: dict[str, Task] = {
        "view": lambda lap: fill(view, shield, lap),
        SHIELD: lambda _: view.completer.photo_guard(),
    }
    times = measure(runs, tasks, device)
    needs = _needs(view, looks)
    rows = [Row(name, times["view", name], need=needs[name]) for name in (RENDER, *STAGES)]
    added = tuple(map(sum, zip(*(times["view", name] for name in STAGES), strict=True)))
    rows.append(Row(ADDED, added, need=functools.reduce(operator.add, (needs[name] for name in STAGES))))
    ratios = tuple(more / render for more, render in zip(added, times["view", RENDER], strict=True))
    rows += [Row(IN_RENDERS, ratios, "×", target=LIGHT), Row(f"{SHIELD}, once a photo", times[SHIELD, TOTAL])]
    variants: tuple[list[Row], list[str]] = ([], ["network: not run: there are no weights, the seeds fill the holes"])
    if network is not None:
        variants = _networks(runs, view, network, looks[0], compiled)
    before = hole_area_ratio(renderer.render(base, camera).alpha)
    facts = {
        "gaussians": len(base),
        "width": camera.width,
        "height": camera.height,
        "disparity": disparity,
        "holes": before,
        "holes_after": hole_area_ratio(after.alpha),
        "added": sum(len(look.new) for look in looks),
        "looks": len(looks),
        "network": None if network is None else str(pick_dtype("auto", CPU)).removeprefix("torch."),
    }
    return Found((*rows, *variants[0]), facts, (UNCOUNTED, *variants[1]), device.type)


def _needs(view: HoledView, looks: list[Look]) -> Mapping[str, Need]:
    """Of each stage, over all looks."""
    camera = view.camera
    cells = -(-camera.width // CELL) * -(-camera.height // CELL)
    needs = {RENDER: functools.reduce(operator.add, drawing_needs([view.base], KernelCamera.of(camera, 0.0)).values())}
    # Each look reads the picture and writes its cells; each new Gaussian is made of its cell's deltas and written.
    needs[CUES] = Need(float(len(looks) * (camera.width * camera.height * PIXEL + cells * (CELL_FLOATS * FLOAT + 1))))
    needs[PLACE] = Need(float(sum(len(look.new) for look in looks) * (DELTA_CHANNELS * FLOAT + GAUSSIAN)))
    needs[NETWORK] = Need()
    if view.network is not None:
        needs[NETWORK] = network_need(
            view.network, functools.partial(_predict, view.network, looks[0], view.precision), _kind(view.precision)
        )
    there, drawn = [view.base], Need()
    for look in looks:
        drawn = drawn + redraw_need(there, [look.new], camera, look.tiles)
        there.append(look.new)
    return needs | {REDRAW: drawn}


def _networks(
    runs: int, view: HoledView, network: ResidualNet, look: Look, compiled: bool
) -> tuple[list[Row], list[str]]:
    """The network alone in both precisions, over the whole picture and around the holes."""
    calls: dict[str, tuple[Precision, Callable[[], object]]] = {}
    for precision in PRECISIONS:
        for dense, where in ((True, "whole picture"), (False, "around the holes")):
            call = functools.partial(_predict, network, look, precision, dense)
            calls[f"network, {precision}, {where}"] = (precision, call)
    needs = {name: network_need(network, call, _kind(precision)) for name, (precision, call) in calls.items()}
    whole = look.cues.mask.numel()
    seen = sum(outer.area for _, outer in crops_around(look.cues.mask, STRIDE))
    notes = [f"Around the holes the network looks at {seen:,} of {whole:,} cells ({seen / whole:.0%})."]
    if compiled:
        try:
            call = functools.partial(_predict, compile_network(network), look, view.precision)
            call()
            calls[COMPILED] = (view.precision, call)
            needs[COMPILED] = needs[f"network, {_kind(view.precision)}, around the holes"]
        except RuntimeError as error:  # no compiler, or one that cannot do it
            notes.append(f"{COMPILED}: not run: {(str(error).strip().splitlines() or ['?'])[0][:200]}")
    else:
        notes.append(f"{COMPILED}: not run: not asked for (--compile)")
    times = measure(runs, {name: lambda _, call=call: call() for name, (_, call) in calls.items()})  # type: ignore[misc]
    return [Row(name, times[name, TOTAL], need=needs[name]) for name in calls], notes


def _predict(network: ResidualNet, look: Look, precision: Precision, dense: bool = False) -> Tensor:
    assert look.rim is not None
    return predict_deltas(network, look.cues, look.seeds, look.rim, precision, dense=dense)


def _kind(precision: Precision) -> str:
    return "bf16" if pick_dtype(precision, CPU) == torch.bfloat16 else "fp32"
