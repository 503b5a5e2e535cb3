"""In which order the views of a path are completed, and which need no look."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from spackle.camera import Camera


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


class Visits:
    """Which frames of a path are known to be in order: looked at, or near one that needed nothing.

    Such a frame speaks for those around it, half of the way to the next that is known on either side.
    """

    def __init__(self, frames: int) -> None:
        self._known = [False] * frames

    def known(self, index: int) -> bool:
        """Whether this frame needs no look."""
        return self._known[index]

    def looked(self, index: int, quiet: bool) -> None:
        """Note a look at a frame, and whether nothing was to be done there."""
        self._known[index] = True
        if not quiet:
            return
        before, after = (self._unknown(index, step) for step in (-1, 1))
        for frame in range(index - (before + 1) // 2, index + (after + 1) // 2 + 1):
            self._known[frame] = True

    def _unknown(self, index: int, step: int) -> int:
        """How many unknown frames lie between this one and the next known; none where the path ends before."""
        count = 0
        frame = index + step
        while 0 <= frame < len(self._known):
            if self._known[frame]:
                return count
            count, frame = count + 1, frame + step
        return 0
