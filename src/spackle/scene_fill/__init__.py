"""Complete all views of a path with one set of aux Gaussians; the paper completes single views."""

from spackle.scene_fill.fill import FillContext, FilledScene, FilledView, fill_scene, fill_view
from spackle.scene_fill.occlusion_guard import OcclusionGuard
from spackle.scene_fill.texture import Texture, exemplar_texture, painted_texture

__all__ = [
    "FillContext",
    "FilledScene",
    "FilledView",
    "OcclusionGuard",
    "Texture",
    "exemplar_texture",
    "fill_scene",
    "fill_view",
    "painted_texture",
]
