"""Outlines of a depth that was guessed from the photo, which lie beside the photo's outlines."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import max_pool2d

from spackle.core.surfels import DEPTH_EDGE_RATIO
from spackle.lifting.edges import Floats
from spackle.lifting.step_surfaces import find_step_rings


def grow_near_surfaces(inverse_depth: Floats, growth_px: int) -> Floats:
    """The inverse depth [H, W] with near surfaces that reach further over their depth steps.

    A guessed outline lies beside the photo's, and what lens, sharpening and compression have mixed
    reaches a pixel or two further. If the outline is too narrow, pixels with the object's colour
    stay behind on the far surface, as a ghost line, when the camera moves. If it is too wide, some
    pixels of the background move with the object. They are hardly visible, because what lies around
    the object then is the same background.

    Args:
        inverse_depth: [H, W] 1/z, positive.
        growth_px: by how many pixels each near surface grows, also diagonally.
    """
    grown = inverse_depth
    for _ in range(growth_px):
        # Only pixels that touch a step are in the first ring, and have the depths of both sides.
        rings, side_depths = find_step_rings(grown)
        middle = side_depths.mean(-1)
        rim = np.where((rings == 1) & (grown > middle), grown, np.float32(0))
        rim_nearby = max_pool2d(torch.from_numpy(rim)[None, None], 3, stride=1, padding=1)
        near = rim_nearby[0, 0].numpy()
        is_behind = near > (1 + np.float32(DEPTH_EDGE_RATIO)) * grown
        grown = np.where(is_behind, near, grown)
    return grown
