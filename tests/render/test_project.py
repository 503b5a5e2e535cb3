"""The projection, whose arithmetic runs a block at a time, against its plain twin; the rest is in test_render.py."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from plain_project import project_plainly
from scenes import random_scene, turned_camera

from spackle.gaussians import Gaussians
from spackle.render.cpu import project, wanted_tiles
from spackle.render.project import BLOCK, DEPTH, RECORD, KernelCamera, Splats, natural_log
from spackle.render.protocol import ALPHA_MIN

CAMERA = turned_camera(150, 110, 90.0)
ROUNDING = 2.0**-23


def cloud(n: int, seed: int = 0) -> Gaussians:
    """Of any shape, from a thousandth of a pixel to half the image."""
    return random_scene(seed, n, CAMERA, 0.3, sizes=(1e-3, 50.0))


def found_in(splats: Splats, spans: np.ndarray) -> np.ndarray:
    """The numbers of the visible ones, as they came."""
    return np.concatenate([splats.ids[a : a + n] for a, n in spans]) if len(spans) else np.empty(0, np.int32)


def check(gaussians: Gaussians, eps2d: float = 0.0, tiles: torch.Tensor | None = None) -> int:
    """Hold the kernel to its twin, and count the visible ones."""
    view = KernelCamera.of(CAMERA, eps2d)
    wanted = wanted_tiles(view, tiles)
    splats, spans = project([gaussians], view, wanted)
    ids = found_in(splats, spans)
    expected = project_plainly(gaussians, view, wanted)
    assert ids.tolist() == list(expected)
    boxes = np.array([plain.box for plain in expected.values()]).reshape(-1, 4)
    np.testing.assert_array_equal(splats.boxes[ids], boxes)
    records = np.array([plain.record for plain in expected.values()]).reshape(-1, RECORD)
    np.testing.assert_allclose(splats.records[ids], records, rtol=ROUNDING, atol=1e-30)
    np.testing.assert_array_equal(splats.keys[: len(ids)].view(np.float32), splats.records[ids, DEPTH])
    assert not (splats.boxes[: len(gaussians), 1] > np.ceil(view.width / 16)).any()
    return len(ids)


@pytest.mark.parametrize("eps2d", [0.0, 0.3])
@pytest.mark.parametrize("n", [0, 1, 7, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 50])
def test_blocks_of_any_size_are_projected_as_one_by_one(n, eps2d):
    visible = check(cloud(n, seed=n), eps2d)
    assert n < 100 or 0.2 * n < visible < 0.8 * n


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5])
def test_gaussians_that_touch_no_wanted_tile_are_left_out(share):
    tiles = torch.rand(7, 10, generator=torch.Generator().manual_seed(1)) < share
    visible = check(cloud(700), tiles=tiles)
    assert (visible == 0) == (share == 0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e38, -1e38, 1e-40, 0.0])
def test_no_number_of_one_gaussian_spoils_it_or_its_neighbours_unnoticed(value):
    """Each of the fourteen numbers in turn, of every third Gaussian."""
    scene = cloud(14 * 3 * 8, seed=3)
    fields = [t.reshape(len(scene), -1).clone() for t in scene.tensors]
    for k, (field, column) in enumerate((f, c) for f in fields for c in range(f.shape[1])):
        field[3 * k :: 42, column] = value
    scene = Gaussians(*(f.reshape(t.shape) for f, t in zip(fields, scene.tensors, strict=True)))
    visible = check(scene)
    assert visible > 70
    splats, spans = project([scene], KernelCamera.of(CAMERA, 0.0), np.ones((7, 10), np.bool_))
    assert np.isfinite(splats.records[found_in(splats, spans)]).all()


def test_the_smallest_and_the_farthest_end_where_float32_would():
    """All in the middle of one pixel, which even the smallest touches: what counts is their size and distance."""
    uv = torch.tensor([[40.5, 30.5]]).expand(400, 2)
    scene = replace(cloud(400, seed=6), opacities=torch.ones(400))
    sizes = 10 ** torch.linspace(-25.0, -5.0, 400).double()
    small = replace(scene, means=CAMERA.unproject(uv, torch.ones(400)), scales=sizes.float()[:, None].expand(400, 3))
    assert 100 < check(small) < 300
    far = (10 ** torch.linspace(27.0, 33.0, 400).double()).float()
    distant = replace(scene, means=CAMERA.unproject(uv, far), scales=0.05 * far[:, None].expand(400, 3))
    assert 100 < check(distant) < 300


def test_what_is_seen_edge_on_keeps_its_slope():
    """A needle a million times as long as thick: its covariance has no digit to spare."""
    scene = cloud(400, seed=5)
    thin = replace(scene, scales=scene.scales * torch.tensor([1.0, 1e-6, 1e-6]))
    assert check(thin) > 50


def test_logarithms_hold_over_their_whole_range():
    generator = np.random.default_rng(0)
    special = [1.0, math.sqrt(0.5), math.sqrt(2.0), ALPHA_MIN, 0.999, *(1 + generator.normal(size=200) * 1e-6)]
    values = np.float32([*np.geomspace(1e-37, 1e30, 3001), *np.linspace(0.65, 1.5, 3001), *special])
    found = np.array([natural_log(x) for x in values])
    np.testing.assert_allclose(found, np.log(values.astype(np.float64)), rtol=4e-16, atol=0)
