"""Beyond the paper, which completes each view by itself: one scene that is consistent along a path.

`fill` builds on `spackle.residual` and says in which order views are completed, `occlusion_guard` keeps aux Gaussians
behind what the photo and other views show, and `texture` gives colours for each pixel.
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
