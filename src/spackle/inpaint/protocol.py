"""What an inpainter is given, and what it gives back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol

from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians

# (base, photo's camera, V cameras) to a function that draws the completed scene, sRGB [H, W, 3], from any of them.
SceneCompletion = Callable[[Gaussians, Camera, Sequence[Camera]], Callable[[Camera], Tensor]]


@dataclasses.dataclass(frozen=True)
class ViewStack:
    """A photo's Gaussians and what V cameras see of them."""

    base: Gaussians
    photo_camera: Camera
    cameras: Sequence[Camera]  # in a dataset the first one is the photo's
    rgb: Tensor  # [V, H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [V, H, W] expected z; 0 where alpha is 0
    alpha: Tensor  # [V, H, W] opacity
    mask: Tensor  # [V, H, W] bool: uncovered


@dataclasses.dataclass(frozen=True)
class InpainterOptions:
    """What inpainters are made of; each takes what it needs."""

    weights: Path | None = None  # a folder
    side: int | None = None  # pixels of the long side at which a network works; its own default where None
    device: str | None = None  # "cpu" or "cuda"; where None, CUDA if there is any
    complete_scene: SceneCompletion | None = None  # fills a scene's holes in 3D


class Inpainter(Protocol):
    """Turns renderings with holes into targets."""

    name: str
    version: str  # another version may give other pixels
    network: ClassVar[bool]  # takes weights and a side, and uses a GPU
    notice: ClassVar[str]  # a line that people read before it is used, such as its licence; empty where there is none
    files: Mapping[str, Path]  # its weights, by the names that a manifest gives them

    def __init__(self, options: InpainterOptions) -> None:
        """Find what it needs; InputError where that is missing."""

    def complete(self, views: ViewStack) -> Tensor:
        """Targets [V, H, W, 3] sRGB in 0..1: new colours where `views.mask` is, elsewhere `views.rgb` as it is."""
        ...


class PlainInpainter:
    """What inpainters without a network have in common."""

    network: ClassVar[bool] = False
    notice: ClassVar[str] = ""
    files: Mapping[str, Path] = {}
