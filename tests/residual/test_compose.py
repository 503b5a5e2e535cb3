"""Composition: what each channel of a delta does to a seed's Gaussian."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import pytest
import torch
from scenes import shifted

from spackle.camera import Camera
from spackle.color import linear_to_srgb, srgb_to_linear
from spackle.gaussians import Gaussians
from spackle.residual import Seeds
from spackle.residual.base_values import OPACITY
from spackle.residual.compose import COLOR_MARGIN, DELTA_CHANNELS, compose


def flat_seeds(count: int) -> tuple[Seeds, Camera]:
    """Seeds all over a picture, their colours off black and white."""
    generator = torch.Generator().manual_seed(0)
    camera = shifted(Camera.from_focal(60, 64, 48), 0.4)
    uv = torch.rand(count, 2, generator=generator) * torch.tensor([64.0, 48.0])
    inverse = 0.1 + torch.rand(count, generator=generator)
    slope = 0.01 * (torch.rand(count, 2, generator=generator) - 0.5)
    return Seeds(uv, inverse, slope, 0.1 + 0.8 * torch.rand(count, 3, generator=generator)), camera


def moved(channels: Sequence[int], by: float) -> tuple[Gaussians, Gaussians, Seeds, Camera]:
    """Seeds without deltas, and with one delta."""
    seeds, camera = flat_seeds(20)
    deltas = torch.zeros(20, DELTA_CHANNELS)
    deltas[:, list(channels)] = by
    return compose(seeds, None, camera), compose(seeds, deltas, camera), seeds, camera


def test_no_deltas_and_zero_deltas_both_give_the_seeds() -> None:
    seeds, camera = flat_seeds(50)
    none, zeros = compose(seeds, None, camera), compose(seeds, torch.zeros(50, DELTA_CHANNELS), camera)
    for one, other in zip(none.tensors, zeros.tensors, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    uv, z = camera.project(none.means)
    torch.testing.assert_close(uv, seeds.uv, rtol=0, atol=1e-3)
    torch.testing.assert_close(z, 1 / seeds.inverse_depth)
    torch.testing.assert_close(none.colors, srgb_to_linear(seeds.rgb))
    assert torch.equal(none.opacities, torch.full((50,), OPACITY))
    nothing = seeds.select(torch.zeros(50, dtype=torch.bool))
    assert len(compose(nothing, None, camera)) == len(compose(nothing, torch.zeros(0, DELTA_CHANNELS), camera)) == 0
    black_and_white = dataclasses.replace(seeds.select(torch.arange(50) < 2), rgb=torch.tensor([[0.0] * 3, [1.0] * 3]))
    found = linear_to_srgb(compose(black_and_white, torch.zeros(2, DELTA_CHANNELS), camera).colors)
    assert float((found - black_and_white.rgb).abs().max()) <= COLOR_MARGIN * 1.01  # within a step of 8 bits


@pytest.mark.parametrize(("channel", "step"), [(0, (1.5, 0.0)), (1, (0.0, -2.0))])
def test_two_channels_move_on_the_image_and_one_along_the_ray(channel: int, step: tuple[float, float]) -> None:
    _, after, seeds, camera = moved([channel], sum(step))
    uv, z = camera.project(after.means)
    torch.testing.assert_close(uv, seeds.uv + torch.tensor(step), rtol=0, atol=1e-3)
    torch.testing.assert_close(z, 1 / seeds.inverse_depth, rtol=1e-4, atol=0)
    for by in (-20.0, -1.0, 1.0, 20.0):  # never behind the eye
        before, after, seeds, camera = moved([2], by)
        uv, z = camera.project(after.means)
        torch.testing.assert_close(uv, seeds.uv, rtol=0, atol=1e-2)
        assert float(z.min()) > 0
        assert bool(((z < camera.project(before.means)[1]) == (by > 0)).all())  # inverse depth: more is nearer


@pytest.mark.parametrize("by", [-1e4, -1.0, 1.0, 1e4])
def test_colour_and_opacity_stay_within_bounds(by: float) -> None:
    before, after, _, _ = moved(range(10, 14), by)
    for one, other in ((before.colors, after.colors), (before.opacities, after.opacities)):
        assert 0 <= float(other.min()) <= float(other.max()) <= 1
        assert bool(((other > one) == (by > 0)).all())
