"""The views that are reported and shown are views that are filled."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import pytest
import torch
from helpers.scenes import box_before_wall

from spackle.core.camera import Camera
from spackle.core.keyframes import Keyframe, KeyframePath
from spackle.core.trajectories import TRAJECTORIES, DepthRange, TrajectoryKind
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio
from spackle.scene import Scene
from spackle.scene_fill import FillContext, fill_scene
from spackle.video.frames import VideoOptions
from spackle.views import PathOptions, PlannedViews, plan_views

RENDERER = CpuRenderer()
MAX_HOLE_RATIO = 0.001  # of a view after the fill; nobody sees less
DISPARITY = 0.3


def filled_scene(path: PathOptions, keyframes: KeyframePath | None = None) -> FilledPath:
    """A box in front of a wall, filled for a path as a photo's scene is."""
    # In smaller pictures, a slit of one pixel would already be more than the largest ratio.
    box = box_before_wall(width=192, height=144, focal=160)
    prediction = dataclasses.replace(box.lift(), max_disparity=DISPARITY)
    views = plan_views(prediction, path, Path("photo.png"), RENDERER, keyframes=keyframes)
    aux = fill_scene(
        FillContext(prediction.gaussians, prediction.camera, RENDERER, None, None),
        [views.cameras[index] for index in views.views_to_fill],
    ).aux
    return FilledPath(views, Scene(prediction.gaussians, aux, prediction.camera))


@dataclasses.dataclass(frozen=True)
class FilledPath:
    """A scene, and the views for which it was filled."""

    views: PlannedViews
    scene: Scene

    def largest_hole_ratio(self, cameras: Iterable[Camera]) -> float:
        """The largest share of hole pixels in some views."""
        return max(hole_area_ratio(self.scene.render(view, RENDERER).alpha) for view in cameras)


@pytest.mark.parametrize("overscan", [0.0, None])
@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_every_trajectory_is_filled_where_it_is_reported_and_shown(
    trajectory: TrajectoryKind, overscan: float | None
) -> None:
    path = PathOptions(trajectory=trajectory, overscan=overscan, video=VideoOptions(fps=15))
    filled = filled_scene(path)
    views = filled.views
    assert len(views.frames) == 60
    assert set(views.reported_views.values()) <= set(views.views_to_fill)
    shown = [views.cameras[index] for index in range(views.shown_view_count)]
    assert filled.largest_hole_ratio(shown) <= MAX_HOLE_RATIO

    # Other viewers show the path through the photo's own lens.
    scene = filled.scene
    depth_range = DepthRange.of(scene.base)
    wide = path.video_cameras(depth_range, scene.camera, None, DISPARITY, framing=None)
    assert filled.largest_hole_ratio(wide) <= MAX_HOLE_RATIO

    # The video of the saved scene, drawn anew, consists of the planned frames.
    framing = path.choose_framing(scene.base, scene.camera, depth_range, DISPARITY, RENDERER)
    drawn = path.video_cameras(depth_range, scene.camera, None, DISPARITY, framing)
    for (index,), view in zip(views.frames, drawn, strict=True):
        assert torch.equal(views.cameras[index].world_to_camera, view.world_to_camera)
        assert torch.equal(views.cameras[index].K, view.K)


# Each path has (seconds, eye, point in the middle of the view, horizontal field of view).
KEYFRAME_PATHS = {
    "the camera turns in place": [
        Keyframe(0, (0, 0, 0), (0, 0, 4)),
        Keyframe(2, (0, 0, 0), (1.2, 0, 4)),
        Keyframe(4, (0, 0, 0), (-1.2, 0.4, 4)),
    ],
    "it stays in place and zooms out": [
        Keyframe(0, (0, 0, 0), (0, 0, 4)),
        Keyframe(2, (0, 0, 0), (0, 0, 4), fov=70),
        Keyframe(4, (0, 0, 0), (0, 0, 4), fov=40),
    ],
    "it moves aside, turns there and comes back": [
        Keyframe(0, (0, 0, 0), (0, 0, 4)),
        Keyframe(1, (0.3, 0, 0), (0, 0, 4)),
        Keyframe(2, (0.3, 0, 0), (1.2, 0, 4)),
        Keyframe(3, (0.3, 0, 0), (-1.2, 0, 4)),
        Keyframe(4, (0, 0, 0), (0, 0, 4)),
    ],
    "it moves back, and zooms in": [
        Keyframe(0, (0, 0, 0), (0, 0, 4)),
        Keyframe(3, (0, 0, -0.8), (0, 0, 4), fov=40),
    ],
}


@pytest.mark.parametrize("keys", KEYFRAME_PATHS.values(), ids=KEYFRAME_PATHS.keys())
def test_keyframes_are_filled_where_they_are_shown(keys: list[Keyframe]) -> None:
    path = PathOptions(video=VideoOptions(fps=15))
    filled = filled_scene(path, KeyframePath(tuple(keys)))
    shown = [filled.views.cameras[index] for index in range(filled.views.shown_view_count)]
    assert len(shown) > len(keys)
    assert filled.largest_hole_ratio(shown) <= MAX_HOLE_RATIO
