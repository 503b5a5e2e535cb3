"""Detect the uniform frame around a picture, such as a scan's margin, letterbox bars or a white mount."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

NARROWEST, WIDEST = (
    2,
    0.25,
)  # bounds for the width of a side: in pixels, and as a share of the photo's side
NOISE, STEP = (
    9 / 255,
    20 / 255,
)  # mean difference from the frame's colour: at most in the frame, at least beyond
STRAIGHT = 0.8  # least share of an edge's pixels that differ by STEP
EDGE_PX = 6  # width of a blurred edge


class PhotoFrame(NamedTuple):
    """The widths of a frame's four sides in pixels; 0 for a side without frame."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def note(self) -> str:
        """A line for the log."""
        widths = ", ".join(f"{width:g}" for width in self)
        return f"a frame ({widths} pixels: left, top, right, bottom) is cut off"

    def scaled(self, across: float, down: float) -> PhotoFrame:
        """The frame of a photo that is resized by these factors."""
        return PhotoFrame(
            self.left * across, self.top * down, self.right * across, self.bottom * down
        )

    def inside(self, picture: Tensor, width: int, height: int) -> Tensor:
        """Cut the frame off a picture [H, W, ...] of any size; the frame is in pixels of a width×height photo."""
        rows, columns = picture.shape[:2]
        left, right = (round(side * columns / width) for side in (self.left, self.right))
        top, bottom = (round(side * rows / height) for side in (self.top, self.bottom))
        return picture[top : rows - bottom, left : columns - right].contiguous()


def find_frame(rgb: Tensor) -> PhotoFrame | None:
    """The uniform frame of an sRGB picture [H, W, 3] in 0..1, or None.

    Two opposite sides must have one colour and straight inner edges, because a false frame would crop the picture.
    """
    across, down = rgb.numpy().swapaxes(0, 1), rgb.numpy()
    inwards = (
        across,
        down,
        across[::-1],
        down[::-1],
    )  # lines [N, M, 3] from the left, the top, the right, the bottom
    colors = np.stack([np.median(lines[0], axis=0) for lines in inwards])
    limits = [int(WIDEST * len(lines)) for lines in inwards]
    widths = np.zeros(4, int)

    def apart(side: int, start: int, stop: int) -> NDArray[np.float32]:
        """Differences of the lines start..stop of a side from its colour; no further lines are read."""
        differences = np.abs(inwards[side][start : min(stop, limits[side])] - colors[side])
        return cast("NDArray[np.float32]", differences.max(-1))

    plain = [
        next((n for n in range(limits[k]) if apart(k, n, n + 1).mean() > NOISE), limits[k])
        for k in range(4)
    ]
    for side in range(4):
        before, after = plain[1 - side % 2], plain[3 - side % 2]  # widths of the two adjacent sides
        lines = apart(side, plain[side], plain[side] + EDGE_PX)
        edge = (lines[:, before : lines.shape[1] - after] > STEP).mean(1)
        if plain[side] >= NARROWEST and edge.max(initial=0.0) >= STRAIGHT:
            widths[side] = plain[side] + int((edge >= 0.95 * edge.max()).argmax()) + 1
    for side in (0, 1):
        alike = np.where(np.abs(colors - colors[side]).max(1) <= NOISE, widths, 0)
        if alike[side] and alike[side + 2]:
            frame = PhotoFrame(*alike.tolist())
            inner = find_frame(
                frame.inside(rgb, *down.shape[1::-1])
            )  # such as a line inside a mount
            return PhotoFrame(*(alike + (inner or (0, 0, 0, 0))).tolist())
    return None
