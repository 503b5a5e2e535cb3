"""Inpainters fill the holes of images."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from spackle.core.photo import MAX_SIDE
from spackle.runtime.errors import InputError, check_name

MIN_SIDE = 128  # pixels; the coarsest map of ProPainter's flow, 1/64, needs two cells each way
INPAINTERS = {  # module and class, imported on use
    "exemplar": ("plain", "ExemplarInpainter"),
    "lama": ("lama", "LamaInpainter"),
    "opencv": ("plain", "OpencvInpainter"),
    "propainter": ("propainter", "PropainterInpainter"),
}


@dataclasses.dataclass(frozen=True)
class InpainterOptions:
    """Options of all inpainters."""

    weights: Path | None = None  # a file or a folder; None: the download of `spackle weights get`
    side: int | None = (
        None  # pixels of the long side of a network's input; None: the network's default
    )
    device: str | None = None  # "cpu" or "cuda"; None: CUDA if available

    def side_or(self, default: int) -> int:
        """The side, or `default`; InputError for a side that is too small or too large."""
        if self.side is not None and not MIN_SIDE <= self.side <= MAX_SIDE:
            raise InputError(
                f"--inpainter-side must be between {MIN_SIDE} and {MAX_SIDE}, got {self.side}"
            )
        return default if self.side is None else self.side


class Inpainter(Protocol):
    """Fills the holes of images; the same input gives the same output."""

    name: str
    version: str  # different versions may give different pixels
    network: ClassVar[bool]  # takes weights and a side, and uses a GPU
    video: ClassVar[bool]  # paints all views together, so that they agree
    notice: ClassVar[str]  # a line to show before use, such as a licence; may be empty
    files: Mapping[str, Path]  # weights, by their names in manifests

    def __init__(self, options: InpainterOptions) -> None:
        """Find packages and weights; InputError if they are missing."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the holes of V views of one scene, in the order of a moving camera.

        Args:
            rgb: [V, H, W, 3] sRGB in 0..1.
            hole: [V, H, W] bool.
            inverse_depth: [V, H, W] 1/z of the visible surfaces; 0 if unknown.

        Returns:
            [V, H, W, 3] sRGB in 0..1, equal to `rgb` bit for bit outside of the holes.
        """


def inpainter_class(name: str) -> type[Inpainter]:
    """The class of an inpainter; InputError for an unknown name."""
    check_name("inpainter", name, INPAINTERS)
    file, kind = INPAINTERS[name]
    found: type[Inpainter] = getattr(import_module(f"{__name__}.{file}"), kind)
    return found


def get_inpainter(name: str, options: InpainterOptions) -> Inpainter:
    """An inpainter by name; InputError if the name is unknown, or a package or weights are missing."""
    return inpainter_class(name)(options)


def known_inverse_depth(depth: Tensor, hole: Tensor) -> Tensor:
    """The argument `inverse_depth` of `Inpainter.paint`, from rendered depth [V, H, W]."""
    return torch.where(~hole & (depth > 0), 1 / depth.clamp_min(1e-6), 0.0)
