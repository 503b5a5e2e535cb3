"""Depth maps are resampled, sharpened along the photo's outlines, and smoothed if noisy."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.plain_cleanup import Pixel, cheapest, uncompiled
from helpers.scenes import Scene, box_before_wall, box_mask, slanted_plane, texture
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.filters import gaussian_blur
from spackle.core.hole_filling import fill_from_far_side
from spackle.depth.depth_map import DepthMap
from spackle.lifting import edges, open_pixels, resampling, smoothing
from spackle.lifting.edges import find_edges
from spackle.lifting.open_pixels import assign_open_pixels
from spackle.lifting.resampling import HOLE, OPEN, resample_map
from spackle.lifting.smoothing import NOISE_DEVIATIONS, estimate_noise, smooth_inverse_depth
from spackle.runtime.errors import InputError

FOCAL = (100.0, 110.0)


def map_of(inverse: Tensor, known: Tensor | None = None) -> DepthMap:
    known = inverse > 0 if known is None else known
    return DepthMap(
        torch.where(known, 1 / inverse, 0.0), known, None, None, "depth", Path("network")
    )


def front(scene: Scene, depth: DepthMap) -> Tensor:
    """[H, W] inverse depth of the pixels' Gaussians after lifting."""
    means = lift_rgbd(scene.rgb, depth, scene.camera, levels=0).gaussians.means
    return 1 / means[: scene.depth.numel(), 2].reshape(scene.depth.shape)


def settled(
    inverse: Tensor, known: Tensor, rgb: Tensor, focal: tuple[float, float] = FOCAL
) -> tuple[Tensor, Tensor]:
    """Sharpened inverse depth at the photo's size, and a mask of the pixels that are no holes."""
    depths, mask = inverse.numpy(), known.numpy()
    sampled = resample_map(depths, mask, find_edges(depths, mask, focal), *rgb.shape[:2])
    return torch.from_numpy(
        assign_open_pixels(sampled, rgb.contiguous().numpy())
    ), torch.from_numpy(sampled.state != HOLE)


def random_map(seed: int, height: int = 13, width: int = 17) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth with planes, blurred steps and holes, and a mask of its known pixels."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
    inverse = 0.3 + 0.2 * torch.rand(1, generator=generator) * x
    for _ in range(3):
        a, b, c, rise = (2 * torch.rand(4, generator=generator) - 1).tolist()
        inverse = inverse + torch.where(a * (x - 0.5) + b * (y - 0.5) > 0.2 * c, abs(rise), 0.0)
    inverse = gaussian_blur(
        inverse[..., None], 0.4 + 0.5 * float(torch.rand(1, generator=generator))
    )[..., 0]
    inverse = inverse + 0.003 * torch.rand(height, width, generator=generator)
    known = torch.rand(height, width, generator=generator) > 0.06
    return torch.where(known, inverse, 0.0).numpy(), known.numpy()


def random_photo(seed: int, height: int, width: int) -> np.ndarray:
    generator = torch.Generator().manual_seed(seed + 1000)
    coarse = torch.rand(1, 3, 4, 5, generator=generator)
    smooth = interpolate(coarse, size=(height, width), mode="bilinear", align_corners=False)[
        0
    ].permute(1, 2, 0)
    return (smooth + 0.05 * torch.rand(height, width, 3, generator=generator)).contiguous().numpy()


def noisy(inverse: np.ndarray, seed: int, noise: float = 0.005) -> np.ndarray:
    return (
        inverse * (1 + noise * np.random.default_rng(seed).standard_normal(inverse.shape))
    ).astype(np.float32)


@pytest.mark.parametrize(("seed", "size"), [(0, (14, 18)), (1, (30, 35)), (2, (9, 12))])
def test_compiled_kernels_agree_with_plain_python(seed: int, size: tuple[int, int]) -> None:
    inverse, known = random_map(seed, 14, 18)
    rgb, rough = random_photo(seed, *size), noisy(inverse, seed)

    def arrays() -> list[np.ndarray]:
        found = find_edges(inverse, known, FOCAL)
        sampled = resample_map(inverse, known, found, *size)
        images = (
            found.smear_height,
            found.right,
            found.below,
            sampled.state,
            sampled.inverse_depth,
            sampled.edge_height,
        )
        return [
            *images,
            *sampled.slope,
            assign_open_pixels(sampled, rgb),
            smooth_inverse_depth(rough, known, np.float32(0.01)),
        ]

    compiled = arrays()
    assert compiled[0].any()
    with uncompiled(edges, open_pixels, resampling, smoothing):
        plain = arrays()
    for one, other in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def sphere(radius_px: float, behind: float, size: int = 120) -> Tensor:
    """Exact inverse depth of a ball at 3 m, `behind` radii in front of a wall.

    The focal length is 200 pixels.
    """
    ray = Camera.from_focal(200, size, size).pixel_centers().sub(size / 2).div(200)
    radius = 3 * radius_px / 200
    a, c = ray.square().sum(-1) + 1, 9 - radius**2
    within = 9 - a * c
    return torch.where(within > 0, a / (3 - within.clamp_min(0).sqrt()), 1 / (3 + behind * radius))


@pytest.mark.parametrize("radius", [5, 10, 30, 50])
@pytest.mark.parametrize("behind", [0.0, 0.2, 1.0])
def test_a_ball_in_front_of_a_wall_keeps_its_shape(radius: float, behind: float) -> None:
    inverse = sphere(radius, behind)
    rgb = torch.where((inverse == inverse.min())[..., None], 0.2, texture(*inverse.shape))
    error = (settled(inverse, inverse > 0, rgb, (200.0, 200.0))[0] / inverse - 1).abs()
    assert float(error.max()) < 0.04
    assert int((error > 0).sum()) < 3 * 2 * math.pi * radius


@pytest.mark.parametrize(
    "factor", [(1.0, 1.0), (1.25, 1.25), (3.3, 2.9), (4.0, 4.0), (12.0, 12.0), (0.7, 0.7)]
)
@pytest.mark.parametrize("slope", [(0.0, 1.0), (1.0, 0.0), (-0.4, 0.7)])
def test_a_plane_stays_that_plane_at_any_size(
    factor: tuple[float, float], slope: tuple[float, float]
) -> None:

    def plane(rows: int, columns: int) -> Tensor:
        x, y = (torch.arange(columns) + 0.5) / columns, (torch.arange(rows) + 0.5) / rows
        return 0.5 + 0.4 * (slope[0] * x + slope[1] * y[:, None])

    rgb = torch.rand(96, 120, 3, generator=torch.Generator().manual_seed(0))
    scene = Scene(rgb, 1 / plane(96, 120), Camera.from_focal(100, 120, 96))
    found = front(scene, map_of(plane(round(96 / factor[0]), round(120 / factor[1]))))
    torch.testing.assert_close(found, plane(96, 120), rtol=1e-5, atol=0)


@pytest.mark.parametrize("seed", [0, 1, 3, 4, 5, 6])
def test_cheapest_paths_are_those_of_dijkstra(seed: int) -> None:
    inverse, known = random_map(seed)
    height, width = ((13, 17), (21, 30))[seed % 2]
    sampled = resample_map(inverse, known, find_edges(inverse, known, FOCAL), height, width)
    flat = np.zeros((height, width), np.float32)
    sampled, rgb = (
        dataclasses.replace(sampled, slope=(flat, flat)),
        random_photo(seed, height, width),
    )
    found, expected = assign_open_pixels(sampled, rgb), sampled.inverse_depth.copy()
    for state in (OPEN, HOLE):
        far = fill_from_far_side(
            *map(torch.from_numpy, (expected, expected[None], sampled.state != HOLE))
        )[0].numpy()

        def step(p: Pixel, q: Pixel, state: int = state, far: np.ndarray = far) -> float:
            cost = open_pixels.COLOR_CHANGE_COST * float(np.abs(rgb[p] - rgb[q]).sum())
            if state == OPEN:
                return cost + open_pixels.COLOR_CHANGE_COST * abs(
                    float(expected[q] - expected[p]) / float(sampled.edge_height[q])
                )
            near = max(0.0, 1 - float(far[q] / expected[p])) if sampled.state[p] > state else 0.0
            return cost + open_pixels.NEAR_START_COST * near

        origin = cheapest(sampled.state > state, sampled.state == state, step)
        depths = {pixel: expected[start] for pixel, start in origin.items()}
        for pixel, depth in depths.items():
            expected[pixel] = depth
    assert (sampled.state == OPEN).any()
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("sigma", "factor"), [(1.0, 1), (2.0, 1), (3.0, 1), (1.0, 4), (3.0, 4), (6.0, 4)]
)
def test_a_smeared_outline_snaps_to_the_photos(sigma: float, factor: int) -> None:
    scene = box_before_wall(width=192, height=144, focal=200)
    smeared = avg_pool2d(gaussian_blur(1 / scene.depth[..., None], sigma)[None, ..., 0], factor)[
        None
    ]
    found = front(scene, map_of(smeared[0, 0]))
    ways = [
        3 * values - 0.5
        for values in (interpolate(smeared, size=(144, 192), mode="bilinear"), found)
    ]
    # The number of pixels between box (1) and wall (0), at least 5 % away from both.
    before, after = (int(((way > 0.05) & (way < 0.95)).sum()) for way in ways)
    assert before > 400
    assert after <= 8  # about the corners
    assert int(((found > 1 / 3) ^ box_mask(192, 144)).sum()) <= 24
    assert float((found * scene.depth - 1).abs().median()) < 1e-3


@pytest.mark.parametrize("quantum", [0.0, 0.02])
def test_smoothing_changes_values_by_at_most_half_a_step_or_the_noise(quantum: float) -> None:
    inverse, known = random_map(1)
    inverse = noisy(inverse, 1)
    found = smooth_inverse_depth(inverse, known, np.float32(quantum))
    reach = np.maximum(quantum / 2, NOISE_DEVIATIONS * estimate_noise(inverse, known) * inverse)
    assert np.array_equal(found[~known], inverse[~known])
    assert (np.abs(found - inverse) <= reach * (1 + 1e-3)).all()
    assert (found != inverse).mean() > 0.3


@pytest.mark.parametrize("noise", [0.001, 0.003, 0.01])
def test_the_noise_of_a_slanted_plane_is_measured(noise: float) -> None:
    inverse = noisy((1 / slanted_plane(1.5, 6, 1).depth).numpy(), 0, noise)
    assert estimate_noise(inverse, np.ones(inverse.shape, bool)) == pytest.approx(noise, rel=0.05)
    assert estimate_noise(np.ones((2, 9), np.float32), np.ones((2, 9), bool)) == 0
    assert estimate_noise(np.ones((9, 9), np.float32), np.zeros((9, 9), bool)) == 0


def test_a_clean_map_is_not_smoothed() -> None:
    mesh = torch.full((60, 80), 0.2)
    mesh[::5] = mesh[1::5] = mesh[:, ::5] = mesh[:, 1::5] = 1.0
    for inverse in (
        1 / box_before_wall().depth,
        sphere(30, 1.0),
        1 / slanted_plane(1.5, 6, 0).depth,
        mesh,
    ):
        clean = inverse.numpy()
        assert np.array_equal(
            smooth_inverse_depth(clean, np.ones(clean.shape, bool), np.float32(0)), clean
        )


def test_invalid_depths_are_filled() -> None:
    scene = slanted_plane(2, 4, 0, width=48, height=36, focal=40)
    depth = scene.depth.clone()
    depth[10, 10:26:4] = torch.tensor([math.nan, math.inf, 0.0, -1.0])
    every = torch.ones(36, 48, dtype=torch.bool)
    found = lift_rgbd(
        scene.rgb, DepthMap(depth, every, None, None, "depth", Path("d")), scene.camera, levels=0
    )
    assert found.gaussians.finite
    assert found.notes["depth_filled"] == round(4 / (36 * 48), 4)
    with pytest.raises(InputError, match=r"network: no depth is left at 48×36"):
        lift_rgbd(scene.rgb, map_of(torch.zeros(36, 48)), scene.camera)
