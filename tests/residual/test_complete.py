"""Completion: of one view, and of a path by one set of aux Gaussians, whichever frames are looked at."""

from __future__ import annotations

import dataclasses

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
    slanted_plane,
    wall,
)
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import DepthRange, TrajectoryKind, extremes, trajectory
from spackle.gaussians import Gaussians
from spackle.render.protocol import Rendering
from spackle.residual import Completer, Cues, ResidualNet, farthest_first, hole_area_ratio, hole_mask, make_seeds
from spackle.residual.complete import WIDEST
from spackle.residual.rim_underlay import COARSE, REACH_CELLS, rim_underlay
from spackle.residual.view_order import SettledFrames, has_speck, reach_of

FRAMES = 60


def holes_of(camera: Camera, *gaussians: Gaussians) -> float:
    return hole_area_ratio(CPU.render(list(gaussians), camera).alpha)


def path_of(
    completer: Completer, kind: TrajectoryKind = "rotate_forward", disparity: float = 0.3, frames: int = FRAMES
) -> list[Camera]:
    return trajectory(kind, completer.photo_camera, disparity, DepthRange.of(completer.base), frames)


# One view


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("disparity", [0.2, 0.5])
def test_completion_closes_a_view(disparity: float, side: int) -> None:
    completer, camera = box_view(disparity, side)
    before = CPU.render(completer.base, camera)
    after = CPU.render([completer.base, completer.complete_view(camera)], camera)
    assert hole_area_ratio(after.alpha) < 0.03 * hole_area_ratio(before.alpha)
    seen = ~hole_mask(before.alpha)
    assert psnr(after.rgb[seen], before.rgb[seen]) > 35


@pytest.mark.parametrize("network", [False, True])
@pytest.mark.parametrize("there", [False, True])
def test_the_completed_view_is_bit_for_bit_that_of_drawing_everything_and_repeats(network: bool, there: bool) -> None:
    completer, camera = box_view(0.4)
    completer = dataclasses.replace(completer, network=random_network() if network else None)
    aux = completer.complete_view(box_view(0.2)[1]) if there else Gaussians.empty()
    new, drawn = completer.completed_view(camera, aux=aux)
    assert len(new) > 100
    assert same_bits(drawn, CPU.render([completer.base, aux, new], camera))
    assert same_bits(completer.complete_view(camera, [completer.photo_guard()], aux), new)


def test_aux_gaussians_already_there_are_seen_and_not_returned() -> None:
    completer, camera = box_view()
    first = completer.complete_view(camera)
    assert len(first) > 100
    assert len(completer.complete_view(camera, aux=first)) < 0.02 * len(first)


@pytest.mark.parametrize("network", [False, True])
def test_an_odd_view_is_completed(network: bool) -> None:
    scene = wall(4.0, 63, 47)
    completer = Completer(scene.base(), scene.camera, CPU, random_network() if network else None)
    camera = shifted(scene.camera, 0.8)
    aux = completer.complete_view(camera)
    assert len(aux) > 20
    before = holes_of(camera, completer.base)
    assert holes_of(camera, completer.base, aux) < (0.5 if network else 0.03) * before


@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
@pytest.mark.parametrize("network", [False, True])
@pytest.mark.parametrize("empty", [False, True])
def test_a_view_of_nothing_at_all_becomes_a_wall(size: tuple[int, int], network: bool, empty: bool) -> None:
    scene = wall(4.0, *size)
    base, camera = (Gaussians.empty(), scene.camera) if empty else (scene.base(), away(scene.camera))
    completer = Completer(base, scene.camera, CPU, ResidualNet() if network else None)
    assert holes_of(camera, base) == 1
    aux = completer.complete_view(camera)
    assert all(bool(t.isfinite().all()) for t in aux.tensors)
    assert holes_of(camera, base, aux) < 0.01


def test_base_gaussians_behind_the_camera_play_no_part() -> None:
    completer, camera = box_view()
    generator = torch.Generator().manual_seed(0)
    behind = Gaussians(
        camera.unproject(camera.pixel_centers()[::8, ::8].reshape(-1, 2), -3 * torch.ones(108)),
        torch.randn(108, 4, generator=generator),
        torch.full((108, 3), 0.3),
        torch.ones(108),
        torch.rand(108, 3, generator=generator),
    )
    more = dataclasses.replace(completer, base=Gaussians.cat([completer.base, behind]))
    assert same_bits(more.complete_view(camera), completer.complete_view(camera))


# A path


def test_the_widest_view_comes_first_and_any_beginning_is_spread_out() -> None:
    camera = Camera.from_focal(50, 40, 30)
    order = farthest_first([shifted(camera, x) for x in (-1.0, -0.2, 0.0, 0.6, 1.1)], camera)
    assert order == [4, 0, 3, 1, 2]  # the photo's own place counts as visited
    assert sorted(farthest_first([camera] * 3, camera)) == [0, 1, 2]


@pytest.mark.parametrize("disparity", [0.3, 0.5])
@pytest.mark.parametrize("kind", ["rotate_forward", "rotate"])
def test_a_long_path_and_its_extremes_are_closed_by_one_set(kind: TrajectoryKind, disparity: float) -> None:
    """As the command line asks for it: the extremes come after the path, and lie beside it."""
    completer, _ = box_view()
    path = path_of(completer, kind, disparity)
    sides = extremes(completer.photo_camera, disparity, DepthRange.of(completer.base))
    aux = completer.complete_scene([*path, *sides])
    for camera in [*path[::4], *sides]:
        assert holes_of(camera, completer.base, aux) <= max(2e-3, 0.03 * holes_of(camera, completer.base))


@pytest.mark.parametrize("exact", [False, True])
def test_scene_completion_visits_every_view_and_none_of_none(exact: bool) -> None:
    completer, _ = box_view()
    calls: list[int] = []
    path = [completer.photo_camera] * 7
    aux = completer.complete_scene(path, exact, progress=lambda done, _: calls.append(done))
    assert len(aux) == 0  # the photo has no holes in its own view
    assert calls == list(range(1, 8))
    assert len(completer.complete_scene([], exact)) == 0


def test_no_aux_gaussian_of_a_scene_stands_before_the_photos_surface_and_it_repeats() -> None:
    completer, _ = box_view()
    path = path_of(completer, "shake", frames=8)
    aux = completer.complete_scene(path)
    assert same_bits(completer.complete_scene(path), aux)
    depth = box_before_wall().depth
    uv, z = completer.photo_camera.project(aux.means)
    x, y = uv.floor().long().unbind(-1)
    inside = (z > 0) & (x >= 0) & (x < 96) & (y >= 0) & (y < 72)
    assert int(inside.sum()) > 100
    assert bool((z[inside] > depth[y[inside], x[inside]] * 1.0005).all())


def test_a_slanted_floor_is_continued_beyond_the_frame() -> None:
    scene = slanted_plane(1.5, 6, 0, width=96, height=72, focal=90)
    completer = Completer(scene.base(), scene.camera, CPU)
    path = path_of(completer, "swipe", frames=3)
    aux = completer.complete_scene(path)
    for camera in (path[0], path[-1]):
        before = holes_of(camera, completer.base)
        assert before > 0.03
        assert holes_of(camera, completer.base, aux) < 0.03 * before


# Beneath the rims


Wide = tuple[Completer, int, Rendering, Gaussians, Gaussians]


def subject() -> Completer:
    return box_view(width=160, height=120)[0]


@pytest.fixture(scope="module")
def wide() -> Wide:
    """A wide view of a path, what it shows, and what fills and surrounds its holes."""
    completer = subject()
    path = path_of(completer)
    index = farthest_first(path, completer.photo_camera)[0]
    before = CPU.render(completer.base, path[index])
    cues = Cues.of(before)
    assert 0.1 < float(cues.mask.float().mean()) < 0.5
    fill = completer.complete_view(path[index], [], rendering=before)
    seeds = make_seeds(cues, path[index], completer.photo_camera)
    return completer, index, before, fill, rim_underlay(cues, seeds, path[index])


def test_what_lies_beneath_the_rim_is_hidden_from_the_view_that_it_is_made_for(wide: Wide) -> None:
    completer, index, before, fill, beneath = wide
    camera = path_of(completer)[index]
    assert len(beneath) > 100
    without = CPU.render([completer.base, fill], camera)
    both = CPU.render([completer.base, fill, beneath], camera)
    seen = ~hole_mask(before.alpha)
    assert psnr(both.rgb[seen], before.rgb[seen]) >= 50
    assert psnr(both.rgb, without.rgb) >= 45
    # It lies around the holes and nowhere in them.
    mask = Cues.of(before).mask
    uv, z = camera.project(beneath.means)
    column, row = (uv / 2).floor().long().unbind(-1)
    assert bool((z > 0).all())
    assert not bool(mask[row, column].any())
    near = [mask[max(y - REACH_CELLS, 0) : y + REACH_CELLS + 1, max(x - REACH_CELLS, 0) : x + REACH_CELLS + 1]
            for y, x in zip(row.tolist(), column.tolist(), strict=True)]  # fmt: skip
    assert all(bool(part.any()) for part in near)
    assert bool((row % COARSE == 0).all() and (column % COARSE == 0).all())


def test_the_neighbours_of_a_completed_view_have_fewer_holes_for_it(wide: Wide) -> None:
    completer, index, _, fill, beneath = wide
    beside = [path_of(completer)[index + step] for step in (-4, -2, 2, 4)]
    without, both = (
        sum(holes_of(camera, completer.base, *aux) for camera in beside) / 4 for aux in ((fill,), (fill, beneath))
    )
    assert without > 1e-3
    assert both < 0.5 * without


def test_a_view_without_neighbours_gets_nothing_beneath_its_rims(wide: Wide) -> None:
    completer, index, before, _, _ = wide
    camera = path_of(completer)[index]
    alone = completer.complete_view(camera, rendering=before)
    assert same_bits(completer.complete_scene([camera], exact=True), alone)
    assert len(completer.complete_scene([camera, camera], exact=True)) > len(alone)


# Which frames are looked at


class Counting:
    """A renderer that keeps the cameras that whole pictures are taken by."""

    device = torch.device("cpu")

    def __init__(self) -> None:
        self.cameras: list[Camera] = []

    def render(
        self,
        gaussians: Gaussians | list[Gaussians],
        camera: Camera,
        *,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        if tiles is None:
            self.cameras.append(camera)
        return CPU.render(gaussians, camera, tiles=tiles, onto=onto)


@pytest.mark.parametrize(
    ("frames", "looks", "expected"),
    [
        (12, [(0, 0.0), (9, 0.0)], [0, 9]),
        (12, [(0, 0.0), (9, 0.0), (4, 0.5)], [0, 2, 3, 4, 5, 6, 9]),
        (12, [(0, 0.0), (9, 0.0), (4, 0.5), (8, 0.5)], [0, 2, 3, 4, 5, 6, 7, 8, 9]),
        (16, [(1, 0.0), (14, 0.0), (5, 0.75)], [*range(1, 12), 14]),
        *((5, [(2, reach)], [2]) for reach in (0.5, 0.75)),  # nobody speaks for the ends of a path
    ],
)
def test_a_quiet_frame_speaks_for_a_part_of_the_way_to_the_next_known_ones(
    frames: int, looks: list[tuple[int, float]], expected: list[int]
) -> None:
    settled = SettledFrames(frames)
    for index, reach in looks:
        settled.looked(index, reach)
    assert [k for k in range(frames) if settled.known(k)] == expected


@pytest.mark.parametrize(("holes", "reach"), [(0, 0.75), (25, 0.75), (26, 0.5), (100, 0.5), (101, 0.0)])
def test_the_fewer_holes_the_farther_a_frame_speaks(holes: int, reach: float) -> None:
    alpha = torch.ones(250, 400)
    alpha.view(-1)[torch.arange(holes) * 37] = 0.3  # nowhere together
    assert reach_of(hole_area_ratio(alpha), alpha) == reach


@pytest.mark.parametrize(("height", "width", "speck"), [(4, 5, True), (3, 3, False), (1, 60, False)])
def test_few_holes_are_a_speck_where_they_lie_together(height: int, width: int, speck: bool) -> None:
    alpha = torch.ones(120, 160)
    alpha[120 - height :, 160 - width :] = 0.3
    assert has_speck(alpha) is speck
    assert not reach_of(hole_area_ratio(alpha), alpha) or not speck
    assert not has_speck(torch.zeros(2, 60))


@pytest.mark.parametrize(("kind", "most"), [("rotate_forward", 30), ("rotate", 60), ("swipe", 20)])
def test_few_frames_of_a_path_are_looked_at_all_of_them_are_closed_and_what_the_widest_show_stays(
    kind: TrajectoryKind, most: int
) -> None:
    counting = Counting()
    completer = dataclasses.replace(subject(), renderer=counting)  # type: ignore[arg-type]
    path = path_of(completer, kind)
    calls: list[tuple[int, int]] = []
    aux = completer.complete_scene(path, progress=lambda done, total: calls.append((done, total)))
    assert len(counting.cameras) <= most  # the photo, the widest, and those that were looked at
    assert calls == [(k, FRAMES) for k in range(1, FRAMES + 1)]
    left = [holes_of(camera, completer.base, aux) for camera in path]
    assert max(left) <= 2e-3
    assert sum(left) / FRAMES <= 5e-4
    for index in farthest_first(path, completer.photo_camera)[:WIDEST]:
        before, after = CPU.render(completer.base, path[index]), CPU.render([completer.base, aux], path[index])
        seen = ~hole_mask(before.alpha)
        assert psnr(after.rgb[seen], before.rgb[seen]) >= 45


def test_an_exact_path_is_looked_at_frame_by_frame() -> None:
    counting = Counting()
    completer = dataclasses.replace(subject(), renderer=counting)  # type: ignore[arg-type]
    path = path_of(completer, frames=12)
    completer.complete_scene(path, exact=True)
    assert all(any(camera is seen for seen in counting.cameras) for camera in path)


# Motorcycle, a real photo with real depth, at Middlebury's quarter size


def test_motorcycle_the_right_view_is_closed_plausibly_and_nothing_that_was_seen_changes() -> None:
    pair, found = motorcycle(), motorcycle_base()
    completer = Completer(found.gaussians, found.camera, CPU)
    aux = completer.complete_view(pair.right)
    before, after = CPU.render(completer.base, pair.right), CPU.render([completer.base, aux], pair.right)
    assert hole_area_ratio(before.alpha) > 0.08
    assert hole_area_ratio(after.alpha) <= 0.03 * hole_area_ratio(before.alpha)
    hole = hole_mask(before.alpha)
    assert psnr(after.rgb[hole], pair.right_rgb[hole]) >= 16.3
    assert psnr(after.rgb[~hole], pair.right_rgb[~hole]) >= psnr(before.rgb[~hole], pair.right_rgb[~hole]) - 0.1
    photo = CPU.render(completer.base, found.camera)
    assert psnr(CPU.render([completer.base, aux], found.camera).rgb, photo.rgb) >= 45


def test_motorcycle_a_swipe_is_completed_as_one_scene() -> None:
    found = motorcycle_base()
    completer = Completer(found.gaussians, found.camera, CPU)
    aux = completer.complete_scene(path_of(completer, "swipe", frames=5))
    photo = CPU.render(completer.base, found.camera)
    assert psnr(CPU.render([completer.base, aux], found.camera).rgb, photo.rgb) >= 45
    for camera in extremes(found.camera, 0.3, DepthRange.of(completer.base)):
        before = holes_of(camera, completer.base)
        assert before > 0.2
        assert holes_of(camera, completer.base, aux) <= 0.03 * before
