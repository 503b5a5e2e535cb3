"""A scene in another unit of length: the same pictures, paths, fill and files, in proportion."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.scenes import box_before_wall, psnr, same_bits
from PIL import Image
from torch import Tensor

import spackle
from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import TRAJECTORIES, TrajectoryKind
from spackle.formats.scene_files import load_scene
from spackle.pipeline import complete
from spackle.render import CpuRenderer
from spackle.scene import Scene

CPU = CpuRenderer()
SIZES = (0.001, 0.01, 100.0, 1000.0)
POWERS_OF_TWO = (2.0**-10, 2.0**10)  # by which numbers keep all their bits
DISPARITY = 0.2
NEAR, FAR = 1.4, 4.0  # nearer than 2, which is nothing special in a scene of unknown unit


@functools.cache
def prediction(size: float = 1.0) -> BasePrediction:
    """A box before a wall, whose unit of length is not known."""
    lifted = box_before_wall(NEAR, FAR, width=96, height=72, focal=80).lift()
    return dataclasses.replace(lifted, gaussians=lifted.gaussians.scaled(size), is_metric=False)


def path(size: float = 1.0, kind: TrajectoryKind = "rotate-forward") -> list[Camera]:
    scene = Scene(prediction(size).gaussians, Gaussians.empty(), prediction().camera)
    return scene.path(kind, DISPARITY, frames=5)


@functools.cache
def completed(size: float = 1.0) -> Scene:
    return dataclasses.replace(complete(prediction(size), path(size)), disparity=DISPARITY)


@functools.cache
def views(size: float = 1.0, kind: TrajectoryKind = "rotate-forward") -> list[Tensor]:
    return [completed(size).render(camera, CPU).rgb for camera in path(size, kind)]


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("size", SIZES + POWERS_OF_TWO)
def test_the_camera_moves_in_proportion(size: float, kind: TrajectoryKind) -> None:
    for camera, expected in zip(path(size, kind), path(1.0, kind), strict=True):
        poses = camera.world_to_camera, expected.world_to_camera
        torch.testing.assert_close(poses[0][:, :3], poses[1][:, :3], rtol=0, atol=1e-6)
        torch.testing.assert_close(poses[0][:3, 3] / size, poses[1][:3, 3], rtol=1e-5, atol=1e-7)
        torch.testing.assert_close(camera.K, expected.K)


@pytest.mark.parametrize("size", SIZES)
def test_the_base_looks_the_same_along_the_path(size: float) -> None:
    for camera, expected in zip(path(size), path(), strict=True):
        view = CPU.render(prediction(size).gaussians, camera)
        same = CPU.render(prediction().gaussians, expected)
        assert psnr(view.rgb, same.rgb) > 80
        torch.testing.assert_close(view.depth / size, same.depth, rtol=1e-3, atol=0)


@pytest.mark.parametrize("size", POWERS_OF_TWO)
def test_the_base_looks_the_same_bit_by_bit(size: float) -> None:
    for camera, expected in zip(path(size), path(), strict=True):
        view = CPU.render(prediction(size).gaussians, camera)
        same = CPU.render(prediction().gaussians, expected)
        assert torch.equal(view.rgb, same.rgb)
        assert torch.equal(view.depth, same.depth * size)


@pytest.mark.parametrize("size", [*SIZES, 2.0**-20, *POWERS_OF_TWO, 2.0**20])
def test_holes_are_filled_alike(size: float) -> None:
    assert len(completed().aux) > 200
    assert len(completed(size).aux) == pytest.approx(len(completed().aux), rel=0.02)
    # A rounding error may decide between two fills that are equally good, here at the outermost
    # views. Powers of two make no rounding errors but in logarithms.
    bound = 45 if math.log2(size).is_integer() else 27
    for view, expected in zip(views(size), views(), strict=True):
        assert psnr(view, expected) > bound
    assert psnr(views(size)[0], views()[0]) > 60


def test_a_lifted_depth_map_keeps_its_bits_in_another_unit() -> None:
    scene = box_before_wall(NEAR, FAR, width=96, height=72, focal=80)
    for size in POWERS_OF_TWO:
        scaled = dataclasses.replace(scene, depth=scene.depth * size).lift(levels=3).gaussians
        assert same_bits(scaled, scene.lift(levels=3).gaussians.scaled(size))


@pytest.mark.parametrize("kind", ["ply", "compressed.ply", "spz", "v4.spz", "sog", "splat", "glb"])
@pytest.mark.parametrize("size", SIZES)
def test_files_keep_the_scene(size: float, kind: str, tmp_path: Path) -> None:
    def reloaded(scale: float) -> Gaussians:
        file = tmp_path / f"{scale:g}.{kind}"
        scene = completed()
        scaled = dataclasses.replace(
            scene, base=scene.base.scaled(scale), aux=scene.aux.scaled(scale)
        )
        scaled.export(file)
        return load_scene(file).gaussians

    scene = reloaded(size)
    usual_scene = reloaded(1.0)
    cameras = zip(path(size), path(), strict=True)
    for (camera, usual_camera), original in zip(cameras, views(), strict=True):
        view = CPU.render(scene, camera).rgb
        usual = CPU.render(usual_scene, usual_camera).rgb
        # What rounding costs is no more than in metres.
        assert psnr(view, original) > min(psnr(usual, original) - 1.5, 50)


@pytest.mark.parametrize("kind", ["compressed.ply", "spz", "v4.spz", "sog"])
@pytest.mark.parametrize("size", [0.001, 1.0, 1000.0])
def test_files_keep_near_and_very_far_things_together(
    size: float, kind: str, tmp_path: Path
) -> None:
    near = prediction(size).gaussians
    # A sky ten million times as far as the box, as a renderer's background.
    sky = near.select(near.means[:, 2] > 0.9 * FAR * size).scaled(1e7)
    scene = Scene(Gaussians.cat([near, sky]), Gaussians.empty(), prediction().camera)
    scene.export(tmp_path / f"a.{kind}")
    stored = load_scene(tmp_path / f"a.{kind}").gaussians
    for camera in path(size):
        view = CPU.render(stored, camera).rgb
        # A chunk of compressed PLY, 256 Gaussians of this tiny scene, has near and far ones.
        bound = 22 if kind == "compressed.ply" else 45
        assert psnr(view, scene.render(camera, CPU).rgb) > bound


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_the_page_gets_an_ordinary_unit(size: float) -> None:
    pages = [completed(scale).page("box") for scale in (1.0, size)]
    usual, page = (json.loads(json.dumps(one.description)) for one in pages)
    for key in ("name", "camera"):
        assert page[key] == usual[key]
    # Lengths are multiples of the nearest depth, whatever the unit.
    assert 1 / 16 < page["zNear"] < 256
    assert page["focus"] / page["zNear"] == pytest.approx(usual["focus"] / usual["zNear"])
    assert page["orbit"]["unit"] / page["zNear"] == pytest.approx(
        usual["orbit"]["unit"] / usual["zNear"]
    )
    for kind, positions in page["paths"].items():
        for part, rows in positions.items():
            np.testing.assert_allclose(
                np.array(rows) / page["zNear"],
                np.array(usual["paths"][kind][part]) / usual["zNear"],
                rtol=1e-5,
                atol=1e-9,
            )


@pytest.mark.parametrize("size", SIZES)
def test_videos_show_the_same(size: float) -> None:
    def frames(scale: float, **options: object) -> list[np.ndarray]:
        file = io.BytesIO()
        scene = completed()
        scaled = dataclasses.replace(
            scene, base=scene.base.scaled(scale), aux=scene.aux.scaled(scale)
        )
        scaled.save_video(file, "swipe", frames=3, format="webp", **options)  # type: ignore[arg-type]
        video = Image.open(file)
        pictures = []
        for index in range(3):
            video.seek(index)
            pictures.append(np.asarray(video.convert("RGB")) / 255)
        return pictures

    for options in ({}, {"stereo": "sbs"}, {"show": "depth"}):
        for frame, expected in zip(frames(size, **options), frames(1.0, **options), strict=True):
            assert expected.mean() > 0.1
            assert psnr(torch.from_numpy(frame), torch.from_numpy(expected)) > 35  # of lossy WebP


def test_a_saved_scene_says_whether_it_is_metric(tmp_path: Path) -> None:
    for is_metric in (False, True):
        scene = dataclasses.replace(completed(), is_metric=is_metric)
        for kind in ("ply", "compressed.ply"):
            scene.export(tmp_path / f"a.{kind}")
            loaded = Scene.load(tmp_path / f"a.{kind}")
            assert loaded.is_metric == is_metric
            # SHARP's rule for metres: the camera looks at a point that is 2 m away, or farther.
            assert loaded.depth_range.focus == pytest.approx(2.0 if is_metric else NEAR, rel=0.05)


def test_depth_of_a_stated_unit_is_metric() -> None:
    scene = box_before_wall(NEAR, FAR, width=64, height=48, focal=54)
    rgb, depth = scene.rgb.numpy(), scene.depth.numpy()

    def predict(**options: object) -> Scene:
        return spackle.predict(rgb, depth, fill="none", disparity=0.1, **options)  # type: ignore[arg-type]

    assert not predict().is_metric  # nobody said that the numbers are metres
    assert predict(depth_unit="m").is_metric
    assert predict(depth_kind="metric").is_metric
