"""Bring photos of different exposure and white balance to the colours of the first one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.core.color import srgb_to_linear
from spackle.posed.union import PlacedPhoto, evidence_of

MIN_SHARED = 200  # Gaussians of one surface that two photos must share to be compared
# Linear values beyond these are clipped or noise, and have no ratio to another photo's.
DARKEST = 0.02
BRIGHTEST = 0.9
LEAST_CHANGE = 0.02  # a photo whose colours would change by less is left as it is
MAX_LOG_GAIN = 1.1  # a factor of three; a larger one is no exposure
ANCHOR = 1e-3  # weight with which a photo that shares nothing keeps its colours


@torch.no_grad()
def gains_of_photos(photos: Sequence[PlacedPhoto]) -> Tensor:
    """[P, 3] factors of the linear red, green and blue of photos; those of the first one are 1.

    Where two photos see the same surface, their colours should agree. The factors make them agree
    best for all pairs of photos together (least squares of the logarithms).
    """
    # The normal equations of the least squares. The anchor draws each gain weakly towards 1: else
    # they would have no single solution, as for a photo that shares no surface with others.
    count = len(photos)
    normal = ANCHOR * torch.eye(count, dtype=torch.float64)
    right_side = torch.zeros(count, 3, dtype=torch.float64)
    for first in range(count):
        for second in range(count):
            if first == second:
                continue
            log_ratio, weight = _log_ratio(photos[first], photos[second])
            # (log gain of the first) - (log gain of the second) should be -log_ratio.
            normal[first, first] += weight
            normal[second, second] += weight
            normal[first, second] -= weight
            normal[second, first] -= weight
            right_side[first] -= weight * log_ratio
            right_side[second] += weight * log_ratio
    log_gains = torch.linalg.solve(normal, right_side)
    log_gains = (log_gains - log_gains[0]).clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN)
    # A photo that would hardly change is left exactly as it is.
    is_same = log_gains.abs().amax(dim=1, keepdim=True) < LEAST_CHANGE
    kept_gains: Tensor = log_gains.where(~is_same, 0.0).exp()
    return kept_gains


def _log_ratio(photo: PlacedPhoto, other: PlacedPhoto) -> tuple[Tensor, float]:
    """The logarithm [3] of how much brighter a photo shows surfaces than another one.

    The second value is its weight: the share of Gaussians that both photos show, 0 for too few.
    """
    # Which of the photo's N Gaussians the other photo sees, and in which of its pixels.
    evidence = evidence_of(photo, other)
    row, column = evidence.row, evidence.column
    own = photo.gaussians.colors  # [N, 3] linear
    seen = srgb_to_linear(other.rgb[row, column])  # [N, 3] at the pixels of the other photo
    both = torch.stack([own, seen])
    is_usable = ((both > DARKEST) & (both < BRIGHTEST)).all(dim=2).all(dim=0)
    is_shared = evidence.same_surface & is_usable
    if int(is_shared.sum()) < MIN_SHARED:
        return torch.zeros(3, dtype=torch.float64), 0.0
    ratios = (own[is_shared] / seen[is_shared]).log().double()
    return ratios.median(dim=0).values, float(is_shared.double().mean())


def with_gain(photo: PlacedPhoto, gain: Tensor) -> PlacedPhoto:
    """A photo whose linear colours are multiplied by a factor [3] for each channel."""
    if bool((gain == 1).all()):
        return photo
    colors = (photo.gaussians.colors * gain.to(photo.gaussians.colors)).clamp(max=1)
    return dataclasses.replace(photo, gaussians=dataclasses.replace(photo.gaussians, colors=colors))
