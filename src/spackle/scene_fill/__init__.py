"""Beyond the paper, which completes each view by itself: one scene that is consistent along a path.

- `fill`: `fill_scene` for a path, `fill_view` for one view; both build on `spackle.residual`.
- `view_order`: the order of views, and which may be skipped.
- `occlusion_guard`: keeps aux Gaussians behind what the photo and other views show.
- `rim_underlay`: Gaussians beneath the rims of holes, seen by neighbouring views.
- `texture`: colours for each pixel, from patches of the view or from an inpainter.
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
