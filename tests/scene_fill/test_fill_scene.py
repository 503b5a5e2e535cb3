"""Completion: of one view, and of a path by one set of aux Gaussians, whichever frames are looked at."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from holes import CPU, box_view, random_network
from scenes import (
    away,
    box_before_wall,
    motorcycle,
    motorcycle_base,
    psnr,
    same_bits,
    shifted,
    wall,
)
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import DepthRange, TrajectoryKind, extremes, trajectory
from spackle.color import to_bytes
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer, touched_tiles
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet, ViewFeatures, hole_area_ratio, hole_mask, make_seeds
from spackle.residual.base_values import Seeds
from spackle.residual.rim import find_rim
from spackle.scene_fill import FillContext, OcclusionGuard, fill, fill_scene, fill_view
from spackle.scene_fill.fill import CLOSED_HAR, WIDEST
from spackle.scene_fill.occlusion_guard import push_behind
from spackle.scene_fill.rim_underlay import COARSE, REACH_CELLS, rim_underlay
from spackle.scene_fill.view_order import farthest_first

FRAMES = 60


def holes_of(camera: Camera, *gaussians: Gaussians) -> float:
    return hole_area_ratio(CPU.render(list(gaussians), camera).alpha)


def path_of(
    context: FillContext, kind: TrajectoryKind = "rotate-forward", disparity: float = 0.3, frames: int = FRAMES
) -> list[Camera]:
    return trajectory(kind, context.photo_camera, disparity, DepthRange.of(context.base), frames)


@pytest.mark.parametrize("network", [False, True])
def test_a_completed_view_is_that_of_drawing_everything(network: bool) -> None:
    context, camera = box_view(0.4)
    context = dataclasses.replace(context, network=random_network() if network else None)
    filled = fill_view(context, camera)
    assert len(filled.aux) > 100
    assert same_bits(filled.rendering, CPU.render([context.base, filled.aux], camera))
    again = fill_view(context, camera, [context.photo_guard()], CPU.render(context.base, camera))
    assert same_bits(again.aux, filled.aux)


@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
@pytest.mark.parametrize("network", [False, True])
@pytest.mark.parametrize("empty", [False, True])
def test_a_view_of_nothing_at_all_becomes_a_wall(size: tuple[int, int], network: bool, empty: bool) -> None:
    scene = wall(4.0, *size)
    base, camera = (Gaussians.empty(), scene.camera) if empty else (scene.base(), away(scene.camera))
    context = FillContext(base, scene.camera, CPU, ResidualNet() if network else None)
    assert holes_of(camera, base) == 1
    aux = fill_view(context, camera).aux
    assert all(bool(t.isfinite().all()) for t in aux.tensors)
    assert holes_of(camera, base, aux) < 0.01


def test_the_widest_view_comes_first_and_a_beginning_is_spread() -> None:
    camera = Camera.from_focal(50, 40, 30)
    order = farthest_first([shifted(camera, x) for x in (-1.0, -0.2, 0.0, 0.6, 1.1)], camera)
    assert order == [4, 0, 3, 1, 2]  # the photo's own place counts as visited
    assert sorted(farthest_first([camera] * 3, camera)) == [0, 1, 2]


def test_no_aux_gaussian_of_a_scene_hides_the_photo() -> None:
    context, _ = box_view()
    path = path_of(context, "shake", frames=8)
    aux = fill_scene(context, path).aux
    assert same_bits(fill_scene(context, path).aux, aux)
    assert len(fill_scene(context, []).aux) == len(fill_scene(context, [], exact=True).aux) == 0
    depth = box_before_wall().depth
    uv, z = context.photo_camera.project(aux.means)
    x, y = uv.floor().long().unbind(-1)
    inside = (z > 0) & (x >= 0) & (x < 96) & (y >= 0) & (y < 72)
    assert int(inside.sum()) > 100
    assert bool((z[inside] > depth[y[inside], x[inside]] * 1.0005).all())


FAR = torch.device("meta")


class FarGaussians(Gaussians):
    """Gaussians on the renderer's device, as far as a machine with one device can tell."""


class FarRendering(Rendering):
    """A view on the renderer's device."""


class FarRenderer:
    """Draws what lies on its device, and nothing else."""

    device = FAR

    def render(
        self, sets: Gaussians | Sequence[Gaussians], camera: Camera, *, onto: Any = None, tiles: Any = None
    ) -> FarRendering:
        sets = [sets] if isinstance(sets, Gaussians) else sets
        assert all(isinstance(part, FarGaussians) for part in sets)
        assert onto is None or isinstance(onto, FarRendering)
        return FarRendering(*CPU.render(sets, camera, tiles=tiles, onto=onto).tensors)

    def touched_tiles(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        assert isinstance(gaussians, FarGaussians)
        return touched_tiles(gaussians, camera)


def test_images_travel_down_once_and_gaussians_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    subject, camera = box_view(0.3)
    path = path_of(subject, "swipe", frames=3)
    expected = [fill_view(subject, camera).aux, fill_scene(subject, path).aux]
    moved: list[object] = []

    def to(value: Any, device: torch.device) -> Any:
        kind = Gaussians if isinstance(value, Gaussians) else Rendering
        far = {Gaussians: FarGaussians, Rendering: FarRendering}[kind]
        if isinstance(value, far) == (device == FAR):
            return value
        moved.append(value)
        return (far if device == FAR else kind)(*value.tensors)

    for kind in (Gaussians, Rendering):
        monkeypatch.setattr(kind, "to", to)
    subject = dataclasses.replace(subject, renderer=FarRenderer())
    for found, wanted in zip((fill_view(subject, camera).aux, fill_scene(subject, path).aux), expected, strict=True):
        assert same_bits(found, wanted)
    assert len({id(value) for value in moved}) == len(moved) > 10
    assert sum(value is subject.base for value in moved) == 1


Wide = tuple[FillContext, int, Rendering, Gaussians, Gaussians]


def subject() -> FillContext:
    return box_view(width=160, height=120)[0]


@pytest.fixture(scope="module")
def wide() -> Wide:
    """A wide view of a path, what it shows, and what fills and surrounds its holes."""
    context = subject()
    path = path_of(context)
    index = farthest_first(path, context.photo_camera)[0]
    before = CPU.render(context.base, path[index])
    cues = ViewFeatures.of(before)
    assert 0.1 < float(cues.mask.float().mean()) < 0.5
    filling = fill_view(context, path[index], [], before).aux
    seeds = make_seeds(cues, path[index], context.photo_camera)
    return context, index, before, filling, rim_underlay(cues.mask, seeds, path[index])


def test_what_lies_beneath_a_rim_is_hidden_from_its_own_view(wide: Wide) -> None:
    context, index, before, filling, beneath = wide
    camera = path_of(context)[index]
    assert len(beneath) > 100
    without = CPU.render([context.base, filling], camera)
    both = CPU.render([context.base, filling, beneath], camera)
    seen = ~hole_mask(before.alpha)
    assert psnr(both.rgb[seen], before.rgb[seen]) >= 48
    assert psnr(both.rgb, without.rgb) >= 45
    # It lies around the holes and nowhere in them.
    mask = ViewFeatures.of(before).mask
    uv, z = camera.project(beneath.means)
    column, row = (uv / 2).floor().long().unbind(-1)
    assert bool((z > 0).all())
    assert not bool(mask[row, column].any())
    near = [mask[max(y - REACH_CELLS, 0) : y + REACH_CELLS + 1, max(x - REACH_CELLS, 0) : x + REACH_CELLS + 1]
            for y, x in zip(row.tolist(), column.tolist(), strict=True)]  # fmt: skip
    assert all(bool(part.any()) for part in near)
    assert bool((row % COARSE == 0).all() and (column % COARSE == 0).all())


def test_the_underlay_closes_holes_of_neighbouring_views(
    wide: Wide,
) -> None:
    context, index, before, filling, beneath = wide
    path = path_of(context)
    beside = [path[index + step] for step in (-8, -4, 4, 8)]
    without, both = (
        sum(holes_of(camera, context.base, *aux) for camera in beside) / 4 for aux in ((filling,), (filling, beneath))
    )
    assert without > 1e-4
    assert both < 0.5 * without
    alone = fill_view(context, path[index], rendering=before).aux
    assert same_bits(fill_scene(context, [path[index]], exact=True).aux, alone)
    assert len(fill_scene(context, [path[index]] * 2, exact=True).aux) > len(alone)


def test_an_underlay_covers_nothing_beyond_the_photos_border() -> None:
    found = motorcycle_base()
    context = FillContext(found.gaussians, found.camera, CPU)
    turned = path_of(context)[44]
    left, _ = extremes(found.camera, 0.3, DepthRange.of(context.base))
    filled = fill_view(context, turned)
    first, view = filled.aux, filled.rendering
    guards = [context.photo_guard(), OcclusionGuard.of(view, turned)]
    stage = fill._Stage(context)
    stage.add(first)
    before = stage.look(left)
    added, beneath, without = fill._fill(context, stage, before, left, guards, CLOSED_HAR, beneath=True)
    hidden = [push_behind(rims, left.position, guards) for rims in beneath]
    assert sum(map(len, hidden)) > 1000
    both = CPU.render([context.base, first, *added, *hidden], left)
    cues = ViewFeatures.of(before)
    beyond = find_rim(cues, make_seeds(cues, left, found.camera), left, found.camera)[0].beyond
    beyond = beyond.repeat_interleave(2, 0).repeat_interleave(2, 1)[: left.height, : left.width]
    assert int(beyond.sum()) > 10_000
    assert float((both.rgb - without.rgb)[beyond].abs().max()) < 0.02


def test_no_underlay_is_seen_in_the_other_widest_views_holes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    green = torch.tensor([0.0, 1.0, 0.0])

    def painted(mask: Tensor, seeds: Seeds, camera: Camera) -> Gaussians:
        rims = rim_underlay(mask, seeds, camera)
        return dataclasses.replace(rims, colors=green.expand_as(rims.colors).contiguous())

    monkeypatch.setattr(fill, "rim_underlay", painted)
    scene = box_before_wall()
    pole = torch.zeros_like(scene.depth, dtype=torch.bool)
    pole[:, 44:54] = True
    scene = dataclasses.replace(scene, depth=torch.where(pole, 2.0, 6.0))
    context = FillContext(scene.base(), scene.camera, CPU)
    sides = extremes(scene.camera, 0.3, DepthRange.of(context.base))
    aux = fill_scene(context, sides, exact=True).aux
    assert int((aux.colors == green).all(-1).sum()) > 20
    shown = [CPU.render([context.base, aux], camera).rgb for camera in sides]
    holes = [hole_mask(CPU.render(context.base, camera).alpha) for camera in sides]
    found = torch.cat([rgb[hole] for rgb, hole in zip(shown, holes, strict=True)])
    assert len(found) > 5000
    assert float((found[:, 1] > found[:, ::2].amax(-1)).float().mean()) < 0.01


class Counting(CpuRenderer):
    """A renderer that keeps the cameras that whole pictures are taken by."""

    def __init__(self) -> None:
        super().__init__()
        self.cameras: list[Camera] = []

    def render(self, gaussians: Gaussians | Sequence[Gaussians], camera: Camera, **part: Any) -> Rendering:
        if part.get("tiles") is None:
            self.cameras.append(camera)
        return CPU.render(gaussians, camera, **part)


@pytest.mark.parametrize(("kind", "most"), [("rotate-forward", 30), ("rotate", 60), ("swipe", 20)])
def test_few_frames_are_checked_and_all_are_closed(kind: TrajectoryKind, most: int) -> None:
    counting = Counting()
    context = dataclasses.replace(subject(), renderer=counting)
    path = path_of(context, kind)
    calls: list[tuple[int, int]] = []
    sides = extremes(context.photo_camera, 0.3, DepthRange.of(context.base))  # as the command line adds them
    filled = fill_scene(context, [*path, *sides], progress=lambda done, total: calls.append((done, total)))
    aux, seen = filled.aux, filled.pictures
    assert len(counting.cameras) <= most + 2  # the photo, the widest, and those that were looked at
    assert calls == [(k, FRAMES + 2) for k in range(1, FRAMES + 3)]
    assert len(seen) > 3
    for index, picture in seen.items():  # as the finished scene is drawn, bit for bit
        assert torch.equal(picture, to_bytes(CPU.render([context.base, aux], [*path, *sides][index]).rgb))
    left = [holes_of(camera, context.base, aux) for camera in (*path, *sides)]
    assert max(left) <= 2e-3
    assert sum(left) / len(left) <= 5e-4
    for index in farthest_first(path, context.photo_camera)[:WIDEST]:
        before, after = CPU.render(context.base, path[index]), CPU.render([context.base, aux], path[index])
        shown = ~hole_mask(before.alpha)
        assert psnr(after.rgb[shown], before.rgb[shown]) >= 45
    counting.cameras.clear()
    fill_scene(context, path[::5], exact=True)  # no view of an exact path is skipped
    assert all(any(camera is seen for seen in counting.cameras) for camera in path[::5])


def test_motorcycle_is_closed_and_nothing_that_was_seen_changes() -> None:
    pair, found = motorcycle(), motorcycle_base()
    context = FillContext(found.gaussians, found.camera, CPU)
    aux = fill_view(context, pair.right).aux
    before, after = CPU.render(context.base, pair.right), CPU.render([context.base, aux], pair.right)
    assert hole_area_ratio(before.alpha) > 0.08
    assert hole_area_ratio(after.alpha) <= 0.03 * hole_area_ratio(before.alpha)
    hole = hole_mask(before.alpha)
    assert psnr(after.rgb[hole], pair.right_rgb[hole]) >= 16.3
    assert psnr(after.rgb[~hole], pair.right_rgb[~hole]) >= psnr(before.rgb[~hole], pair.right_rgb[~hole]) - 0.1
    photo = CPU.render(context.base, found.camera)
    whole = fill_scene(context, path_of(context, "swipe", frames=5)).aux
    for new in (aux, whole):
        assert psnr(CPU.render([context.base, new], found.camera).rgb, photo.rgb) >= 45
    for camera in extremes(found.camera, 0.3, DepthRange.of(context.base)):
        holes = holes_of(camera, context.base)
        assert holes > 0.2
        assert holes_of(camera, context.base, whole) <= 0.03 * holes
