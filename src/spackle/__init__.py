"""Spackle: one photo in, a 3D Gaussian scene out that survives a large camera move.

import spackle
scene = spackle.predict("photo.jpg")  # or depth="depth.png", or base=spackle.SharpBase.load("sharp.pt")
scene.save_video("video.mp4")
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spackle.bases.depth_map import DepthMap, load_depth
    from spackle.bases.hf import HfBase
    from spackle.bases.lite.base import LiteBase
    from spackle.bases.protocol import Base, BasePrediction
    from spackle.bases.sharp import SharpBase
    from spackle.camera import Camera
    from spackle.errors import InputError
    from spackle.formats import load_cameras, load_ply, save_ply
    from spackle.gaussians import Gaussians
    from spackle.image import Photo, load_photo
    from spackle.render import Renderer, get_renderer
    from spackle.render.protocol import Rendering
    from spackle.residual import Completer, hole_area_ratio, hole_mask
    from spackle.scene import Scene, complete, predict

__version__ = "0.1.0"

# Loaded at first use: `spackle --help` need not wait for torch.
_HOMES = {
    "Base": "spackle.bases.protocol",
    "BasePrediction": "spackle.bases.protocol",
    "Camera": "spackle.camera",
    "Completer": "spackle.residual",
    "DepthMap": "spackle.bases.depth_map",
    "Gaussians": "spackle.gaussians",
    "HfBase": "spackle.bases.hf",
    "InputError": "spackle.errors",
    "LiteBase": "spackle.bases.lite.base",
    "Photo": "spackle.image",
    "Renderer": "spackle.render",
    "Rendering": "spackle.render.protocol",
    "Scene": "spackle.scene",
    "SharpBase": "spackle.bases.sharp",
    "complete": "spackle.scene",
    "get_renderer": "spackle.render",
    "hole_area_ratio": "spackle.residual",
    "hole_mask": "spackle.residual",
    "load_cameras": "spackle.formats",
    "load_depth": "spackle.bases.depth_map",
    "load_photo": "spackle.image",
    "load_ply": "spackle.formats",
    "predict": "spackle.scene",
    "save_ply": "spackle.formats",
}

__all__ = [
    "Base",
    "BasePrediction",
    "Camera",
    "Completer",
    "DepthMap",
    "Gaussians",
    "HfBase",
    "InputError",
    "LiteBase",
    "Photo",
    "Renderer",
    "Rendering",
    "Scene",
    "SharpBase",
    "complete",
    "get_renderer",
    "hole_area_ratio",
    "hole_mask",
    "load_cameras",
    "load_depth",
    "load_photo",
    "load_ply",
    "predict",
    "save_ply",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'spackle' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
