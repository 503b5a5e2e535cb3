"""One scene that is consistent along a whole path; the paper completes each view by itself.

`fill` builds on `spackle.residual` and chooses the order in which views are completed, `occlusion_guard` keeps aux
Gaussians behind the surfaces that the photo and other views show, and `texture` gives a colour to each pixel.
"""

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
