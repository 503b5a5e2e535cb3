"""Clips rendered from a moving camera: alignment of depth, propagated colours."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.scenes import box_before_wall, cast
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.clips.alignment import DepthAlignment, align_depth
from spackle.clips.complete import ClipCompleter, CompletedView
from spackle.clips.flow import Track, extend_flow, pixel_grid, sample
from spackle.core.camera import Camera
from spackle.depth.depth_map import DepthMap
from spackle.inpaint.plain import OpenCV
from spackle.render import CpuRenderer
from spackle.residual import hole_mask

CPU = CpuRenderer()


def test_flow_in_a_hole_follows_the_camera() -> None:
    camera = Camera.from_focal(90, 96, 64)
    inverse = torch.full((64, 96), 0.2)
    inverse[20:44, 30:50] = 0.8  # a near object with its own motion
    hole = torch.zeros(64, 96, dtype=torch.bool)
    hole[20:44, 50:66] = True
    point = camera.unproject(pixel_grid(inverse), 1 / inverse)
    step = torch.eye(4)
    step[:3, 3] = torch.tensor([0.03, -0.02, 0.1])
    uv, _ = dataclasses.replace(camera, world_to_camera=step).project(point)
    truth = uv - pixel_grid(inverse)
    seen = truth.clone()
    seen[20:44, 30:50] += 6.0
    seen[hole] = 99.0
    motion = extend_flow(Track(seen, torch.ones_like(hole)), inverse, ~hole, camera)
    assert float((motion - truth)[hole].norm(dim=-1).max()) < 0.2
    torch.testing.assert_close(motion[~hole], seen[~hole], atol=1e-3, rtol=0)


def test_scale_and_shift_of_depth_are_recovered() -> None:
    then = 0.2 + 0.5 * torch.rand(64, 96, generator=torch.Generator().manual_seed(0))
    now = (then - 0.03) / 1.3
    now[:12] = 1.5  # a new near object
    found = Track(torch.zeros(64, 96, 2), torch.ones(64, 96, dtype=torch.bool))
    torch.testing.assert_close(
        align_depth(now, then, found).of(now)[12:], then[12:], rtol=0.02, atol=0.0
    )
    assert (
        align_depth(
            now, then, dataclasses.replace(found, reliable=torch.zeros_like(found.reliable))
        )
        == DepthAlignment()
    )


def test_aligned_gaussians_look_the_same_from_the_photos_camera() -> None:
    scene = box_before_wall()
    base, alignment = scene.base(), DepthAlignment(1.2, 0.05)
    moved = alignment.of_gaussians(base)
    torch.testing.assert_close(1 / moved.means[:, 2], alignment.of(1 / base.means[:, 2]))
    places = [scene.camera.project(part.means)[0] for part in (moved, base)]
    torch.testing.assert_close(*places, rtol=1e-4, atol=1e-3)
    assert DepthAlignment().of_gaussians(base) is base
    first, value = DepthAlignment(0.9, -0.01), torch.tensor([0.3, 0.7])
    torch.testing.assert_close(alignment.after(first).of(value), alignment.of(first.of(value)))


WALL, BOX = 6.0, 2.0


def paint(points: Tensor) -> Tensor:
    x, y = points[..., 0], points[..., 1]
    parts = [torch.sin(3 * x + y), torch.sin(2.5 * y - x), torch.cos(2 * x + 2 * y)]
    return (torch.tensor([0.35, 0.45, 0.6]) + 0.15 * torch.stack(parts, -1)).clamp(0, 1)


def lifted(rgb: Tensor, depth: Tensor) -> BasePrediction:
    camera = Camera.from_focal(80, 96, 72)
    return lift_rgbd(rgb, DepthMap(depth, depth > 0, None, None, "depth", Path("frame")), camera)


def frame_of(right: float) -> tuple[Camera, Tensor, BasePrediction]:
    camera = Camera.from_focal(80, 96, 72)
    camera = camera.looking(torch.tensor([right, 0.0, 0.0]), torch.tensor([right, 0.0, 1.0]))
    wall, front = cast(camera, WALL), cast(camera, BOX)
    box = (front[..., 0].abs() < 0.35) & (front[..., 1].abs() < 0.4)
    rgb = torch.where(box[..., None], 0.3 * paint(4 * front).flip(-1) + 0.4, paint(wall))
    return camera, rgb, lifted(rgb, torch.where(box, BOX, WALL))


def completer_of(disparity: float | None, frame_count: int, **options: Any) -> ClipCompleter:
    return ClipCompleter(
        trajectory="rotate",
        disparity=disparity,
        frame_count=frame_count,
        renderer=CPU,
        flow=OpenCV("this").flow,
        **options,
    )


def test_propagated_colours_flicker_less_with_no_larger_error() -> None:
    completer = completer_of(0.3, 80, align=False)
    past: tuple[CompletedView, Camera] | None = None
    flickers, errors = (
        torch.zeros(2),
        torch.zeros(2),
    )  # of frames completed alone, and with colours of earlier frames
    for index in range(8):
        taken_by, rgb, prediction = frame_of(-0.10 + 0.025 * index)
        drawn = completer.add(rgb, prediction)
        pose = drawn.camera.world_to_camera @ taken_by.world_to_camera
        camera = dataclasses.replace(drawn.camera, world_to_camera=pose)
        points, hole = cast(camera, WALL), drawn.hole
        assert not drawn.starts_shot
        if past is not None:
            before, uv = past[0], past[1].project(points)[0]
            both = hole & (sample(before.hole[..., None].float(), uv)[..., 0] > 0.999)
            for k, (one, other) in enumerate(
                (
                    (drawn.independent_rendering, before.independent_rendering),
                    (drawn.rendering, before.rendering),
                )
            ):
                flickers[k] += (one.rgb - sample(other.rgb, uv)).abs().mean(-1)[both].mean()
        errors += torch.stack(
            [
                (v.rgb - paint(points))[hole].square().mean()
                for v in (drawn.independent_rendering, drawn.rendering)
            ]
        )
        past = (drawn, camera)
    assert float(flickers[1]) < 0.6 * float(flickers[0])
    assert float(errors[1]) < 1.02 * float(errors[0])  # 0.1 dB


@pytest.mark.parametrize("fill", [True, False])
def test_a_cut_resets_the_state_and_holes_can_be_kept(fill: bool) -> None:
    completer = completer_of(None, 20, fill=fill)
    _, rgb, prediction = frame_of(0.0)
    noise = torch.rand(72, 96, 3, generator=torch.Generator().manual_seed(0))
    drawn = [
        completer.add(rgb, prediction),
        completer.add(noise, lifted(noise, torch.full((72, 96), 3.0))),
    ]
    assert [one.starts_shot for one in drawn] == [False, True]
    assert torch.equal(drawn[1].rendering.rgb, drawn[1].independent_rendering.rgb)
    assert drawn[0].base is prediction.gaussians
    given = completer_of(prediction.max_disparity, 20, fill=False)
    assert torch.equal(
        given.add(rgb, prediction).camera.world_to_camera, drawn[0].camera.world_to_camera
    )
    assert bool(len(drawn[0].aux)) == fill
    assert fill or bool(hole_mask(drawn[0].rendering.alpha).any())
