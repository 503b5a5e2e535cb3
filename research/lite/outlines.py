"""How well outlines of predicted depth lie on the true ones: precision, recall and F1 of depth
edges within 2 pixels.

`compare_outlines` takes maps of inverse depth [H, W] from anywhere: lite's output, or the depth as
it was lifted. Results of several pictures are summed by `+`, then `best` and `overlap` score the
whole set.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from depth_loss import FARTHEST, scale_and_shift
from torch import Tensor
from torch.nn.functional import conv2d, max_pool1d, pad

# A true edge is a change of depth by this factor over three steps from pixel to pixel. Smooth
# surfaces of the stereo pairs change by less than 1.015 in 97 % of their pixels.
TRUE_RATIO = 1.1
# Predicted edges may be fainter or stronger than true ones: all of these are tried.
PREDICTED_RATIOS = (1.01, 1.02, 1.03, 1.05, 1.07, 1.1, 1.15, 1.2, 1.3, 1.5)
REACH_PX = 2  # an edge within this distance of the other map's edge is found
# Changes of log depth below this belong to slopes, and do not count in the overlap.
SLOPE = 0.03


@dataclasses.dataclass(frozen=True)
class Outline:
    """Precision, recall and F1 of depth edges; an edge of a strength above `ratio` counts."""

    ratio: float  # of depths on both sides of a predicted edge
    precision: float
    recall: float

    @property
    def f1(self) -> float:
        """The harmonic mean of precision and recall; 0 if both are 0."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0


@dataclasses.dataclass(frozen=True)
class OutlineCounts:
    """Counts of edge pixels, which are summed over the pictures of a set.

    The first three have one value for each of `PREDICTED_RATIOS`.
    """

    predicted: Tensor  # predicted edges that are right, or lie where the truth is known
    right: Tensor  # those within 2 pixels of a true edge
    found: Tensor  # true edges within 2 pixels of a predicted edge
    true: int  # all true edges
    shared_jumps: float  # the part of all changes of depth that both maps have at the same place
    all_jumps: float  # the mean of both maps' changes of depth

    def __add__(self, other: OutlineCounts) -> OutlineCounts:
        """The counts of both sets of pictures."""
        names = [field.name for field in dataclasses.fields(self)]
        return OutlineCounts(*(getattr(self, name) + getattr(other, name) for name in names))

    def at(self, ratio: float) -> Outline:
        """The score if predicted edges of this strength count, one of `PREDICTED_RATIOS`."""
        index = PREDICTED_RATIOS.index(ratio)
        precision = float(self.right[index]) / max(1, int(self.predicted[index]))
        return Outline(ratio, precision, float(self.found[index]) / max(1, self.true))

    @property
    def best(self) -> Outline:
        """The score at the strength of predicted edges that gives the best F1."""
        return max((self.at(ratio) for ratio in PREDICTED_RATIOS), key=lambda score: score.f1)

    @property
    def overlap(self) -> float:
        """0 to 1: how much of all changes of depth both maps have at the same place.

        It needs no threshold. A ramp in place of a jump shares only its steepest part.
        """
        return self.shared_jumps / max(self.all_jumps, 1e-9)


def compare_outlines(
    predicted_inverse_depth: Tensor, true_inverse_depth: Tensor, valid: Tensor
) -> OutlineCounts:
    """Counts of predicted and true depth edges, and of those within 2 pixels of each other.

    Both maps have the size of the truth; the predicted one is first aligned to the truth by the
    best scale and shift of inverse depth. An edge is a pixel where log depth changes most along its
    row or column, by at least a threshold over three steps from pixel to pixel. Predicted edges
    beside unknown pixels are not counted as wrong, because a true edge there may be unknown.

    Args:
        predicted_inverse_depth: [H, W] up to scale and shift.
        true_inverse_depth: [H, W] in any unit, 0 for infinitely far.
        valid: [H, W] bool, where the truth is known.
    """
    true = true_inverse_depth.double()
    predicted = predicted_inverse_depth.double()
    scale, shift = scale_and_shift(predicted[valid], true[valid])
    # As in training, the sky stands at a fiftieth of the median inverse depth.
    farthest = float(true[valid & (true > 0)].median()) * FARTHEST
    log_true = true.clamp_min(farthest).log()
    log_predicted = (scale * predicted + shift).clamp_min(farthest).log()

    # Columns are treated as rows of the transposed maps.
    true_edges = _Edges.of(log_true, valid)
    # The prediction has a value everywhere: a jump may lie beside the strip of unknown pixels that
    # stereo leaves along outlines.
    predicted_edges = _Edges.of(log_predicted, torch.ones_like(valid))
    at_true_edge = true_edges.above(TRUE_RATIO)
    near_true_edge = _widened(at_true_edge)
    far_from_unknown = ~_widened(~valid)
    predicted_counts = []
    right_counts = []
    found_counts = []
    for ratio in PREDICTED_RATIOS:
        at_edge = predicted_edges.above(ratio)
        right = at_edge & near_true_edge
        predicted_counts.append(int((right | (at_edge & far_from_unknown)).sum()))
        right_counts.append(int(right.sum()))
        found_counts.append(int((at_true_edge & _widened(at_edge)).sum()))

    # The overlap compares changes of depth where both are known.
    known_jumps = _Edges.of(log_predicted, valid)
    shared = 0.0
    total = 0.0
    for true_jump, jump in (
        (true_edges.along_rows, known_jumps.along_rows),
        (true_edges.along_columns, known_jumps.along_columns),
    ):
        true_excess = (true_jump - SLOPE).clamp_min(0)
        excess = (jump - SLOPE).clamp_min(0)
        shared += float(torch.minimum(excess, true_excess).sum())
        total += float((excess + true_excess).sum()) / 2
    return OutlineCounts(
        torch.tensor(predicted_counts),
        torch.tensor(right_counts),
        torch.tensor(found_counts),
        int(at_true_edge.sum()),
        shared,
        total,
    )


@dataclasses.dataclass(frozen=True)
class _Edges:
    """Changes of log depth over three steps, and the pixels where they are largest."""

    along_rows: Tensor  # [H, W] change of log depth along the row
    along_columns: Tensor  # [H, W] along the column
    row_peak: Tensor  # [H, W] bool: no larger change within 2 pixels along the row
    column_peak: Tensor  # [H, W] bool: the same along the column

    @staticmethod
    def of(log_depth: Tensor, known: Tensor) -> _Edges:
        """Find the changes of [H, W]; steps from or to pixels that are not `known` do not count."""
        along_rows, row_peak = _changes_along_rows(log_depth, known)
        along_columns, column_peak = _changes_along_rows(log_depth.T, known.T)
        return _Edges(along_rows, along_columns.T, row_peak, column_peak.T)

    def above(self, ratio: float) -> Tensor:
        """[H, W] bool: edges with a change of depth by more than a factor."""
        least = math.log(ratio)
        in_rows = self.row_peak & (self.along_rows > least)
        in_columns = self.column_peak & (self.along_columns > least)
        return in_rows | in_columns


def _changes_along_rows(log_depth: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """[H, W] the change over three steps around the step from each pixel to its right neighbour,
    and [H, W] bool whether it is a peak.
    """
    step = (log_depth[:, 1:] - log_depth[:, :-1]).abs()
    both_known = known[:, 1:] & known[:, :-1]
    step = pad(step.where(both_known, 0.0), (0, 1))  # the last pixel has no right neighbour
    around = pad(step, (1, 1))
    before = around[:, :-2]
    after = around[:, 2:]
    # Twice the middle: a single step then has its peak at its own place. Several pixels of a ramp
    # or a thin bar can have the same value, and are all peaks.
    weighted = before + 2 * step + after
    largest = max_pool1d(weighted[:, None], 2 * REACH_PX + 1, 1, REACH_PX)[:, 0]
    return before + step + after, (weighted >= largest) & (weighted > 0)


def _widened(edges: Tensor) -> Tensor:
    """[H, W] bool: pixels within 2 pixels of `edges` [H, W]."""
    offsets = torch.arange(-REACH_PX, REACH_PX + 1)
    disc = (offsets[:, None] ** 2 + offsets**2 <= REACH_PX**2).float()
    return conv2d(edges.float()[None, None], disc[None, None], padding=REACH_PX)[0, 0] > 0.5
