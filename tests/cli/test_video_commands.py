"""The videos of both commands: paths, stereo, sizes, formats and repetitions, and choices that cannot be."""

from __future__ import annotations

import json
import os
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from command import refuses, report_of, run
from photos import camera_file, write_pair
from PIL import Image
from scenes import box_before_wall, psnr
from torch import Tensor

import spackle
from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, TrajectoryKind
from spackle.render import CpuRenderer
from spackle.stereo import Stereo
from spackle.views import PathOptions, VideoOptions, cover

CPU = CpuRenderer()
CAMERA = Camera.from_focal(60, 64, 48)


def decode(video: Path) -> list[Tensor]:
    with av.open(str(video)) as container:
        return [torch.from_numpy(f.to_ndarray(format="rgb24")).float() / 255 for f in container.decode(video=0)]


def path_file(path: Path, *keys: tuple[float, float]) -> Path:
    """A path whose eye is so far to the right at these times."""
    frames = [{"time": time, "eye": [right, 0, 0], "target": [0, 0, 4]} for time, right in keys]
    path.write_text(json.dumps({"keyframes": frames}))
    return path


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_a_video_that_starts_again_does_not_show_its_first_view_twice(kind: TrajectoryKind) -> None:
    scene = box_before_wall()
    for options, looped in ((VideoOptions(), 0), (VideoOptions(loop=2), 1), (VideoOptions(format="gif"), 1)):
        path = PathOptions(kind, frames=8, video=options).fly(scene.base(), scene.camera, None)
        assert len(path) == 8
        assert (float((path[-1].position - path[0].position).norm()) > 1e-5) == bool(looped or kind == "swipe")


def test_a_stereo_video_holds_what_two_cameras_see(tmp_path: Path, scene: Path) -> None:
    views = camera_file(tmp_path / "views.json", rights=[0.1, -0.2])
    options = ("--cameras", views, "--stereo", "sbs", "--ipd", 0.2, "--convergence", 3)
    result = run("render", "-i", scene, "-o", tmp_path / "out", *options)
    assert result.code == 0, result.err
    assert set(os.listdir(tmp_path / "out")) == {"scene.mp4", "0000.png", "0001.png"}
    gaussians = spackle.load_ply(scene)
    frames = decode(tmp_path / "out" / "scene.mp4")
    for index, frame in enumerate(frames):
        K = torch.tensor([[55.0, 0, 32], [0, 55, 24], [0, 0, 1]])
        seen = []
        for side in (-1, 1):
            pose, lens = torch.eye(4), K.clone()
            pose[0, 3] = -([0.1, -0.2][index] + side * 0.1)
            lens[0, 2] += side * 55 * 0.1 / 3
            seen.append(CPU.render(gaussians, Camera(lens, pose, 64, 48)).rgb)
        both = torch.cat(seen, dim=1)
        with Image.open(tmp_path / "out" / f"{index:04d}.png") as image:
            picture = torch.from_numpy(np.array(image)).float() / 255
        torch.testing.assert_close(picture, both, atol=0.003, rtol=0)
        assert psnr(frame, both) > 28


@pytest.mark.parametrize(
    ("name", "options", "size"),
    [
        ("a.gif", (), (64, 48)),
        ("a.webp", ("--stereo", "anaglyph"), (64, 48)),
        ("a.webm", ("--stereo", "sbs-half", "--size", "80x40"), (80, 40)),
        ("a.mp4", ("--show", "depth"), (64, 48)),
        ("a.mp4", ("--show", "depth", "--stereo", "ou-half", "--loop", 2), (64, 48)),
    ],
)
def test_render_makes_every_kind(
    tmp_path: Path, scene: Path, name: str, options: tuple[object, ...], size: tuple[int, int]
) -> None:
    result = run("render", "-i", scene, "-o", tmp_path / name, "--frames", 3, "--fps", 10, *options)
    assert result.code == 0, result.err
    if name.endswith(("gif", "webp")):
        with Image.open(tmp_path / name) as image:
            assert (image.size, image.n_frames, image.info["loop"]) == (size, 3, 0)  # type: ignore[attr-defined]
    else:
        frames = decode(tmp_path / name)
        assert len(frames) == (6 if "--loop" in options else 3)
        assert frames[0].shape == (size[1], size[0], 3)


def test_predict_completes_what_both_eyes_see(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    # A path that stays where it is: all holes are those that the eyes see.
    common = ("predict", "-i", photo, "--depth", depth, "--frames", 3, "--disparity", 0)
    assert run(*common, "-o", tmp_path / "one").code == 0
    wide = ("--stereo", "sbs", "--ipd", 0.8, "--format", "webm", "--fps", 12, "--size", "32x24")
    assert run(*common, "-o", tmp_path / "two", *wide).code == 0
    one, two = (report_of(tmp_path / name / "photo") for name in ("one", "two"))
    assert one["video"]["file"] == "video.mp4"
    assert one["video"]["stereo"] is None
    expected = {"file": "video.webm", "frames": 3, "fps": 12, "plays": 1, "width": 64, "height": 24, "show": "color"}
    assert {name: two["video"][name] for name in expected} == expected
    assert two["video"]["stereo"] == {"layout": "sbs", "ipd": 0.8, "convergence": pytest.approx(2.0, rel=0.02)}
    before = [[view["before"] for view in report["hole_area_ratio"]] for report in (one, two)]
    assert before[0] == before[1]  # measured at the same views
    frames = decode(tmp_path / "two" / "photo" / "video.webm")
    assert len(frames) == 3
    assert frames[0].shape == (24, 64, 3)
    base, merged = (spackle.load_ply(tmp_path / "two" / "photo" / name) for name in ("base.ply", "scene.ply"))
    camera = spackle.formats.PlyFile(tmp_path / "two" / "photo" / "scene.ply").camera()
    assert camera is not None
    for eye, picture in zip(Stereo("sbs", 0.8, 2.01).eyes(camera), frames[0].split(32, dim=1), strict=True):
        holes, rest = (float((CPU.render(part, eye).alpha < 0.95).float().mean()) for part in (base, merged))
        assert rest < 0.01 < 0.1 < holes
        assert psnr(CPU.render(merged, cover(eye, 32, 24)).rgb, picture) > 25


def test_predict_follows_a_path_and_measures_its_keyframes(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    path, out = path_file(tmp_path / "p.json", (0, -0.5), (0.2, 0.0), (0.4, 0.5)), tmp_path / "out"
    options = ("--path", path, "--fps", 10, "--format", "gif")
    result = run("predict", "-i", photo, "--depth", depth, "-o", out, *options)
    assert result.code == 0, result.err
    report = report_of(out / "photo")
    assert (report["views"], report["disparity"], report["video"]["file"]) == ("p.json", None, "video.gif")
    assert [row["view"] for row in report["hole_area_ratio"]] == ["keyframe 0", "keyframe 1", "keyframe 2"]
    assert all(row["after"] < 0.01 for row in report["hole_area_ratio"])
    assert report["hole_area_ratio"][0]["before"] > 0.01
    for more, count in (((), 5), (("--frames", 4), 4)):  # as many as the keyframes take, or as are asked for
        result = run("render", "-i", out / "photo" / "scene.ply", "-o", tmp_path / "a.gif", *options[:4], *more)
        assert result.code == 0, result.err
        with Image.open(tmp_path / "a.gif") as image:
            assert image.n_frames == count  # type: ignore[attr-defined]


@pytest.mark.parametrize("command", ["predict", "render"])
@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--fps", "nan"), "--fps nan"),
        (("--fps", 60, "--format", "gif"), "--fps 60"),
        (("--loop", 0), "--loop 0"),
        (("--ipd", 0.06), "--ipd 0.06: is for two eyes"),
        (("--stereo", "sbs", "--ipd", 0), "--ipd must be"),
        (("--stereo", "ou", "--convergence", -1), "--convergence must be"),
        (("--stereo", "anaglyph", "--show", "depth"), "anaglyph"),
        (("--stereo", "sbs", "--ipd", 5, "--convergence", 1), "smaller --ipd"),
        (("--cameras", "views.json", "--size", "64x48"), "--size"),
        (("--stereo", "sbs", "--size", "8000x8000"), "8192"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_bad_choices_are_one_line(
    tmp_path: Path, scene: Path, pair: tuple[Path, Path], command: str, options: tuple[object, ...], named: str
) -> None:
    source: tuple[object, ...] = ("-i", scene)
    if command == "predict":
        source = ("-i", pair[0], "--depth", pair[1], "--residual", "none")
    short = () if "--cameras" in options else ("--frames", 2)
    result = run(command, *source, "-o", tmp_path / "out", *short, *options)
    assert (result.code, result.out) == (2, ""), result.err
    assert named in result.lines[-1]
    assert not (tmp_path / "out").exists()


def test_what_is_for_a_video_needs_one(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    for option, value in (("--fps", 24.0), ("--loop", 2), ("--format", "webm")):
        command = ("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path / "out", "--no-render", option, value)
        refuses(run(*command), f"{option} {value}", "--no-render")
    assert not (tmp_path / "out").exists()


def test_a_name_and_a_format_must_agree(tmp_path: Path, scene: Path) -> None:
    result = run("render", "-i", scene, "-o", tmp_path / "a.gif", "--format", "webm")
    assert (result.code, len(result.lines)) == (2, 1)
    assert "--format webm" in result.err
    assert run("render", "-i", scene, "-o", tmp_path / "out", "--format", "gif", "--frames", 2).code == 0
    assert os.listdir(tmp_path / "out") == ["scene.gif"]


@pytest.mark.parametrize("command", ["predict", "render"])
def test_a_path_that_cannot_be_is_refused_before_anything_is_loaded(tmp_path: Path, command: str) -> None:
    good = path_file(tmp_path / "good.json", (0, 0), (1, 0.2))
    bad = tmp_path / "bad.json"
    bad.write_text(good.read_text().replace("[0, 0, 4]", "[0.2, 0, 0]"))
    for options, reason in (
        (("--path", bad), "bad.json: keyframe 1: eye and target coincide"),
        (("--path", good, "--trajectory", "swipe"), "--trajectory swipe"),
        (("--path", good, "--disparity", 0.2), "--disparity 0.2"),
        (("--path", good, "--cameras", bad), "--cameras"),
        (("--cameras", bad, "--disparity", 0.3), "--disparity 0.3"),
        (("--cameras", bad, "--trajectory", "rotate_forward"), "--trajectory rotate-forward"),
        (("--cameras", bad, "--frames", 9), "--frames 9"),
        (("--path", tmp_path / "none.json"), "none.json: no such path file"),
    ):
        result = run(command, "-i", tmp_path / "nothing", "-o", tmp_path / "out", *options)
        assert (result.code, len(result.lines)) == (2, 1), result.err
        assert reason in result.err
    assert not (tmp_path / "out").exists()
