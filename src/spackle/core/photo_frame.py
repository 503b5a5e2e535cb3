"""Detect the uniform frame around a picture: a scan's margin, letterbox bars or a white mount.

A thin dark or bright rim at single sides, as scanners and resizing leave it, belongs to the frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

MIN_FRAME_PX = 2  # a thinner line is not taken for a side of a frame
MAX_FRAME_RATIO = 0.25  # widest side of a frame, as a share of the photo's width or height
# Colours are compared by the largest difference of a channel of sRGB in 0..1.
MAX_FRAME_NOISE = 9 / 255  # mean difference of a frame's line from the frame's colour
MIN_PICTURE_CONTRAST = 20 / 255  # difference of a pixel that does not belong to the frame
MIN_STRAIGHT_RATIO = 0.8  # share of an inner edge's pixels that must have this difference
BLURRED_EDGE_PX = 6  # width of a blurred inner edge

# A rim is at most this wide: 6 pixels or, if that is more, this share of the width or height.
MAX_RIM_PX = 6
MAX_RIM_RATIO = 0.01
MIN_RIM_CONTRAST = 20 / 255  # of the outermost line to the picture inside
# What varies inside by more than this share of the rim's contrast is the picture's own.
MAX_INSIDE_VARIATION = 0.35
MAX_BLURRED_RIM = 0.1  # share of the contrast at which a rim's blurred edge has ended

Floats = NDArray[np.float32]


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
        """Cut the frame off a picture [H, W, ...] of any size, such as a depth map.

        The frame's widths are in pixels of a width×height photo, and are scaled to the picture.
        """
        rows, columns = picture.shape[:2]
        left = round(self.left * columns / width)
        right = round(self.right * columns / width)
        top = round(self.top * rows / height)
        bottom = round(self.bottom * rows / height)
        return picture[top : rows - bottom, left : columns - right].contiguous()


def find_frame(rgb: Tensor) -> PhotoFrame | None:
    """The uniform frame of an sRGB picture [H, W, 3] in 0..1, with thin rims inside it, or None."""
    height, width = rgb.shape[:2]
    frame = _find_uniform_frame(rgb) or PhotoFrame(0, 0, 0, 0)
    rims = [side.rim_width() for side in _sides(frame.inside(rgb, width, height).numpy())]
    total = PhotoFrame(*(np.array(frame) + np.array(rims)).tolist())
    return total if any(total) else None


def _sides(rows: Floats) -> list[_Side]:
    """The four sides of a picture [H, W, 3] in the order of PhotoFrame."""
    # Each side sees the picture as lines of pixels, from its border inwards.
    columns = rows.swapaxes(0, 1)  # [W, H, 3]
    return [_Side(lines) for lines in (columns, rows, columns[::-1], rows[::-1])]


def _find_uniform_frame(rgb: Tensor) -> PhotoFrame | None:
    """The uniform frame of an sRGB picture [H, W, 3] in 0..1 without thin rims, or None.

    At least two opposite sides must have the same colour and straight inner edges. The rule is
    strict, because a false frame would crop the picture. A frame within the frame, such as a line
    inside a mount, is added to it.
    """
    rows = rgb.numpy()  # [H, W, 3]
    sides = _sides(rows)
    uniform_widths = [side.uniform_width() for side in sides]
    widths = np.zeros(4, int)
    for index, side in enumerate(sides):
        # Columns, which the left and the right side see, run from the top to the bottom; rows run
        # from the left to the right.
        is_left_or_right = index % 2 == 0
        first_side = 1 if is_left_or_right else 0  # top or left
        last_side = first_side + 2  # bottom or right
        widths[index] = side.frame_width(
            uniform_widths[index],
            before=uniform_widths[first_side],
            after=uniform_widths[last_side],
        )

    colors = np.stack([side.color for side in sides])  # [4, 3]
    for index in (0, 1):  # left and right, then top and bottom
        # The frame consists of the sides that have the colour of this one.
        color_difference = np.abs(colors - colors[index]).max(axis=1)
        frame_widths = np.where(color_difference <= MAX_FRAME_NOISE, widths, 0)
        if frame_widths[index] and frame_widths[index + 2]:  # this side and the opposite one
            height, width = rows.shape[:2]
            outer = PhotoFrame(*frame_widths.tolist())
            # Inside of the frame there may be another one; the widths of both add up.
            inner = _find_uniform_frame(outer.inside(rgb, width, height))
            if inner is None:
                return outer
            total_widths = frame_widths + np.array(inner)  # [4]
            return PhotoFrame(*total_widths.tolist())
    return None


class _Side:
    """One side of a picture, seen as lines of pixels from the border inwards."""

    def __init__(self, lines: Floats) -> None:
        """Take the median colour of the outermost line for the colour of a possible frame.

        `lines` [N, M, 3] are N lines of M pixels; the first one is the border.
        """
        # The median, because a scratch or a speck of dust must not change the colour.
        self.color: Floats = np.median(lines[0], axis=0)  # [3]
        self._max_width = int(MAX_FRAME_RATIO * len(lines))
        self._lines = lines

    def _differences(self, start: int, stop: int) -> Floats:
        """Differences [n, M] of the pixels of the lines start..stop from the side's colour.

        The difference of two colours is that of the channel that differs most. Lines beyond the
        widest possible frame are left out.
        """
        lines = self._lines[start : min(stop, self._max_width)]
        differences: Floats = np.abs(lines - self.color).max(axis=-1)
        return differences

    def uniform_width(self) -> int:
        """The number of lines at the border that have the side's colour."""
        for line in range(self._max_width):
            if self._differences(line, line + 1).mean() > MAX_FRAME_NOISE:
                return line
        return self._max_width

    def frame_width(self, uniform_width: int, before: int, after: int) -> int:
        """The width of the frame in pixels, with its blurred inner edge; 0 if there is no frame.

        There is a frame if its inner edge is straight: within a few lines, most pixels change from
        the side's colour to another one.

        Args:
            uniform_width: number of lines at the border that have the side's colour.
            before: number of pixels at the beginning of each line that belong to the adjacent side
                of the frame, and so are not looked at.
            after: number of such pixels at the end of each line.
        """
        edge_lines = self._differences(uniform_width, uniform_width + BLURRED_EDGE_PX)  # [n, M]
        between = edge_lines[:, before : edge_lines.shape[1] - after]
        differing_ratio = (between > MIN_PICTURE_CONTRAST).mean(axis=1)  # [n]
        is_straight = differing_ratio.max(initial=0.0) >= MIN_STRAIGHT_RATIO
        if uniform_width < MIN_FRAME_PX or not is_straight:
            return 0
        # A blurred edge ends where the share of differing pixels stops growing: at the first line
        # that has at least 95 % of the largest share.
        end_of_edge = int((differing_ratio >= 0.95 * differing_ratio.max()).argmax())
        return uniform_width + end_of_edge + 1

    def rim_width(self) -> int:
        """The width of a thin dark or bright rim in pixels, with its blurred edge; 0 without a rim.

        A rim is darker or brighter than the picture inside along most of the side, and the picture
        inside varies much less.
        """
        # `_lines` [N, M, 3] are N lines of M pixels, from the picture's border inwards. The first
        # `max_width` lines may be a rim. The next `max_width` lines show how much the picture
        # inside varies. The 6 lines (MAX_RIM_PX) after these are the reference for both.
        max_width = max(MAX_RIM_PX, int(MAX_RIM_RATIO * len(self._lines)))
        reference_start = 2 * max_width
        brightness = self._lines[: reference_start + MAX_RIM_PX].mean(axis=-1)  # [n, M]
        if len(brightness) <= reference_start:
            return 0
        reference = brightness[reference_start:].mean(axis=0)  # [M]
        differences = brightness[:reference_start] - reference  # [2·max_width, M]
        contrasts = np.median(differences, axis=1)  # [2·max_width] of each line

        # Most pixels of the outermost line must differ, and to the same side.
        rim_contrast = contrasts[0]
        differs = differences[0] * np.sign(rim_contrast) > MIN_RIM_CONTRAST
        if abs(rim_contrast) < MIN_RIM_CONTRAST or differs.mean() < MIN_STRAIGHT_RATIO:
            return 0

        # The rim ends at the first line that is like the reference.
        ratios = np.abs(contrasts / rim_contrast)
        has_ended = ratios < MAX_BLURRED_RIM
        width = int(has_ended.argmax())  # 0 if there is no such line
        is_calm = bool((ratios[width:] < MAX_INSIDE_VARIATION).all())
        return width if 0 < width <= max_width and is_calm else 0
