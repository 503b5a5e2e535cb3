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


@PROPERTY
@given(SEEDS, SIZES, BIASES, st.sampled_from([0.0, 0.4]))  # a single known pixel, and many
def test_known_pixels_stay_and_the_rest_is_within_their_range(
    seed: int, size: tuple[int, int], bias: float, share: float
) -> None:
    inverse, values, known = random_scene(seed, *size, share)
    filled, propagated = far_fill(inverse, values, known, far_bias=bias)
    images, sources = (torch.cat([image[None], more]) for image, more in ((filled, propagated), (inverse, values)))
    assert torch.equal(images[:, known], sources[:, known])
    for image, source in zip(images, sources[:, known], strict=True):
        assert float(image.min()) >= float(source.min()) * (1 - 1e-4) - 1e-6
        assert float(image.max()) <= float(source.max()) * (1 + 1e-4) + 1e-6
    for rubbish in (math.nan, math.inf, -1.0, 0.0, 1e30):  # what is not known is not read
        spoiled = torch.where(known, sources, rubbish)
        again = far_fill(spoiled[0], spoiled[1:], known, far_bias=bias)
        assert torch.equal(torch.cat([again[0][None], again[1]]), images)


@pytest.mark.parametrize("bias", [0.0, 5.0, 80.0])
def test_a_relaxed_fill_is_a_membrane_over_the_rim(bias: float) -> None:
    """Each filled pixel is the mean of its neighbours, those of the rim weighted by min(1, fill / sample)^bias."""
    inverse, values, known = random_scene(7, 11, 13, 0.7)
    biases = bias * torch.rand(11, 13, generator=torch.Generator().manual_seed(1))
    filled, propagated = far_fill(inverse, values, known, far_bias=biases, sweeps=4000)
    images = torch.cat([filled[None], propagated]).double()
    for y, x in (~known).nonzero().tolist():
        mass, total = 0.0, torch.zeros(3, dtype=torch.float64)
        for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            v, u = min(max(v, 0), 10), min(max(u, 0), 12)  # nothing flows across the border
            trust = min(1.0, float(filled[y, x] / filled[v, u])) ** float(biases[y, x]) if known[v, u] else 1.0
            mass += max(trust, 1e-6)
            total += max(trust, 1e-6) * images[:, v, u]
        torch.testing.assert_close(total / mass, images[:, y, x], rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_hole_beside_a_near_thing_extends_what_is_behind_it(turned: bool, flipped: bool) -> None:
    x = torch.arange(64).expand(16, 64)
    near, known = (x >= 32) if flipped else (x < 32), (x < 16) | (x >= 48)
    near, known = (near.T, known.T) if turned else (near, known)
    inverse, red = torch.where(near, 1.0, 0.2), near.float()[None]
    filled, propagated = far_fill(inverse, red, known)
    alike, _ = far_fill(inverse, red, known, far_bias=0.0)
    assert float(filled[~known].median()) < 0.3
    assert float(alike[~known].mean()) == pytest.approx(0.6, abs=0.05)
    assert float(propagated[0][~known].mean()) < 0.3


def test_the_input_is_left_alone_and_may_have_no_holes_or_channels() -> None:
    inverse, values, known = random_scene(4, 8, 8)
    kept = inverse.clone(), values.clone()
    assert far_fill(inverse, values[:0], known)[1].shape == (0, 8, 8)
    whole = far_fill(inverse, values, torch.ones(8, 8, dtype=torch.bool))
    for found in ((inverse, values), whole):
        assert all(torch.equal(one, other) for one, other in zip(found, kept, strict=True))
    with pytest.raises(ValueError, match="no pixel is known"):
        far_fill(inverse, values, torch.zeros(8, 8, dtype=torch.bool))
