"""Camera paths through keyframes: the interpolation, and the files that hold them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import run
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box_before_wall

from spackle.camera import Camera
from spackle.camera_path import DepthRange, Keyframe, KeyframePath, PathError, interpolate, max_offset, view_matrix
from spackle.errors import InputError
from spackle.formats import load_path
from spackle.formats.camera_files import MAX_PATH_BYTES
from spackle.jobs.film import fly
from spackle.jobs.video_options import VideoOptions

CAMERA = Camera.from_focal(60, 64, 48)
DEPTHS = DepthRange(near=1.5, focus=4.0)
TARGET = (0.0, 0.0, 4.0)
KEYS = (
    Keyframe(0.0, (0.0, 0.0, 0.0), TARGET),
    Keyframe(0.5, (0.4, -0.1, 0.2), TARGET, fov=40.0),
    Keyframe(2.0, (-0.4, 0.0, 0.0), (0.1, 0.0, 3.0), up=(0.2, -1.0, 0.0)),
)


@st.composite
def samples(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Increasing times [K] and values [K, 2]."""
    steps = draw(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=7))
    count = len(steps) + 1
    values = draw(st.lists(st.tuples(*[st.floats(-100, 100)] * 2), min_size=count, max_size=count))
    return np.cumsum([0.0, *steps]), np.array(values)


@settings(deadline=None, max_examples=100)
@given(samples(), st.booleans())
def test_a_path_passes_through_its_keys_and_never_beyond_them(
    drawn: tuple[np.ndarray, np.ndarray], closed: bool
) -> None:
    times, values = drawn
    period = times[-1] + 1.7 if closed else None
    assert np.array_equal(interpolate(times, values, times, period), values)
    ends = [*times, period] if period else times
    around = np.concatenate([values, values[:1]]) if closed else values
    for k in range(len(ends) - 1):
        between = interpolate(times, values, np.linspace(ends[k], ends[k + 1], 9), period)
        low, high = np.minimum(around[k], around[k + 1]), np.maximum(around[k], around[k + 1])
        assert ((between >= low) & (between <= high)).all()
        assert (np.diff(between, axis=0) * (around[k + 1] - around[k]) >= -1e-9 * np.abs(around).max() ** 2).all()


@settings(deadline=None, max_examples=50)
@given(samples())
def test_a_path_has_no_kink(drawn: tuple[np.ndarray, np.ndarray]) -> None:
    times, values = drawn
    steepest = float(np.abs(np.diff(values, axis=0) / np.diff(times)[:, None]).max())
    for time in times[1:-1]:
        h = 1e-5 * float(np.diff(times).min())
        before, here, after = interpolate(times, values, np.array([time - h, time, time + h]))
        np.testing.assert_allclose((here - before) / h, (after - here) / h, atol=1e-3 * steepest + 1e-3)


def test_the_interpolation_is_the_monotone_cubic_of_the_textbooks() -> None:
    scipy = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(0)
    times, values = np.cumsum(rng.uniform(0.1, 2, 9)), rng.normal(size=(9, 3))
    wanted = np.linspace(times[1], times[-2], 200)  # at the very ends the textbooks differ
    np.testing.assert_allclose(
        interpolate(times, values, wanted), scipy.PchipInterpolator(times, values)(wanted), atol=1e-12
    )


@settings(deadline=None, max_examples=50)
@given(*[st.tuples(*[st.floats(-5, 5)] * 3)] * 3)
def test_a_view_looks_at_its_target_with_its_up_upwards(eye: Any, target: Any, up: Any) -> None:
    try:
        matrix = view_matrix(np.array(eye), np.array(target), np.array(up))
    except PathError:
        return
    rotation = matrix[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) > 0
    x, y, z = matrix[:3] @ [*target, 1]
    distance = math.dist(eye, target)
    assert (x, y, z) == pytest.approx((0, 0, distance), abs=1e-8 * max(1, distance))
    assert (rotation @ up)[0] == pytest.approx(0, abs=1e-8)
    assert (rotation @ up)[1] < 0  # y points down


def test_without_an_up_a_key_is_what_a_trajectory_would_look_like() -> None:
    eye, target = torch.tensor([0.3, -0.2, 0.1]), torch.tensor([0.0, 0.1, 4.0])
    path = KeyframePath((Keyframe(0, tuple(eye.tolist()), tuple(target.tolist())), KEYS[1]))
    view = path.cameras(CAMERA, 2, DEPTHS)[0]
    torch.testing.assert_close(view.world_to_camera, CAMERA.looking(eye, target).world_to_camera)
    assert torch.equal(view.K, CAMERA.K)


def test_frames_begin_and_end_at_the_keys_and_the_lens_zooms() -> None:
    path = KeyframePath(KEYS)
    views = path.cameras(CAMERA, 5, DEPTHS)  # at 0, 0.5, 1, 1.5, 2 s
    keys = path.key_cameras(CAMERA, DEPTHS)
    for index, key in ((0, 0), (1, 1), (4, 2)):
        assert torch.equal(views[index].world_to_camera, keys[key].world_to_camera)
        torch.testing.assert_close(views[index].position, torch.tensor(KEYS[key].eye), atol=1e-6, rtol=0)
    assert views[1].focal[0] == pytest.approx(32 / math.tan(math.radians(20)))
    assert views[4].focal[0] == pytest.approx(60)
    assert 60 < views[2].focal[0] < views[1].focal[0]
    assert (path.frame_count(30), path.seconds) == (61, 2)


def test_a_closed_path_comes_back_without_showing_the_first_view_twice() -> None:
    path = KeyframePath(KEYS, closed=True)
    assert path.seconds == 3  # two steps of 1 s in the mean, and one back
    assert path.frame_count(10) == 30
    views = path.cameras(CAMERA, 30, DEPTHS)
    eyes = torch.stack([view.position for view in views])
    jumps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert float(jumps[0]) < 2 * float(jumps.median())
    assert len({tuple(eye.tolist()) for eye in eyes}) == 30
    torch.testing.assert_close(path.at([3.0], CAMERA, DEPTHS)[0].position, eyes[0], atol=1e-6, rtol=0)


def test_disparity_as_the_unit_moves_the_eye_as_far_as_a_trajectory_goes() -> None:
    keys = (Keyframe(0, (0.3, 0.0, 0.0), (0.0, 0.0, 2.0)), Keyframe(1, (-0.3, 0.0, 0.0), (0.0, 0.0, 2.0)))
    view = KeyframePath(keys, unit="disparity").cameras(CAMERA, 2, DEPTHS)[0]
    assert float(view.position[0]) == pytest.approx(max_offset(CAMERA, 0.3, DEPTHS), abs=1e-6)


def test_what_happens_between_keys_is_looked_at_too() -> None:
    through = KeyframePath((Keyframe(0, (0, 0, 0), (0, 0, 2)), Keyframe(1, (0, 0, 4), (0, 0, 2))))
    with pytest.raises(PathError, match=r"at 0\.5 s.*coincide.*add a keyframe"):
        through.cameras(CAMERA, 3, DEPTHS)
    over = KeyframePath((Keyframe(0, (0, 0, 0), (0, 1, 1)), Keyframe(1, (0, 0, 0), (0, 1, -1))))
    with pytest.raises(PathError, match="up lies along the view"):
        over.cameras(CAMERA, 3, DEPTHS)
    slow = KeyframePath((KEYS[0], Keyframe(1e6, (1, 0, 0), TARGET)))
    with pytest.raises(PathError, match="--frames"):
        fly(box_before_wall().base(), CAMERA, slow, 0.3, None, VideoOptions())


# Files


def content(**changes: Any) -> dict[str, Any]:
    keys = [{"time": 0, "eye": [0, 0, 0], "target": [0, 0, 3]}, {"time": 1.5, "eye": [0.2, 0, 0], "target": [0, 0, 3]}]
    return {"keyframes": keys} | changes


def with_key(**changes: Any) -> dict[str, Any]:
    """A file whose second key is changed; None takes a name away."""
    made = content()
    key = made["keyframes"][1] | changes
    made["keyframes"][1] = {name: value for name, value in key.items() if value is not None}
    return made


def test_a_path_file_is_read(tmp_path: Path) -> None:
    file = tmp_path / "p.json"
    file.write_text(json.dumps(with_key(up=[0, -1, 0.1], fov=50) | {"closed": True, "unit": "disparity"}))
    path = load_path(file)
    assert path.keys == (
        Keyframe(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
        Keyframe(1.5, (0.2, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, -1.0, 0.1), 50.0),
    )
    assert (path.closed, path.unit) == (True, "disparity")


BAD: dict[str, tuple[Any, str]] = {
    "not JSON": ("{", "not JSON"),
    "deep": ("[" * 100_000, "not JSON"),
    "a list": ([], "needs a list"),
    "no list": ({"keyframes": {}}, "needs a list"),
    "no key": (content(keyframes=[]), "two keyframes, got 0"),
    "one key": (content(keyframes=content()["keyframes"][:1]), "two keyframes, got 1"),
    "too many": (content(keyframes=[0] * 10_001), "too many"),
    "unknown name": (content(loop=1), "unknown name 'loop'"),
    "closed 1": (content(closed=1), '"closed"'),
    "unit": (content(unit="feet"), '"unit"'),
    "unit list": (content(unit=[]), '"unit"'),
    "no object": (content(keyframes=[1, 2]), "keyframe 0: must be an object"),
    "NaN": (with_key(eye=[math.nan, 0, 0]), 'keyframe 1: "eye" must be a finite number'),
    "infinite time": (with_key(time=math.inf), 'keyframe 1: "time" must be a finite number'),
    "huge": (with_key(eye=[10**400, 0, 0]), 'keyframe 1: "eye"'),
    "a word": (with_key(eye=["left", 0, 0]), 'keyframe 1: "eye" must hold numbers, not "left"'),
    "true": (with_key(time=True), 'keyframe 1: "time" must hold numbers, not true'),
    "two numbers": (with_key(target=[0, 0]), '"target" must be a list of three'),
    "no eye": (with_key(eye=None), 'keyframe 1: must be an object with "time", "eye"'),
    "key name": (with_key(roll=3), "keyframe 1: unknown name 'roll'"),
    "zero look": (with_key(target=[0.2, 0, 0]), "keyframe 1: eye and target coincide"),
    "up along": (with_key(up=[0.2, 0, -3]), "keyframe 1: up lies along the view"),
    "no up": (with_key(up=[0, 0, 0]), "keyframe 1: up has no length"),
    "wide": (with_key(fov=179), "keyframe 1: fov must be from 1 to 170"),
    "fov 0": (with_key(fov=0), "keyframe 1: fov"),
    "same time": (with_key(time=0), "times must increase, by a microsecond at least: keyframe 1 is at 0 s"),
    "hardly later": (with_key(time=1e-300), "times must increase, by a microsecond"),
    "back in time": (with_key(time=-1), "times must increase"),
    "twice": ('{"keyframes": [], "keyframes": []}', "'keyframes' is there twice"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_path_file_is_refused_with_the_reason(tmp_path: Path, kind: str) -> None:
    made, reason = BAD[kind]
    file = tmp_path / "bad.json"
    file.write_text(made if isinstance(made, str) else json.dumps(made))
    with pytest.raises(InputError) as refusal:
        load_path(file)
    assert str(refusal.value).startswith(f"{file}: ")
    assert reason in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_far_too_long_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "long.json"
    with open(file, "wb") as sparse:
        sparse.truncate(1 << 30)
    assert MAX_PATH_BYTES < 1 << 30
    with pytest.raises(InputError, match="too long for a path file"):
        load_path(file)
    for name in ("missing.json", "."):
        with pytest.raises(InputError, match="path file"):
            load_path(tmp_path / name)


def test_the_command_line_refuses_before_anything_is_loaded(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.json", tmp_path / "bad.json"
    good.write_text(json.dumps(content()))
    bad.write_text(json.dumps(with_key(target=[0.2, 0, 0])))
    cases = (
        (("--path", bad), "bad.json: keyframe 1: eye and target coincide"),
        (("--path", good, "--trajectory", "swipe"), "--trajectory swipe"),
        (
            ("--path", good, "--disparity", 0.2),
            "a camera path of its own: leave --disparity 0.2 out",
        ),
        (("--path", good, "--cameras", bad), "--cameras"),
        (("--cameras", bad, "--disparity", 0.3), "gives the views themselves: leave --disparity 0.3 out"),
        (("--cameras", bad, "--trajectory", "rotate_forward"), "leave --trajectory rotate-forward out"),
        (("--cameras", bad, "--frames", 9), "leave --frames 9 out"),
        (("--path", tmp_path / "none.json"), "none.json: no such path file"),
    )
    for command in ("predict", "render"):
        for options, reason in cases:
            result = run(command, "-i", tmp_path / "nothing", "-o", tmp_path / "out", *options)
            assert (result.code, len(result.lines)) == (2, 1), result.err
            assert reason in result.err
    assert not (tmp_path / "out").exists()
