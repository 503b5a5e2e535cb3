"""Inpainters, which fill the holes of pictures: their protocol, and the table of their names.

To add an inpainter, write a class in a file of its own (see `Inpainter`), add a line to `INPAINTERS`, and test it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from spackle.errors import InputError, check_name
from spackle.image import MAX_SIDE

MIN_SIDE = 128  # pixels; the coarsest map of ProPainter's flow, 1/64, needs two cells each way
INPAINTERS = {  # file and class, imported when the inpainter is asked for
    "exemplar": ("plain", "ExemplarInpainter"),
    "lama": ("lama", "LamaInpainter"),
    "opencv": ("plain", "OpencvInpainter"),
    "propainter": ("propainter", "PropainterInpainter"),
}


@dataclasses.dataclass(frozen=True)
class InpainterOptions:
    """Options of all inpainters; each inpainter uses those that it needs."""

    weights: Path | None = None  # a file or a folder; None: those that `spackle weights get` has downloaded
    side: int | None = None  # pixels of the long side at which a network works; None: its own default
    device: str | None = None  # "cpu" or "cuda"; None: CUDA if available

    def side_or(self, default: int) -> int:
        """The side, or a network's default; InputError for a side that is too small or too large."""
        if self.side is not None and not MIN_SIDE <= self.side <= MAX_SIDE:
            raise InputError(f"--inpainter-side must be between {MIN_SIDE} and {MAX_SIDE}, got {self.side}")
        return default if self.side is None else self.side


class Inpainter(Protocol):
    """Fills the holes of pictures; the same input gives the same output."""

    name: str
    version: str  # another version may give other pixels
    network: ClassVar[bool]  # takes weights and a side, and uses a GPU
    video: ClassVar[bool]  # makes the views agree with each other; else it paints each by itself
    notice: ClassVar[str]  # a line to show before the inpainter is used, such as its licence; may be empty
    files: Mapping[str, Path]  # its weights, by the names that a manifest gives them

    def __init__(self, options: InpainterOptions) -> None:
        """Find the packages and weights that it needs; InputError if they are missing."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the holes of V views of one scene, ordered as a moving camera would see them.

        Args:
            rgb: [V, H, W, 3] sRGB in 0..1.
            hole: [V, H, W] bool.
            inverse_depth: [V, H, W] 1/z of what the views show; 0 where it is unknown.

        Returns:
            [V, H, W, 3] sRGB in 0..1, equal to `rgb` bit for bit outside of the holes.
        """
        ...


def inpainter_class(name: str) -> type[Inpainter]:
    """The class of an inpainter by its name; InputError for an unknown one."""
    check_name("inpainter", name, INPAINTERS)
    file, kind = INPAINTERS[name]
    found: type[Inpainter] = getattr(import_module(f"{__name__}.{file}"), kind)
    return found


def get_inpainter(name: str, options: InpainterOptions) -> Inpainter:
    """An inpainter by its name; InputError for an unknown one, or one whose package or weights are missing."""
    return inpainter_class(name)(options)


def known_inverse_depth(depth: Tensor, hole: Tensor) -> Tensor:
    """The `inverse_depth` of `Inpainter.paint`, from rendered depth [V, H, W]: 0 in holes and where the depth is 0."""
    return torch.where(~hole & (depth > 0), 1 / depth.clamp_min(1e-6), 0.0)
