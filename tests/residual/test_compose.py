"""Composition: what each channel of a delta does to a seed's Gaussian."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from scenes import shifted

from spackle.camera import Camera
from spackle.color import linear_to_srgb
from spackle.residual import Seeds
from spackle.residual.complete import compose
from spackle.residual.network import COLOR_MARGIN, DELTA_CHANNELS

CAMERA = shifted(Camera.from_focal(60, 64, 48), 0.4)
DRAWN = torch.rand(20, 8, generator=torch.Generator().manual_seed(0))
UV = DRAWN[:, :2] * torch.tensor([64.0, 48.0])
SEEDS = Seeds(UV, 0.1 + DRAWN[:, 2], 0.01 * (DRAWN[:, 3:5] - 0.5), 0.1 + 0.8 * DRAWN[:, 5:])
BEFORE = compose(SEEDS, None, CAMERA)


def test_no_deltas_and_zero_deltas_both_give_the_seeds() -> None:
    zeros = torch.zeros(20, DELTA_CHANNELS)
    for one, other in zip(BEFORE.tensors, compose(SEEDS, zeros, CAMERA).tensors, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    uv, z = CAMERA.project(BEFORE.means)
    torch.testing.assert_close(uv, SEEDS.uv, rtol=0, atol=1e-3)
    torch.testing.assert_close(z, 1 / SEEDS.inverse_depth)
    torch.testing.assert_close(linear_to_srgb(BEFORE.colors), SEEDS.rgb)
    assert len(compose(SEEDS.select(torch.zeros(20, dtype=torch.bool)), zeros[:0], CAMERA)) == 0
    extremes = dataclasses.replace(SEEDS, rgb=(DRAWN[:, 5:] > 0.5).float())  # black and white
    found = linear_to_srgb(compose(extremes, zeros, CAMERA).colors)
    assert float((found - extremes.rgb).abs().max()) <= COLOR_MARGIN * 1.01  # within a step of 8 bits


@pytest.mark.parametrize("by", [-1e4, -20.0, -1.0, 1.0, 20.0, 1e4])
def test_deltas_keep_bounds(by: float) -> None:
    deltas = torch.zeros(20, DELTA_CHANNELS)
    deltas[:, 2] = deltas[:, 10:] = by
    after = compose(SEEDS, deltas, CAMERA)
    _, z = CAMERA.project(after.means)
    assert float(z.min()) > 0  # never behind the eye
    assert bool(((z < 1 / SEEDS.inverse_depth) == (by > 0)).all())  # inverse depth: more is nearer
    for one, other in ((BEFORE.colors, after.colors), (BEFORE.opacities, after.opacities)):
        assert 0 <= float(other.min()) <= float(other.max()) <= 1
        assert bool(((other > one) == (by > 0)).all())
