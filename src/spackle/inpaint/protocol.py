"""What every inpainter is: the `Inpainter` protocol, and the options with which one is opened."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from spackle.core.photo import MAX_WORKING_SIDE_PX
from spackle.runtime.errors import InputError

# ProPainter's optical flow works at 1/64 of the input's size, and needs two of these pixels.
MIN_INPUT_SIDE_PX = 128

# A depth below this is treated as this depth, so that 1 / depth is finite. It is shorter than any
# depth in a scene of any unit.
MIN_DEPTH = 1e-30


@dataclasses.dataclass(frozen=True, kw_only=True)
class InpainterOptions:
    """Options with which any inpainter is opened; inpainters without a network ignore them."""

    # A file or a folder of weights; None: the files that `spackle weights get` downloaded.
    weights: Path | None = None
    # The long side, in pixels, of the images that the network gets; None: the network's default.
    side: int | None = None
    # "cpu" or "cuda"; None: CUDA if available.
    device: str | None = None

    def side_or(self, default_side: int) -> int:
        """Return the long side of the network's input in pixels: `side`, or else the default.

        Raises:
            InputError: `side` is smaller than networks can use, or larger than a photo may be.
        """
        if self.side is None:
            return default_side
        if not MIN_INPUT_SIDE_PX <= self.side <= MAX_WORKING_SIDE_PX:
            limits = f"between {MIN_INPUT_SIDE_PX} and {MAX_WORKING_SIDE_PX}"
            raise InputError(f"`inpainter_side` must be {limits}, got {self.side}")
        return self.side


class Inpainter(Protocol):
    """Paints the holes of images; the same input gives the same output, bit for bit."""

    name: str
    version: str  # noted in reports: inpainters of different versions may paint other pixels
    uses_network: ClassVar[bool]  # whether it takes weights and a side, and runs on a GPU
    paints_views_together: ClassVar[bool]  # whether all views are painted at once, so they agree
    notice: ClassVar[str]  # a line for the user to read first, such as a licence; may be empty
    weight_files: Mapping[str, Path]  # the files of weights, by their names in reports

    def __init__(self, options: InpainterOptions) -> None:
        """Find the packages and load the weights; InputError if one of them is missing."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the holes of V views of one scene, which are in the order of a moving camera.

        Args:
            rgb: [V, H, W, 3] sRGB colours in 0..1.
            hole: [V, H, W] bool, True where a colour has to be painted.
            inverse_depth: [V, H, W] 1 / depth of the visible surfaces; 0 where it is unknown.

        Returns:
            [V, H, W, 3] sRGB colours in 0..1, equal to `rgb` bit for bit outside of the holes.
        """


def known_inverse_depth(depth: Tensor, hole: Tensor) -> Tensor:
    """Return the inverse depth that `Inpainter.paint` takes.

    Args:
        depth: [V, H, W] depth of rendered views, 0 where nothing was rendered.
        hole: [V, H, W] bool, True where a pixel has to be painted.

    Returns:
        [V, H, W] 1 / depth, and 0 in holes and where nothing was rendered.
    """
    known = ~hole & (depth > 0)
    return torch.where(known, 1 / depth.clamp_min(MIN_DEPTH), 0.0)
