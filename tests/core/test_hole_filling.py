"""Image filters against plain loops; filled holes: exact where known, bounded, of the far side."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from spackle.core import hole_filling
from spackle.core.filters import (
    approximate_gaussian_blur,
    gaussian_blur,
    maximum_filter,
    nearest_known_pixels,
)
from spackle.core.hole_filling import fill_from_far_side


@pytest.mark.parametrize(
    ("size", "sigma"), [((9, 13), 0.65), ((9, 13), 2.5), ((2, 5), 4.0), ((1, 1), 1.0)]
)
def test_blur_against_a_plain_loop(size: tuple[int, int], sigma: float) -> None:
    pictures = torch.rand(
        2, 1, *size, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    expected, reach = torch.empty_like(pictures), int(np.ceil(3 * sigma))
    for y, x in np.ndindex(size):
        total, mass = torch.zeros(2, 1, 3, dtype=torch.float64), 0.0
        for v in range(max(y - reach, 0), min(y + reach + 1, size[0])):
            for u in range(max(x - reach, 0), min(x + reach + 1, size[1])):
                weight = float(np.exp(-((v - y) ** 2 + (u - x) ** 2) / (2 * sigma**2)))
                total, mass = total + weight * pictures[..., v, u, :], mass + weight
        expected[..., y, x, :] = total / mass
    torch.testing.assert_close(gaussian_blur(pictures, sigma), expected, rtol=1e-6, atol=0)
    torch.testing.assert_close(gaussian_blur(pictures[1, 0].float(), sigma), expected[1, 0].float())


@pytest.mark.parametrize(
    ("size", "sigma"), [((60, 81), 5.0), ((60, 81), 0.8), ((120, 101), 20.0), ((3, 4), 9.0)]
)
def test_broad_blur_approximates_the_exact_blur(size: tuple[int, int], sigma: float) -> None:
    picture = gaussian_blur(torch.rand(*size, 3, generator=torch.Generator().manual_seed(0)), 1.0)
    exact, found = gaussian_blur(picture, sigma), approximate_gaussian_blur(picture, sigma)
    assert float((found - exact).abs().mean()) <= 0.1 * float((picture - exact).abs().mean())


@pytest.mark.parametrize("reach", [0, 1, 2, 3, 9])
def test_maximum_against_a_plain_loop(reach: int) -> None:
    pictures = torch.rand(2, 7, 11, generator=torch.Generator().manual_seed(0)) - 0.5
    near = [slice(max(k - reach, 0), k + reach + 1) for k in range(11)]
    expected = torch.stack(
        [pictures[:, near[y], near[x]].amax((1, 2)) for y, x in np.ndindex(7, 11)], 1
    ).view(2, 7, 11)
    assert torch.equal(maximum_filter(pictures, reach), expected)
    assert torch.equal(maximum_filter(pictures > 0.4, reach), expected > 0.4)


@pytest.mark.parametrize(
    ("size", "share"), [((1, 9), 0.5), ((23, 31), 0.9), ((40, 17), 0.997), ((30, 30), 0.1)]
)
def test_nearest_known_against_brute_force(size: tuple[int, int], share: float) -> None:
    hole = np.random.default_rng(1).random(size) < share
    hole[0, 0] = False
    near = nearest_known_pixels(torch.from_numpy(hole)).numpy()
    here = np.indices(size)
    found = np.hypot(*(near - here))
    known = np.argwhere(~hole).T
    best = np.hypot(*(here[..., None] - known[:, None, None])).min(-1)
    assert not hole[tuple(near)].any()
    np.testing.assert_array_equal(found, best)


def random_scene(
    seed: int, height: int, width: int, share: float = 0.4
) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depths over two decades, two channels, and a mask of known pixels."""
    generator = torch.Generator().manual_seed(seed)
    inverse = 0.02 * 100 ** torch.rand(height, width, generator=generator)
    known = torch.rand(height, width, generator=generator) < share
    known[seed % height, seed % width] = True
    return inverse, torch.rand(2, height, width, generator=generator), known


@settings(deadline=None, max_examples=50)
@given(
    *(st.integers(0, 2**32 - 1), st.tuples(*[st.integers(1, 13)] * 2)),
    *(st.sampled_from([0.0, 5.0, 80.0]), st.sampled_from([0.0, 0.4])),  # one known pixel, or many
)
def test_known_pixels_stay_and_filled_ones_are_within_their_range(
    seed: int, size: tuple[int, int], bias: float, share: float
) -> None:
    inverse, values, known = random_scene(seed, *size, share)
    filled, propagated = fill_from_far_side(inverse, values, known, far_bias=bias)
    images, sources = (
        torch.cat([image[None], more]) for image, more in ((filled, propagated), (inverse, values))
    )
    assert torch.equal(images[:, known], sources[:, known])
    for image, source in zip(images, sources[:, known], strict=True):
        assert float(image.min()) >= float(source.min()) * (1 - 1e-4) - 1e-6
        assert float(image.max()) <= float(source.max()) * (1 + 1e-4) + 1e-6
    for rubbish in (math.nan, 1e30):  # unknown values are ignored
        spoiled = torch.where(known, sources, rubbish)
        again = fill_from_far_side(spoiled[0], spoiled[1:], known, far_bias=bias)
        assert torch.equal(torch.cat([again[0][None], again[1]]), images)


@pytest.mark.parametrize("bias", [0.0, 5.0, 80.0])
def test_a_relaxed_fill_is_a_membrane_over_the_rim(
    bias: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hole_filling, "RELAXATION_SWEEPS", 4000)
    inverse, values, known = random_scene(7, 11, 13, 0.7)
    biases = bias * torch.rand(11, 13, generator=torch.Generator().manual_seed(1))
    filled, propagated = fill_from_far_side(inverse, values, known, far_bias=biases)
    images = torch.cat([filled[None], propagated]).double()
    for y, x in (~known).nonzero().tolist():
        mass, total = 0.0, torch.zeros(3, dtype=torch.float64)
        for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            v, u = min(max(v, 0), 10), min(max(u, 0), 12)  # nothing flows across the border
            trust = (
                min(1.0, float(filled[y, x] / filled[v, u])) ** float(biases[y, x])
                if known[v, u]
                else 1.0
            )
            mass += max(trust, 1e-6)
            total += max(trust, 1e-6) * images[:, v, u]
        torch.testing.assert_close(total / mass, images[:, y, x], rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize(("turned", "flipped"), [(False, False), (True, True)])
def test_a_hole_between_near_and_far_is_filled_from_the_far_side(
    turned: bool, flipped: bool
) -> None:
    x = torch.arange(64).expand(16, 64)
    near, known = (x >= 32) if flipped else (x < 32), (x < 16) | (x >= 48)
    near, known = (near.T, known.T) if turned else (near, known)
    inverse, red = torch.where(near, 1.0, 0.2), near.float()[None]
    filled, propagated = fill_from_far_side(inverse, red, known)
    alike, _ = fill_from_far_side(inverse, red, known, far_bias=0.0)
    assert float(filled[~known].median()) < 0.3
    assert float(alike[~known].mean()) == pytest.approx(0.6, abs=0.05)
    assert float(propagated[0][~known].mean()) < 0.3
