"""How a path's views are framed, so that little of them lies beyond the photo's border.

What lies beyond the border is made up, and a viewer sees that first. A camera that moves aside sees
less of it if it looks at the depth of what stands at the border, and if it zooms in a little.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import working_size
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    DepthRange,
    Framing,
    TrajectoryKind,
    trajectory_cameras,
)
from spackle.render.protocol import Renderer
from spackle.residual.features import hole_mask

# The share of the widest views, on average, that may lie beyond the photo's border: at most a pixel
# or two along one side.
MAX_BEYOND_RATIO = 0.001
# Zooms that are tried; more would cut off too much of the photo.
OVERSCANS = (0.03, 0.04, 0.05, 0.06, 0.07, 0.08)
# The camera's target moves across the view by a share of its width. This share costs half as much
# as a share that the zoom cuts off: what moves aside stays in the picture.
TARGET_SHIFT_COST = 0.5
# Trajectories whose widest views are the leftmost and the rightmost one.
SIDEWAYS: tuple[TrajectoryKind, ...] = ("swipe", "rotate-forward", "orbit")
FOCUS_TRIALS = 9  # depths of the target that are tried
FAR_QUANTILE = 0.9  # of depth: the farthest target
# Long side of the renderings in which the border is found, and holes are measured (views.py).
COARSE_SIDE_PX = 240
# A coarse pixel that the photo's border cuts in two is half covered.
MIN_COVERED_ALPHA = 0.5
MARGIN_RATIO = 0.15  # by which these are wider and higher than the views, on each side


@torch.no_grad()
def choose_framing(
    base: Gaussians,
    camera: Camera,
    depth_range: DepthRange,
    trajectory: TrajectoryKind,
    disparity: float,
    renderer: Renderer,
) -> Framing:
    """The mildest framing in which hardly anything beyond the photo's border is visible.

    Mild is a target near the usual one, and a small zoom. If none suffices, the one that shows
    least is taken.

    Args:
        base: the Gaussians of the photo.
        camera: the photo's camera at the world's origin.
        depth_range: the scene's depths, with the usual target.
        trajectory: the path, one of SIDEWAYS.
        disparity: how far the path goes to the side.
        renderer: renders the two widest views.
    """
    coarse = camera.resized(*working_size(camera.width, camera.height, COARSE_SIDE_PX))
    # A loop of four frames has the leftmost and the rightmost one.
    loop = trajectory_cameras(trajectory, coarse, disparity, depth_range, frames=4, looped=True)
    loop.sort(key=lambda view: float(view.position[0]))
    widest = (loop[0], loop[-1])
    margin = math.ceil(MARGIN_RATIO * max(coarse.width, coarse.height))
    wide_size = (coarse.width + 2 * margin, coarse.height + 2 * margin)
    beyond_border = []
    for view in widest:
        alpha = renderer.render(base, view.cropped(-margin, -margin, *wide_size)).alpha
        is_hole = hole_mask(alpha, MIN_COVERED_ALPHA).numpy(force=True)
        beyond_border.append(open_to_border(is_hole))

    principal_x, principal_y = coarse.K[:2, 2].tolist()

    def beyond_ratio(shift: float, overscan: float) -> float:
        """Share of the two views that lies beyond the border.

        The masks `beyond_border` are those of coarse views with a margin, in which a frame is cut
        out.

        Args:
            shift: coarse pixels by which the left view's frame moves to the left, and the right
                one's to the right.
            overscan: zoom, as a relative gain in focal length.
        """
        cut_off = 1 - 1 / (1 + overscan)  # share of the width and of the height
        ratios = []
        for mask, direction in zip(beyond_border, (-1, 1), strict=True):
            # A zoom leaves the principal point in its place.
            left = margin + principal_x * cut_off + direction * shift
            top = margin + principal_y * cut_off
            columns = slice(round(left), round(left + (1 - cut_off) * coarse.width))
            rows = slice(round(top), round(top + (1 - cut_off) * coarse.height))
            ratios.append(float(mask[rows, columns].mean()))
        return sum(ratios) / len(ratios)

    # Cameras that look at a farther target turn less, which shifts what they show.
    right, _, forward = widest[1].position.tolist()
    best: tuple[bool, float, Framing] | None = None
    for focus, overscan in itertools.product(_targets(base, depth_range), OVERSCANS):
        turn_less = right / (depth_range.focus - forward) - right / (focus - forward)
        shift = coarse.focal[0] * turn_less
        if shift > margin - 1:
            continue
        ratio = beyond_ratio(shift, overscan)
        suffices = ratio <= MAX_BEYOND_RATIO
        cost = overscan + TARGET_SHIFT_COST * shift / coarse.width if suffices else ratio
        # Framings that suffice come before all others.
        trial = (not suffices, cost, Framing(focus, overscan))
        if best is None or trial[:2] < best[:2]:
            best = trial
    if best is None:
        return Framing(depth_range.focus, DEFAULT_OVERSCAN)
    return best[2]


def _targets(base: Gaussians, depth_range: DepthRange) -> list[float]:
    """Depths of possible targets, from the usual one to the farthest, evenly in inverse depth."""
    z = base.means[:, 2].detach().double().cpu().numpy()
    farthest = float(np.quantile(z[z > 0], FAR_QUANTILE))
    usual = depth_range.focus
    if farthest <= usual:
        return [usual]
    inverse_depths = np.linspace(1 / usual, 1 / farthest, FOCUS_TRIALS)
    return [usual, *(1 / inverse_depths[1:]).tolist()]


def open_to_border(hole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[H, W] bool: the hole pixels from which a straight row or column of holes leads outside.

    `hole` [H, W] bool: a view's pixels that show no surface.
    """
    from_left = np.logical_and.accumulate(hole, axis=1)
    from_right = np.logical_and.accumulate(hole[:, ::-1], axis=1)[:, ::-1]
    from_top = np.logical_and.accumulate(hole, axis=0)
    from_bottom = np.logical_and.accumulate(hole[::-1], axis=0)[::-1]
    is_open: NDArray[np.bool_] = from_left | from_right | from_top | from_bottom
    return is_open
