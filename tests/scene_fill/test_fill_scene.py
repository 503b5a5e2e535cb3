"""Completion of one view, and of a path with one set of aux Gaussians."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from helpers.holes import CPU, box_view, random_network
from helpers.scenes import (
    away,
    box_before_wall,
    motorcycle,
    motorcycle_base,
    psnr,
    same_bits,
    shifted,
    wall,
)

from spackle.core.camera import Camera
from spackle.core.color import to_uint8
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import (
    DepthRange,
    TrajectoryKind,
    leftmost_and_rightmost,
    trajectory_cameras,
)
from spackle.pipeline import complete
from spackle.render import CpuRenderer
from spackle.render.protocol import Rendering
from spackle.residual import ViewFeatures, completion, hole_area_ratio, hole_mask, initialize
from spackle.residual.initializer import inside_photo
from spackle.scene_fill import FillContext, fill, fill_scene, fill_view
from spackle.scene_fill.fill import GUARDED_VIEWS, farthest_first, view_differences
from spackle.scene_fill.texture import group_by_cell
from spackle.scene_fill.underlay import UNDERLAY_REACH_CELLS, UNDERLAY_STRIDE, rim_underlay
from spackle.scene_fill.unet import UNet

FRAMES = 60


def holes_of(camera: Camera, *gaussians: Gaussians) -> float:
    return hole_area_ratio(CPU.render(list(gaussians), camera).alpha)


def path_of(
    context: FillContext,
    kind: TrajectoryKind = "rotate-forward",
    disparity: float = 0.3,
    frames: int = FRAMES,
) -> list[Camera]:
    return trajectory_cameras(
        kind, context.photo_camera, disparity, DepthRange.of(context.base, is_metric=True), frames
    )


def order_of(cameras: list[Camera], photo_camera: Camera, near_depth: float) -> list[int]:
    """The views' indices in the order in which a fill visits them."""
    return farthest_first(view_differences([*cameras, photo_camera], photo_camera, near_depth))


def turned_right(camera: Camera, degrees: float, right: float = 0.0) -> Camera:
    """The camera moved to the right, and turned to the right."""
    angle = math.radians(degrees)
    eye = torch.tensor([right, 0.0, 0.0])
    direction = torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    return camera.looking(eye, eye + direction)


@pytest.mark.parametrize("network", [False, True])
def test_a_completed_view_equals_a_full_rendering(network: bool) -> None:
    context, camera = box_view(0.4)
    context = dataclasses.replace(context, network=random_network() if network else None)
    filled = fill_view(context, camera)
    assert len(filled.aux) > 100
    assert same_bits(filled.rendering, CPU.render([context.base, filled.aux], camera))
    again = fill_view(context, camera, [context.photo_guard()], CPU.render(context.base, camera))
    assert same_bits(again.aux, filled.aux)


@pytest.mark.parametrize(("size", "network"), [((64, 48), False), ((63, 47), True)])
@pytest.mark.parametrize("empty", [False, True])
def test_an_empty_view_is_filled_with_a_wall(
    size: tuple[int, int], network: bool, empty: bool
) -> None:
    scene = wall(4.0, *size)
    base, camera = (
        (Gaussians.empty(), scene.camera) if empty else (scene.base(), away(scene.camera))
    )
    aux = fill_view(FillContext(base, scene.camera, CPU, UNet() if network else None), camera).aux
    assert holes_of(camera, base) == 1
    assert all(bool(t.isfinite().all()) for t in aux.tensors)
    assert holes_of(camera, base, aux) < 0.01


def test_the_order_of_views() -> None:
    camera = Camera.from_focal(50, 40, 30)
    views = [shifted(camera, x) for x in (-1.0, -0.2, 0.0, 0.6, 1.1)]
    assert order_of(views, camera, 1.0) == [4, 0, 3, 1, 2]  # the photo's camera counts
    assert sorted(order_of([camera] * 3, camera, 1.0)) == [0, 1, 2]


def test_views_from_one_eye_are_ordered_by_what_they_show() -> None:
    camera = Camera.from_focal(50, 40, 30)
    turned = [turned_right(camera, degrees) for degrees in (1.0, 2.0, 30.0, 29.0, 0.0)]
    assert order_of(turned, camera, 1.0) == [2, 1, 3, 0, 4]
    # A wider view shows more than one that is zoomed; the photo's own zoom comes last.
    zoomed = [camera, camera.zoomed(1.1), camera.zoomed(0.7)]
    assert order_of(zoomed, camera, 1.0)[0] == 2


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_order_of_views_does_not_depend_on_the_scenes_unit(scale: float) -> None:
    camera = Camera.from_focal(50, 40, 30)
    offsets = [(-1.0, 0.0), (0.2, 20.0), (0.0, -30.0), (0.4, 0.0)]
    orders = [
        order_of(
            [turned_right(camera, degrees, right=unit * x) for x, degrees in offsets],
            camera,
            unit,
        )
        for unit in (1.0, scale)
    ]
    assert orders[0] == orders[1]


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


def test_an_underlay_is_hidden_and_closes_holes_of_neighbours() -> None:
    context, _ = box_view(width=160, height=120)
    path = path_of(context)
    index = order_of(path, context.photo_camera, context.near_depth)[0]
    camera, before = path[index], CPU.render(context.base, path[index])
    features = ViewFeatures.of(before)
    mask, seen = features.mask, ~hole_mask(before.alpha)
    filling = fill_view(context, camera, [], before).aux
    beneath = rim_underlay(mask, initialize(features, camera, context.photo_camera), camera)
    assert len(beneath) > 100
    without, both = (CPU.render([context.base, filling, *more], camera) for more in ([], [beneath]))
    assert psnr(both.rgb[seen], before.rgb[seen]) >= 48
    assert psnr(both.rgb, without.rgb) >= 45
    # The underlay lies around the holes, not in them.
    uv, z = camera.project(beneath.means)
    column, row = (uv / 2).floor().long().unbind(-1)
    assert bool((z > 0).all())
    assert bool((maximum_filter(mask, UNDERLAY_REACH_CELLS) & ~mask)[row, column].all())
    assert bool((row % UNDERLAY_STRIDE == 0).all() and (column % UNDERLAY_STRIDE == 0).all())
    beside = [path[index + step] for step in (-8, -4, 4, 8)]
    open_before, open_after = (
        sum(holes_of(view, context.base, filling, *more) for view in beside) / 4
        for more in ([], [beneath])
    )
    assert open_before > 1e-4
    assert open_after < 0.5 * open_before
    alone = fill_view(context, camera, rendering=before).aux
    assert same_bits(fill_scene(context, [camera], exact=True).aux, alone)
    assert len(fill_scene(context, [camera] * 2, exact=True).aux) > len(alone)


def test_an_underlay_is_not_visible_in_the_opposite_view(monkeypatch: pytest.MonkeyPatch) -> None:
    green = torch.tensor([0.0, 1.0, 0.0])

    def painted(*given: Any) -> Gaussians:
        rims = rim_underlay(*given)
        return dataclasses.replace(rims, colors=green.expand_as(rims.colors).contiguous())

    monkeypatch.setattr(fill, "rim_underlay", painted)
    scene = box_before_wall()
    pole = torch.zeros_like(scene.depth, dtype=torch.bool)
    pole[:, 44:54] = True
    scene = dataclasses.replace(scene, depth=torch.where(pole, 2.0, 6.0))
    context = FillContext(scene.base(), scene.camera, CPU)
    sides = leftmost_and_rightmost(scene.camera, 0.3, DepthRange.of(context.base, is_metric=True))
    aux = fill_scene(context, sides, exact=True).aux
    assert int((aux.colors == green).all(-1).sum()) > 20
    shown = [CPU.render([context.base, aux], camera).rgb for camera in sides]
    holes = [hole_mask(CPU.render(context.base, camera).alpha) for camera in sides]
    found = torch.cat([rgb[hole] for rgb, hole in zip(shown, holes, strict=True)])
    assert len(found) > 5000
    assert float((found[:, 1] > found[:, ::2].amax(-1)).float().mean()) < 0.01


def test_an_underlay_is_not_visible_beyond_the_border(monkeypatch: pytest.MonkeyPatch) -> None:
    context, _ = box_view()
    sides = leftmost_and_rightmost(
        context.photo_camera, 0.6, DepthRange.of(context.base, is_metric=True)
    )
    aux = fill_scene(context, sides, exact=True).aux
    monkeypatch.setattr(fill, "rim_underlay", lambda *given: Gaussians.empty())
    bare = fill_scene(context, sides, exact=True).aux
    assert len(bare) < len(aux)
    for camera in sides:
        features = ViewFeatures.of(CPU.render(context.base, camera))
        initial = initialize(features, camera, context.photo_camera)
        beyond = features.mask & ~inside_photo(initial.inverse_depth, camera, context.photo_camera)
        with_rims, without = (CPU.render([context.base, part], camera).rgb for part in (aux, bare))
        assert int(beyond.sum()) > 500
        assert float(group_by_cell(with_rims - without)[beyond].abs().max()) < 0.03


@pytest.mark.parametrize(
    ("kind", "disparity"), [("rotate-forward", 0.3), ("rotate", 0.2), ("swipe", 0.3)]
)
def test_all_frames_are_filled_and_a_view_that_shows_the_same_is_not_rendered_again(
    kind: TrajectoryKind, disparity: float
) -> None:
    calls: list[tuple[int, int]] = []
    context, _ = box_view(width=160, height=120)
    renderer = CountingRenderer()
    context = dataclasses.replace(context, renderer=renderer)
    path = path_of(context, kind, disparity)
    # The command line adds the widest views, too. Players repeat a video, so views come twice.
    depths = DepthRange.of(context.base, is_metric=True)
    widest = leftmost_and_rightmost(context.photo_camera, disparity, depths)
    views = [*path, *widest, *path]
    filled = fill_scene(context, views, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(k, len(views)) for k in range(1, len(views) + 1)]
    assert len(renderer.cameras) <= 1 + len(path) + len(widest)  # the photo, each view once

    after = [CPU.render([context.base, filled.aux], camera) for camera in views]
    assert len(filled.pictures) > 3
    for index, picture in filled.pictures.items():  # equal to the final scene, bit for bit
        assert torch.equal(picture, to_uint8(after[index].rgb))
    assert max(hole_area_ratio(view.alpha) for view in after) <= 1e-3
    for index in order_of(path, context.photo_camera, context.near_depth)[:GUARDED_VIEWS]:
        before = CPU.render(context.base, path[index])
        seen = ~hole_mask(before.alpha)
        assert psnr(after[index].rgb[seen], before.rgb[seen]) >= 45

    renderer.cameras.clear()
    fill_scene(context, path[::5], exact=True)
    assert len(renderer.cameras) == 12  # no view of an exact path is left out


class CountingRenderer(CpuRenderer):
    """Counts how often each camera is rendered in full."""

    def __init__(self) -> None:
        self.cameras: list[Camera] = []

    def render(self, gaussians: Any, camera: Camera, **options: Any) -> Rendering:
        if options.get("tiles") is None:
            self.cameras.append(camera)
        return super().render(gaussians, camera, **options)


def test_a_scene_renders_the_photo_once() -> None:
    context, _ = box_view()
    renderer = CountingRenderer()
    network = random_network(name="sharp-decoder")
    context = dataclasses.replace(context, renderer=renderer, network=network)
    cameras = path_of(context, "shake", frames=24)
    assert len(fill_scene(context, cameras).aux) > 100
    photo_renderings = [camera for camera in renderer.cameras if camera is context.photo_camera]
    assert len(photo_renderings) == 1
    assert len(renderer.cameras) <= 1 + len(cameras)  # each view at most once in full
    # Another base must not get the old one's photo.
    other = dataclasses.replace(context, base=context.base.select(slice(100)))
    assert not same_bits(other.photo_rendering, context.photo_rendering)


def test_motorcycle_is_filled_and_visible_pixels_stay() -> None:
    pair, found = motorcycle(), motorcycle_base()
    context = FillContext(found.gaussians, found.camera, CPU)
    aux = fill_view(context, pair.right).aux
    before, after = (
        CPU.render(context.base, pair.right),
        CPU.render([context.base, aux], pair.right),
    )
    assert hole_area_ratio(before.alpha) > 0.08
    assert hole_area_ratio(after.alpha) <= 0.03 * hole_area_ratio(before.alpha)
    hole = hole_mask(before.alpha)
    assert psnr(after.rgb[hole], pair.right_rgb[hole]) >= 16.3
    assert (
        psnr(after.rgb[~hole], pair.right_rgb[~hole])
        >= psnr(before.rgb[~hole], pair.right_rgb[~hole]) - 0.1
    )
    photo = CPU.render(context.base, found.camera)
    whole = fill_scene(context, path_of(context, "swipe", frames=5)).aux
    for new in (aux, whole):
        assert psnr(CPU.render([context.base, new], found.camera).rgb, photo.rgb) >= 45
    for camera in leftmost_and_rightmost(
        found.camera, 0.3, DepthRange.of(context.base, is_metric=True)
    ):
        assert holes_of(camera, context.base) > 0.2
        assert holes_of(camera, context.base, whole) <= 0.03 * holes_of(camera, context.base)


def test_a_network_that_names_the_photo_sees_the_photo_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[Any] = []
    sample = completion.sample_photo

    def noted(photo: Any, *others: Any) -> Any:
        seen.append(photo)
        return sample(photo, *others)

    monkeypatch.setattr(completion, "sample_photo", noted)
    # This "photo" differs from all that the Gaussians show.
    photo = torch.rand(72, 96, 3, generator=torch.Generator().manual_seed(0))
    prediction = dataclasses.replace(box_before_wall().lift(), photo=photo)
    camera = shifted(prediction.camera, 0.4)
    network = random_network(name="sharp-decoder")
    complete(prediction, [camera], network=network, fill="network", renderer=CPU)
    assert seen.pop() is photo
    # Gaussians of another tool come without a photo: their rendering stands in.
    nameless = dataclasses.replace(prediction, photo=None)
    complete(nameless, [camera], network=network, fill="network", renderer=CPU)
    assert psnr(seen.pop(), box_before_wall().rgb) > 30
    assert not seen
