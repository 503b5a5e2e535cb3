"""The fill of holes from their rim: exact where known, bounded, and biased to the far side."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from spackle.fill import far_fill

PROPERTY = settings(deadline=None, max_examples=50)
SIZES = st.tuples(st.integers(1, 13), st.integers(1, 13))
SEEDS = st.integers(0, 2**32 - 1)
BIASES = st.sampled_from([0.0, 5.0, 80.0])


def random_scene(seed: int, height: int, width: int, share: float = 0.4) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depths over two decades, two channels, and what is known; at least one pixel."""
    generator = torch.Generator().manual_seed(seed)
    inverse = 0.02 * 100 ** torch.rand(height, width, generator=generator)
    known = torch.rand(height, width, generator=generator) < share
    known[seed % height, seed % width] = True
    return inverse, torch.rand(2, height, width, generator=generator), known


def strip(width: int = 64, near: float = 1.0, far: float = 0.2) -> tuple[Tensor, Tensor, Tensor]:
    """A near red side, a hole, and a far blue side."""
    x = torch.arange(width).expand(16, width)
    inverse = torch.where(x < width // 2, near, far)
    red, blue = (x < width // 2).float(), (x >= width // 2).float()
    known = (x < width // 4) | (x >= width - width // 4)
    return inverse, torch.stack([red, torch.zeros_like(red), blue]), known


@pytest.mark.parametrize("share", [0.0, 0.4])  # a single pixel, and many
@PROPERTY
@given(seed=SEEDS, size=SIZES, bias=BIASES)
def test_known_pixels_stay_and_the_rest_is_within_their_range(
    share: float, seed: int, size: tuple, bias: float
) -> None:
    inverse, values, known = random_scene(seed, *size, share)
    filled, carried = far_fill(inverse, values, known, far_bias=bias)
    assert torch.equal(filled[known], inverse[known])
    assert torch.equal(carried[:, known], values[:, known])
    for image, source in ((filled, inverse[known]), (carried[0], values[0, known]), (carried[1], values[1, known])):
        assert float(image.min()) >= float(source.min()) * (1 - 1e-4) - 1e-6
        assert float(image.max()) <= float(source.max()) * (1 + 1e-4) + 1e-6


@pytest.mark.parametrize("bias", [0.0, 5.0, 80.0])
def test_a_relaxed_fill_is_a_membrane_over_the_rim(bias: float) -> None:
    """Each filled pixel is the mean of its neighbours, those of the rim weighted by min(1, fill / sample)^bias."""
    inverse, values, known = random_scene(7, 11, 13, 0.7)
    biases = bias * torch.rand(11, 13, generator=torch.Generator().manual_seed(1))
    filled, carried = far_fill(inverse, values, known, far_bias=biases, sweeps=4000)
    for y, x in (~known).nonzero().tolist():
        mass, total = 0.0, torch.zeros(3, dtype=torch.float64)
        for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            v, u = min(max(v, 0), 10), min(max(u, 0), 12)  # nothing flows across the border
            trust = min(1.0, float(filled[y, x] / filled[v, u])) ** float(biases[y, x]) if known[v, u] else 1.0
            mass += max(trust, 1e-6)
            total += max(trust, 1e-6) * torch.stack([filled[v, u], *carried[:, v, u]]).double()
        expected = torch.stack([filled[y, x], *carried[:, y, x]]).double()
        torch.testing.assert_close(total / mass, expected, rtol=2e-3, atol=1e-4)


@PROPERTY
@given(SEEDS, SIZES, BIASES)
def test_what_is_not_known_is_not_read(seed: int, size: tuple, bias: float) -> None:
    inverse, values, known = random_scene(seed, *size)
    filled, carried = far_fill(inverse, values, known, far_bias=bias)
    for rubbish in (math.nan, math.inf, -1.0, 0.0, 1e30):
        spoiled = torch.where(known, inverse, rubbish), torch.where(known, values, rubbish)
        again = far_fill(*spoiled, known, far_bias=bias)
        assert torch.equal(again[0], filled)
        assert torch.equal(again[1], carried)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_hole_beside_a_near_thing_extends_what_is_behind_it(turned: bool, flipped: bool) -> None:
    inverse, values, known = strip()
    if flipped:
        inverse, values, known = inverse.flip(1), values.flip(2), known.flip(1)
    if turned:
        inverse, values, known = inverse.T, values.transpose(1, 2), known.T
    filled, carried = far_fill(inverse, values, known)
    _, alike = far_fill(inverse, values, known, far_bias=0.0)
    assert float(filled[~known].median()) < 0.3  # the far side has 0.2, the near one 1
    assert float(alike[0][~known].mean()) == pytest.approx(0.5, abs=0.05)
    assert float(carried[0][~known].mean()) < 0.3


def test_edge_cases() -> None:
    inverse, values, known = random_scene(4, 8, 8)
    kept = inverse.clone(), values.clone()
    filled, carried = far_fill(inverse, torch.zeros(0, 8, 8), known)
    assert carried.shape == (0, 8, 8)
    assert torch.equal(filled[known], inverse[known])
    far_fill(inverse, values, known)
    filled, carried = far_fill(inverse, values, torch.ones(8, 8, dtype=torch.bool))
    for found in ((inverse, values), (filled, carried)):  # the input is left alone, and without holes nothing happens
        assert all(torch.equal(one, other) for one, other in zip(found, kept, strict=True))
    with pytest.raises(ValueError, match="no pixel is known"):
        far_fill(inverse, values, torch.zeros(8, 8, dtype=torch.bool))
