"""In which order the views of a path are completed, and which may be skipped."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.filters import greatest_in_windows
from spackle.residual.mask import MASK_THRESHOLD

QUIET_HAR = 1e-3  # fewer holes may stay open in a frame that is checked; in between up to twice as many were seen
SURE_HAR = QUIET_HAR / 4  # so few that more of the frames beside it may be skipped
SPECK_PX = 4  # a square of holes as wide as this is seen, however little else is open


def farthest_first(cameras: Sequence[Camera], photo_camera: Camera) -> list[int]:
    """An order that visits the widest view first and then always the one farthest from all visited.

    Any beginning of it is spread evenly over the path.
    """
    if not cameras:
        return []
    eyes = torch.stack([camera.position.double() for camera in cameras])
    distance = (eyes - photo_camera.position.double()).norm(dim=-1)
    order: list[int] = []
    for _ in cameras:
        pick = int(distance.argmax())
        order.append(pick)
        distance = torch.minimum(distance, (eyes - eyes[pick]).norm(dim=-1))
        distance[pick] = -1.0
    return order


def skipped_gap(holes: float, alpha: Tensor, threshold: float = MASK_THRESHOLD) -> float:
    """Fraction of the gap to the nearest checked frames that may be skipped beside a frame; 0: complete it.

    `holes` is the hole area ratio of the frame, alpha its opacity [H, W].
    """
    if holes > QUIET_HAR or has_speck(alpha, threshold):
        return 0.0
    return 0.75 if holes <= SURE_HAR else 0.5


def has_speck(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> bool:
    """Whether holes lie so close together that they are seen, however few they are."""
    if min(alpha.shape) < SPECK_PX:
        return False
    covered = greatest_in_windows(alpha >= threshold, SPECK_PX)
    return not bool(covered[:: SPECK_PX // 2, :: SPECK_PX // 2].all())


class CheckedFrames:
    """Which frames of a path were checked, or may be skipped because a frame beside them needed nothing."""

    def __init__(self, frames: int) -> None:
        self._checked = [False] * frames

    def __contains__(self, index: int) -> bool:
        return self._checked[index]

    def add(self, index: int, gap: float) -> None:
        """Note a frame as checked, and the fraction `gap` of the gaps to the nearest checked ones as skipped."""
        before, after = (math.ceil(gap * self._gap(index, step)) for step in (-1, 1))
        for frame in range(index - before, index + after + 1):
            self._checked[frame] = True

    def _gap(self, index: int, step: int) -> int:
        """How many frames lie between this one and the nearest checked one; 0 if the path ends before it."""
        frames = range(index + step, len(self._checked) if step > 0 else -1, step)
        return next((count for count, frame in enumerate(frames) if self._checked[frame]), 0)
