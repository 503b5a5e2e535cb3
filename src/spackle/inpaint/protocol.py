"""What an inpainter is given, and what it gives back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class InpainterOptions:
    """What inpainters are made of; each takes what it needs."""

    weights: Path | None = None  # a file or a folder; where None, those that `spackle weights get` brought
    side: int | None = None  # pixels of the long side at which a network works; its own default where None
    device: str | None = None  # "cpu" or "cuda"; where None, CUDA if there is any


class Inpainter(Protocol):
    """Fills the holes of pictures; the same input gives the same output."""

    name: str
    version: str  # another version may give other pixels
    network: ClassVar[bool]  # takes weights and a side, and uses a GPU
    notice: ClassVar[str]  # a line that people read before it is used, such as its licence; empty where there is none
    files: Mapping[str, Path]  # its weights, by the names that a manifest gives them

    def __init__(self, options: InpainterOptions) -> None:
        """Find what it needs; InputError where that is missing."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """New colours in the holes of V views of one scene, ordered as a camera that flies past would see them.

        Args:
            rgb: [V, H, W, 3] sRGB in 0..1.
            hole: [V, H, W] bool.
            inverse_depth: [V, H, W] 1/z of what the views show; 0 where it is unknown.

        Returns:
            [V, H, W, 3] sRGB in 0..1, outside of the holes `rgb` bit for bit.
        """
        ...


class PlainInpainter:
    """What inpainters without a network have in common."""

    network: ClassVar[bool] = False
    notice: ClassVar[str] = ""
    files: Mapping[str, Path] = {}


def known_inverse_depth(depth: Tensor, hole: Tensor) -> Tensor:
    """`inverse_depth` for `Inpainter.paint` of renderings with depth [V, H, W]: 0 in the holes and where depth is 0."""
    return torch.where(~hole & (depth > 0), 1 / depth.clamp_min(1e-6), 0.0)
