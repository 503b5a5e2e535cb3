"""Patch matching: kernels against plain twins, textures that continue, and extreme holes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.plain_patches import Subject, as_tensors
from helpers.scenes import psnr
from torch import Tensor

from spackle.core.patch_matching import NEIGHBOR_STEPS, match_patches
from spackle.core.patch_search import improve_match, patch_cost

Y, X = np.indices((100, 117))
WALL = torch.ones(Y.shape)
PATTERNS = {
    "stripes": 0.5 + 0.3 * np.sin(0.7 * X + 0.1 * Y),
    "bricks": np.where((Y % 8 < 2) | ((X + 7 * (Y // 8 % 2)) % 14 < 2), 0.8, 0.3),
}


@pytest.mark.parametrize("size", [(24, 31), (33, 26)])
def test_costs_match_the_formula_and_searches_approach_the_minimum(size: tuple[int, int]) -> None:
    subject = Subject(*size)
    cells, places, costs = subject.cells, subject.places, subject.costs
    assert set(places[:, 0]) == {0, 1}
    np.testing.assert_allclose(costs, subject.expected(), rtol=1e-4)
    for factor, expected in ((1.01, costs[7]), (0.99, np.inf)):
        limit = costs[7] * np.float32(factor)
        assert patch_cost(subject.inputs, *cells[7], *places[7], limit) == expected
    for turn in range(24):
        step = NEIGHBOR_STEPS[turn % len(NEIGHBOR_STEPS)]
        before = (places.copy(), costs.copy())
        state = (*before, subject.valid, subject.pool, step, np.uint32(turn * 7919))
        arguments = (cells, subject.numbers, *state, subject.inputs, places, costs)
        improve_match(len(costs), *map(as_tensors, arguments))
        assert (costs <= before[1]).all()
    np.testing.assert_allclose(costs, subject.expected(), rtol=1e-4)
    assert costs.mean() < 1.06 * np.mean([subject.formula(*cell).min() for cell in cells])


def punched(name: str) -> tuple[Tensor, Tensor, Tensor]:
    """A pattern, the pattern with its mean colour in a hole, and the hole."""
    rgb, hole = (
        torch.from_numpy(PATTERNS[name][..., None] * [1, 0.8, 0.6]).float(),
        torch.zeros(Y.shape) > 0,
    )
    hole[40:66, 45:71] = True
    return rgb, torch.where(hole[..., None], rgb[~hole].mean(0), rgb), hole


@pytest.mark.parametrize(("name", "behind"), [("stripes", 1.0), ("bricks", 0.99), ("bricks", 0.9)])
def test_textures_are_extended_equally_by_any_number_of_threads(name: str, behind: float) -> None:
    truth, guess, hole = punched(name)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 2):
            torch.set_num_threads(count)
            found.append(match_patches(guess, hole, torch.where(hole, behind, WALL)))
    finally:
        torch.set_num_threads(threads)
    assert psnr(found[0].rgb[hole], truth[hole]) > 42 > psnr(guess[hole], truth[hole]) + 22
    assert torch.equal(found[0].rgb[~hole], truth[~hole])
    assert torch.equal(found[0].mismatch > 0, hole)
    assert all(
        torch.equal(one.rgb, found[0].rgb) and torch.equal(one.mismatch, found[0].mismatch)
        for one in found[1:]
    )


EDGES = {
    "none": (30, 40, ()),
    "all": (30, 40, np.s_[:]),
    "smaller than a patch": (5, 40, np.s_[:, 9:20]),
}
EDGES |= {"no source": (60, 60, np.s_[::5]), "deep": (12, 1100, np.s_[:, 20:])}


@pytest.mark.parametrize("name", EDGES)
def test_extreme_holes_get_colours_of_the_picture(name: str) -> None:
    height, width, where = EDGES[name]
    rgb = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0)) / 2
    hole = torch.zeros(height, width, dtype=torch.bool)
    hole[where] = name != "none"
    found = match_patches(rgb, hole, torch.ones(height, width))
    assert torch.equal(found.rgb[~hole], rgb[~hole])
    assert 0 <= float(found.rgb.min()) <= float(found.rgb.max()) <= 0.501
    assert torch.equal(found.mismatch > 0, hole & (name == "deep"))
