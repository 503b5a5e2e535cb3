"""The rgbd base: no holes at the photo's camera, and open disocclusions from the side."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from helpers.scenes import (
    Scene,
    box_before_wall,
    box_mask,
    cast,
    motorcycle,
    motorcycle_base,
    psnr,
    slanted_plane,
    wall,
)
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.bases.depth import RgbdBase, lift_rgbd
from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo
from spackle.core.photo_frame import PhotoFrame
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost, trajectory_cameras
from spackle.depth.depth_map import DepthMap
from spackle.lifting.quadtree import TILE_LEVELS
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio, hole_mask

CPU = CpuRenderer()


def eroded(mask: Tensor, pixels: int) -> Tensor:
    """A mask without its outermost pixels; the image's border counts as outside."""
    outside = torch.nn.functional.pad((~mask).float()[None, None], [pixels] * 4, value=1.0)
    return max_pool2d(outside, 2 * pixels + 1, stride=1)[0, 0] == 0


def in_frame(camera: Camera, points: Tensor, margin: float = 0.0) -> Tensor:
    """A mask of the world points in a camera's frame, at least `margin` pixels from the border."""
    uv, z = camera.project(points)
    size = torch.tensor([camera.width, camera.height]).to(uv)
    return ((uv > margin) & (uv < size - margin)).all(-1) & (z > 0)


def shows_plane(scene: Scene, camera: Camera) -> Tensor:
    """[H, W] mask of a view's pixels that show the plane of `slanted_plane` inside the photo."""
    inverse = 1 / scene.depth.double()
    slope = torch.stack([inverse[0, -1] - inverse[0, 0], inverse[-1, 0] - inverse[0, 0]])
    slope = slope / torch.tensor([scene.camera.width - 1, scene.camera.height - 1])
    at_middle = inverse[0, 0] + slope @ (scene.camera.K[:2, 2].double() - 0.5)
    normal = torch.cat(
        [scene.camera.focal[0] * slope, at_middle[None]]
    )  # normal · point = 1: 1/z is linear in pixels
    centers, eye = camera.pixel_centers().double(), camera.position.double()
    ray = camera.unproject(centers, torch.ones(centers.shape[:-1], dtype=torch.float64)) - eye
    points = eye + ray * ((1 - normal @ eye) / (ray @ normal))[..., None]
    return in_frame(scene.camera, points, margin=8) & (points[..., 2] > 0)


def test_pixels_come_first_then_mixed_ones_then_the_backing() -> None:
    scene = box_before_wall(width=94, height=70)  # the box's border runs through the cells
    base, pixels = scene.lift(levels=0).gaussians, scene.depth.numel()
    front, others = base.select(slice(0, pixels)), base.select(slice(pixels, None))
    uv, z = scene.camera.project(front.means)
    torch.testing.assert_close(uv, scene.camera.pixel_centers().reshape(-1, 2), rtol=0, atol=1e-3)
    torch.testing.assert_close(z, scene.depth.reshape(-1))
    torch.testing.assert_close(
        front.colors, srgb_to_linear(scene.rgb).reshape(-1, 3), rtol=0, atol=0.125
    )
    uv, z = scene.camera.project(others.means)
    backing = z > 1.001 * torch.where(z < 4, 2.0, 6.0)
    x, y = uv[backing].round().long().unbind(-1)
    farthest = max_pool2d(scene.depth[None, None], 2, stride=1)[0, 0][
        y - 1, x - 1
    ]  # of the four pixels around
    assert bool((z[backing] / farthest < 1.01).all())
    assert bool((z[backing] > farthest).all())
    assert torch.equal(others.colors[:, 2] > others.colors[:, 0], z > 4)  # the wall is bluish


@pytest.mark.parametrize("size", [(63, 47), (5, 3), (3, 2), (2, 2), (64, 1), (1, 64), (1, 1)])
def test_odd_and_tiny_photos_are_lifted(size: tuple[int, int]) -> None:
    scene = wall(4.0, *size)
    assert len(scene.lift(levels=0).gaussians) == size[0] * size[1] + (size[0] // 2) * (
        size[1] // 2
    )
    view = CPU.render(scene.lift(TILE_LEVELS).gaussians, scene.camera)
    assert hole_area_ratio(view.alpha) == 0
    if min(size) > 1:  # else there is no backing
        torch.testing.assert_close(view.depth, scene.depth, rtol=0.01, atol=0)


def test_missing_depth_is_filled_from_behind_and_reported() -> None:
    scene = box_before_wall()
    strip = torch.zeros_like(scene.depth, dtype=torch.bool)
    strip[24:48, 28:32] = True  # the wall's last columns before the box
    found = dataclasses.replace(scene, depth=torch.where(strip, 0.0, scene.depth)).lift(levels=0)
    assert found.notes["depth_filled"] == pytest.approx(24 * 4 / (72 * 96), abs=1e-4)
    z = found.gaussians.means[: 72 * 96, 2].reshape(72, 96)
    elsewhere = eroded(~strip, 1)  # pixels beside the strip may become mixed pixels
    assert torch.equal(
        z[elsewhere], scene.lift(levels=0).gaussians.means[: 72 * 96, 2].reshape(72, 96)[elsewhere]
    )
    assert float(z[strip].min()) > 5.99  # the wall's depth is 6, the box's 2
    assert wall().lift().notes["depth_filled"] == 0


def test_the_intrinsics_come_from_the_calibration_else_from_the_photo() -> None:
    scene = wall()
    photo = Photo(scene.rgb, scene.camera.focal[0], FocalSource.FOCAL_PX, Path("photo.png"))
    assert torch.equal(RgbdBase(scene.depth_map).predict(photo).camera.K, photo.camera.K)
    K = torch.tensor([[70.0, 0.0, 15.0], [0.0, 70.0, 12.5], [0.0, 0.0, 1.0]])
    half = DepthMap(
        scene.depth[::2, ::2], scene.depth[::2, ::2] > 0, K, None, "disparity", Path("disp.pfm")
    )
    found = RgbdBase(half).predict(photo)
    assert found.camera.K.tolist() == [[140, 0, 30], [0, 140, 25], [0, 0, 1]]
    assert (found.camera.width, found.camera.height) == (64, 48)
    uv, _ = found.camera.project(found.gaussians.means)
    assert (
        float((2 * uv - (2 * uv).round()).abs().max()) < 2e-3
    )  # centres of pixels, or their borders
    torch.testing.assert_close(
        torch.stack([uv.amin(0), uv.amax(0)]), torch.tensor([[0.5, 0.5], [63.5, 47.5]])
    )
    # Cropping a frame moves nothing.
    framed = dataclasses.replace(photo, rgb=photo.rgb[6:-4, 2:-10], frame=PhotoFrame(2, 6, 10, 4))
    inside = RgbdBase(half).predict(framed)
    assert inside.camera.K.tolist() == [[140, 0, 28], [0, 140, 19], [0, 0, 1]]
    uv, _ = found.camera.project(inside.gaussians.means)
    torch.testing.assert_close(
        torch.stack([uv.amin(0), uv.amax(0)]), torch.tensor([[2.5, 6.5], [53.5, 43.5]])
    )
    views = [CPU.render(base.gaussians, found.camera).rgb[6:-4, 2:-10] for base in (found, inside)]
    assert psnr(*views) > 40


@pytest.mark.parametrize("disparity", [0.1, 0.2, 0.5])
@pytest.mark.parametrize("side", [0, 1])
def test_the_holes_are_the_regions_that_a_box_uncovers(disparity: float, side: int) -> None:
    near, far = 2.0, 6.0
    scene = box_before_wall(near, far)
    base = scene.lift(TILE_LEVELS).gaussians
    camera = leftmost_and_rightmost(
        scene.camera, disparity, DepthRange.of(scene.lift(levels=0).gaussians, is_metric=True)
    )[side]
    box = box_mask(96, 72)

    def looked_up(points: Tensor) -> Tensor:
        uv, _ = scene.camera.project(points)
        x, y = uv.long().unbind(-1)
        return in_frame(scene.camera, points) & box[y.clamp(0, 71), x.clamp(0, 95)]

    at_wall = cast(camera, far)
    hits_box, hidden = looked_up(cast(camera, near)), looked_up(at_wall)
    uncovered, seen = ~hits_box & hidden, hits_box | (in_frame(scene.camera, at_wall) & ~hidden)
    alpha = CPU.render(base, camera).alpha
    assert int(eroded(uncovered, 1).sum()) > 20
    assert (
        float(alpha[eroded(uncovered, 1)].quantile(0.98)) < 0.5
    )  # the photo's outline is found to half a pixel
    assert float(alpha[eroded(uncovered, 2)].max()) < 0.5
    assert bool(hole_mask(alpha)[uncovered].float().mean() > 0.95)
    assert not hole_mask(alpha)[eroded(seen, 2)].any()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("kind", ["swipe", "shake"])
def test_slanted_ground_has_no_pinholes(axis: int, kind: str) -> None:
    scene = slanted_plane(1.5, 6, axis)
    base = scene.lift(TILE_LEVELS).gaussians
    for camera in trajectory_cameras(
        kind, scene.camera, 0.5, DepthRange.of(base, is_metric=True), frames=9
    ):  # type: ignore[arg-type]
        interior = shows_plane(scene, camera)
        assert int(interior.sum()) > 1000
        assert int(hole_mask(CPU.render(base, camera).alpha)[interior].sum()) == 0


def test_rounded_disparities_leave_no_stairs() -> None:
    scene = slanted_plane(2, 4, 1)
    quantum = 0.005
    stored = (1 / scene.depth / quantum).round() * quantum
    depth = DepthMap(1 / stored, stored > 0, None, quantum, "disparity", Path("disp.png"))
    pixels, base = (
        lift_rgbd(scene.rgb, depth, scene.camera, levels).gaussians for levels in (0, TILE_LEVELS)
    )
    z = pixels.means[: scene.depth.numel(), 2].reshape(scene.depth.shape)
    error, before = (
        (1 / z - 1 / scene.depth).square().mean(),
        (stored - 1 / scene.depth).square().mean(),
    )
    assert float(error) < 0.25 * float(before)
    for camera in leftmost_and_rightmost(scene.camera, 0.3, DepthRange.of(base, is_metric=True)):
        holes = hole_mask(CPU.render(base, camera).alpha)[shows_plane(scene, camera)]
        assert float(holes.float().mean()) < 0.002


def test_the_motorcycle_is_reproduced_and_its_disocclusions_are_holes() -> None:
    pair, found = motorcycle(), motorcycle_base()
    scene, view = pair.left, CPU.render(found.gaussians, found.camera)
    assert found.notes["depth_filled"] == pytest.approx(0.0735, abs=1e-3)
    assert hole_area_ratio(view.alpha) < 1e-4
    assert psnr(view.rgb, scene.rgb) > 30.5
    assert float((view.depth / scene.depth - 1).abs()[scene.depth > 0].median()) < 0.01
    view = CPU.render(found.gaussians, pair.right)
    hole = hole_mask(view.alpha)
    assert 0.08 < float(hole.float().mean()) < 0.15
    assert psnr(view.rgb[~hole], pair.right_rgb[~hole]) > 26
