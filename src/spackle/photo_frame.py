"""The uniform frame around a picture: a scan's margin, letterbox bars, a white mount.

A false find costs part of the picture, so a side counts only if its lines have one colour up to JPEG's noise, end at
a straight edge along nearly all of their length, and agree with the other sides. A sky, a studio's background and a
vignette have no such edge. A fringe of up to four pixels that a scanner darkened costs little, so one step is enough.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Pixels = NDArray[np.float32]

WIDEST = 0.25  # of the photo's width or height that a side of the frame takes
NESTED = 3  # frames within each other: a mount with a thin line around the picture
# Differences are the largest of the three channels, sRGB in 0..1. A line's colour is compared with the outermost's.
NOISE, RINGING = 3.5 / 255, 9 / 255  # mean difference of a frame's line; near its edge, where JPEG rings
RINGING_PX = 16  # JPEG's block with subsampled colours
STEP = 20 / 255  # the least difference across the frame's edge
FLAWED = 0.1  # of a frame's line may differ by more than the step
ALONE, OF_PAIR, OF_FOUR = 0.9, 0.8, 0.6  # of the edge has the step: of one side, of opposite sides, of all four
BLUR_PX, BLUR = 6, 0.004  # the edge is not longer than this, in pixels, or in long sides of the photo
INSIDE = 0.8  # of the step is done where the picture begins
MIXED_PX = 1  # more is cut off, in which both are still mixed
SHARP_PX = 3  # the edge of a side that stands alone is not longer than this, or half of the above
SAME = 8 / 255  # colours of different sides
BLACK, WHITE = 16 / 255, 250 / 255  # a side without its opposite is as dark or as bright as this
FRINGE_PX, BESIDE_PX = 4, 20  # lines that may be a fringe; lines beside them, whose steps are the picture's own
FRINGE_STEP, FRINGE_RATIO = 6 / 255, 3.0  # the least step at a fringe's end, and the least over the picture's own


@dataclasses.dataclass(frozen=True)
class PhotoFrame:
    """The widths of a frame's sides in pixels of the photo; 0 where there is none."""

    left: int
    top: int
    right: int
    bottom: int
    shade: Literal["dark", "light"]

    @property
    def widths(self) -> tuple[int, int, int, int]:
        """Left, top, right, bottom."""
        return self.left, self.top, self.right, self.bottom

    @property
    def note(self) -> str:
        """For the log."""
        widths = ", ".join(map(str, self.widths))
        return f"a {self.shade} frame ({widths} pixels: left, top, right, bottom) is cut off"

    def inside(self, picture: Tensor, width: int, height: int) -> Tensor:
        """What a picture [H, W, ...] of a width×height photo shows inside the frame, to the nearest pixel."""
        rows, columns = picture.shape[:2]
        left, right = (round(side * columns / width) for side in (self.left, self.right))
        top, bottom = (round(side * rows / height) for side in (self.top, self.bottom))
        return picture[top : rows - bottom, left : columns - right].contiguous()


@dataclasses.dataclass(frozen=True)
class _Side:
    """What one side of a picture looks like."""

    flat: int  # so many lines have one colour; 0: no frame
    color: NDArray[np.float32]  # [3] of the outermost line
    edge: int = 0  # lines before the picture begins
    covered: float = 0.0  # share of the edge that has the step

    def alike(self, other: _Side) -> bool:
        return float(np.abs(self.color - other.color).max()) <= SAME

    def pure(self, blur: int) -> bool:
        """Black or white, with a sharp edge."""
        extreme = float(self.color.max()) <= BLACK or float(self.color.min()) >= WHITE
        return extreme and self.edge - self.flat <= max(SHARP_PX, blur // 2 if blur > BLUR_PX else 0)


def find_frame(rgb: Tensor) -> PhotoFrame | None:
    """The uniform frame of an sRGB picture [H, W, 3] in 0..1, or None."""
    pixels: Pixels = rgb.numpy()
    height, width = pixels.shape[:2]
    most = WIDEST * np.array([width, height, width, height]) - MIXED_PX
    cut, color = np.zeros(4, int), None
    for _ in range(NESTED):
        left, top, right, bottom = cut
        sides = _sides(pixels[top : height - bottom, left : width - right])
        found = np.array([side.edge for side in sides])
        if not found.any() or (cut + found > most).any():
            break
        cut = cut + found
        color = sides[found.argmax()].color if color is None else color
    left, top, right, bottom = (int(n + MIXED_PX * (n > 0)) for n in cut)
    inner = pixels[top : height - bottom, left : width - right]
    across = inner.swapaxes(0, 1)
    fringes = [_fringe(lines) for lines in (across, inner, across[::-1], inner[::-1])]
    left, top, right, bottom = (n + more for n, more in zip((left, top, right, bottom), fringes, strict=True))
    if not left + top + right + bottom:
        return None
    if color is None:
        color = pixels[[0, -1][bottom > top]].mean(0) if top + bottom else pixels[:, [0, -1][right > left]].mean(0)
    return PhotoFrame(left, top, right, bottom, "light" if color.mean() > 0.5 else "dark")


def _fringe(lines: Pixels) -> int:
    """How many of the outermost lines [N, M, 3] a straight step parts from the picture: what scanning or cropping left.

    Where the lines beside them have such steps, too, it is the picture's own.
    """
    if len(lines) < 2 * (FRINGE_PX + BESIDE_PX):
        return 0
    grey = lines[: FRINGE_PX + BESIDE_PX].mean(-1)
    steps = np.abs(np.median(np.diff(grey, axis=0), axis=1))
    least = max(FRINGE_STEP, FRINGE_RATIO * float(steps[FRINGE_PX:].max()))
    ends = np.flatnonzero(steps[:FRINGE_PX] > least)
    return int(ends[-1]) + 1 if len(ends) else 0


def _sides(pixels: Pixels) -> list[_Side]:
    """Left, top, right and bottom of a picture; the edge is 0 where there is no frame to believe in."""
    height, width = pixels.shape[:2]
    across = pixels.swapaxes(0, 1)
    inwards = (across, pixels, across[::-1], pixels[::-1])  # lines from each side inwards
    blur = max(BLUR_PX, round(BLUR * max(height, width)))
    flat = [_flat(lines) for lines in inwards]
    counts = [side.flat for side in flat]
    within = [slice(counts[1], height - counts[3]), slice(counts[0], width - counts[2])] * 2
    sides = [_with_edge(side, lines[:, span], blur) for side, lines, span in zip(flat, inwards, within, strict=True)]
    chosen = _believed(sides, blur)
    return [side if k in chosen else dataclasses.replace(side, edge=0) for k, side in enumerate(sides)]


def _flat(lines: Pixels) -> _Side:
    """How many of a picture's lines [N, M, 3], from the outermost inwards, have the outermost's colour."""
    color = np.median(lines[0], axis=0)
    noise: list[float] = []
    for line in lines[: int(WIDEST * len(lines)) + 1]:
        difference = np.abs(line - color).max(-1)
        if difference.mean() > RINGING or (difference > STEP).mean() > FLAWED:
            break
        noise.append(float(difference.mean()))
    endless = len(noise) > WIDEST * len(lines)
    noisy = any(mean > NOISE for mean in noise[:-RINGING_PX])
    return _Side(0 if endless or noisy else len(noise), color)


def _with_edge(side: _Side, lines: Pixels, blur: int) -> _Side:
    """The side with the edge that follows its lines [N, M, 3], which the other sides' frames have been cut off."""
    if not side.flat or not lines.shape[1]:
        return side
    difference = np.abs(lines[side.flat : side.flat + 2 * blur] - side.color).max(-1)
    covered = (difference > STEP).mean(1)
    best = int(covered[:blur].argmax())
    full = np.maximum(difference[best : best + 3].max(0), STEP)
    inside = (covered >= 0.95 * covered[best]) & (np.median(difference / full, axis=1) >= INSIDE)
    begins = int(inside[: best + 1].argmax()) if inside[: best + 1].any() else best
    return dataclasses.replace(side, edge=side.flat + begins, covered=float(covered[best]))


def _believed(sides: list[_Side], blur: int) -> set[int]:
    """The sides that are of a frame: all four, opposite ones, or black or white ones."""
    if not any(side.flat for side in sides):
        return set()
    if min(side.covered for side in sides) >= OF_FOUR and all(side.alike(sides[0]) for side in sides):
        return set(range(4))
    chosen = set()
    for k, side in enumerate(sides):
        opposite = sides[(k + 2) % 4]
        pair = min(side.covered, opposite.covered) >= OF_PAIR and side.alike(opposite)
        if pair or (side.covered >= ALONE and side.pure(blur)):
            chosen.add(k)
    if any(not sides[k].alike(sides[j]) for k in chosen for j in chosen):
        return set()
    if len(chosen) > 2:
        return chosen
    # Where a neighbour has the colour but no edge, an object lies on a background.
    beside = {k: {(k + 1) % 4, (k + 3) % 4} - chosen for k in chosen}
    return {k for k in chosen if not any(sides[j].flat and sides[j].alike(sides[k]) for j in beside[k])}
