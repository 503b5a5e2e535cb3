"""One set of aux Gaussians for a path: what lies beneath the rims of holes, and which frames are looked at."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from scenes import box_before_wall, psnr, same_bits
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import DepthRange, TrajectoryKind, trajectory
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, Cues, farthest_first, hole_area_ratio, hole_mask, make_seeds
from spackle.residual.complete import WIDEST
from spackle.residual.rim_underlay import COARSE, REACH_CELLS, rim_underlay
from spackle.residual.view_order import SettledFrames, has_speck, reach_of

CPU = CpuRenderer()
FRAMES = 60


def subject() -> Completer:
    scene = box_before_wall(width=160, height=120, focal=133)
    return Completer(scene.base(), scene.camera, CPU)


def path_of(completer: Completer, kind: TrajectoryKind = "rotate_forward", frames: int = FRAMES) -> list[Camera]:
    return trajectory(kind, completer.photo_camera, 0.3, DepthRange.of(completer.base), frames)


class Counting:
    """A renderer that counts whole pictures, and the cameras that they are taken by."""

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


# Beneath the rim


def wide_view() -> tuple[Completer, Camera, Rendering, Gaussians, Gaussians]:
    """A wide view, what it shows, and what fills and surrounds its holes."""
    completer = subject()
    path = path_of(completer)
    camera = path[farthest_first(path, completer.photo_camera)[0]]
    before = CPU.render(completer.base, camera)
    cues = Cues.of(before)
    assert 0.1 < float(cues.mask.float().mean()) < 0.5
    fill = completer.complete_view(camera, [], rendering=before)
    return completer, camera, before, fill, rim_underlay(cues, make_seeds(cues, camera, completer.photo_camera), camera)


def test_what_lies_beneath_the_rim_is_hidden_from_the_view_that_it_is_made_for() -> None:
    completer, camera, before, fill, beneath = wide_view()
    assert len(beneath) > 100
    without = CPU.render([completer.base, fill], camera)
    both = CPU.render([completer.base, fill, beneath], camera)
    seen = ~hole_mask(before.alpha)
    assert psnr(both.rgb[seen], before.rgb[seen]) >= 50
    assert psnr(both.rgb, without.rgb) >= 45


def test_it_lies_around_the_holes_and_nowhere_in_them() -> None:
    _, camera, before, _, beneath = wide_view()
    mask = Cues.of(before).mask
    uv, z = camera.project(beneath.means)
    column, row = (uv / 2).floor().long().unbind(-1)
    assert bool((z > 0).all())
    assert not bool(mask[row, column].any())
    near = [mask[max(y - REACH_CELLS, 0) : y + REACH_CELLS + 1, max(x - REACH_CELLS, 0) : x + REACH_CELLS + 1]
            for y, x in zip(row.tolist(), column.tolist(), strict=True)]  # fmt: skip
    assert all(bool(part.any()) for part in near)
    assert bool((row % COARSE == 0).all() and (column % COARSE == 0).all())


def test_the_neighbours_of_a_completed_view_have_fewer_holes_for_it() -> None:
    completer, _, _, fill, beneath = wide_view()
    path = path_of(completer)
    index = farthest_first(path, completer.photo_camera)[0]

    def left(*aux: Gaussians) -> float:
        views = [CPU.render([completer.base, *aux], path[index + step]) for step in (-4, -2, 2, 4)]
        return sum(hole_area_ratio(view.alpha) for view in views) / 4

    assert left(fill) > 1e-3
    assert left(fill, beneath) < 0.5 * left(fill)


def test_a_view_without_neighbours_gets_nothing_beneath_its_rims() -> None:
    completer, camera, before, _, _ = wide_view()
    alone = completer.complete_view(camera, rendering=before)
    assert same_bits(completer.complete_scene([camera], exact=True), alone)
    assert len(completer.complete_scene([camera, camera], exact=True)) > len(alone)


# Which frames are looked at


def test_a_quiet_frame_speaks_for_those_half_of_the_way_to_the_next_known_ones() -> None:
    visits = SettledFrames(12)
    visits.looked(0, 0.0)
    visits.looked(9, 0.0)
    assert [k for k in range(12) if visits.known(k)] == [0, 9]
    visits.looked(4, 0.5)
    assert [k for k in range(12) if visits.known(k)] == [0, 2, 3, 4, 5, 6, 9]
    visits.looked(8, 0.5)
    assert [k for k in range(12) if visits.known(k)] == [0, 2, 3, 4, 5, 6, 7, 8, 9]


def test_one_with_hardly_a_hole_speaks_for_more() -> None:
    visits = SettledFrames(16)
    visits.looked(1, 0.0)
    visits.looked(14, 0.0)
    visits.looked(5, 0.75)
    assert [k for k in range(16) if visits.known(k)] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 14]


@pytest.mark.parametrize("reach", [0.5, 0.75])
def test_nobody_speaks_for_the_ends_of_a_path(reach: float) -> None:
    visits = SettledFrames(5)
    visits.looked(2, reach)
    assert [visits.known(i) for i in range(5)] == [False, False, True, False, False]


@pytest.mark.parametrize(("holes", "reach"), [(0, 0.75), (25, 0.75), (26, 0.5), (100, 0.5), (101, 0.0)])
def test_the_fewer_holes_the_farther_a_frame_speaks(holes: int, reach: float) -> None:
    alpha = torch.ones(250, 400)
    alpha.view(-1)[torch.arange(holes) * 37] = 0.3  # nowhere together
    assert reach_of(hole_area_ratio(alpha), alpha) == reach


@pytest.mark.parametrize(("kind", "most"), [("rotate_forward", 30), ("rotate", 60), ("swipe", 20)])
def test_few_frames_of_a_path_are_looked_at_and_all_of_them_are_closed(kind: TrajectoryKind, most: int) -> None:
    counting = Counting()
    completer = dataclasses.replace(subject(), renderer=counting)  # type: ignore[arg-type]
    path = path_of(completer, kind)
    calls: list[tuple[int, int]] = []
    aux = completer.complete_scene(path, progress=lambda done, total: calls.append((done, total)))
    assert len(counting.cameras) <= most  # the photo, the widest, and those that were looked at
    assert calls == [(k, FRAMES) for k in range(1, FRAMES + 1)]
    left = [hole_area_ratio(CPU.render([completer.base, aux], camera).alpha) for camera in path]
    assert max(left) <= 2e-3
    assert sum(left) / FRAMES <= 5e-4


@pytest.mark.parametrize(("height", "width", "speck"), [(4, 5, True), (3, 3, False), (1, 60, False)])
def test_few_holes_are_a_speck_where_they_lie_together(height: int, width: int, speck: bool) -> None:
    alpha = torch.ones(120, 160)
    alpha[120 - height :, 160 - width :] = 0.3
    assert has_speck(alpha) is speck
    assert not reach_of(hole_area_ratio(alpha), alpha) or not speck
    assert not has_speck(torch.zeros(2, 60))


def test_an_exact_path_is_looked_at_frame_by_frame() -> None:
    counting = Counting()
    completer = dataclasses.replace(subject(), renderer=counting)  # type: ignore[arg-type]
    path = path_of(completer, frames=12)
    completer.complete_scene(path, exact=True)
    assert all(sum(camera is seen for seen in counting.cameras) >= 1 for camera in path)


def test_what_the_widest_views_show_stays() -> None:
    completer = subject()
    path = path_of(completer)
    aux = completer.complete_scene(path)
    for index in farthest_first(path, completer.photo_camera)[:WIDEST]:
        before, after = CPU.render(completer.base, path[index]), CPU.render([completer.base, aux], path[index])
        seen = ~hole_mask(before.alpha)
        assert psnr(after.rgb[seen], before.rgb[seen]) >= 45


def test_a_path_of_one_frame_may_be_looked_at_twice_and_gives_the_same() -> None:
    completer = subject()
    path = path_of(completer)[16:17]
    assert same_bits(completer.complete_scene(path), completer.complete_scene(path))
