"""The score of outlines of predicted depth."""

from __future__ import annotations

import pytest
import torch
from outlines import TRUE_RATIO, compare_outlines
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

pytestmark = pytest.mark.slow  # not part of the package: `make test-slow` runs it


def box(left: int = 20, step: float = 1.0) -> Tensor:
    """[48, 64] inverse depth of a wall and of a nearer box, 24 pixels wide, on a slope."""
    inverse_depth = torch.linspace(1.0, 1.2, 48)[:, None].repeat(1, 64)
    inverse_depth[12:36, left : left + 24] += step
    return inverse_depth


def everywhere() -> Tensor:
    """[48, 64] bool: the truth is known in each pixel."""
    return torch.ones(48, 64, dtype=torch.bool)


def test_the_truth_itself_has_full_marks_at_any_scale_and_shift() -> None:
    counts = compare_outlines(3 * box() + 5, box(), everywhere())
    assert counts.best.f1 == 1
    assert counts.at(TRUE_RATIO).f1 == 1
    assert counts.overlap == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize(("shift_px", "lowest", "highest"), [(2, 0.95, 1.0), (4, 0.0, 0.75)])
def test_an_outline_counts_within_2_pixels_and_not_beyond(
    shift_px: int, lowest: float, highest: float
) -> None:
    score = compare_outlines(box(20 + shift_px), box(), everywhere()).best
    assert lowest <= score.f1 <= highest


def test_a_ramp_in_place_of_a_jump_overlaps_less() -> None:
    blurred = avg_pool2d(box()[None, None], 9, 1, 4, count_include_pad=False)[0, 0]
    counts = compare_outlines(blurred, box(), everywhere())
    assert counts.overlap < 0.5
    sharper = avg_pool2d(box()[None, None], 3, 1, 1, count_include_pad=False)[0, 0]
    assert 0.7 < compare_outlines(sharper, box(), everywhere()).overlap < 1


def test_outlines_of_half_the_size_count_after_enlarging() -> None:
    half = interpolate(box()[None, None], size=(24, 32), mode="area")
    enlarged = interpolate(half, size=(48, 64), mode="bilinear")[0, 0]
    assert compare_outlines(enlarged, box(), everywhere()).best.f1 > 0.95


def test_invented_edges_cost_precision_but_not_beside_unknown_pixels() -> None:
    invented = box()
    invented[:, 8:10] += 1
    score = compare_outlines(invented, box(), everywhere()).at(TRUE_RATIO)
    assert score.recall == 1
    assert score.precision < 0.75
    unknown = everywhere()
    unknown[:, 7:11] = False
    assert compare_outlines(invented, box(), unknown).at(TRUE_RATIO).precision == 1


def test_a_picture_without_edges_scores_0_and_sums_with_others() -> None:
    flat = torch.ones(48, 64)
    counts = compare_outlines(flat, box(), everywhere())
    assert counts.best.f1 == 0
    both = counts + compare_outlines(box(), box(), everywhere())
    assert both.best.recall == pytest.approx(0.5)
    assert both.best.precision == 1
