"""Two eyes, depth as colours, and the videos of both commands that show them."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from command import report_of, run
from hypothesis import given, settings
from hypothesis import strategies as st
from photos import camera_file, write_pair
from PIL import Image
from scenes import box_before_wall, cast, wall
from torch import Tensor

import spackle
from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange
from spackle.color import INFERNO, UNKNOWN_GREY, DepthColors, linear_to_srgb, srgb_to_linear
from spackle.jobs.film import cover, fly, make_film
from spackle.jobs.video_options import VideoOptions
from spackle.render import CpuRenderer
from spackle.scene import scene_path
from spackle.stereo import DUBOIS_LEFT, DUBOIS_RIGHT, LAYOUTS, Stereo, anaglyph, default_ipd

CPU = CpuRenderer()
CAMERA = Camera.from_focal(60, 64, 48)


def decode(video: Path) -> list[Tensor]:
    with av.open(str(video)) as container:
        return [torch.from_numpy(f.to_ndarray(format="rgb24")).float() / 255 for f in container.decode(video=0)]


def psnr(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10((a - b).square().mean()))


def parallax(stereo: Stereo, camera: Camera, point: Sequence[float]) -> tuple[float, float]:
    """How far to the right, and below, the left eye sees a point of where the right eye does, in pixels."""
    (left, _), (right, _) = (eye.project(torch.tensor(point)) for eye in stereo.eyes(camera))
    across, down = (left - right).tolist()
    return across, down


# The eyes


@settings(deadline=None, max_examples=50)
@given(st.floats(0.01, 0.5), st.floats(1, 20), st.floats(0.5, 50), st.floats(-1, 1), st.floats(-1, 1))
def test_parallax_is_crossed_before_the_screen_none_on_it_and_uncrossed_behind(
    ipd: float, convergence: float, z: float, x: float, y: float
) -> None:
    stereo = Stereo("sbs", ipd, convergence)
    across, down = parallax(stereo, CAMERA, [x * z, y * z, z])
    assert across == pytest.approx(60 * ipd * (1 / z - 1 / convergence), abs=1e-3)
    assert down == pytest.approx(0, abs=1e-4)  # rows stay rows: nothing is toed in
    assert parallax(stereo, CAMERA, [x, y, convergence])[0] == pytest.approx(0, abs=1e-3)
    assert (
        parallax(stereo, CAMERA, [x, y, convergence / 2])[0] > 0 > parallax(stereo, CAMERA, [x, y, 2 * convergence])[0]
    )


def test_eyes_stand_beside_a_view_that_is_turned() -> None:
    camera = CAMERA.looking(torch.tensor([1.0, 0.5, 0.0]), torch.tensor([0.0, 0.0, 4.0]))
    left, right = Stereo("sbs", 0.2, float("inf")).eyes(camera)
    torch.testing.assert_close((left.position + right.position) / 2, camera.position)
    torch.testing.assert_close(right.position - left.position, 0.2 * camera.world_to_camera[0, :3])
    assert torch.equal(left.K, camera.K)  # parallel axes


def test_what_is_seen_at_the_screen_is_the_same_for_both_eyes() -> None:
    """A wall at the depth of convergence shows no parallax, a nearer box stands to the right for the left eye."""
    flat = wall(depth=4.0)
    left, right = (CPU.render(flat.base(), eye).rgb for eye in Stereo("sbs", 0.3, 4.0).eyes(flat.camera))
    assert psnr(left[:, 6:-6], right[:, 6:-6]) > 35
    scene = box_before_wall()
    left, right = (CPU.render(scene.base(), eye).rgb for eye in Stereo("sbs", 0.3, 6.0).eyes(scene.camera))
    reddish = [(p[..., 0] > p[..., 2]).float() for p in (left, right)]
    columns = torch.arange(96) + 0.5
    places = [float((mask.sum(0) * columns).sum() / mask.sum()) for mask in reddish]
    assert places[0] - places[1] == pytest.approx(80 * 0.3 * (1 / 2 - 1 / 6), abs=1)


def test_the_default_eyes_spread_the_depth_over_three_percent_of_the_width() -> None:
    depths = DepthRange(near=1.8, focus=2.5)
    ipd = default_ipd(CAMERA, depths)
    stereo = Stereo("sbs", ipd, depths.focus)
    span = parallax(stereo, CAMERA, [0, 0, depths.near])[0] - parallax(stereo, CAMERA, [0, 0, 1e6])[0]
    assert span == pytest.approx(0.03 * 64, abs=1e-3)
    lens = Camera.from_focal(1200, 1440, 960)  # about 30 mm
    assert default_ipd(lens, depths) == pytest.approx(0.065, abs=0.001)


@pytest.mark.parametrize(("layout", "ipd", "convergence"), [("sbs", 0, 1), ("sbs", 1, 0), ("wide", 1, 1)])
def test_eyes_that_cannot_be(layout: str, ipd: float, convergence: float) -> None:
    with pytest.raises(ValueError, match="stereo"):
        Stereo(layout, ipd, convergence)  # type: ignore[arg-type]


# One frame of two pictures


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 65)])
def test_frames_have_the_size_that_is_foretold(layout: str, height: int, width: int) -> None:
    stereo = Stereo(layout, 0.06, 2.0)  # type: ignore[arg-type]
    frame = stereo.pack(torch.rand(height, width, 3), torch.rand(height, width, 3))
    assert (frame.shape[1], frame.shape[0]) == stereo.frame_size(width, height)
    if layout.endswith("half") and width == 64:
        assert frame.shape == (height, width, 3)


def test_the_left_eye_is_on_the_left_and_on_top_and_half_is_a_mean_of_light() -> None:
    left, right = torch.rand(48, 64, 3), torch.rand(48, 64, 3)
    sbs, ou = (Stereo(layout, 0.06, 2.0).pack(left, right) for layout in ("sbs", "ou"))  # type: ignore[arg-type]
    assert torch.equal(sbs[:, :64], left)
    assert torch.equal(sbs[:, 64:], right)
    assert torch.equal(ou[:48], left)
    assert torch.equal(ou[48:], right)
    half = Stereo("sbs-half", 0.06, 2.0).pack(left, right)
    light = srgb_to_linear(right)
    torch.testing.assert_close(half[:, 32:], linear_to_srgb((light[:, ::2] + light[:, 1::2]) / 2))
    low = Stereo("ou-half", 0.06, 2.0).pack(left, right)
    light = srgb_to_linear(left)
    torch.testing.assert_close(low[:24], linear_to_srgb((light[::2] + light[1::2]) / 2))


def test_an_anaglyph_of_grey_is_grey_and_each_eye_has_its_glass() -> None:
    grey = torch.linspace(0, 1, 64).repeat(3, 1).T
    torch.testing.assert_close(anaglyph(grey, grey), grey, atol=0.004, rtol=0)
    assert torch.tensor(DUBOIS_LEFT).sum(1) + torch.tensor(DUBOIS_RIGHT).sum(1) == pytest.approx([1, 1, 1], abs=0.0011)
    white, black = torch.ones(1, 3), torch.zeros(1, 3)
    assert anaglyph(white, black)[0].tolist() == pytest.approx([1, 0, 0], abs=1e-6)
    cyan = anaglyph(black, white)[0]
    assert cyan[0] == 0
    assert float(cyan[1:].min()) > 0.99


# Depth as colours


def test_near_is_bright_holes_are_grey_and_the_scale_is_linear_in_inverse_depth() -> None:
    colors = DepthColors(near=1.0, far=5.0)
    inverse = torch.linspace(1 / 5, 1, 17)
    shown = colors(1 / inverse[None], torch.ones(1, 17, dtype=torch.bool))[0]
    torch.testing.assert_close(shown, torch.tensor(INFERNO), atol=1e-4, rtol=0)
    luma = shown @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert bool((luma.diff() > 0).all())
    odd = colors(torch.tensor([[0.0, 0.5, 50.0]]), torch.tensor([[False, True, True]]))[0]
    assert odd[0].tolist() == [UNKNOWN_GREY] * 3
    torch.testing.assert_close(odd[1:], torch.tensor([INFERNO[-1], INFERNO[0]]))


def test_one_scale_serves_all_views_of_a_video() -> None:
    scene = box_before_wall(near=2.0, far=6.0)
    base = scene.base()
    path = scene_path(base, scene.camera, "rotate_forward", 0.3, 5)
    scale = DepthColors.over(base, path)
    assert (scale.near, scale.far) == pytest.approx((2.0, 6.0), rel=0.25)
    film = make_film(VideoOptions(show="depth"), base, path, Path("x"))
    for camera in path:
        frame = film.frame([CPU.render(base, camera)])
        box, corner = frame[36, 48].sum(), frame[2, 48].sum()
        assert float(box) > float(corner) + 1
    with pytest.raises(ValueError, match="in view"):
        DepthColors.over(base, [CAMERA.looking(torch.zeros(3), torch.tensor([0.0, 0.0, -1.0]))])


def test_a_still_thing_keeps_its_colour_while_the_camera_moves_past_it() -> None:
    """No flicker: the colour of a point depends on its distance alone."""
    scene = box_before_wall(near=2.0, far=6.0)
    base = scene.base()
    path = scene_path(base, scene.camera, "swipe", 0.3, 4)
    film = make_film(VideoOptions(show="depth"), base, path, Path("x"))
    for camera in path:
        view = CPU.render(base, camera)
        frame = film.frame([view])
        z = cast(camera, 2.0)
        box = (z[..., :2].abs() < 0.25).all(dim=-1)
        distance = camera.to_camera(z)[..., 2]
        expected = film.depth(distance, torch.ones_like(box))  # type: ignore[misc]
        torch.testing.assert_close(frame[box], expected[box], atol=0.1, rtol=0)


# Looking the same way


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_a_looped_path_does_not_show_its_first_view_twice(kind: str) -> None:
    scene = box_before_wall()
    once, looped = (
        scene_path(scene.base(), scene.camera, kind, 0.3, 8, looped=looped)  # type: ignore[arg-type]
        for looped in (False, True)
    )
    assert len(once) == len(looped) == 8
    step = float((looped[-1].position - looped[0].position).norm())
    if kind == "swipe":
        assert all(torch.equal(a.world_to_camera, b.world_to_camera) for a, b in zip(once, looped, strict=True))
    else:
        assert float((once[-1].position - once[0].position).norm()) < 1e-5 < step


def test_a_video_that_starts_again_gets_a_looped_path_and_a_single_one_does_not() -> None:
    scene = box_before_wall()
    for options, looped in ((VideoOptions(), 0), (VideoOptions(loop=2), 1), (VideoOptions(format="gif"), 1)):
        path = fly(scene.base(), scene.camera, "rotate", 0.3, 8, options)
        step = float((path[-1].position - path[0].position).norm())
        assert (step > 0.01) == looped


@settings(deadline=None, max_examples=30)
@given(st.integers(2, 200), st.integers(2, 200))
def test_another_size_never_shows_more_than_the_view_that_was_completed(width: int, height: int) -> None:
    eye = Stereo("sbs", 0.3, 2.0).eyes(CAMERA)[0]
    drawn = cover(eye, width, height)
    corners = torch.tensor([[0.0, 0.0], [float(width), float(height)]])
    uv, _ = eye.project(drawn.unproject(corners, torch.ones(2)))
    assert bool((uv > -1e-3).all())
    assert bool((uv < torch.tensor([64.0, 48.0]) + 1e-3).all())
    assert drawn.K[0, 0] == drawn.K[1, 1]


# The commands


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    photo, depth = write_pair(folder)
    assert run("predict", "-i", photo, "--depth", depth, "-o", folder, "--frames", 2, "--no-render").code == 0
    return folder / "photo" / "scene.ply"


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
        ("a.webm", ("--stereo", "ou"), (64, 96)),
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


def test_a_path_file_takes_its_time(tmp_path: Path, scene: Path) -> None:
    keys = [{"time": t, "eye": [x, 0, 0], "target": [0, 0, 4]} for t, x in ((0, 0), (0.5, 0.2))]
    (tmp_path / "p.json").write_text(json.dumps({"keyframes": keys}))
    for options, count in (((), 6), (("--frames", 4), 4)):
        result = run(
            "render", "-i", scene, "-o", tmp_path / "a.gif", "--path", tmp_path / "p.json", "--fps", 10, *options
        )
        assert result.code == 0, result.err
        with Image.open(tmp_path / "a.gif") as image:
            assert image.n_frames == count  # type: ignore[attr-defined]


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
    camera = spackle.formats.load_ply_camera(tmp_path / "two" / "photo" / "scene.ply")
    assert camera is not None
    for eye, picture in zip(Stereo("sbs", 0.8, 2.01).eyes(camera), frames[0].split(32, dim=1), strict=True):
        holes, rest = (float((CPU.render(part, eye).alpha < 0.95).float().mean()) for part in (base, merged))
        assert rest < 0.01 < 0.1 < holes
        assert psnr(CPU.render(merged, cover(eye, 32, 24)).rgb, picture) > 25


def test_predict_follows_a_path_and_measures_its_keyframes(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    keys = [{"time": t, "eye": [x, 0, 0], "target": [0, 0, 4]} for t, x in ((0, -0.5), (1, 0.0), (2, 0.5))]
    (tmp_path / "p.json").write_text(json.dumps({"keyframes": keys}))
    options = ("--path", tmp_path / "p.json", "--frames", 3, "--format", "gif")
    out = tmp_path / "out"
    result = run("predict", "-i", photo, "--depth", depth, "-o", out, *options)
    assert result.code == 0, result.err
    report = report_of(out / "photo")
    assert (report["views"], report["disparity"], report["video"]["file"]) == ("p.json", None, "video.gif")
    assert [row["view"] for row in report["hole_area_ratio"]] == ["keyframe 0", "keyframe 1", "keyframe 2"]
    assert all(row["after"] < 0.01 for row in report["hole_area_ratio"])
    assert report["hole_area_ratio"][0]["before"] > 0.01


def test_another_video_is_not_done_already(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    (tmp_path / "photos").mkdir()
    photo.rename(tmp_path / "photos" / photo.name)
    keys = [{"time": t, "eye": [0.1 * t, 0, 0], "target": [0, 0, 4]} for t in (0, 1)]
    path = tmp_path / "p.json"
    path.write_text(json.dumps({"keyframes": keys}))
    out = tmp_path / "out"
    common = ("predict", "-i", tmp_path / "photos", "--depth", depth, "-o", out, "--frames", 2, "--residual", "none")
    for options in ((), ("--format", "gif"), ("--stereo", "ou"), ("--path", path)):
        first, again = (run(*common, *options) for _ in range(2))
        assert (first.code, again.code) == (0, 0), first.err
        assert "done already" not in first.err
        assert "done already" in again.err
    path.write_text(json.dumps({"keyframes": [keys[0], keys[1] | {"fov": 50}]}))
    assert "done already" not in run(*common, "--path", path).err
    assert {"video.mp4", "video.gif"} <= set(os.listdir(out / "photo"))
    assert report_of(out / "photo")["video"]["file"] == "video.mp4"


@pytest.mark.parametrize("command", ["predict", "render"])
@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--fps", 0), "--fps 0"),
        (("--fps", "nan"), "--fps nan"),
        (("--fps", 60, "--format", "gif"), "--fps 60"),
        (("--loop", 0), "--loop 0"),
        (("--loop", -1, "--format", "webp"), "--loop -1"),
        (("--size", "64"), "--size 64"),
        (("--ipd", 0.06), "--ipd 0.06: is for two eyes"),
        (("--stereo", "sbs", "--ipd", 0), "--ipd must be"),
        (("--stereo", "sbs", "--ipd", "nan"), "--ipd must be"),
        (("--stereo", "ou", "--convergence", -1), "--convergence must be"),
        (("--stereo", "anaglyph", "--show", "depth"), "anaglyph"),
        (("--stereo", "cross"), "--stereo"),
        (("--stereo", "sbs", "--ipd", 5, "--convergence", 1), "smaller --ipd"),
        (("--cameras", "views.json", "--size", "64x48"), "--size"),
        (("--stereo", "sbs", "--size", "8000x8000"), "8192"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_bad_choices_are_one_line(
    tmp_path: Path, scene: Path, command: str, options: tuple[object, ...], named: str
) -> None:
    source: tuple[object, ...] = ("-i", scene)
    if command == "predict":
        photo, depth = write_pair(tmp_path)
        source = ("-i", photo, "--depth", depth, "--residual", "none")
    short = () if "--cameras" in options else ("--frames", 2)
    result = run(command, *source, "-o", tmp_path / "out", *short, *options)
    assert (result.code, result.out) == (2, ""), result.err
    assert named in result.lines[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [("--fps", 24.0), ("--loop", 2), ("--format", "webm")], ids=lambda o: o[0])
def test_what_is_for_a_video_needs_one(tmp_path: Path, options: tuple[str, object]) -> None:
    photo, depth = write_pair(tmp_path)
    common = ("predict", "-i", photo, "--depth", depth, "-o", tmp_path / "out", "--residual", "none", "--no-render")
    result = run(*common, *options)
    assert (result.code, len(result.lines)) == (2, 1)
    assert " ".join(map(str, options)) in result.err
    assert "--no-render writes none" in result.err
    assert not (tmp_path / "out").exists()


def test_a_name_and_a_format_must_agree(tmp_path: Path, scene: Path) -> None:
    result = run("render", "-i", scene, "-o", tmp_path / "a.gif", "--format", "webm")
    assert (result.code, len(result.lines)) == (2, 1)
    assert "--format webm" in result.err
    assert run("render", "-i", scene, "-o", tmp_path / "out", "--format", "gif", "--frames", 2).code == 0
    assert os.listdir(tmp_path / "out") == ["scene.gif"]
