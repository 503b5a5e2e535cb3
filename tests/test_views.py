"""The views that are reported and shown are views that are filled."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from helpers.scenes import box_before_wall

from spackle.core.camera import Camera
from spackle.core.trajectories import DEFAULT_OVERSCAN, TRAJECTORIES, TrajectoryKind
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio
from spackle.scene import Scene
from spackle.scene_fill import FillContext, fill_scene
from spackle.video.frames import VideoOptions
from spackle.views import PathOptions, plan_views

RENDERER = CpuRenderer()
# A frame between two filled frames may keep holes that nobody sees.
MAX_HOLE_RATIO = 0.005


@pytest.mark.parametrize("overscan", [0.0, DEFAULT_OVERSCAN])
@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_every_trajectory_is_filled_where_it_is_reported_and_shown(
    trajectory: TrajectoryKind, overscan: float
) -> None:
    prediction = dataclasses.replace(box_before_wall().lift(), max_disparity=0.3)
    base, camera = prediction.gaussians, prediction.camera
    path = PathOptions(trajectory=trajectory, overscan=overscan, video=VideoOptions(fps=15))
    views = plan_views(prediction, path, Path("photo.png"))
    assert len(views.frames) == 60
    assert set(views.reported_views.values()) <= views.always_filled <= set(views.views_to_fill)

    aux = fill_scene(
        FillContext(base, camera, RENDERER, None, None),
        [views.cameras[index] for index in views.views_to_fill],
        always_filled=[
            position
            for position, index in enumerate(views.views_to_fill)
            if index in views.always_filled
        ],
    ).aux
    scene = Scene(base, aux, camera)

    def holes(view: Camera) -> float:
        return hole_area_ratio(scene.render(view, RENDERER).alpha)

    for index in views.always_filled:
        assert holes(views.cameras[index]) <= MAX_HOLE_RATIO
    for (index,) in views.frames[::3]:
        assert holes(views.cameras[index]) <= MAX_HOLE_RATIO

    # The video of the saved scene, drawn anew, consists of the planned frames.
    drawn = path.video_cameras(base, camera, None, prediction.max_disparity)
    for (index,), view in zip(views.frames, drawn, strict=True):
        assert torch.equal(views.cameras[index].world_to_camera, view.world_to_camera)
        assert torch.equal(views.cameras[index].K, view.K)
