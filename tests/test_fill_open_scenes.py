"""Scenes that are open to all sides: holes are closed, sky and nothing stay empty."""

from __future__ import annotations

import functools

import pytest
import torch
from helpers.open_scenes import OpenScene, chair, cup, houses_around, room, street, table
from helpers.scenes import box_before_wall, same_bits, shifted

import spackle
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.residual.features import hole_mask
from spackle.scene_fill.background import ViewEmptiness
from spackle.scene_fill.fill_plan import choose_reference, plan_fill

RENDERER = CpuRenderer()


@functools.cache
def filled(make: type | object) -> tuple[OpenScene, Gaussians]:
    assert callable(make)
    scene = make()
    return scene, spackle.fill(scene.given, scene.cameras, network=None)


def shares_filled(scene: OpenScene) -> tuple[float, float]:
    """The share of true holes that are planned to be filled, and of true background."""
    plan = plan_fill(scene.given, scene.cameras, RENDERER)
    assert plan.fillable is not None
    holes = hole_count = background = background_count = 0
    for camera, pixels in zip(scene.cameras, plan.fillable, strict=True):
        assert pixels is not None
        is_hole, is_background = scene.truth(camera)
        holes += int((is_hole & pixels).sum())
        hole_count += int(is_hole.sum())
        background += int((is_background & pixels).sum())
        background_count += int(is_background.sum())
    return holes / max(1, hole_count), background / background_count


def test_nothing_is_put_into_a_cups_handle_or_between_a_chairs_legs() -> None:
    for scene in (cup(), cup(count=7, height=0.4), chair(), chair(count=16, height=0.5)):
        assert shares_filled(scene)[1] < 0.003


def test_a_hole_in_a_table_is_filled_and_the_space_around_it_is_not() -> None:
    holes, background = shares_filled(table())
    assert holes > 0.95
    assert background < 0.004


def test_the_sky_over_an_outdoor_scene_stays_empty() -> None:
    for scene in (street(), houses_around(), houses_around(close=True)):
        holes, background = shares_filled(scene)
        assert holes > 0.45  # others are open to the border, or specks of ground
        assert background < 0.015


def test_a_hole_in_the_ground_that_the_pictures_border_cuts_is_filled() -> None:
    holes, background = shares_filled(houses_around(count=16, hole=1.1))
    assert holes > 0.95
    assert background < 0.002


def test_a_room_and_a_photo_have_no_background() -> None:
    scene, result = filled(room)
    assert plan_fill(scene.given, scene.cameras, RENDERER).fillable is None
    for camera in scene.cameras:
        assert not bool(hole_mask(RENDERER.render(result, camera).alpha).any())

    photo = box_before_wall(width=64, height=48, focal=54)
    cameras = [shifted(photo.camera, x) for x in (0.5, -0.5)]
    # With the photo's camera, everything that others see beyond its frame is a hole.
    base = photo.base()
    assert plan_fill(base, [photo.camera, *cameras], RENDERER).fillable is None
    assert plan_fill(base, cameras, RENDERER, photo_camera=photo.camera).fillable is None
    assert plan_fill(base, cameras, RENDERER).fillable is not None
    kept = plan_fill(base, cameras, RENDERER)
    everything = plan_fill(base, cameras, RENDERER, background="fill")
    assert everything.fillable is None
    for hole, sky, empty in zip(
        kept.hole_ratios, kept.background_ratios, everything.hole_ratios, strict=True
    ):
        assert hole + sky == pytest.approx(empty)


def test_a_photos_scene_has_no_background_after_somebody_deleted_a_thing_in_its_middle() -> None:
    photo = box_before_wall(width=64, height=48, focal=54)
    cameras = [photo.camera, *(shifted(photo.camera, x) for x in (0.5, -0.5))]
    base = photo.base()
    edited = base.select(base.means[:, 2] > 4)  # without the box, which covers the wall
    holes = hole_mask(RENDERER.render(edited, photo.camera).alpha)
    assert 0.05 < float(holes.float().mean()) < 0.5

    assert plan_fill(edited, cameras, RENDERER).fillable is None
    # Where something is cut off at the border, the emptiness there may be background.
    cut = base.select(base.means[:, 0] > -0.5)
    assert plan_fill(cut, cameras, RENDERER).fillable is not None


def test_cameras_that_stand_close_together_fill_what_surfaces_enclose() -> None:
    scene = table()
    near = scene.cameras[0]
    eye = near.position
    beside = [
        near.looking(eye + torch.tensor([x, 0.0, 0.0]), torch.zeros(3)) for x in (-0.05, 0.05)
    ]
    is_hole, _ = scene.truth(near)
    for cameras in ([near, *beside], [near]):
        plan = plan_fill(scene.given, cameras, RENDERER)
        assert plan.fillable is not None
        assert plan.fillable[0] is not None
        assert int((is_hole & plan.fillable[0]).sum()) > 0.95 * int(is_hole.sum())


@pytest.mark.parametrize("make", [table, houses_around, room])
def test_what_any_of_twelve_cameras_sees_is_not_hidden(make: object) -> None:
    scene, result = filled(make)
    assert same_bits(result.select(slice(0, len(scene.given))), scene.given)
    for camera in scene.cameras:
        before, after = (RENDERER.render(part, camera) for part in (scene.given, result))
        is_seen = ~hole_mask(before.alpha)
        assert float((before.rgb - after.rgb)[is_seen].square().mean()) < 10**-4.5


@pytest.mark.parametrize("make", [houses_around, room])
def test_a_second_fill_of_the_same_views_adds_nothing(make: object) -> None:
    scene, result = filled(make)
    assert len(result) > len(scene.given)
    assert len(spackle.fill(result, scene.cameras, network=None)) == len(result)


def open_pixels(gaussians: Gaussians, cameras: list[Camera], scene: OpenScene) -> int:
    total = 0
    for camera in cameras:
        is_hole, _ = scene.truth(camera)
        total += int((hole_mask(RENDERER.render(gaussians, camera).alpha) & is_hole).sum())
    return total


def test_the_order_of_the_cameras_does_not_matter() -> None:
    scene, result = filled(houses_around)
    shuffled = [scene.cameras[index] for index in (7, 2, 9, 0, 4, 8, 1, 6, 3, 5)]

    def reference(cameras: list[Camera]) -> Camera:
        views = [ViewEmptiness.of(RENDERER.render(scene.given, c), c) for c in cameras]
        return cameras[choose_reference(views)]

    assert reference(shuffled) is reference(scene.cameras)
    other = spackle.fill(scene.given, shuffled, network=None)
    assert open_pixels(other, scene.cameras, scene) == open_pixels(result, scene.cameras, scene)
