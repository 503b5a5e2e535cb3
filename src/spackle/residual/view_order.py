"""In which order the views of a path are completed, and which need no look."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.filters import greatest_in_windows
from spackle.residual.hole_features import MASK_THRESHOLD

QUIET_HAR = 1e-3  # fewer holes may stay open where a path is looked at; in between up to twice as many were seen
SURE_HAR = QUIET_HAR / 4  # so few that frames farther off need no look either
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


def reach_of(holes: float, alpha: Tensor, threshold: float = MASK_THRESHOLD) -> float:
    """How much of the way to the next known frames a frame speaks for; 0: complete it.

    Holes cover the share `holes` of the picture; alpha is its opacity [H, W].
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


class SettledFrames:
    """Which frames of a path are known to be in order: looked at, or near one that needed nothing."""

    def __init__(self, frames: int) -> None:
        self._known = [False] * frames

    def known(self, index: int) -> bool:
        """Whether this frame needs no look."""
        return self._known[index]

    def looked(self, index: int, reach: float) -> None:
        """Note a look at a frame, which speaks for so much of the way to the next known ones; see `reach_of`."""
        before, after = (math.ceil(reach * self._unknown(index, step)) for step in (-1, 1))
        for frame in range(index - before, index + after + 1):
            self._known[frame] = True

    def _unknown(self, index: int, step: int) -> int:
        """How many unknown frames lie between this one and the next known one; 0 if the path ends before it."""
        count = 0
        frame = index + step
        while 0 <= frame < len(self._known):
            if self._known[frame]:
                return count
            count, frame = count + 1, frame + step
        return 0
