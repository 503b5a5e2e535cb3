"""Depths of photos at known points: the correction, its Gaussians, and matched patches."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from helpers.posed_captures import EYES, HEIGHT, WIDTH, camera_at, view
from helpers.scenes import random_gaussians

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.posed.correction import (
    FIELD_NODES,
    DepthCorrection,
    FittedCorrection,
    KnownDepths,
    fit_correction,
    move_gaussians,
)
from spackle.posed.matching import match_depths


def some_points(count: int, seed: int = 0) -> KnownDepths:
    """Points on the surfaces of the middle photo."""
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(count, 2, generator=generator) * torch.tensor([WIDTH, HEIGHT])
    column, row = uv.long().unbind(1)
    return KnownDepths(uv, view(EYES[1]).depth[row, column])


def fit(points: KnownDepths, depth: torch.Tensor) -> FittedCorrection:
    found = fit_correction(points, depth, torch.ones_like(depth, dtype=torch.bool))
    assert found is not None
    return found


def corrected(found: FittedCorrection, depth: torch.Tensor) -> torch.Tensor:
    """The corrected depth [H, W] of all pixels."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    place = torch.stack([x / WIDTH, y / HEIGHT], dim=-1).reshape(-1, 2).double()
    return (1 / found.correction.inverse_depth(1 / depth.flatten().double(), place)).reshape(
        HEIGHT, WIDTH
    )


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("shift", [0.0, 0.15])
def test_wrong_unit_and_shift_are_recovered_although_a_third_of_the_points_is_wrong(
    factor: float, shift: float
) -> None:
    truth = view(EYES[1]).depth
    base_depth = factor / (1 / truth + shift)
    points = some_points(300)
    rng = np.random.default_rng(1)
    z = points.z.clone()
    z[:90] *= torch.from_numpy(rng.uniform(0.2, 5, 90)).float()  # 30 % of the points
    found = fit(KnownDepths(points.uv, z), base_depth)
    error = (corrected(found, base_depth) / truth - 1).abs()
    assert float(error.median()) < 0.005
    assert float(error.quantile(0.98)) < 0.02
    assert found.error < 0.02
    assert found.explained_ratio > 0.6


def test_a_bent_depth_is_straightened_by_points() -> None:
    truth = view(EYES[1]).depth
    bend = 1 + 0.3 * torch.sin(torch.linspace(0, 3, WIDTH))[None, :] * torch.ones(HEIGHT, 1)
    found = fit(some_points(300), truth * bend)
    straight = corrected(found, truth * bend)
    before = (truth * bend / (truth * bend).median() * truth.median() / truth - 1).abs().median()
    after = (straight / truth - 1).abs().median()
    assert after < 0.01 < 0.05 < before


def test_few_points_give_no_correction() -> None:
    truth = view(EYES[1]).depth
    everywhere = torch.ones_like(truth, dtype=torch.bool)
    assert fit_correction(some_points(7), truth, everywhere) is None
    assert fit_correction(some_points(300), truth, ~everywhere) is None


def test_the_unit_of_the_world_does_not_matter() -> None:
    truth = view(EYES[1]).depth
    points = some_points(100)
    metres = fit(points, truth * 1.3)
    millimetres = fit(KnownDepths(points.uv, points.z * 1000), truth * 1.3)
    assert torch.allclose(
        corrected(metres, truth * 1.3) * 1000, corrected(millimetres, truth * 1.3), rtol=1e-6
    )


def test_moved_gaussians_are_the_image_of_the_map_of_space() -> None:
    """The covariance follows the Jacobian of the map, here by finite differences."""
    camera = Camera.from_focal(90.0, 100, 80)
    true_camera = dataclasses.replace(camera, K=camera.K.clone())
    true_camera.K[0, 0] = 100.0
    true_camera.K[0, 2] += 3
    generator = torch.Generator().manual_seed(2)
    field = 0.2 * torch.randn(FIELD_NODES, generator=generator).double()
    correction = DepthCorrection(0.7, 0.05, field, first_layer=0.1, last_layer=0.6)
    gaussians = random_gaussians(40, dtype=torch.float64)

    def moved(points: torch.Tensor) -> torch.Tensor:
        """Points moved: the same pixel of the true lens, at the corrected depth."""
        uv, z = camera.project(points)
        inverse = correction.inverse_depth(1 / z, uv / torch.tensor([100.0, 80.0]).double())
        return true_camera.unproject(uv, 1 / inverse)

    result = move_gaussians(gaussians, correction, camera, true_camera)
    means = gaussians.means
    assert torch.allclose(result.means, moved(means), rtol=1e-6)
    step = 1e-6
    columns = [
        (moved(means + step * axis) - moved(means - step * axis)) / (2 * step)
        for axis in torch.eye(3, dtype=torch.float64)
    ]
    jacobian = torch.stack(columns, dim=2)
    expected = jacobian @ gaussians.covariances() @ jacobian.transpose(1, 2)
    # Beside the field's nodes, where its slope jumps, differences see both sides.
    error = (result.covariances() - expected).abs().amax((1, 2)) / expected.abs().amax((1, 2))
    assert float(error.quantile(0.9)) < 1e-4


def test_an_unchanged_photo_keeps_the_shapes_of_its_gaussians() -> None:
    camera = Camera.from_focal(90.0, 100, 80)
    gaussians = random_gaussians(40)
    unchanged = DepthCorrection(1.0, 0.0, torch.zeros(2, 2, 2))
    result = move_gaussians(gaussians, unchanged, camera, camera)
    assert torch.allclose(result.means, gaussians.means, atol=1e-6)
    assert torch.allclose(result.covariances(), gaussians.covariances(), atol=1e-6)
    assert isinstance(result, Gaussians)


def test_patches_that_photos_share_give_depths_without_points() -> None:
    photos = [view(eye) for eye in EYES]
    cameras = [camera_at(eye) for eye in EYES]
    found = match_depths(
        [photo.rgb for photo in photos], cameras, 1, cameras[1].to(dtype=torch.float32)
    )
    column, row = found.uv.long().unbind(1)
    truth = photos[1].depth[row, column]
    error = (found.z / truth - 1).abs()
    assert len(found) >= 25
    assert float(error.median()) < 0.03
    assert float((error < 0.1).double().mean()) > 0.8
