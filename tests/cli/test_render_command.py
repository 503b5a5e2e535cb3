"""`spackle render`: a saved scene to a video, and scenes that are none."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command import SHORT, Run, decode, names_in, refuses, run, shortened
from photos import (
    HEIGHT,
    WIDTH,
    box,
    camera_file,
    damaged_scene,
)


def test_render_draws_a_saved_scene(tmp_path: Path, scene: Path, plain: tuple[Path, Run]) -> None:
    result = run("render", "-i", scene, "-o", tmp_path / "new" / "a.mp4", *SHORT)
    assert (result.code, len(result.lines)) == (0, 1)
    assert run("render", "-i", scene, "-o", tmp_path / "folder", *SHORT).code == 0
    assert names_in(tmp_path / "folder") == {"scene.mp4"}
    ours, predicted = decode(tmp_path / "new" / "a.mp4"), decode(plain[0] / "video.mp4")
    assert len(ours) == len(predicted) == 3
    assert (ours[0].width, ours[0].height, ours[0].format.name) == (WIDTH, HEIGHT, "yuv420p")
    first = [frames[0].to_ndarray(format="rgb24").astype(float) for frames in (ours, predicted)]
    assert np.abs(first[0] - first[1]).mean() < 1  # the path starts at the photo's place
    far = run(
        "render", scene, "-o", tmp_path / "far.mp4", "--trajectory", "swipe", "--disparity", 1.5, "--json", *SHORT
    )
    assert "the scene was completed for --disparity 0.3" in far.err
    assert json.loads(far.out)["open"] > 0.01


def test_render_at_another_size_squeezes_nothing(tmp_path: Path, scene: Path) -> None:
    for size in ("128x96", "128x64", "31x31"):
        arguments = ("--size", size, "--disparity", 0, "--frames", 1)
        assert run("render", "-i", scene, "-o", tmp_path / "a.mp4", *arguments).code == 0
        width, height = map(int, size.split("x"))
        frame = decode(tmp_path / "a.mp4")[0]
        assert (frame.width, frame.height) == (width + width % 2, height + height % 2)
        rgb = frame.to_ndarray(format="rgb24")[:height, :width].astype(float)
        red = rgb[..., 0] > rgb[..., 2]
        scale = max(width / WIDTH, height / HEIGHT)
        for axis in (0, 1):
            assert red.any(axis=axis).sum() == pytest.approx(scale * box().any(axis=axis).sum(), abs=5)


def test_render_given_views(tmp_path: Path, scene: Path) -> None:
    views = camera_file(tmp_path / "views.json", rights=[0.0, 0.3], sizes=[(64, 48), (32, 24)])
    result = run("render", "-i", scene, "-o", tmp_path / "out", "--cameras", views)
    assert result.code == 0
    assert names_in(tmp_path / "out") == {"0000.png", "0001.png"}
    assert "no video" in result.lines[0]
    views = camera_file(tmp_path / "views.json", rights=[0.0, 0.3])
    assert run("render", "-i", scene, "-o", tmp_path / "out", "--cameras", views).code == 0
    assert names_in(tmp_path / "out") == {"0000.png", "0001.png", "scene.mp4"}


def test_render_says_where_it_guesses_the_lens(tmp_path: Path, scene: Path) -> None:
    bare = damaged_scene(scene, tmp_path / "bare.ply", lambda head: re.sub("comment.*\n", "", head))
    result = run("render", "-i", bare, "-o", tmp_path, "--size", "64x48", *SHORT)
    assert result.code == 0
    assert "no camera stored" in result.lines[0]
    assert len(run("render", "-i", bare, "-o", tmp_path, "--size", "64x48", "--focal-px", 55, *SHORT).lines) == 1


def mirrored(body: bytes) -> bytes:
    """The scene behind the camera."""
    table = np.frombuffer(body, "<f4").reshape(-1, 17).copy()
    table[:, 2] *= -1
    return table.tobytes()


@pytest.mark.parametrize(
    ("header", "data"),
    [
        pytest.param(lambda head: head, lambda body: body[:-1], id="cut off"),
        pytest.param(lambda head: head, mirrored, id="all behind the camera"),
        pytest.param(lambda head: head.replace("spackle_camera", "spackle_camera 1"), lambda body: body, id="camera"),
        pytest.param(lambda head: "\x00" + head, lambda body: body, id="no scene"),
    ],
)
def test_bad_scenes(tmp_path: Path, scene: Path, header: Callable[[str], str], data: Callable[[bytes], bytes]) -> None:
    path = damaged_scene(scene, tmp_path / "bad.ply", header, data)
    for file in (path, tmp_path / "missing.ply"):
        refuses(run("render", "-i", file, "-o", tmp_path / "out", *SHORT), file)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options",
    [
        ("--size", "0x0"),
        ("--focal-px", "inf"),
        ("--disparity", "3"),
        ("--cameras", "nowhere.json"),
        ("--focal-px", "9", "--cameras", "nowhere.json"),
    ],
    ids=" ".join,
)
def test_bad_render_options(tmp_path: Path, scene: Path, options: tuple[str, ...]) -> None:
    named = options[1] if options[0] == "--cameras" else options[0]
    refuses(run("render", "-i", scene, "-o", tmp_path / "out", *shortened(options)), named)
    refuses(run("render", "-i", scene, "-o", tmp_path / "film.avi", *SHORT), "film.avi: not a kind of video")
    assert names_in(tmp_path) == set()
