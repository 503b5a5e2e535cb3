"""Specks of a depth map far before all surfaces: what sets the camera's path is said."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.trajectories import DepthRange
from spackle.depth.depth_map import DepthMap
from spackle.pipeline import describe_specks

CAMERA = Camera.from_focal(110.0, 128, 96)


def room(speck_m: float | None, side: int = 6) -> DepthMap:
    """The depth of a wall that recedes from 2 to 4 m, with a square of specks at another depth."""
    depth = torch.linspace(2, 4, 128).repeat(96, 1)
    if speck_m is not None:
        depth[40 : 40 + side, 60 : 60 + side] = speck_m
    valid = torch.ones(96, 128, dtype=torch.bool)
    return DepthMap(depth, valid, K=None, quantum=None, quantity="depth", path=Path("depth.npy"))


@pytest.mark.parametrize(
    ("depth", "says"),
    [
        (room(0.01), "is as near as 0.01, and the rest begins at 2"),
        (room(None), ""),
        (room(1.6), ""),  # a thing before the wall, such as a vase
        (room(0.5, side=30), ""),  # large enough for a surface
    ],
)
def test_specks_that_set_the_path_are_said(depth: DepthMap, says: str) -> None:
    scene = lift_rgbd(torch.rand(96, 128, 3), depth, CAMERA).gaussians
    line = describe_specks(scene)
    assert (says in line) if says else (line == "")
    # The path itself stays what the paper's rule makes of it.
    z = scene.means[:, 2].double().numpy()
    assert DepthRange.of(scene).near == pytest.approx(float(np.quantile(z, 0.001)))


@pytest.mark.parametrize("speck_m", [1e-20, 1e-38])
def test_a_depth_of_nearly_zero_gives_no_warnings_of_numpy(speck_m: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = lift_rgbd(torch.rand(96, 128, 3), room(speck_m), CAMERA).gaussians
        assert describe_specks(scene) != "" or float(scene.means[:, 2].min()) > 1
    assert scene.finite
