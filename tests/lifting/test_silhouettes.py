"""Silhouettes in two layers: finding both surfaces, blending them, and lifting them."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from helpers.plain_cleanup import uncompiled
from helpers.scenes import Scene, box_before_wall, psnr
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.surfels import SURFEL_OPACITY
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost
from spackle.lifting import silhouettes, splats, step_surfaces
from spackle.lifting.quadtree import TILE_LEVELS
from spackle.lifting.silhouettes import find_layers
from spackle.lifting.splats import NEIGHBOR_FALLOFF, blended_opacities, layered_gaussians
from spackle.render import CpuRenderer

Image = np.ndarray
CPU = CpuRenderer()


def steps(seed: int, height: int = 15, width: int = 17) -> tuple[Image, Image, Image]:
    """Inverse depth with steps along random lines, its slopes, and colours.

    The colours are blurred and noisy, and follow the depth.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    inverse = 0.2 + 0.002 * x + 0.001 * rng.random((height, width))
    for level in (0.4, 0.6)[: 1 + seed % 2]:
        a, b, c = rng.normal(size=3)
        inverse[a * (x - width / 2) + b * (y - height / 2) > 3 * c] += level
    noise = 0.05 * rng.normal(size=(height, width, 3))
    colors = np.clip(np.stack([inverse, 1 - inverse, 0.5 + 0 * inverse], -1) + noise, 0, 1)
    colors[1:] = 0.6 * colors[1:] + 0.4 * colors[:-1]
    return (
        inverse.astype(np.float32),
        np.zeros((height, width, 2), np.float32),
        colors.astype(np.float32),
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_compiled_kernels_agree_with_plain_python(seed: int) -> None:
    made = steps(seed)

    def arrays() -> list[Image]:
        found = find_layers(*made)
        return [*dataclasses.astuple(found), blended_opacities(found.alpha, found.ring)]

    compiled = arrays()
    assert 0 < np.count_nonzero(compiled[0]) < compiled[0].size
    with uncompiled(silhouettes, splats, step_surfaces):
        plain = arrays()
    for one, other in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-4)


def blended() -> Scene:
    """A dark box in front of a bright wall, rendered at four times the resolution.

    The box's left border halves pixels.
    """
    fine = box_before_wall(width=384, height=288, focal=320)
    near = fine.depth < 3
    near[:, 128:130] = False  # the left border lies half a pixel further in
    rgb = torch.where(near[..., None], torch.tensor([0.1, 0.1, 0.4]), torch.tensor([0.8, 0.9, 0.5]))
    mixed = avg_pool2d(srgb_to_linear(rgb).movedim(-1, 0), 4).movedim(0, -1)
    share = avg_pool2d(near.float()[None], 4)[0]
    return Scene(
        linear_to_srgb(mixed), torch.where(share >= 0.5, 2.0, 6.0), Camera.from_focal(80, 96, 72)
    )


def wall_beside(scene: Scene) -> list[Tensor]:
    """[N, 3] colours of the wall in views from both sides."""
    base = scene.lift(TILE_LEVELS).gaussians
    assert psnr(CPU.render(base, scene.camera).rgb, scene.rgb) > 32
    views = [
        CPU.render(base, view)
        for view in leftmost_and_rightmost(scene.camera, 0.3, DepthRange.of(base, is_metric=True))
    ]
    return [seen.rgb[(seen.depth > 5) & (seen.alpha > 0.95)] for seen in views]


def test_a_mixed_pixel_is_separated_into_both_colours() -> None:
    scene = blended()
    colors = srgb_to_linear(scene.rgb)
    found = find_layers(
        (1 / scene.depth).numpy(), np.zeros((72, 96, 2), np.float32), colors.numpy()
    )
    column = found.alpha[30:42, 32]  # the box covers half of these pixels
    assert column == pytest.approx(0.5, abs=0.06)
    assert found.alpha[30:42, 36] == pytest.approx(0) or found.ring[36, 36] == 0
    near, far = srgb_to_linear(torch.tensor([[0.1, 0.1, 0.4], [0.8, 0.9, 0.5]])).numpy()
    assert np.abs(found.color[0, 30:42, 32] - near).max() < 0.05
    assert np.abs(found.color[1, 30:42, 32] - far).max() < 0.05
    for wall in wall_beside(scene):
        assert float(wall.amin()) > 0.42  # the wall shows none of the box's colour


def test_a_sharpened_fringe_belongs_to_the_near_surface() -> None:
    scene = blended()
    scene.rgb[:, 31][scene.depth[:, 32] < 3] = torch.tensor([1.0, 1.0, 0.9])
    for wall in wall_beside(scene):
        assert float(wall[:, 2].amax()) < 0.6


@pytest.mark.parametrize("cells", [2, 3, 7])
def test_a_photo_full_of_steps_has_no_holes_and_few_gaussians(cells: int) -> None:
    y, x = torch.meshgrid(torch.arange(42) // cells, torch.arange(50) // cells, indexing="ij")
    near = ((x + y) % 2).bool()
    colors = torch.where(near[..., None], 0.9, 0.1) + 0.05 * torch.rand(42, 50, 3)
    base = layered_gaussians(torch.where(near, 0.5, 0.2), colors, Camera.from_focal(60, 50, 42))
    assert 42 * 50 <= len(base) <= 42 * 50 * 9 // 4
    assert float(CPU.render(base, Camera.from_focal(60, 50, 42)).alpha.min()) > 0.95


@pytest.mark.parametrize("seed", [1, 2])
def test_rings_are_distances_to_the_nearest_step(seed: int) -> None:
    ring = torch.from_numpy(find_layers(*steps(seed)).ring)
    within = [
        max_pool2d((ring == 1).float()[None], 2 * n + 1, 1, n)[0] > 0
        for n in range(step_surfaces.MAX_RING)
    ]
    expected = torch.where(within[-1], step_surfaces.MAX_RING + 1 - torch.stack(within).sum(0), 0)
    assert torch.equal(ring.long(), expected)


@pytest.mark.parametrize("seed", range(3))
def test_opacities_blend_to_the_shares(seed: int) -> None:
    inverse, slope, colors = steps(seed)
    layers = find_layers(inverse, slope, colors)
    opacity = blended_opacities(layers.alpha, layers.ring)
    for y, x in np.argwhere((layers.ring > 0) & (opacity > 0) & (opacity < 1)):
        passes = 1.0
        for k, (dy, dx) in enumerate(itertools.product((-1, 0, 1), repeat=2)):
            v, u = (
                min(max(y + dy, 0), inverse.shape[0] - 1),
                min(max(x + dx, 0), inverse.shape[1] - 1),
            )
            if k != 4 and layers.ring[v, u]:
                passes *= 1 - SURFEL_OPACITY * NEIGHBOR_FALLOFF[k] * opacity[v, u]
        assert 1 - passes * (1 - opacity[y, x]) == pytest.approx(layers.alpha[y, x], abs=0.03)
