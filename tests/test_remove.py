"""A thing is taken out of a photo's scene, and what it hid is filled; all else stays as it was."""

from __future__ import annotations

import functools

import pytest
import torch
from helpers.scenes import Scene, psnr, same_bits, shifted
from helpers.things_in_rooms import Room, box, room, sphere

import spackle
from spackle.core.camera import Camera
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.residual import hole_mask

CPU = CpuRenderer()
ROUGH_PX = 3  # how far a hand-drawn mask reaches over the outline
SIZE = {"width": 120, "height": 90, "focal": 112.0, "spacing": 0.04}
PHOTO = Camera.from_focal(112.0, 120, 90)
VIEWS = [PHOTO, shifted(PHOTO, 0.25), shifted(PHOTO, -0.25)]


def lifted(made: Room) -> Gaussians:
    """The scene of a photo of a room, as a base makes it: only what the photo shows."""
    view = CPU.render(made.scene, made.camera)
    return Scene(view.rgb, view.depth, PHOTO).base()


@functools.cache
def made_box() -> Room:
    return room(box((0.1, 0.6, 3.0), (0.3, 0.4, 0.25), 0.03), **SIZE)  # type: ignore[arg-type]


def test_what_a_thing_hid_is_filled_and_all_else_stays() -> None:
    made = room(sphere((0.1, 0.0, 3.0), 0.5, 0.03), floor_height=None, **SIZE)  # type: ignore[arg-type]
    scene = lifted(made)
    mask = maximum_filter(made.mask(), ROUGH_PX)
    marked = spackle.marked_gaussians(scene, [(PHOTO, mask)], CPU)
    removal = spackle.remove(scene, marked, VIEWS, network=None, renderer=CPU)

    assert same_bits(removal.edited, scene.select(~marked))
    assert torch.equal(removal.is_kept, ~marked)
    count = len(removal.edited)
    assert same_bits(removal.patched.select(slice(0, count)), removal.edited)
    for camera in VIEWS:
        before, edited, patched = (
            CPU.render(some, camera) for some in (scene, removal.edited, removal.patched)
        )
        was_open = hole_mask(before.alpha)
        uncovered = hole_mask(edited.alpha) & ~was_open
        still_open = hole_mask(patched.alpha) & uncovered
        assert int(uncovered.sum()) > 500
        assert int(still_open.sum()) < 0.01 * int(uncovered.sum())
    before, patched = (CPU.render(some, PHOTO).rgb for some in (scene, removal.patched))
    assert psnr(before[~mask], patched[~mask]) > 45
    # The wall is blue, and the sphere was red.
    there = patched[made.mask()]
    assert bool((there[:, 2] > there[:, 0]).float().mean() > 0.99)


def test_nothing_of_a_thing_is_left_where_it_stood() -> None:
    made = room(
        box((0.1, 0.6, 3.0), (0.3, 0.4, 0.25), 0.015),
        width=240,
        height=180,
        focal=225,
        spacing=0.02,
    )
    view = CPU.render(made.scene, made.camera)
    photo = Camera.from_focal(225, 240, 180)
    scene = Scene(view.rgb, view.depth, photo).base()
    mask = maximum_filter(made.mask(), ROUGH_PX)
    marked = spackle.marked_gaussians(scene, [(photo, mask)], CPU)
    edited = CPU.render(scene.select(~marked), photo)
    # The box is orange; beneath it lies a second layer of its colour, behind the floor's surface.
    is_orange = (edited.rgb[..., 0] > edited.rgb[..., 2] + 0.3) & (edited.rgb[..., 0] > 0.6)
    assert int((is_orange & mask).sum()) <= 0.003 * int(mask.sum())


def test_before_an_empty_sky_nothing_is_filled_in() -> None:
    made = made_box()
    floor = made.background.select(made.background.means[:, 1] > 0.99)
    scene = Gaussians.cat([floor, made.thing])
    marked = torch.zeros(len(scene), dtype=torch.bool)
    marked[len(floor) :] = True
    # The floor beneath the box is missing, too: a photo does not show it.
    hidden = (floor.means - torch.tensor([0.1, 1.0, 3.0])).norm(dim=-1) < 0.35
    marked[: len(floor)] |= hidden
    removal = spackle.remove(scene, marked, [made.camera], network=None, renderer=CPU)
    edited, patched = (CPU.render(some, made.camera) for some in (removal.edited, removal.patched))
    horizon = int(made.camera.project(torch.tensor([[0.0, 1.0, 5.0]]))[0][0, 1])
    opened = hole_mask(edited.alpha)
    closed = opened & ~hole_mask(patched.alpha)
    # Just above the horizon, something and nothing are equally near.
    assert not bool(closed[: horizon - 10].any())
    below = opened[horizon + 5 :]
    assert int(closed[horizon + 5 :].sum()) > 0.9 * int(below.sum()) > 0


def test_marks_that_leave_nothing_to_do_are_refused() -> None:
    scene = made_box().thing
    nothing = torch.zeros(len(scene), dtype=torch.bool)
    with pytest.raises(ValueError, match="marks no Gaussian"):
        spackle.remove(scene, nothing, [PHOTO])
    with pytest.raises(ValueError, match="marks all Gaussians"):
        spackle.remove(scene, ~nothing, [PHOTO])
    with pytest.raises(ValueError, match="`cameras` is empty"):
        spackle.remove(scene, nothing.clone().index_fill_(0, torch.tensor([0]), True), [])
    with pytest.raises(ValueError, match="bool"):
        spackle.remove(scene, nothing[1:], [PHOTO])
