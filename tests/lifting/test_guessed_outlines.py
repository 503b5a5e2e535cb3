"""Outlines of guessed depth: near surfaces grow, and leave no pixel of their colour behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.scenes import same_bits
from numpy.typing import NDArray
from torch import Tensor

from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.surfels import DEPTH_EDGE_RATIO
from spackle.depth.depth_map import DepthMap
from spackle.lifting.guessed_outlines import grow_near_surfaces

Image = NDArray[np.float32]
NEAR_M, FAR_M = 2.0, 6.0


def boxes(seed: int) -> Image:
    """Inverse depth [24, 30] of three boxes at random places and depths before a wall."""
    rng = np.random.default_rng(seed)
    inverse_depth = np.full((24, 30), 0.1, np.float32)
    for near in (0.2, 0.4, 0.3):
        y = rng.integers(0, 18)
        x = rng.integers(0, 22)
        inverse_depth[y : y + 6, x : x + 8] = near
    return inverse_depth


def grown_once(inverse_depth: Image) -> Image:
    """Each pixel takes the nearest depth of its eight neighbours over a step."""
    height, width = inverse_depth.shape
    grown = inverse_depth.copy()
    for y in range(height):
        for x in range(width):
            own = inverse_depth[y, x]
            around = inverse_depth[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            if around.max() > own * (1 + DEPTH_EDGE_RATIO):
                grown[y, x] = around.max()
    return grown


@pytest.mark.parametrize("seed", range(4))
def test_a_near_surface_grows_over_each_neighbour_behind_it(seed: int) -> None:
    two_boxes = np.minimum(boxes(seed), np.float32(0.2))  # one height of steps
    expected = grown_once(grown_once(two_boxes))
    assert (expected != two_boxes).any()
    np.testing.assert_array_equal(grow_near_surfaces(two_boxes, 2), expected)


@pytest.mark.parametrize("seed", range(4))
def test_growing_brings_no_pixel_farther_and_invents_no_depth(seed: int) -> None:
    before = boxes(seed)
    after = grow_near_surfaces(before, 3)
    assert (after >= before).all()
    assert set(np.unique(after)) <= set(np.unique(before))


def test_a_slanted_plane_does_not_grow() -> None:
    steep = np.tile(np.linspace(0.02, 1, 40, dtype=np.float32), (20, 1))
    np.testing.assert_array_equal(grow_near_surfaces(steep, 3), steep)


def test_no_growth_leaves_the_lifted_scene_as_it_is() -> None:
    rgb, depth, camera = red_box()
    plain = lift_rgbd(rgb, depth, camera).gaussians
    given = lift_rgbd(rgb, depth, camera, outline_growth_px=0).gaussians
    assert same_bits(plain, given)


def red_box() -> tuple[Tensor, DepthMap, Camera]:
    """A photo of a red box before a grey wall, and a guess that sees the box two pixels smaller."""
    rgb = torch.full((48, 64, 3), 0.6)
    rgb[12:36, 20:44] = torch.tensor([0.8, 0.1, 0.1])
    # Lens and compression mix the colours beside the outline.
    rgb[1:-1, 1:-1] = torch.nn.functional.avg_pool2d(rgb.permute(2, 0, 1), 3, 1).permute(1, 2, 0)
    z = torch.full((48, 64), FAR_M)
    z[14:34, 22:42] = NEAR_M
    known = torch.ones_like(z, dtype=torch.bool)
    depth = DepthMap(z, known, K=None, quantum=None, quantity="depth", path=Path("guess"))
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    return rgb, depth, Camera(K, torch.eye(4), 64, 48)


def red_on_the_wall(outline_growth_px: int) -> int:
    """How many Gaussians at the wall's depth have clearly the box's colour."""
    gaussians = lift_rgbd(*red_box(), outline_growth_px=outline_growth_px).gaussians
    on_wall = gaussians.means[:, 2] > 0.9 * FAR_M
    redness = gaussians.colors[:, 0] - gaussians.colors[:, 1]
    return int((on_wall & (redness > 0.05)).sum())


def test_a_box_with_a_guessed_outline_leaves_none_of_its_colour_on_the_wall() -> None:
    assert red_on_the_wall(0) > 50
    assert red_on_the_wall(3) == 0
