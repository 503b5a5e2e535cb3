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


class BrokenDepth(Exception):
    """A photo has a depth map that cannot be used; the message completes "the depth map in the photo …"."""


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


def to_number(text: str, name: str) -> float:
    """A finite number; BrokenDepth with the property's name otherwise."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BrokenDepth(f"has {text[:40]!r} for {name.rpartition('}')[2]}, which is no number")
    return value


def read_codes(picture: bytes) -> tuple[Array, int]:
    """[H, W] values of a JPEG or PNG, and the highest value that its format has."""
    with decoding(), Image.open(io.BytesIO(picture), formats=("JPEG", "PNG")) as image:
        check_pixels(*image.size, len(picture), "it")
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16), 65535
        return np.asarray(image.convert("L")), 255


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

    def matrix(self, width: int, height: int, turn: str) -> Tensor | None:
        """[3, 3] for a width×height map, after its turn; None where the numbers cannot be this map's."""
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
        for step in turn:
            if step == "t":
                fx, cx, fy, cy, width, height = fy, cy, fx, cx, height, width
            cx = width - cx if step == "x" else cx
            cy = height - cy if step == "y" else cy
        return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def turned(values: Tensor, turn: str) -> Tensor:
    """[H, W] to [H, W] or [W, H] by the steps of a turn, see `containers.BY_ORIENTATION`."""
    for step in turn:
        values = values.T if step == "t" else values.flip(1 if step == "x" else 0)
    return values.contiguous()


@dataclasses.dataclass(frozen=True)
class CodedDepth:
    """A depth map as it lies in the file."""

    codes: Array  # [H, W] whole numbers
    full: int  # the highest code of the picture's format
    scale: Scale
    source: str  # whose layout, of what quantity, how far to be trusted: for the report
    lens: Lens | None = None
    decoded_turn: str = ""  # what the decoder has done to the codes, but not to the lens
    turn: str = ""  # what is still to do to get to the photo as Pillow opens it
    along_ray: bool = False  # distances from the eye instead of z
    unit_known: bool = True
