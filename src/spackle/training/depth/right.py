"""The right photo of a stereo pair with the depth that the left one has."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SAME = 1.05  # neighbours whose depths differ by less are of one surface


def seen_from_the_right(depth: Tensor, valid: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Each pixel's depth carried to where the right photo shows it; the nearest of several stays.

    Args:
        depth: [H, W] of the left photo's pixels; both cameras look the same way, so it is the right one's as well.
        valid: [H, W] bool, where it is known.
        shift: [H, W] pixels to the right, negative in a pair that is not crossed.

    Returns:
        Depth [H, W], and where it is known [H, W]: not where the left photo shows nothing. A surface that the
        right camera sees wider has cracks, which are closed where they are a pixel wide.
    """
    rows, columns = (place.numpy() for place in valid.nonzero(as_tuple=True))
    z = depth[valid].numpy()
    places = np.rint(columns + shift[valid].numpy()).astype(np.int64)
    order = np.argsort(-z, kind="stable")  # of several values for one pixel NumPy keeps the last
    order = order[(places[order] >= 0) & (places[order] < depth.shape[1])]
    carried = np.full(tuple(depth.shape), np.inf, depth.numpy().dtype)
    carried[rows[order], places[order]] = z[order]
    _close_cracks(carried)
    known = torch.from_numpy(np.isfinite(carried))
    return torch.from_numpy(carried).where(known, 0.0), known


def _close_cracks(depth: NDArray[np.float32]) -> None:
    """A pixel between two of one surface, with nothing in it or what lies behind, is of that surface."""
    left, middle, right = depth[:, :-2], depth[:, 1:-1], depth[:, 2:]
    nearer, farther = np.minimum(left, right), np.maximum(left, right)
    crack = (farther < SAME * nearer) & (middle > SAME * farther)
    middle[crack] = farther[crack]
