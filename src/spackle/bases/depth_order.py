"""Compare a depth map's order, near to far, with what a small network sees in the photo.

Relative depth often has the numbers of metric depth, but the opposite order: large is near. Only
the photo shows which of both a map holds.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from spackle.bases.lite import INPUT_SCALES, SHIPPED_WEIGHTS, LiteBase, merge_outputs
from spackle.core.photo import Photo
from spackle.depth.depth_map import Array, DepthMap

# Of 42 photos with measured depth (7-Scenes, TUM, Middlebury, ETH3D), the correlation was 0.26 to
# 0.9, and 0.75 in the middle. A map of inverse depth has the same numbers below 0.
CLEAR_CORRELATION = 0.25
COMPARED_SCALES = INPUT_SCALES[:2]  # two small inputs take 0.2 s, and their order is good enough
SAMPLE_ROWS, SAMPLE_COLUMNS = 48, 64  # points at which both depths are compared
MIN_SAMPLES = 100  # fewer known points prove nothing


def depth_order_agreement(depth: DepthMap, photo: Photo) -> float:
    """How well a map's order of depths agrees with the photo, as a rank correlation in -1..1.

    1: the same order, from near to far, as a small network (lite) guesses; -1: the opposite order;
    0: no connection, or nothing to compare.
    """
    # A border was cropped from a photo with a frame. Its map has the border still, so the two
    # cannot be compared pixel by pixel.
    if photo.frame is not None or not SHIPPED_WEIGHTS.is_file():
        return 0.0

    # The network guesses inverse depth, which is large where the photo is near.
    outputs = _load_lite().at_scales(photo.rgb, COMPARED_SCALES)
    gives_low_frequencies = [scale.gives_low_frequencies for scale in COMPARED_SCALES]
    farness = -merge_outputs(outputs, gives_low_frequencies)

    is_known = _sampled(depth.valid)
    if int(is_known.sum()) < MIN_SAMPLES:
        return 0.0
    return rank_correlation(_sampled(depth.depth)[is_known], _sampled(farness)[is_known])


@functools.cache
def _load_lite() -> LiteBase:
    """The networks of lite, on the CPU, loaded once."""
    return LiteBase.load(SHIPPED_WEIGHTS, device="cpu")


def _sampled(values: Tensor) -> Array:
    """48×64 values of a map [H, W], evenly spread, as an array.

    The same points of the picture are taken from a map of any size.
    """
    height, width = values.shape
    # 0.5: the middles of 48 rows and 64 columns of equal parts.
    rows = ((torch.arange(SAMPLE_ROWS) + 0.5) / SAMPLE_ROWS * height).long()
    columns = ((torch.arange(SAMPLE_COLUMNS) + 0.5) / SAMPLE_COLUMNS * width).long()
    sampled: Array = values[rows][:, columns].numpy()
    return sampled


def rank_correlation(first: Array, second: Array) -> float:
    """Spearman's rank correlation of two arrays [N] in -1..1; 0 if one of them is constant."""
    first_ranks = _centred_ranks(first)
    second_ranks = _centred_ranks(second)
    norm = float(np.linalg.norm(first_ranks) * np.linalg.norm(second_ranks))
    return float(first_ranks @ second_ranks) / norm if norm > 0 else 0.0


def _centred_ranks(values: Array) -> Array:
    """The ranks [N] of values, minus their mean; equal values share the mean of their ranks."""
    # Equal values are a group, and groups are numbered from the least value upwards.
    _, group_of_value, group_sizes = np.unique(values, return_inverse=True, return_counts=True)
    last_rank = np.cumsum(group_sizes)  # of each group
    mean_rank = last_rank - (group_sizes - 1) / 2
    ranks: Array = mean_rank[group_of_value]
    return ranks - float(ranks.mean())
