"""The value `DepthMap`: metres for each pixel of a photo, and what is known about them.

`readers` reads depth maps from files, `units` turns stored numbers into metres, `calibration` does
so for the disparities of stereo pairs.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.runtime.errors import InputError

Array = NDArray[Any]
StrPath = str | os.PathLike[str]
Quantity = Literal["depth", "disparity"]

ASPECT_TOLERANCE = 0.01  # a depth map's aspect ratio may differ from the photo's by this share
# Networks round the sides of their input to multiples of these: patches of 14 or 16 pixels, five
# halvings, and the factors of encoders. Their maps show the whole photo, a little stretched.
NETWORK_SIDE_MULTIPLES = (8, 14, 16, 32, 64)
MAX_NETWORK_STRETCH = 0.05  # share by which such a map's aspect ratio may differ from the photo's
# Depths in metres that a map may hold. Their squares, and products with a focal length, fit
# float32. Renderers write 1e10 for the background.
MIN_DEPTH_M = 1e-9
MAX_DEPTH_M = 1e12
NEAR_AND_FAR_QUANTILES = (0.01, 0.99)  # quantiles that count as the nearest and farthest depth
MIN_DISTINCT_VALUES = 16  # fewer distinct values may share a divisor by chance
MAX_EXACT_INTEGER = 1 << 53  # beyond it, float64 skips integers


@dataclasses.dataclass(frozen=True)
class DepthMap:
    """A depth map as it was stored: neither filled nor cleaned."""

    depth: Tensor  # [H, W] float32 z in metres; 0 where not valid
    valid: Tensor  # [H, W] bool: where the depth is known
    K: Tensor | None  # [3, 3] intrinsics in pixels of this map, from the map's calibration
    quantum: float | None  # quantisation step: metres for depth, 1/m for disparity
    quantity: Quantity  # the stored quantity
    path: Path  # the file, for messages
    note: str = ""  # for the report: the format of a depth map that was inside a photo
    meaning: str = ""  # for the report: how the stored numbers were understood, such as "metres"
    is_guess: bool = False  # whether nobody stated the meaning or the unit

    @property
    def range_in_words(self) -> str:
        """The near (1 % quantile), median and far (99 %) depth, such as "near 1 m, median …"."""
        near_quantile, far_quantile = NEAR_AND_FAR_QUANTILES
        known_depths = self.depth[self.valid].numpy()
        near, median, far = np.quantile(known_depths, [near_quantile, 0.5, far_quantile])
        return f"near {near:.3g} m, median {median:.3g} m, far {far:.3g} m"

    def stretch_to(self, height: int, width: int) -> float:
        """How much wider this map is than a height×width photo, relative: 0.02 for 2 %."""
        # A map may be smaller or larger than its photo: only the shape counts.
        rows, columns = self.depth.shape
        return columns * height / (rows * width) - 1

    def check_aspect_ratio(self, height: int, width: int, photo: StrPath) -> None:
        """InputError unless this map has the aspect ratio of a height×width photo.

        It may differ by 1 %; and by what a network's rounding of both sides explains, up to 5 %.
        """
        stretch = abs(self.stretch_to(height, width))
        if stretch <= ASPECT_TOLERANCE:
            return
        rows, columns = self.depth.shape
        is_rounded = is_size_of_network(rows, columns, height, width)
        if is_rounded and stretch <= MAX_NETWORK_STRETCH:
            return
        advice = "give a depth map with the photo's size or aspect ratio"
        # Programs that ignore EXIF's orientation write maps that lie on their side.
        is_on_its_side = abs(self.stretch_to(width, height)) <= ASPECT_TOLERANCE
        if is_on_its_side:
            advice = "it lies on its side: turn it upright, as EXIF turns the photo"
        raise InputError(
            f"depth map {self.path} is {columns}×{rows} but photo {photo} is {width}×{height}: "
            + advice
        )

    def with_focal(self, focal_px: float) -> DepthMap:
        """The map for another focal length, in pixels of the map.

        Metres that were computed from disparity scale with the focal length, because
        depth = baseline · focal / disparity. Measured metres do not depend on a lens and stay. Only
        their intrinsics, which would contradict the new focal length, are removed.
        """
        if self.K is None or self.quantity == "depth":
            return dataclasses.replace(self, K=None)

        factor = focal_px / float(self.K[0, 0])
        K = self.K.clone()
        K[0, 0] = focal_px
        K[1, 1] = focal_px
        # The step is in 1/m, so that it shrinks where metres grow.
        quantum = None if self.quantum is None else self.quantum / factor
        return dataclasses.replace(self, depth=self.depth * factor, K=K, quantum=quantum)


def is_size_of_network(rows: int, columns: int, height: int, width: int) -> bool:
    """Whether rows×columns is the size to which a network may shrink a height×width photo.

    That is, both sides are multiples of 8, 14, 16, 32 or 64 pixels, and one of them is at most one
    such step away from the side that the photo's aspect ratio asks for.
    """
    # The sides that would keep the aspect ratio, if the other side is right.
    exact_rows = columns * height / width
    exact_columns = rows * width / height
    for multiple in NETWORK_SIDE_MULTIPLES:
        are_multiples = rows % multiple == 0 and columns % multiple == 0
        smaller_error = min(abs(rows - exact_rows), abs(columns - exact_columns))
        if are_multiples and smaller_error <= multiple:
            return True
    return False


def is_valid_depth(metres: Tensor) -> Tensor:
    """Mask of valid depths: from a nanometre to 1e12 m, between which all arithmetic is safe."""
    # Comparisons are false for NaN.
    return (metres >= MIN_DEPTH_M) & (metres <= MAX_DEPTH_M)


def quantisation_step(values: Array) -> float | None:
    """The greatest common step of integers: any two of `values` [N] differ by a multiple of it.

    None, for an unknown step, if a value is not an integer, or is too large to be exact.
    """
    are_integers = np.array_equal(values, np.round(values))
    if float(values.max()) > MAX_EXACT_INTEGER or not are_integers:
        return None

    distinct = np.unique(values.astype(np.int64))
    # Few values may share a large step by chance: a map of two walls, at 2000 and 3000 mm, does not
    # have steps of a metre.
    if len(distinct) < MIN_DISTINCT_VALUES:
        return 1.0
    # A camera with 10 bits in a file of 16 bits stores multiples of 64.
    return float(np.gcd.reduce(np.diff(distinct)))


def check_not_negative(stored: Array, path: StrPath) -> None:
    """InputError, naming the file, if a number of `stored` [H, W] is negative. NaN and inf pass."""
    # The program that wrote negative depths may mean that z points backwards, or that they are
    # unknown. The file does not say which, so it is refused.
    negative_count = int((np.isfinite(stored) & (stored < 0)).sum())
    if negative_count:
        raise InputError(
            f"{path}: {negative_count} of {stored.size} values are negative: "
            "mark unknown pixels with 0 or NaN"
        )


def build_depth_map(
    stored: Array,
    *,
    depth: Array,
    valid: Array,
    quantity: Quantity,
    stored_unit: float | None,
    K: Tensor | None,
    path: StrPath,
    meaning: str,
    is_guess: bool = False,
) -> DepthMap:
    """The depth map of a file's numbers that were converted to metres.

    Depths that are 0, or beyond MIN_DEPTH_M to MAX_DEPTH_M, become unknown.

    Args:
        stored: [H, W] the file's numbers, whose common step becomes the quantisation step.
        depth: [H, W] metres, computed from `stored`.
        valid: [H, W] bool: the pixels that may be known.
        quantity: what the file stores, "depth" or "disparity".
        stored_unit: metres (for disparity, 1/m) that one unit of `stored` means; None if the
            numbers are floats, which have no common step.
        K: [3, 3] intrinsics of the map, None if they are not known.
        path: the file, for messages.
        meaning: how `stored` was understood, such as "metres".
        is_guess: whether nobody stated that meaning.

    Raises:
        InputError: no pixel is known.
    """
    with np.errstate(over="ignore"):  # a depth too large for float32 becomes inf, hence unknown
        metres = torch.from_numpy(depth.astype(np.float32))
    known = torch.from_numpy(valid) & is_valid_depth(metres)
    if not known.any():
        positive = depth[valid & np.isfinite(depth) & (depth > 0)]
        if positive.size:
            raise InputError(
                f"{path}: read as {meaning}, its depth goes from {positive.min():.3g} to "
                f"{positive.max():.3g} m, which nothing in a photo has: give `depth_unit`"
            )
        raise InputError(f"{path}: all-invalid: not one of {stored.size} pixels has a {quantity}")

    # The step is kept, because smoothing must know it: a step of the numbers is no edge of a
    # surface.
    quantum = None
    if stored_unit is not None:
        step = quantisation_step(stored[known.numpy()])
        quantum = None if step is None else step * stored_unit
    return DepthMap(
        depth=metres.where(known, 0.0),
        valid=known,
        K=K,
        quantum=quantum,
        quantity=quantity,
        path=Path(path),
        meaning=meaning,
        is_guess=is_guess,
    )
