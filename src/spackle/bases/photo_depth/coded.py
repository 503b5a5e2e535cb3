"""A depth map as a photo stores it: codes, their meaning, and how the map is turned."""

from __future__ import annotations

import dataclasses
import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.bases.depth_map import ASPECT_TOLERANCE, Quantity, grid_step
from spackle.errors import reason_in_a_line
from spackle.image import LENSES, check_pixels

Array = NDArray[Any]


@dataclasses.dataclass(frozen=True)
class Turn:
    """Rows and columns swapped first, then mirrored."""

    transpose: bool = False
    mirror_x: bool = False  # left and right
    mirror_y: bool = False  # top and bottom

    def grid(self, values: Tensor) -> Tensor:
        """[H, W] to [H, W] or [W, H]."""
        values = values.T if self.transpose else values
        axes = [axis for axis, mirrored in enumerate((self.mirror_y, self.mirror_x)) if mirrored]
        return values.flip(axes).contiguous()

    def matrix(self, K: Tensor, width: int, height: int) -> Tensor:
        """Intrinsics [3, 3] of a width×height map, after the turn."""
        (fx, cx), (fy, cy) = (float(K[0, 0]), float(K[0, 2])), (float(K[1, 1]), float(K[1, 2]))
        if self.transpose:
            fx, cx, fy, cy, width, height = fy, cy, fx, cx, height, width
        cx = width - cx if self.mirror_x else cx
        cy = height - cy if self.mirror_y else cy
        return K.new_tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def then(self, after: Turn) -> Turn:
        """This turn followed by another."""
        x, y = (self.mirror_y, self.mirror_x) if after.transpose else (self.mirror_x, self.mirror_y)
        return Turn(self.transpose != after.transpose, x != after.mirror_x, y != after.mirror_y)


UPRIGHT = Turn()
# How a picture with this EXIF orientation is turned upright.
BY_ORIENTATION = {
    2: Turn(mirror_x=True),
    3: Turn(mirror_x=True, mirror_y=True),
    4: Turn(mirror_y=True),
    5: Turn(transpose=True),
    6: Turn(transpose=True, mirror_x=True),
    7: Turn(transpose=True, mirror_x=True, mirror_y=True),
    8: Turn(transpose=True, mirror_y=True),
}
# HEIF's `irot`: so many quarter turns anticlockwise. Its `imir`: 0 swaps top and bottom, 1 left and right.
BY_IROT = (UPRIGHT, BY_ORIENTATION[8], BY_ORIENTATION[3], BY_ORIENTATION[6])
BY_IMIR = (BY_ORIENTATION[4], BY_ORIENTATION[2])


class BrokenDepth(Exception):
    """A photo has a depth map that cannot be used; the message completes "the depth map in the photo …"."""


@dataclasses.dataclass(frozen=True)
class Scale:
    """Codes to values, along a straight line."""

    quantity: Quantity
    first: float  # value of the lowest code: metres of depth, or 1/m of disparity
    last: float  # value of the highest code
    lowest: float = 0.0
    highest: float | None = None  # None: the highest that the picture's format has

    def decode(self, codes: Array, full: int) -> tuple[Array, float | None]:
        """Depth of codes [H, W] in metres, not above zero where unknown, and the step between codes in use."""
        highest = full if self.highest is None else self.highest
        if not all(map(math.isfinite, (self.first, self.last, self.lowest, highest))) or highest <= self.lowest:
            raise BrokenDepth("does not say what its values mean: a number of its range makes no sense")
        if self.first == self.last or max(self.first, self.last) <= 0:
            raise BrokenDepth(f"announces a {self.quantity} from {self.first:g} to {self.last:g}")
        if int(codes.min()) == int(codes.max()):
            raise BrokenDepth("has the same value everywhere")
        slope = (self.last - self.first) / (highest - self.lowest)
        grid = grid_step(codes)
        step = None if grid is None else abs(slope) * grid
        with np.errstate(all="ignore"):  # what comes out infinite is marked by the caller
            values = self.first + slope * (codes.astype(np.float64) - self.lowest)
            if self.quantity == "depth":
                return values, step
            # Not above zero is the horizon and what noise has pushed beyond it: far, but not unknown.
            return 1 / np.maximum(values, abs(slope) / 2), step


@dataclasses.dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels of a picture of this size."""

    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[float, float]  # (width, height)

    def matrix(self, width: int, height: int) -> Tensor | None:
        """[3, 3] for a width×height map; None where the numbers cannot be this map's: the photo's own lens counts."""
        numbers = (*self.focal, *self.center, *self.size)
        if not all(map(math.isfinite, numbers)) or min(self.size) <= 0:
            return None
        shortest, longest = (lens * max(self.size) for lens in LENSES)
        believable = all(shortest <= focal <= longest for focal in self.focal)
        inside = all(0 < center < side for center, side in zip(self.center, self.size, strict=True))
        fits = abs(self.size[0] * height / (self.size[1] * width) - 1) <= ASPECT_TOLERANCE
        if not (believable and inside and fits):
            return None
        x, y = width / self.size[0], height / self.size[1]
        fx, fy, cx, cy = self.focal[0] * x, self.focal[1] * y, self.center[0] * x, self.center[1] * y
        return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@dataclasses.dataclass(frozen=True)
class CodedDepth:
    """A depth map as it lies in the file."""

    codes: Array  # [H, W] whole numbers
    full: int  # the highest code of the picture's format
    scale: Scale
    source: str  # whose layout, of what quantity, how far to be trusted: for the report
    lens: Lens | None = None
    turned: Turn = UPRIGHT  # what the decoder has done to the codes, but not to the lens
    turn: Turn = UPRIGHT  # what is still to do to get to the photo as Pillow opens it
    along_ray: bool = False  # distances from the eye instead of z
    unit_known: bool = True


def read_codes(picture: bytes) -> tuple[Array, int]:
    """[H, W] values of a JPEG or PNG, and the highest value that its format has."""
    with decoding(), Image.open(io.BytesIO(picture), formats=("JPEG", "PNG")) as image:
        check_pixels(*image.size, len(picture), "it")
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16), 65535
        return np.asarray(image.convert("L")), 255


@contextmanager
def decoding() -> Iterator[None]:
    """BrokenDepth for whatever a decoder raises over a stranger's bytes; its warnings are not worth a line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except BrokenDepth:
        raise
    except Exception as error:
        raise BrokenDepth(f"cannot be decoded ({reason_in_a_line(error)})") from error
