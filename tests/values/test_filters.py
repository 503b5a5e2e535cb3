"""The Gaussian blur and the greatest value in a window: of pictures and of stacks of them, and where the border is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from spackle.filters import blurred, broadly_blurred, greatest_around, greatest_in_windows, nearest_known


@pytest.mark.parametrize(("size", "sigma"), [((9, 13), 0.65), ((9, 13), 2.5), ((2, 5), 4.0), ((1, 1), 1.0)])
def test_a_blur_is_that_of_a_plain_loop(size: tuple[int, int], sigma: float) -> None:
    pictures = torch.rand(2, 1, *size, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected, reach = torch.empty_like(pictures), int(np.ceil(3 * sigma))
    for y, x in np.ndindex(size):
        total, mass = torch.zeros(2, 1, 3, dtype=torch.float64), 0.0
        for v in range(max(y - reach, 0), min(y + reach + 1, size[0])):
            for u in range(max(x - reach, 0), min(x + reach + 1, size[1])):
                weight = float(np.exp(-((v - y) ** 2 + (u - x) ** 2) / (2 * sigma**2)))
                total, mass = total + weight * pictures[..., v, u, :], mass + weight
        expected[..., y, x, :] = total / mass
    torch.testing.assert_close(blurred(pictures, sigma), expected, rtol=1e-6, atol=0)
    torch.testing.assert_close(blurred(pictures[1, 0].float(), sigma), expected[1, 0].float())


@pytest.mark.parametrize(("size", "sigma"), [((60, 81), 5.0), ((60, 81), 0.8), ((120, 101), 20.0), ((3, 4), 9.0)])
def test_a_broad_blur_is_about_the_exact_one(size: tuple[int, int], sigma: float) -> None:
    picture = blurred(torch.rand(*size, 3, generator=torch.Generator().manual_seed(0)), 1.0)
    exact, found = blurred(picture, sigma), broadly_blurred(picture, sigma)
    assert float((found - exact).abs().mean()) <= 0.1 * float((picture - exact).abs().mean())


@pytest.mark.parametrize("reach", [0, 1, 2, 3, 9])
def test_the_greatest_value_is_that_of_a_plain_loop(reach: int) -> None:
    pictures = torch.rand(2, 7, 11, generator=torch.Generator().manual_seed(0)) - 0.5
    near = [slice(max(k - reach, 0), k + reach + 1) for k in range(11)]
    expected = torch.stack([pictures[:, near[y], near[x]].amax((1, 2)) for y, x in np.ndindex(7, 11)], 1).view(2, 7, 11)
    assert torch.equal(greatest_around(pictures, reach), expected)
    assert torch.equal(greatest_around(pictures > 0.4, reach), expected > 0.4)
    if 2 * reach < 7:
        inside = expected[:, reach : 7 - reach, reach : 11 - reach]
        assert torch.equal(greatest_in_windows(pictures, 2 * reach + 1), inside)


@pytest.mark.parametrize(("size", "share"), [((1, 9), 0.5), ((23, 31), 0.9), ((40, 17), 0.997), ((30, 30), 0.1)])
def test_the_nearest_known_cell_is_that_of_brute_force(size: tuple[int, int], share: float) -> None:
    hole = np.random.default_rng(1).random(size) < share
    hole[0, 0] = False
    near, here = nearest_known(hole), np.indices(size)
    found, best = np.hypot(*(near - here)), np.hypot(*(here[..., None] - np.argwhere(~hole).T[:, None, None])).min(-1)
    assert not hole[tuple(near)].any()
    assert (np.mean(found == best) > 0.99, np.abs(found - best).max() < 0.5) == (True, True)
