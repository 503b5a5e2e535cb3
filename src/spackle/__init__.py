"""Spackle: one photo in, a 3D Gaussian scene out that survives a large camera move.

import spackle
scene = spackle.predict("photo.jpg")  # or depth="depth.png", or base=SharpBase.load("sharp.pt")
scene.save_video("video.mp4")
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # for editors and type checkers
    from spackle.api import Spackle as Spackle
    from spackle.api import predict as predict
    from spackle.bases import Base as Base
    from spackle.bases import BasePrediction as BasePrediction
    from spackle.bases.lite import LiteBase as LiteBase
    from spackle.bases.moge.base import MogeBase as MogeBase
    from spackle.bases.sharp import SharpBase as SharpBase
    from spackle.bases.transformers import HfBase as HfBase
    from spackle.core.camera import Camera as Camera
    from spackle.core.gaussians import Gaussians as Gaussians
    from spackle.core.photo import Photo as Photo
    from spackle.core.photo import load_photo as load_photo
    from spackle.depth.depth_map import DepthMap as DepthMap
    from spackle.depth.readers import load_depth as load_depth
    from spackle.formats import load_cameras as load_cameras
    from spackle.formats import load_ply as load_ply
    from spackle.formats import save_ply as save_ply
    from spackle.pipeline import complete as complete
    from spackle.pipeline import fill as fill
    from spackle.pipeline import remove as remove
    from spackle.posed.predict import predict_posed as predict_posed
    from spackle.posed.scene import PosedScene as PosedScene
    from spackle.render import Renderer as Renderer
    from spackle.render import get_renderer as get_renderer
    from spackle.render.protocol import Rendering as Rendering
    from spackle.residual import complete_view as complete_view
    from spackle.residual import hole_area_ratio as hole_area_ratio
    from spackle.residual import hole_mask as hole_mask
    from spackle.runtime.errors import Cancelled as Cancelled
    from spackle.runtime.errors import InputError as InputError
    from spackle.runtime.progress import StageProgress as StageProgress
    from spackle.scene import Scene as Scene
    from spackle.scene import SceneReport as SceneReport
    from spackle.scene_fill import FillContext as FillContext
    from spackle.scene_fill import fill_scene as fill_scene
    from spackle.scene_fill import fill_view as fill_view
    from spackle.scene_fill import marked_gaussians as marked_gaussians

__version__ = "0.1.0"  # pyproject.toml reads this line

# A name is imported at its first use, so that `spackle --help` does not wait for torch.
_NAMES_BY_MODULE = {
    "spackle.bases": ("Base", "BasePrediction"),
    "spackle.depth.depth_map": ("DepthMap",),
    "spackle.depth.readers": ("load_depth",),
    "spackle.bases.transformers": ("HfBase",),
    "spackle.bases.lite": ("LiteBase",),
    "spackle.bases.moge.base": ("MogeBase",),
    "spackle.bases.sharp": ("SharpBase",),
    "spackle.core.camera": ("Camera",),
    "spackle.runtime.errors": ("Cancelled", "InputError"),
    "spackle.runtime.progress": ("StageProgress",),
    "spackle.formats": ("load_cameras", "load_ply", "save_ply"),
    "spackle.core.gaussians": ("Gaussians",),
    "spackle.core.photo": ("Photo", "load_photo"),
    "spackle.render": ("Renderer", "get_renderer"),
    "spackle.render.protocol": ("Rendering",),
    "spackle.residual": ("complete_view", "hole_area_ratio", "hole_mask"),
    "spackle.pipeline": ("complete", "fill", "remove"),
    "spackle.posed.predict": ("predict_posed",),
    "spackle.posed.scene": ("PosedScene",),
    "spackle.scene": ("Scene", "SceneReport"),
    "spackle.scene_fill": ("FillContext", "fill_scene", "fill_view", "marked_gaussians"),
    "spackle.api": ("Spackle", "predict"),
}
_MODULE_OF_NAME = {name: module for module, names in _NAMES_BY_MODULE.items() for name in names}
__all__ = sorted(_MODULE_OF_NAME)


def __dir__() -> list[str]:
    """The public names, for completion in editors and notebooks."""
    return [*__all__, "__version__"]


if not TYPE_CHECKING:  # so that type checkers report misspelled names

    def __getattr__(name: str) -> object:
        """Import a public name at its first use; AttributeError for any other name."""
        if name not in _MODULE_OF_NAME:
            raise AttributeError(f"module 'spackle' has no attribute {name!r}")
        return getattr(importlib.import_module(_MODULE_OF_NAME[name]), name)
