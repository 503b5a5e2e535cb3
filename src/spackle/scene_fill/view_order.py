"""In which order the views of a path are completed, and which may be skipped."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.filters import greatest_in_windows

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


def skipped_gap(holes: float, alpha: Tensor, threshold: float) -> float:
    """Fraction of the gap to the nearest checked frames that may be skipped beside a frame; 0: complete it.

    `holes` is the hole area ratio of the frame, alpha its opacity [H, W]. Holes that lie close together are seen,
    however few they are.
    """
    if holes > QUIET_HAR:
        return 0.0
    if min(alpha.shape) >= SPECK_PX:
        covered = greatest_in_windows(alpha >= threshold, SPECK_PX)
        if not bool(covered[:: SPECK_PX // 2, :: SPECK_PX // 2].all()):
            return 0.0
    return 0.75 if holes <= SURE_HAR else 0.5


def mark_checked(checked: list[bool], index: int, gap: float) -> None:
    """Mark a frame as checked, and of the frames to the nearest checked ones on both sides the fraction `gap`.

    Towards an end of the path without a checked frame none is marked.
    """
    for frames in (range(index - 1, -1, -1), range(index + 1, len(checked))):
        between = next((count for count, frame in enumerate(frames) if checked[frame]), 0)
        for frame in frames[: math.ceil(gap * between)]:
            checked[frame] = True
    checked[index] = True
