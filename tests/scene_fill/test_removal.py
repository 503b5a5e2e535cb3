"""What a mask marks: the thing in front, whole, and nothing of what is behind it."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.things_in_rooms import Room, box, rectangle, room, sphere
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.scene_fill.removal import marked_gaussians

CPU = CpuRenderer()
ROUGH_PX = 3  # how far a hand-drawn mask reaches over the outline

ROOMS = {
    "a sphere in front of a wall": lambda: room(
        sphere((0.1, 0.1, 3.0), 0.5, 0.02), floor_height=None
    ),
    "a sphere near a wall": lambda: room(sphere((0.3, 0.1, 4.4), 0.5, 0.02), floor_height=None),
    "a sphere on a floor": lambda: room(sphere((0.4, 0.6, 3.3), 0.4, 0.02)),
    "a box on a floor": lambda: room(box((0.1, 0.6, 3.0), (0.3, 0.4, 0.25), 0.02)),
    "a flat box on a floor": lambda: room(box((-0.4, 0.85, 3.0), (0.4, 0.15, 0.35), 0.02)),
    "a box seen from above": lambda: room(
        box((0.1, 0.75, 2.6), (0.3, 0.25, 0.25), 0.02), pitch=0.45
    ),
}


def overlap(marked: Tensor, truth: Tensor) -> float:
    """Intersection over union of two sets [N]."""
    return float((marked & truth).sum() / (marked | truth).sum())


def shows(made: Room, camera: Camera) -> Tensor:
    return maximum_filter(made.mask(camera), ROUGH_PX)


@pytest.mark.parametrize("name", ROOMS)
def test_a_mask_marks_the_whole_thing_and_nothing_behind_it(name: str) -> None:
    made = ROOMS[name]()
    for grow in (0, ROUGH_PX):
        mask = maximum_filter(made.mask(), grow)
        marked = marked_gaussians(made.scene, [(made.camera, mask)], CPU)
        assert overlap(marked, made.is_thing) > 0.9
        # The wall and the floor behind the thing are part of the scene, and stay.
        assert int((marked & ~made.is_thing).sum()) < 0.005 * len(made.background)


def test_the_unit_of_length_does_not_matter() -> None:
    made = ROOMS["a box on a floor"]()
    mask = shows(made, made.camera)
    marked = marked_gaussians(made.scene, [(made.camera, mask)], CPU)
    factor = 1000.0
    pose = made.camera.world_to_camera.clone()
    pose[:3, 3] *= factor
    camera = dataclasses.replace(made.camera, world_to_camera=pose)
    scaled = marked_gaussians(made.scene.scaled(factor), [(camera, mask)], CPU)
    assert overlap(marked, scaled) > 0.99


def test_in_an_empty_world_all_that_is_masked_is_marked() -> None:
    made = room(sphere((0.1, 0.1, 3.0), 0.5, 0.02), floor_height=None)
    alone = dataclasses.replace(made, background=Gaussians.empty())
    marked = marked_gaussians(alone.thing, [(made.camera, shows(alone, made.camera))], CPU)
    assert bool(marked.all())


def test_a_thing_beside_the_masked_one_stays() -> None:
    made = room(sphere((-0.6, 0.1, 3.0), 0.4, 0.02), floor_height=None)
    other = sphere((0.6, 0.1, 3.0), 0.4, 0.02)
    marked = marked_gaussians(
        Gaussians.cat([made.scene, other]), [(made.camera, shows(made, made.camera))], CPU
    )
    assert bool(marked[: len(made.scene)][made.is_thing].all())
    assert not bool(marked[len(made.scene) :].any())


def test_another_camera_that_sees_a_speck_beside_the_mask_keeps_it() -> None:
    made = room(sphere((0.1, 0.1, 3.0), 0.5, 0.02), floor_height=None)
    # A speck between the first camera and the sphere, which the second camera sees elsewhere.
    speck = sphere((0.06, 0.06, 1.5), 0.05, 0.01)
    scene = Gaussians.cat([made.scene, speck])
    beside = made.camera.looking(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.1, 0.1, 3.0]))
    away = made.camera.looking(torch.zeros(3), torch.tensor([0.0, 0.0, -1.0]))

    first = (made.camera, shows(made, made.camera))
    second = (beside, shows(made, beside))
    by_one = marked_gaussians(scene, [first], CPU)
    by_both = marked_gaussians(scene, [first, second], CPU)
    assert bool(by_one[len(made.scene) :].all())
    assert not bool(by_both[len(made.scene) :].any())
    assert overlap(by_both[: len(made.scene)], made.is_thing) > 0.9
    # A camera that looks elsewhere has no say about the sphere.
    elsewhere = (away, torch.ones(away.height, away.width, dtype=torch.bool))
    assert overlap(marked_gaussians(scene, [first, elsewhere], CPU), by_one) > 0.99


def test_a_mask_on_a_wall_marks_that_part_of_the_wall() -> None:
    made = room(
        rectangle((0, 0, 9.0), (0.1, 0, 0), (0, 0.1, 0), 0.05, (1, 1, 1)), floor_height=None
    )
    mask = torch.zeros(made.camera.height, made.camera.width, dtype=torch.bool)
    mask[40:70, 50:90] = True
    marked = marked_gaussians(made.scene, [(made.camera, mask)], CPU)
    uv, _ = made.camera.project(made.scene.means)
    inside = (uv[:, 0] > 50) & (uv[:, 0] < 90) & (uv[:, 1] > 40) & (uv[:, 1] < 70)
    assert overlap(marked, inside & ~made.is_thing) > 0.9
    # What the wall hides is not what was marked.
    assert not bool(marked[made.is_thing].any())


def test_what_a_fill_made_up_behind_the_thing_goes_with_it() -> None:
    made = ROOMS["a sphere in front of a wall"]()
    mask = shows(made, made.camera)
    uv, _ = made.camera.project(made.background.means)
    column, row = uv[:, 0].long().clamp(0, 159), uv[:, 1].long().clamp(0, 119)
    is_invented = torch.zeros(len(made.scene), dtype=torch.bool)
    is_invented[: len(made.background)] = mask[row, column]
    mark = (made.camera, mask)
    marked = marked_gaussians(made.scene, [mark], CPU, is_invented=is_invented)
    inside = (uv >= 0).all(-1) & (uv[:, 0] < 160) & (uv[:, 1] < 120)
    assert overlap(marked, made.is_thing | is_invented & torch.nn.functional.pad(
        inside, (0, len(made.thing))
    )) > 0.99  # fmt: skip


def test_a_mask_of_another_size_than_its_camera_is_refused() -> None:
    made = ROOMS["a sphere near a wall"]()
    with pytest.raises(ValueError, match="a mask of 10×8 pixels for a camera of 160×120"):
        marked_gaussians(made.scene, [(made.camera, torch.ones(8, 10, dtype=torch.bool))], CPU)
    with pytest.raises(ValueError, match="`marks` is empty"):
        marked_gaussians(made.scene, [], CPU)
