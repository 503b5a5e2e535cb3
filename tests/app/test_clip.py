"""Clips seen from a moving camera: calm where nothing was seen."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import pytest
import torch
from scenes import box_before_wall
from torch import Tensor

from spackle.app.clip import ClipChoices, ClipCompleter, Drawn
from spackle.bases.depth_map import DepthMap
from spackle.bases.lift import lift
from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.inpaint.opencv import OpenCV
from spackle.render import CpuRenderer
from spackle.residual import Completer, hole_mask
from spackle.residual.temporal import (
    DepthAlignment,
    FrameMemory,
    Track,
    align_depth,
    extend_flow,
    flicker,
    pixel_grid,
    propagate_colors,
    sample,
    track,
)

pytest.importorskip("cv2")
CPU = CpuRenderer()


# Motion ------------------------------------------------------------------------------------------


def waves(height: int = 64, width: int = 96, right: float = 0.0) -> Tensor:
    """A texture that can be followed, moved to the right."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5 - right, indexing="ij")
    parts = [torch.sin(0.31 * x + 0.17 * y), torch.sin(0.23 * y - 0.41 * x), torch.cos(0.37 * y + 0.13 * x)]
    return 0.5 + 0.2 * torch.stack(parts, dim=-1)


def test_what_moved_is_found_where_it_was() -> None:
    found = track(waves(right=3.0), waves(), OpenCV("this").flow)
    inner = (slice(12, -12), slice(12, -12))
    assert float((found.flow[inner] - torch.tensor([-3.0, 0.0])).norm(dim=-1).median()) < 0.2
    assert float(found.sure[inner].float().mean()) > 0.95
    assert found.same_shot()
    assert not track(
        torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(0)), waves(), OpenCV("t").flow
    ).same_shot()


def test_a_hole_moves_as_the_camera_does_and_not_as_what_hides_it() -> None:
    camera = Camera.from_focal(90, 96, 64)
    inverse = torch.full((64, 96), 0.2)
    inverse[20:44, 30:50] = 0.8  # something near that goes its own way
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


# Depth -------------------------------------------------------------------------------------------


def test_depth_of_another_scale_and_shift_is_brought_back() -> None:
    dice = torch.Generator().manual_seed(0)
    then = 0.2 + 0.5 * torch.rand(64, 96, generator=dice)
    now = (then - 0.03) / 1.3
    now[:12] = 1.5  # what has come between
    found = Track(torch.zeros(64, 96, 2), torch.ones(64, 96, dtype=torch.bool))
    back = align_depth(now, then, found)
    torch.testing.assert_close(back.of(now)[12:], then[12:], rtol=0.02, atol=0.0)
    assert align_depth(now, then, dataclasses.replace(found, sure=torch.zeros_like(found.sure))) == DepthAlignment()


def test_stretched_gaussians_look_the_same_from_the_photos_eye() -> None:
    scene = box_before_wall()
    base, stretch = scene.base(), DepthAlignment(1.2, 0.05)
    moved = stretch.of_gaussians(base)
    torch.testing.assert_close(1 / moved.means[:, 2], stretch.of(1 / base.means[:, 2]))
    torch.testing.assert_close(
        scene.camera.project(moved.means)[0], scene.camera.project(base.means)[0], rtol=1e-4, atol=1e-3
    )
    assert DepthAlignment().of_gaussians(base) is base
    first, value = DepthAlignment(0.9, -0.01), torch.tensor([0.3, 0.7])
    torch.testing.assert_close(stretch.after(first).of(value), stretch.of(first.of(value)))


# Colours -----------------------------------------------------------------------------------------


def test_the_hole_of_a_clip_that_stands_still_keeps_its_colours() -> None:
    scene = box_before_wall()
    base, dice = scene.base(), torch.Generator().manual_seed(0)
    camera = scene.camera.looking(torch.tensor([0.4, 0.0, 0.0]), torch.tensor([0.0, 0.0, 4.0]))
    aux, own = Completer(base, scene.camera, CPU).completed_view(camera)
    before = CPU.render(base, camera)
    hole = hole_mask(before.alpha)
    still, restless = ([], [])
    for noise, views in ((0.0, still), (0.1, restless)):
        past: FrameMemory | None = None
        for _ in range(5):
            hue = 1 + noise * torch.randn(3, generator=dice)
            mine = dataclasses.replace(aux, colors=(aux.colors * hue).clamp(0, 1))
            drawn = CPU.render([base, mine], camera)
            frame = propagate_colors(base, mine, camera, CPU, (before, drawn), past, OpenCV("this").flow)
            past = frame.memory
            views.append((drawn.rgb, frame.view.rgb))
            torch.testing.assert_close(frame.view.rgb[~hole], own.rgb[~hole], atol=0.02, rtol=0)
            assert torch.equal(frame.aux.means, aux.means)
    assert max(float((one[1] - still[0][1]).abs().max()) for one in still) < 1e-3
    alone, carried = (
        sum(float((b[k] - a[k])[hole].abs().mean()) for a, b in itertools.pairwise(restless)) for k in (0, 1)
    )
    assert carried < alone / 3


@dataclasses.dataclass(frozen=True)
class Take:
    """A frame of a box before a wall, taken by a camera on its way."""

    camera: Camera
    prediction: BasePrediction
    rgb: Tensor


WALL, BOX = 6.0, 2.0


def paint(points: Tensor) -> Tensor:
    """The wall's colour at [..., 3]."""
    x, y = points[..., 0], points[..., 1]
    parts = [torch.sin(3 * x + y), torch.sin(2.5 * y - x), torch.cos(2 * x + 2 * y)]
    return torch.tensor([0.35, 0.45, 0.6]) + 0.15 * torch.stack(parts, -1)


def meets(camera: Camera, z: float) -> Tensor:
    """[H, W, 3] where pixels meet a plane that faces the world's z axis."""
    grid = pixel_grid(torch.zeros(camera.height, camera.width))
    ray = camera.unproject(grid, torch.ones(grid.shape[:2])) - camera.position
    return camera.position + ray * ((z - camera.position[2]) / ray[..., 2])[..., None]


def take(right: float) -> Take:
    camera = Camera.from_focal(80, 96, 72)
    camera = camera.looking(torch.tensor([right, 0.0, 0.0]), torch.tensor([right, 0.0, 1.0]))
    wall, front = meets(camera, WALL), meets(camera, BOX)
    box = (front[..., 0].abs() < 0.35) & (front[..., 1].abs() < 0.4)
    rgb = torch.where(box[..., None], 0.3 * paint(4 * front).flip(-1) + 0.4, paint(wall)).clamp(0, 1)
    depth = torch.where(box, BOX, WALL)
    own = dataclasses.replace(camera, world_to_camera=torch.eye(4))
    return Take(camera, lift(rgb, DepthMap(depth, depth > 0, None, None, "depth", Path("take")), own), rgb)


def test_carried_holes_are_calmer_and_no_worse_by_the_true_motion() -> None:
    completer = ClipCompleter(ClipChoices("rotate", 0.3, 80, steady=False), CPU, OpenCV("this").flow)
    past: tuple[Drawn, Camera] | None = None
    flickers: dict[str, list[float]] = {"alone": [], "carried": []}
    errors: dict[str, list[float]] = {"alone": [], "carried": []}
    for index in range(8):
        shot = take(-0.10 + 0.025 * index)
        drawn = completer.add(shot.rgb, shot.prediction)
        camera = dataclasses.replace(
            drawn.camera, world_to_camera=drawn.camera.world_to_camera @ shot.camera.world_to_camera
        )
        points, hole = meets(camera, WALL), drawn.hole
        assert not drawn.cut
        if past is not None:
            grid = pixel_grid(hole)
            flow = past[1].project(points)[0] - grid
            both = hole & (sample(past[0].hole[..., None].float(), grid + flow)[..., 0] > 0.999)
            for name, one, other in (("alone", drawn.alone, past[0].alone), ("carried", drawn.view, past[0].view)):
                value = flicker(one.rgb, other.rgb, flow, both)
                assert value is not None
                flickers[name].append(value)
        for name, view in (("alone", drawn.alone), ("carried", drawn.view)):
            errors[name].append(float((view.rgb - paint(points).clamp(0, 1))[hole].square().mean()))
        past = (drawn, camera)
    assert sum(flickers["carried"]) < 0.6 * sum(flickers["alone"])
    assert sum(errors["carried"]) < 1.02 * sum(errors["alone"])  # 0.1 dB


def test_another_shot_starts_anew() -> None:
    completer = ClipCompleter(ClipChoices("rotate", 0.3, 20), CPU, OpenCV("this").flow)
    shot = take(0.0)
    noise = torch.rand(72, 96, 3, generator=torch.Generator().manual_seed(0))
    depth = torch.full((72, 96), 3.0)
    other = lift(noise, DepthMap(depth, depth > 0, None, None, "depth", Path("b")), shot.prediction.camera)
    drawn = [completer.add(shot.rgb, shot.prediction), completer.add(noise, other)]
    assert [one.cut for one in drawn] == [False, True]
    assert torch.equal(drawn[1].view.rgb, drawn[1].alone.rgb)


def test_nothing_is_filled_where_that_is_wished() -> None:
    completer = ClipCompleter(ClipChoices("rotate", 0.3, 20, fill=False), CPU, OpenCV("this").flow)
    shot = take(0.0)
    drawn = completer.add(shot.rgb, shot.prediction)
    assert len(drawn.gaussians[1]) == 0
    assert drawn.gaussians[0] is shot.prediction.gaussians
    assert isinstance(drawn.gaussians[0], Gaussians)
    assert bool(hole_mask(drawn.view.alpha).any())
