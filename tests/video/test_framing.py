"""Framing: the camera's target and zoom show little of what lies beyond the photo's border."""

from __future__ import annotations

import numpy as np
import torch
from helpers.scenes import box_before_wall

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    DepthRange,
    Framing,
    leftmost_and_rightmost,
)
from spackle.render import CpuRenderer
from spackle.residual.features import hole_mask
from spackle.video.framing import (
    MAX_BEYOND_RATIO,
    MIN_COVERED_ALPHA,
    OVERSCANS,
    choose_framing,
    open_to_border,
)
from spackle.views import PathOptions

RENDERER = CpuRenderer()
ROUNDING = 0.003  # of a picture: half a pixel along a side of the coarse rendering


def beyond_ratio(
    base: Gaussians, camera: Camera, depth_range: DepthRange, disparity: float, framing: Framing
) -> float:
    """Share of the two widest views that lies beyond the photo's border, rendered as they are."""
    views = leftmost_and_rightmost(camera, disparity, framing.of(depth_range))
    masks = [
        open_to_border(
            hole_mask(
                RENDERER.render(base, view.zoomed(1 + framing.overscan)).alpha, MIN_COVERED_ALPHA
            ).numpy()
        )
        for view in views
    ]
    return float(np.mean(masks))


def test_hardly_anything_beyond_the_border_is_shown() -> None:
    box = box_before_wall(width=192, height=144, focal=160)
    base = box.base()
    depth_range = DepthRange.of(base)
    framing = choose_framing(base, box.camera, depth_range, "swipe", 0.05, RENDERER)
    usual = Framing(depth_range.focus, DEFAULT_OVERSCAN)
    usual_ratio = beyond_ratio(base, box.camera, depth_range, 0.05, usual)
    chosen_ratio = beyond_ratio(base, box.camera, depth_range, 0.05, framing)
    # As the target is the box, the wall behind it moves out of the picture.
    assert usual_ratio > 2 * ROUNDING
    assert chosen_ratio <= MAX_BEYOND_RATIO + ROUNDING


def test_a_small_movement_is_framed_as_mildly_as_possible() -> None:
    box = box_before_wall(width=192, height=144, focal=160)
    base = box.base()
    depth_range = DepthRange.of(base)
    framing = choose_framing(base, box.camera, depth_range, "rotate-forward", 0.002, RENDERER)
    assert framing == Framing(depth_range.focus, OVERSCANS[0])


def test_an_overscan_that_is_given_keeps_the_usual_target() -> None:
    box = box_before_wall(width=64, height=48, focal=60)
    depth_range = DepthRange(near=1.0, focus=1.5)
    framing = PathOptions(overscan=0.2).choose_framing(
        box.base(), box.camera, depth_range, 0.3, RENDERER
    )
    assert framing == Framing(1.5, 0.2)


def test_only_holes_that_reach_the_border_lie_beyond_it() -> None:
    hole = torch.zeros(6, 8, dtype=torch.bool)
    hole[:, 6:] = True  # a strip along the right border
    hole[2:4, 2:4] = True  # behind a thing in the middle
    expected = torch.zeros_like(hole)
    expected[:, 6:] = True
    assert np.array_equal(open_to_border(hole.numpy()), expected.numpy())
