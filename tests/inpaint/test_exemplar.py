"""Patch matching: its kernels against plain twins, textures that it continues, and what could break it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from plain_exemplar import Subject
from scenes import psnr
from torch import Tensor

from spackle.inpaint import InpainterOptions
from spackle.inpaint import exemplar as room
from spackle.inpaint.exemplar import JUMPS, RADIUS, ExemplarInpainter, exemplar

Y, X = np.indices((100, 117))
WALL = torch.ones(Y.shape)
PATTERNS = {
    "stripes": 0.5 + 0.3 * np.sin(0.7 * X + 0.1 * Y),
    "bricks": np.where((Y % 8 < 2) | ((X + 7 * (Y // 8 % 2)) % 14 < 2), 0.8, 0.3),
}


@pytest.mark.parametrize(("size", "share"), [((1, 9), 0.5), ((23, 31), 0.9), ((40, 17), 0.997), ((30, 30), 0.1)])
def test_the_nearest_known_cell_is_that_of_brute_force(size: tuple[int, int], share: float) -> None:
    hole = np.random.default_rng(1).random(size) < share
    hole[0, 0] = False
    near, here = room.nearest_known(hole), np.indices(size)
    found, best = np.hypot(*(near - here)), np.hypot(*(here[..., None] - np.argwhere(~hole).T[:, None, None])).min(-1)
    assert not hole[tuple(near)].any()
    assert (np.mean(found == best) > 0.99, np.abs(found - best).max() < 0.5) == (True, True)


@pytest.mark.parametrize(("depth", "expected"), [(0.2, [8, 7, 6, 5, 4, 3, 2, 1, 0, 19]), (0.3, range(10, 20))])
def test_a_hole_starts_mirrored_at_its_rim_where_that_is_the_same_surface(depth: float, expected: list[int]) -> None:
    ramp, hole = np.arange(20, dtype=np.float32)[None, :, None].repeat(3, -1), np.arange(20)[None] >= 10
    room._mirror(ramp, hole, np.where(hole, depth, 0).astype(np.float32), room.nearest_known(hole))
    assert ramp[0, :, 0].tolist() == [*range(10), *expected]


@pytest.mark.parametrize("size", [(24, 31), (33, 26)])
def test_costs_are_the_formulas_and_a_search_comes_near_the_best(size: tuple[int, int]) -> None:
    subject = Subject(*size)
    cells, places, costs = subject.cells, subject.places, subject.costs
    assert set(places[:, 0]) == {0, 1}
    np.testing.assert_allclose(costs, subject.expected(), rtol=1e-4)
    ask = (*subject.target[:2], subject.level.traits, *subject.target[3:], *cells[7], *places[7])
    assert [room._cost(*ask, costs[7] * np.float32(k)) for k in (1.01, 0.99)] == [costs[7], np.inf]
    for turn in range(24):
        jump, before = JUMPS[turn % len(JUMPS)], (places.copy(), costs.copy())
        state = (*before, subject.valid, subject.pool, jump, np.uint32(turn * 7919))
        room._search(0, len(costs), cells, subject.numbers, *state, *subject.target, places, costs)
        assert (costs <= before[1]).all()
    np.testing.assert_allclose(costs, subject.expected(), rtol=1e-4)
    assert costs.mean() < 1.06 * np.mean([subject.formula(*cell).min() for cell in cells])


def test_what_is_taken_is_counted_by_squares_of_the_picture_and_of_its_mirror() -> None:
    matches = torch.full((8, 10, 3), -1)
    matches[0, :3] = torch.tensor([0, 5, 2])
    matches[1, 0] = torch.tensor([1, 4, 9 - 3])  # the same square, in the mirror
    matches[7, 9] = torch.tensor([0, 1, 9])
    expected = torch.zeros(8, 10)
    expected[0, :3] = expected[1, 0] = 4 / 16
    expected[7, 9] = 1 / 16
    assert torch.equal(room.Exemplar(torch.zeros(8, 10, 3), torch.zeros(8, 10), matches).taken(), expected)


def test_votes_are_those_of_a_plain_loop() -> None:
    subject = Subject(24, 31)
    places, costs, found = subject.places, subject.costs, np.zeros_like(subject.level.rgb)
    room._vote(0, len(costs), subject.cells, subject.numbers, places, costs, costs.mean(), subject.sources, found)
    for cell in subject.cells:
        over = np.abs(subject.cells - cell).max(1) <= RADIUS
        says = [
            subject.sources[m, v, u] for m, v, u in places[over] + np.pad(cell - subject.cells[over], [(0, 0), (1, 0)])
        ]
        expected = np.average(says, axis=0, weights=np.exp(-costs[over] / costs.mean()) + 1e-6)
        np.testing.assert_allclose(found[tuple(cell)], expected, rtol=1e-5)


def test_blocks_are_those_of_the_matches_around_a_cell() -> None:
    subject, rng = Subject(24, 31), np.random.default_rng(3)
    places, costs = np.full((24, 31, 3), -1, np.int32), np.zeros((24, 31), np.float32)
    places[tuple(subject.cells.T)], costs[tuple(subject.cells.T)] = subject.places, subject.costs
    blocks = rng.random((24, 31, 2, 3, 1)).astype(np.float32)
    grids = [torch.from_numpy(grid) for grid in (subject.level.rgb, np.sqrt(costs), places)]
    found = room.Exemplar(*grids).of_blocks(torch.from_numpy(blocks)).numpy()
    assert np.array_equal(found[~subject.level.hole], blocks[~subject.level.hole])
    sources = (blocks, blocks[:, ::-1, :, ::-1])
    for cell in subject.cells:
        over = np.abs(subject.cells - cell).max(1) <= 1
        moved = subject.places[over] + np.pad(cell - subject.cells[over], [(0, 0), (1, 0)])
        weights = np.exp(-room.BLOCK_CHOICE * subject.costs[over] / subject.costs.mean()) + 1e-6
        expected = np.average([sources[m][v, u] for m, v, u in moved], axis=0, weights=weights)
        np.testing.assert_allclose(found[tuple(cell)], expected, rtol=1e-4)


@pytest.mark.parametrize("width", [61, 62])
def test_a_level_begins_where_its_parent_ended_also_in_a_mirrored_picture_of_odd_size(width: int) -> None:
    coarse, fine = Subject(25, 31), Subject(49, width)
    cells = np.argwhere(coarse.hole.repeat(2, 0).repeat(2, 1)[:49, :width]).astype(np.int32)
    places = np.empty((len(cells), 3), np.int32)
    room._begin(cells, True, coarse.numbers, coarse.places, fine.valid | True, fine.pool, places)
    for (y, x), (m, v, u) in zip(cells, places, strict=True):
        mirrored, row, column = coarse.places[coarse.numbers[y // 2, x // 2]]
        assert (m, v) == (mirrored, 2 * row + y % 2)
        assert u == 2 * column + x % 2 if not m else (width - 1 - u) // 2 == 30 - column and (u - x - width) % 2 == 0


def punched(name: str) -> tuple[Tensor, Tensor, Tensor]:
    """A pattern, the same with its mean in a hole, and the hole."""
    rgb, hole = torch.from_numpy(PATTERNS[name][..., None] * [1, 0.8, 0.6]).float(), torch.zeros(Y.shape) > 0
    hole[40:66, 45:71] = True
    return rgb, torch.where(hole[..., None], rgb[~hole].mean(0), rgb), hole


@pytest.mark.parametrize("behind", [1.0, 0.99, 0.9])
@pytest.mark.parametrize("name", PATTERNS)
def test_a_texture_goes_on_also_on_a_flat_wall_the_same_with_any_number_of_threads(name: str, behind: float) -> None:
    truth, guess, hole = punched(name)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 2):
            torch.set_num_threads(count)
            found.append(exemplar(guess, hole, torch.where(hole, behind, WALL)))
    finally:
        torch.set_num_threads(threads)
    assert psnr(found[0].rgb[hole], truth[hole]) > 42 > psnr(guess[hole], truth[hole]) + 22
    assert torch.equal(found[0].rgb[~hole], truth[~hole])
    assert torch.equal(found[0].mismatch > 0, hole)
    assert all(torch.equal(one.rgb, found[0].rgb) and torch.equal(one.mismatch, found[0].mismatch) for one in found[1:])


EDGES = {"none": (30, 40, ()), "all": (30, 40, np.s_[:]), "smaller than a patch": (5, 40, np.s_[:, 9:20])}
EDGES |= {"no source": (60, 60, np.s_[::5]), "deep": (12, 1100, np.s_[:, 20:])}


@pytest.mark.parametrize("name", EDGES)
def test_whatever_the_hole_colours_stay_those_of_the_picture(name: str) -> None:
    height, width, where = EDGES[name]
    rgb = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0)) / 2
    hole = torch.zeros(height, width, dtype=torch.bool)
    hole[where] = name != "none"
    found = exemplar(rgb, hole, torch.ones(height, width))
    assert torch.equal(found.rgb[~hole], rgb[~hole])
    assert 0 <= float(found.rgb.min()) <= float(found.rgb.max()) <= 0.501
    assert torch.equal(found.mismatch > 0, hole & (name == "deep"))


def test_the_inpainter_takes_views_by_themselves_and_depth_that_is_unknown() -> None:
    truth, guess, hole = punched("bricks")
    holes, depths = (
        torch.stack([hole, hole | True, hole & False]),
        torch.stack([WALL * (WALL.cumsum(1) > 9), WALL, WALL]),
    )
    rgb, painter = torch.where(holes[..., None], 0.0, guess), ExemplarInpainter(InpainterOptions())
    painted = painter.paint(rgb, holes, depths)
    assert psnr(painted[0][hole], truth[hole]) > 40
    assert torch.equal(painted[0][~hole], truth[~hole])
    assert torch.equal(painted[1:], rgb[1:])
    assert torch.equal(painter.paint(rgb[:1], holes[:1], 0 * depths[:1]), painted[:1])
