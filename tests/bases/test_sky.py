"""The sky of a photo: found only where depth and colour agree, and then at one distance behind everything."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from plain_cleanup import plain_flood
from scenes import Scene, motorcycle_base, slanted_plane, texture
from torch import Tensor

from spackle.bases.lift import _flood, push_sky
from spackle.camera import Camera


def outdoors(sky_depth: Tensor | float = 80.0) -> tuple[Scene, Tensor, Tensor]:
    """A field, a house, a flagpole and a sky, as a network sees them; [H, W] where the sky is, and the pole."""
    height, width = 96, 128
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    inverse = torch.where(y > height // 2, 0.01 * (y - height // 2), 1 / torch.as_tensor(sky_depth))
    blue = torch.tensor([0.35, 0.55, 0.9]) + 0.02 * texture(height, width)
    rgb = torch.where((y > height // 2)[..., None], texture(height, width, (0.35, 0.4, 0.2)), blue)
    house, pole = (x > 20) & (x < 50) & (y > 30) & (y < 60), (x >= 90) & (x < 92) & (y > 10) & (y < 80)
    for thing, inverse_depth, color in ((house, 0.1, (0.5, 0.3, 0.25)), (pole, 0.2, (0.2, 0.2, 0.2))):
        inverse = torch.where(thing, inverse_depth, inverse)
        rgb = torch.where(thing[..., None], torch.tensor(color), rgb)
    sky = (y <= height // 2) & ~house & ~pole
    return Scene(rgb.float(), 1 / inverse, Camera.from_focal(100, width, height)), sky, pole


def test_the_sky_is_one_plane_behind_everything() -> None:
    """However its predicted depth varies."""
    waves = 80 + 40 * texture(96, 128)[..., 0].sub(0.5).mul(10)
    scene, sky, pole = outdoors(waves)
    base = scene.lift()
    z = base.gaussians.means[: 96 * 128, 2].reshape(96, 128)
    assert base.notes["sky"] == pytest.approx(float(sky.float().mean()), abs=0.01)
    assert float(z[sky].max() / z[sky].min()) < 1 + 1e-5
    assert float(z[~sky].max()) < float(z[sky].min())
    torch.testing.assert_close(z[:61][pole[:61]], torch.full((2 * 50,), 5.0))
    torch.testing.assert_close(z[pole], torch.full((2 * 69,), 5.0), rtol=0.02, atol=0)  # by the field as near


def test_a_sky_without_depth_is_far_and_not_as_near_as_the_roofs() -> None:
    scene, sky, _ = outdoors()
    unknown = dataclasses.replace(scene, depth=torch.where(sky, 0.0, scene.depth)).lift()
    z = unknown.gaussians.means[: 96 * 128, 2].reshape(96, 128)
    assert float(z[sky].min()) > 100
    assert unknown.notes["depth_filled"] == 0
    near = dataclasses.replace(scene, depth=torch.where(sky, 0.0, 0.1 * scene.depth))
    assert "sky" not in near.lift().notes  # a model on a table, or a room: what is unknown there is filled


def test_a_sky_that_melts_into_the_sea_is_left_alone() -> None:
    """Pushed with the far part of the sea it would tear the sea apart."""
    scene, _, _ = outdoors()
    sea = torch.where((torch.arange(96)[:, None] > 48)[..., None], scene.rgb[0, 0], scene.rgb)
    assert "sky" in scene.lift().notes
    assert "sky" not in dataclasses.replace(scene, rgb=sea).lift().notes


def test_a_floor_that_runs_to_the_horizon_is_no_sky() -> None:
    """A lake or a field of snow: at the photo's border as far and as bright as any sky."""
    scene = slanted_plane(1.5, 1000, 0)
    for color in ((0.4, 0.55, 0.8), (0.95, 0.95, 0.97)):
        rgb = torch.tensor(color).expand(*scene.depth.shape, 3) + 0.02 * texture(*scene.depth.shape)
        assert "sky" not in dataclasses.replace(scene, rgb=rgb.clamp(0, 1)).lift().notes
    assert "sky" not in scene.lift().notes  # spots of it are blue


def test_specks_in_the_sky_belong_to_it_and_a_lake_does_not() -> None:
    scene, _, _ = outdoors()
    rgb = scene.rgb.clone()
    rgb[20, 60:62] = 0.1  # birds, which the depth does not know
    rgb[70:90, 60:80] = torch.tensor([0.35, 0.55, 0.9])
    inverse, _, _ = push_sky(1 / scene.depth, rgb, torch.ones(96, 128, dtype=torch.bool))
    far = inverse == inverse.min()
    assert bool(far[20, 60:62].all())
    assert not bool(far[49:].any())


@pytest.mark.parametrize("seed", range(4))
def test_the_flood_matches_growing_by_rings(seed: int) -> None:
    generator = np.random.default_rng(seed)
    rgb = (0.5 + 0.03 * generator.standard_normal((15, 20, 3))).astype(np.float32)
    candidates = generator.random((15, 20)) < 0.8
    first = candidates[0] & (generator.random(20) < 0.5)
    found = _flood(rgb, first, candidates)
    assert found[5:].any()
    assert np.array_equal(found, plain_flood(rgb, first, candidates))


def test_indoors_there_is_no_sky() -> None:
    """A bright backdrop ten times as far away as what stands before it, at eight metres."""
    y = torch.arange(96)[:, None].expand(96, 128)
    rgb = torch.where((y < 48)[..., None], torch.tensor(0.85), torch.tensor(0.2)).expand(96, 128, 3)
    inverse = torch.where(y < 48, 1 / 8.0, 1 / 0.5)
    pushed, _, share = push_sky(inverse, rgb.contiguous(), torch.ones(96, 128, dtype=torch.bool))
    assert share == 0
    assert torch.equal(pushed, inverse)
    _, _, outside = push_sky(inverse / 4, rgb.contiguous(), torch.ones(96, 128, dtype=torch.bool))
    assert outside > 0.4  # the same, four times as large
    assert "sky" not in motorcycle_base().notes
