"""Beyond the photo's border floors stay level, walls stay walls, and what ends inside of it does not go on."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.residual import CELL, Seeds, ViewFeatures, beyond_border, make_seeds
from spackle.residual.view_features import cell_centers

PHOTO = Camera.from_focal(150, 240, 160)
VIEW = PHOTO.looking(torch.tensor([-1.2, 0.0, 0.0]), torch.tensor([0.3, 0.0, 4.0]))
FLOOR, WALL = torch.tensor([0.7, 0.6, 0.2]), torch.tensor([0.2, 0.3, 0.8])
GROUND, BACK = 1.0, 6.0  # y of the floor and z of the wall


def room() -> tuple[ViewFeatures, Tensor, Tensor]:
    """What the view shows of a floor and a wall without end; the inverse depth of all cells, and which are floor."""
    rays = VIEW.unproject(cell_centers(VIEW), torch.ones(VIEW.height // CELL, VIEW.width // CELL)) - VIEW.position
    reach = torch.where(rays[..., 1] > 0, GROUND / rays[..., 1].clamp_min(1e-6), torch.inf)
    floor, depth = reach < BACK / rays[..., 2], torch.minimum(reach, BACK / rays[..., 2])
    place, _ = PHOTO.project(VIEW.position + rays * depth[..., None])
    mask = ((place < 0) | (place >= torch.tensor([PHOTO.width, PHOTO.height]))).any(-1)
    rgb = torch.where(floor[..., None], FLOOR, WALL)
    return ViewFeatures(rgb * ~mask[..., None], ~mask / depth, (~mask).float(), mask), 1 / depth, floor


def test_a_floor_stays_level_and_a_wall_goes_on() -> None:
    cues, inverse_depth, floor = room()
    seeds, beyond = make_seeds(cues, VIEW, PHOTO), cues.mask
    assert float(beyond.float().mean()) > 0.2
    off = (seeds.inverse_depth / inverse_depth - 1).abs()[beyond]
    assert float(off.median()) < 0.015
    assert float(off.mean()) < 0.06
    for surface, color in ((floor, FLOOR), (~floor, WALL)):
        assert float((seeds.rgb - color).abs().mean(-1)[beyond & surface].mean()) < 0.07


def test_a_sky_is_extended_and_leaves_of_its_colour_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    cues, _, floor = room()  # the wall is as blue as a sky
    there = cues.mask & ~floor
    dots = torch.rand(floor.shape, generator=torch.Generator().manual_seed(0)) < 0.3
    lively = torch.where((dots & ~cues.mask)[..., None], torch.tensor([0.1, 0.2, 0.3]), cues.rgb)
    views = [cues, dataclasses.replace(cues, rgb=lively)]
    calm, leaves = (make_seeds(view, VIEW, PHOTO).rgb[there] for view in views)
    monkeypatch.setattr(beyond_border, "AT_ONCE", 1e9)  # a sky fades in as other colours do
    faded, leaves_faded = (make_seeds(view, VIEW, PHOTO).rgb[there] for view in views)
    assert float((calm - WALL).abs().mean()) < 0.5 * float((faded - WALL).abs().mean())
    assert float((leaves - leaves_faded).abs().mean()) < 0.3 * float((calm - faded).abs().mean())


def test_what_is_nearer_than_the_border_is_not_extended() -> None:
    cues, _, _ = room()
    mask = cues.mask
    near = torch.zeros_like(mask)
    row, edge = 20, int((~mask[20]).nonzero().max())
    near[row : row + 8, edge - 10 : edge + 6] = True  # before the wall, and over the photo's border
    red = torch.tensor([0.9, 0.1, 0.1])
    shown = ViewFeatures(
        torch.where(near[..., None], red, cues.rgb),
        torch.where(near, 0.22, cues.inverse_depth),
        torch.where(near, 1.0, cues.alpha),
        mask & ~near,
    )
    seeds = make_seeds(shown, VIEW, PHOTO)
    there = seeds.rgb[row : row + 8, edge + 16 :]
    assert float((there - WALL).abs().mean()) < 0.25  # of 0.53


def test_a_view_of_the_photos_own_frame_has_nothing_beyond() -> None:
    cues, _, _ = room()
    inner = ViewFeatures(cues.rgb, torch.ones_like(cues.inverse_depth), cues.alpha, cues.mask)
    seeds = make_seeds(inner, VIEW, VIEW)
    assert isinstance(seeds, Seeds)
    assert float((seeds.inverse_depth - 1).abs().max()) < 0.02
