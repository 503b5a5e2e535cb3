"""`spackle render`, and videos of both commands: paths, stereo, sizes, formats, repetitions."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from helpers.command import SHORT, Run, decode, names_in, refuses, report_of, run
from helpers.photos import HEIGHT, WIDTH, box, camera_file
from helpers.scenes import psnr
from PIL import Image, ImageSequence
from torch import Tensor

import spackle
from spackle.core.camera import Camera
from spackle.render import CpuRenderer
from spackle.video.frames import COMPARE_GAP_PX, crop_camera_to_size
from spackle.video.options import Fit
from spackle.video.stereo import Stereo

CPU = CpuRenderer()


def frames_of(video: Path) -> list[Tensor]:
    """[H, W, 3] in 0..1 of any kind of video that FFmpeg reads."""
    return [
        torch.from_numpy(frame.to_ndarray(format="rgb24")).float() / 255 for frame in decode(video)
    ]


def rendered(scene: Path, output: Path, *options: object) -> Run:
    """`spackle render` that has to succeed."""
    result = run("render", scene, "-o", output, *options)
    assert result.code == 0, result.err
    return result


def test_render_draws_a_saved_scene(tmp_path: Path, scene: Path, plain: tuple[Path, Run]) -> None:
    assert len(rendered(scene, tmp_path / "new" / "a.mp4", *SHORT).lines) == 1
    rendered(scene, tmp_path / "folder", *SHORT, "--format", "gif")
    assert names_in(tmp_path / "folder") == {"scene.gif"}
    ours, predicted = decode(tmp_path / "new" / "a.mp4"), decode(plain[0] / "video.mp4")
    assert len(ours) == len(predicted) == 3
    assert (ours[0].width, ours[0].height, ours[0].format.name) == (WIDTH, HEIGHT, "yuv420p")
    for frames in zip(ours, predicted, strict=True):
        one, other = (frame.to_ndarray(format="rgb24").astype(float) for frame in frames)
        assert np.abs(one - other).mean() < 1
    far = rendered(
        scene, tmp_path / "far.mp4", "--trajectory", "swipe", "--disparity", 1.5, "--json", *SHORT
    )
    assert "--disparity 1.5 goes beyond the 0.07" in far.lines[0]
    assert json.loads(far.out)["open"] > 0.01


@pytest.mark.parametrize("size", [(128, 64), (31, 31), (32, 128)])
@pytest.mark.parametrize("fit", get_args(Fit))
@pytest.mark.parametrize("overscan", [0, 0.25])
def test_render_at_another_size_squeezes_nothing(
    tmp_path: Path, scene: Path, size: tuple[int, int], fit: Fit, overscan: float
) -> None:
    width, height = size
    words = (
        "--size",
        f"{width}x{height}",
        "--fit",
        fit,
        "--overscan",
        overscan,
        "--disparity",
        0,
        "--frames",
        1,
    )
    rendered(scene, tmp_path / "a.mp4", *words)
    (frame,) = frames_of(tmp_path / "a.mp4")
    assert frame.shape == (height + height % 2, width + width % 2, 3)
    red = frame[..., 0] > frame[..., 2]
    scales = (width / WIDTH, height / HEIGHT)
    scale = (max if fit == "crop" else min)(scales)
    margins = [
        (side - scale * own) / 2 for side, own in ((height, HEIGHT), (width, WIDTH))
    ]  # above and beside
    if fit != "crop":
        rows, columns = (
            round(margin) + 2 if margin > 1 else 0 for margin in margins
        )  # colours leak by a pixel or two
        assert float(frame[rows : height - rows, columns : width - columns].amax(-1).min()) > 0.2
        red[:rows] = red[height - rows :] = False
        red[:, :columns] = red[:, width - columns :] = False
    for axis in (0, 1):
        seen = scale * (1 + overscan) * box().any(axis=axis).sum()
        assert int(red.any(dim=axis).sum()) == pytest.approx(min(seen, size[axis]), abs=6)
    if max(margins) > 8:
        corner = float(frame[:2, :2].max())
        assert corner == pytest.approx(0, abs=0.1) if fit == "pad" else 0.1 < corner < 0.6


def test_render_says_where_it_guesses_the_lens(tmp_path: Path, scene: Path) -> None:
    head, end, body = scene.read_bytes().partition(b"end_header\n")
    (bare := tmp_path / "bare.ply").write_bytes(re.sub(b"comment.*\n", b"", head) + end + body)
    assert "no camera stored" in rendered(bare, tmp_path, "--size", "64x48", *SHORT).lines[0]
    for lens in (("--focal-px", 55), ("--fov", 60)):
        assert len(rendered(bare, tmp_path, "--size", "64x48", *lens, *SHORT).lines) == 1


def test_compare_puts_the_base_beside_the_scene(tmp_path: Path, scene: Path) -> None:
    # Without overscan, what lies beyond the photo's border is in the frame, too.
    words = ("--trajectory", "swipe", "--seconds", 0.2, "--fps", 10, "--overscan", 0)
    rendered(scene, tmp_path / "both.webp", "--compare", *words)
    rendered(scene, tmp_path / "whole.webp", *words)
    both, whole = (
        [*ImageSequence.all_frames(Image.open(tmp_path / f"{name}.webp"))]
        for name in ("both", "whole")
    )
    assert len(both) == len(whole) == 2
    for pair, right in zip(both, whole, strict=True):
        assert pair.size == (2 * WIDTH + COMPARE_GAP_PX, HEIGHT)
        sides = [
            pair.crop(box).convert("RGB")
            for box in ((0, 0, WIDTH, HEIGHT), (WIDTH + COMPARE_GAP_PX, 0, *pair.size))
        ]
        open_, filled, expected = (
            np.asarray(image.convert("RGB"), float) for image in (*sides, right)
        )
        assert np.abs(filled - expected).mean() < 6  # WebP is lossy
        dark = open_.max(axis=-1) < 40  # the holes
        assert dark.mean() > 0.01
        assert filled[dark].max(axis=-1).mean() > 60
    bare = tmp_path / "base.ply"
    spackle.save_ply(spackle.load_ply(scene), bare)
    refuses(run("render", bare, "-o", tmp_path / "a.mp4", "--compare"), bare, "--compare")


def test_given_views_become_pictures_and_a_stereo_video(tmp_path: Path, scene: Path) -> None:
    views = camera_file(tmp_path / "views.json", rights=[0.0, 0.3], sizes=[(64, 48), (32, 24)])
    assert "no video" in rendered(scene, tmp_path / "out", "--cameras", views).lines[0]
    assert names_in(tmp_path / "out") == {"0000.png", "0001.png"}
    camera_file(views, rights=[0.1, -0.2])
    rendered(
        scene,
        tmp_path / "out",
        "--cameras",
        views,
        "--stereo",
        "sbs",
        "--ipd",
        0.2,
        "--convergence",
        3,
    )
    assert names_in(tmp_path / "out") == {"scene.mp4", "0000.png", "0001.png"}
    gaussians = spackle.load_ply(scene)
    for index, frame in enumerate(frames_of(tmp_path / "out" / "scene.mp4")):
        seen = []
        for side in (-1, 1):
            pose, K = (
                torch.eye(4),
                torch.tensor([[55.0, 0, 32 + side * 55 * 0.1 / 3], [0, 55, 24], [0, 0, 1]]),
            )
            pose[0, 3] = -([0.1, -0.2][index] + side * 0.1)
            seen.append(CPU.render(gaussians, Camera(K, pose, 64, 48)).rgb)
        both = torch.cat(seen, dim=1)
        with Image.open(tmp_path / "out" / f"{index:04d}.png") as image:
            picture = torch.from_numpy(np.array(image)).float() / 255
        torch.testing.assert_close(picture, both, atol=0.003, rtol=0)
        assert psnr(frame, both) > 28


@pytest.mark.parametrize(
    ("name", "options", "size"),
    [
        ("a.webp", ("--stereo", "anaglyph"), (64, 48)),
        ("a.webm", ("--stereo", "sbs-half", "--size", "80x40"), (80, 40)),
        ("a.mp4", ("--show", "depth", "--stereo", "ou-half", "--loop", 2), (64, 48)),
    ],
)
def test_render_makes_every_kind(
    tmp_path: Path, scene: Path, name: str, options: tuple[object, ...], size: tuple[int, int]
) -> None:
    rendered(scene, tmp_path / name, "--frames", 3, "--fps", 10, *options)
    if name.endswith(("gif", "webp")):
        with Image.open(tmp_path / name) as image:
            assert (image.size, image.n_frames, image.info["loop"]) == (size, 3, 0)  # type: ignore[attr-defined]
    else:
        frames = frames_of(tmp_path / name)
        assert len(frames) == (6 if "--loop" in options else 3)
        assert frames[0].shape == (size[1], size[0], 3)


def test_predict_completes_what_both_eyes_see(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    # The path stays at the photo's camera, so that all holes are those that the eyes see.
    wide = (
        "--stereo",
        "sbs",
        "--ipd",
        0.8,
        "--format",
        "webm",
        "--fps",
        12,
        "--size",
        "32x24",
        "--keep-base",
    )
    result = run(
        "predict",
        pair[0],
        "--depth",
        pair[1],
        "--frames",
        4,
        "--disparity",
        0,
        "-o",
        tmp_path,
        *wide,
    )
    assert result.code == 0, result.err
    folder = tmp_path / "photo"
    expected = {
        "file": "video.webm",
        "frames": 4,
        "fps": 12,
        "plays": 1,
        "width": 64,
        "height": 24,
        "show": "color",
    }
    stereo = {"layout": "sbs", "ipd": 0.8, "convergence": pytest.approx(2.0, rel=0.02)}
    assert report_of(folder)["video"] == {**expected, "stereo": stereo}
    frames = frames_of(folder / "video.webm")
    assert (len(frames), frames[0].shape) == (4, (24, 64, 3))
    base, merged = (spackle.load_ply(folder / name) for name in ("base.ply", "scene.ply"))
    eyes = Stereo("sbs", 0.8, 2.01).eyes(
        spackle.Scene.load(folder / "scene.ply").camera.zoomed(1.05)
    )
    for eye, picture in zip(eyes, frames[0].split(32, dim=1), strict=True):
        holes, rest = (
            float((CPU.render(part, eye).alpha < 0.95).float().mean()) for part in (base, merged)
        )
        assert rest < 0.01 < 0.1 < holes
        assert psnr(CPU.render(merged, crop_camera_to_size(eye, 32, 24)).rgb, picture) > 25


def test_predict_follows_a_path_and_measures_its_keyframes(
    tmp_path: Path, pair: tuple[Path, Path]
) -> None:
    path, out = tmp_path / "p.json", tmp_path / "out"
    places = ((0, -0.5), (0.2, 0.0), (0.4, 0.5))
    keys = [{"time": time, "eye": [right, 0, 0], "target": [0, 0, 4]} for time, right in places]
    path.write_text(json.dumps({"keyframes": keys}))
    options = ("--path", path, "--fps", 10, "--format", "gif")
    assert run("predict", pair[0], "--depth", pair[1], "-o", out, *options).code == 0
    report = report_of(out / "photo")
    assert (report["views"], report["disparity"], report["video"]["file"]) == (
        "p.json",
        None,
        "video.gif",
    )
    assert [row["view"] for row in report["hole_area_ratio"]] == [
        "keyframe 0",
        "keyframe 1",
        "keyframe 2",
    ]
    assert all(row["after"] < 0.01 for row in report["hole_area_ratio"])
    assert report["hole_area_ratio"][0]["before"] > 0.01
    for more, count in (
        ((), 5),
        (("--frames", 4), 4),
    ):  # as many as the keyframes take, or as are asked for
        rendered(out / "photo" / "scene.ply", tmp_path / "a.gif", *options[:4], *more)
        with Image.open(tmp_path / "a.gif") as image:
            assert image.n_frames == count  # type: ignore[attr-defined]
