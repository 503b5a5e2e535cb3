"""Initial Gaussians of holes behind objects, and beyond the photo's border."""

from __future__ import annotations

import dataclasses

import torch
from helpers.holes import random_view
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.core.camera import Camera
from spackle.core.surfels import BEHIND_SURFACE_RATIO
from spackle.residual import CELL, ViewFeatures, initialize
from spackle.residual.features import cell_centers
from spackle.residual.initializer import GAUSSIAN_REACH_CELLS, inside_photo

PHOTO = Camera.from_focal(150, 240, 160)
VIEW = PHOTO.looking(torch.tensor([-1.2, 0.0, 0.0]), torch.tensor([0.3, 0.0, 4.0]))
FLOOR, WALL = torch.tensor([0.7, 0.6, 0.2]), torch.tensor([0.2, 0.3, 0.8])
GROUND, BACK = 1.0, 6.0  # y of the floor and z of the wall


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.tuples(*[st.integers(1, 40)] * 2))
def test_initial_gaussians_lie_behind_visible_surfaces(seed: int, size: tuple[int, int]) -> None:
    features, camera = (
        ViewFeatures.of(random_view(seed, *size)),
        Camera.from_focal(25, size[1], size[0]),
    )
    initial = initialize(features, camera, camera)
    assert all(
        bool(t.isfinite().all())
        for t in (initial.uv, initial.inverse_depth, initial.slope, initial.rgb)
    )
    assert float(initial.inverse_depth.min()) > 0
    assert 0 <= float(initial.rgb.min()) <= float(initial.rgb.max()) <= 1
    seen = torch.where(features.inverse_depth > 0, features.inverse_depth, torch.inf)
    farthest = -max_pool2d(-seen[None], 2 * GAUSSIAN_REACH_CELLS + 1, 1, GAUSSIAN_REACH_CELLS)[0]
    assert bool(
        (initial.inverse_depth <= farthest * (1 - BEHIND_SURFACE_RATIO / 2))[features.mask].all()
    )
    chosen = initial.select(features.mask)
    for name in ("uv", "inverse_depth", "slope", "rgb"):
        assert torch.equal(getattr(chosen, name), getattr(initial, name)[features.mask])


def test_inside_photo_matches_projected_points() -> None:
    photo = Camera.from_focal(25, 40, 30)
    camera = photo.looking(torch.tensor([0.4, -0.2, 0.1]), torch.tensor([0.1, 0.2, 3.0]))
    inverse = 0.1 + torch.rand(15, 20, generator=torch.Generator().manual_seed(0))
    place, z = photo.project(camera.unproject(cell_centers(camera), 1 / inverse))
    expected = (z > 0) & ((place >= 0) & (place < torch.tensor([40, 30]))).all(-1)
    assert 10 < int(expected.sum()) < 290
    assert torch.equal(inside_photo(inverse, camera, photo), expected)


def room() -> tuple[ViewFeatures, Tensor, Tensor]:
    """Features of an endless floor and wall, inverse depth of all cells, and the floor's cells [h,
    w] bool.
    """
    rays = (
        VIEW.unproject(cell_centers(VIEW), torch.ones(VIEW.height // CELL, VIEW.width // CELL))
        - VIEW.position
    )
    reach = torch.where(rays[..., 1] > 0, GROUND / rays[..., 1].clamp_min(1e-6), torch.inf)
    floor, depth = reach < BACK / rays[..., 2], torch.minimum(reach, BACK / rays[..., 2])
    place, _ = PHOTO.project(VIEW.position + rays * depth[..., None])
    mask = ((place < 0) | (place >= torch.tensor([PHOTO.width, PHOTO.height]))).any(-1)
    rgb = torch.where(floor[..., None], FLOOR, WALL)
    return (
        ViewFeatures(rgb * ~mask[..., None], ~mask / depth, (~mask).float(), mask),
        1 / depth,
        floor,
    )


def test_floor_and_wall_are_extended_beyond_the_border() -> None:
    features, inverse_depth, floor = room()
    initial, beyond = initialize(features, VIEW, PHOTO), features.mask
    assert float(beyond.float().mean()) > 0.2
    off = (initial.inverse_depth / inverse_depth - 1).abs()[beyond]
    assert float(off.median()) < 0.015
    assert float(off.mean()) < 0.06
    for surface, color in ((floor, FLOOR), (~floor, WALL)):
        assert float((initial.rgb - color).abs().mean(-1)[beyond & surface].mean()) < 0.12
    within = initialize(
        dataclasses.replace(features, inverse_depth=torch.ones_like(inverse_depth)), VIEW, VIEW
    )
    assert (
        float((within.inverse_depth - 1).abs().max()) < 0.02
    )  # the photo's own view has no border


def test_nearer_objects_are_not_extended_beyond_the_border() -> None:
    features, _, _ = room()
    near, edge = torch.zeros_like(features.mask), int((~features.mask[20]).nonzero().max())
    near[20:28, edge - 10 : edge + 6] = True  # in front of the wall, across the photo's border
    red = torch.where(near[..., None], torch.tensor([0.9, 0.1, 0.1]), features.rgb)
    inverse, alpha = (
        torch.where(near, 0.22, features.inverse_depth),
        torch.where(near, 1.0, features.alpha),
    )
    initial = initialize(ViewFeatures(red, inverse, alpha, features.mask & ~near), VIEW, PHOTO)
    assert float((initial.rgb[20:28, edge + 16 :] - WALL).abs().mean()) < 0.3  # of 0.53
