"""What `spackle.fill` decides about a scene before it fills: which view stands for a photo, which
empty pixels are holes, and which are background.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import NEAR_QUANTILE
from spackle.render import Renderer
from spackle.scene_fill.background import ViewEmptiness, find_background
from spackle.scene_fill.fill import view_differences

# Whether sky and other empty space stays empty, or every empty pixel is filled.
Background = Literal["keep", "fill"]
# Views whose fractions of empty pixels differ less see equally much; the most central one is taken.
SIMILAR_EMPTY_RATIO = 0.005


@dataclasses.dataclass(frozen=True, kw_only=True)
class FillPlan:
    """The decisions before a fill; lists have an element for each view to fill."""

    photo_camera: Camera  # of the view that stands for a photo: it sees most
    # [H, W] bool of each view: the pixels whose holes are filled; None: all pixels, of all views or
    # of one
    fillable: list[Tensor | None] | None
    # [H, W] bool of each view: emptiness in which nothing may appear; None: there is none
    keep_empty: list[Tensor | None] | None
    hole_ratios: list[float]  # the fraction of each view's pixels that are holes to be filled
    background_ratios: list[float]  # the fraction of each view's pixels that are background
    sees_scene: bool  # whether any view shows a surface


@torch.no_grad()
def plan_fill(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    renderer: Renderer,
    *,
    background: Background = "keep",
    fillable: Sequence[Tensor | None] | None = None,
    photo_camera: Camera | None = None,
) -> FillPlan:
    """Decide what a fill of these views fills.

    Args:
        gaussians: the scene.
        cameras: the views to fill.
        renderer: draws the scene.
        background: "keep": empty space behind the scene is no hole; "fill": all emptiness is.
        fillable: for each view the pixels [H, W] bool that may be filled, or None for all. If
            given, it decides alone what is filled.
        photo_camera: of the photo from which the scene was made; None: the view that sees most.
    """
    on_device = gaussians.to(renderer.device)

    def emptiness(camera: Camera) -> ViewEmptiness:
        """Where a camera's view is empty."""
        return ViewEmptiness.of(renderer.render(on_device, camera), camera)

    views = [emptiness(camera) for camera in cameras]
    given = list(fillable) if fillable is not None else None
    keep_empty: list[Tensor | None] | None = None
    background_ratios = [0.0] * len(views)
    if given is None and background == "keep":
        # The photo's own view tells more of the scene than any other.
        photo_views = [] if photo_camera is None else [emptiness(photo_camera)]
        backgrounds = find_background(gaussians, [*views, *photo_views])
        if backgrounds is not None:
            backgrounds = backgrounds[: len(views)]
            background_ratios = [float(view.is_background.float().mean()) for view in backgrounds]
            given = [~view.is_background for view in backgrounds]
            # What is filled in other views may appear in enclosed background, but not in the sky.
            keep_empty = [view.is_open for view in backgrounds]

    return FillPlan(
        photo_camera=photo_camera or cameras[choose_reference(views)],
        fillable=given,
        keep_empty=keep_empty,
        hole_ratios=_hole_ratios(views, given),
        background_ratios=background_ratios,
        sees_scene=any(view.empty_ratio < 1 for view in views),
    )


def _hole_ratios(
    views: Sequence[ViewEmptiness], fillable: Sequence[Tensor | None] | None
) -> list[float]:
    """The fraction of each view's pixels that are empty and may be filled, 0..1."""
    ratios = []
    for index, view in enumerate(views):
        pixels = None if fillable is None else fillable[index]
        is_hole = view.is_empty if pixels is None else view.is_empty & pixels.cpu()
        ratios.append(float(is_hole.float().mean()))
    return ratios


def choose_reference(views: Sequence[ViewEmptiness]) -> int:
    """The index of the view that stands for a photo: it has the fewest empty pixels.

    Of views with nearly as few, it is the most central one. The order of the views does not matter.
    """
    fewest = min(view.empty_ratio for view in views)
    candidates = [
        index
        for index, view in enumerate(views)
        if view.empty_ratio <= fewest + SIMILAR_EMPTY_RATIO
    ]

    # What differs between two views depends on how near the scene is: as near as the nearest
    # surfaces in the view that sees most. Views that see nothing are told apart with any depth.
    best = min(views, key=lambda view: view.empty_ratio)
    surface_depths = best.witness.depth[best.witness.depth > 0].numpy()
    near_depth = float(np.quantile(surface_depths, NEAR_QUANTILE)) if len(surface_depths) else 1.0
    cameras = [view.camera for view in views]
    # [V] how much a view differs from all others together: the most central one differs least.
    totals = view_differences(cameras, best.camera, near_depth).sum(1)

    def rank(index: int) -> tuple[float, float, list[float]]:
        """What is smallest for the reference: of equal views, the smallest numbers of the pose."""
        view = views[index]
        pose = view.camera.world_to_camera.flatten().tolist()
        # Rounded, so that the order in which the differences were added up does not matter.
        return (round(float(totals[index]), 6), view.empty_ratio, pose)

    return min(candidates, key=rank)
