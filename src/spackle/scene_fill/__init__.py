"""Beyond the paper: complete all views of a path with one set of Gaussians. Read `fill` first."""

from spackle.scene_fill.context import FillContext
from spackle.scene_fill.fill import FilledScene, FilledView, fill_scene, fill_view
from spackle.scene_fill.occlusion_guard import OcclusionGuard
from spackle.scene_fill.removal import marked_gaussians
from spackle.scene_fill.texture import Texture, exemplar_texture, painted_texture
from spackle.scene_fill.view_completion import SceneViewCompletion

__all__ = [
    "FillContext",
    "FilledScene",
    "FilledView",
    "OcclusionGuard",
    "SceneViewCompletion",
    "Texture",
    "exemplar_texture",
    "fill_scene",
    "fill_view",
    "marked_gaussians",
    "painted_texture",
]
