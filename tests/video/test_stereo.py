"""Stereo views and their frames, and depth as colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from helpers.scenes import box_before_wall
from hypothesis import given, settings
from hypothesis import strategies as st

from spackle.core.camera import Camera
from spackle.core.color import (
    INFERNO_COLORS,
    UNKNOWN_DEPTH_GREY,
    DepthColorScale,
    linear_to_srgb,
    srgb_to_linear,
)
from spackle.core.trajectories import DepthRange, trajectory_cameras
from spackle.render import CpuRenderer
from spackle.video.frames import FrameMaker
from spackle.video.options import VideoOptions
from spackle.video.stereo import Stereo, anaglyph, default_ipd

CAMERA = Camera.from_focal(60, 64, 48)


def parallax(stereo: Stereo, camera: Camera, point: Sequence[float]) -> list[float]:
    """A point's pixel in the left eye's image minus that in the right eye's image."""
    (left, _), (right, _) = (eye.project(torch.tensor(point)) for eye in stereo.eyes(camera))
    return (left - right).tolist()


@settings(deadline=None, max_examples=50)
@given(st.floats(0.01, 0.5), st.floats(1, 20), st.floats(-1, 1), st.floats(-1, 1))
def test_parallax_changes_its_sign_at_the_screen(
    ipd: float, convergence: float, x: float, y: float
) -> None:
    stereo = Stereo("sbs", ipd, convergence)
    for part, expected in (
        (1, 0),
        (0.5, 60 * ipd / convergence),
        (2, -60 * ipd / (2 * convergence)),
    ):
        z = part * convergence
        assert parallax(stereo, CAMERA, [x * z, y * z, z]) == pytest.approx([expected, 0], abs=1e-3)


def test_the_default_distance_of_the_eyes_gives_a_parallax_of_3_percent() -> None:
    depths = DepthRange(near=1.8, focus=2.5)
    stereo = Stereo("sbs", default_ipd(CAMERA, depths), depths.focus)
    span = (
        parallax(stereo, CAMERA, [0, 0, depths.near])[0] - parallax(stereo, CAMERA, [0, 0, 1e6])[0]
    )
    assert span == pytest.approx(0.03 * 64, abs=1e-3)


@pytest.mark.parametrize("layout", ["sbs", "sbs-half", "ou", "ou-half", "anaglyph"])
@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 65)])
def test_frame_size_and_layout(layout: str, height: int, width: int) -> None:
    stereo, eyes = Stereo(layout, 0.06, 2.0), torch.rand(2, height, width, 3)  # type: ignore[arg-type]
    frame = stereo.pack(*eyes)
    assert (frame.shape[1], frame.shape[0]) == stereo.frame_size(width, height)
    left, right = srgb_to_linear(eyes)
    if layout in ("sbs", "ou"):
        assert torch.equal(frame, torch.cat(list(eyes), dim=1 if layout == "sbs" else 0))
    elif (layout, width) == ("sbs-half", 64):
        torch.testing.assert_close(
            frame[:, 32:], linear_to_srgb((right[:, ::2] + right[:, 1::2]) / 2)
        )
    elif (layout, width) == ("ou-half", 64):
        torch.testing.assert_close(frame[:24], linear_to_srgb((left[::2] + left[1::2]) / 2))


def test_an_anaglyph_of_grey_is_grey_and_each_eye_has_its_filter() -> None:
    grey = torch.linspace(0, 1, 64).repeat(3, 1).T
    torch.testing.assert_close(anaglyph(grey, grey), grey, atol=0.004, rtol=0)
    white = torch.ones(1, 3)
    black = torch.zeros(1, 3)
    assert anaglyph(white, black)[0].tolist() == pytest.approx([1, 0, 0], abs=1e-6)
    cyan = anaglyph(black, white)[0]
    assert (float(cyan[0]), float(cyan[1:].min()) > 0.99) == (0, True)


def test_depth_colours_are_linear_in_inverse_depth() -> None:
    colors = DepthColorScale(near=1.0, far=5.0)
    shown = colors(1 / torch.linspace(1 / 5, 1, 17)[None], torch.ones(1, 17, dtype=torch.bool))[0]
    torch.testing.assert_close(shown, torch.tensor(INFERNO_COLORS), atol=1e-4, rtol=0)
    assert bool(((shown @ torch.tensor([0.2126, 0.7152, 0.0722])).diff() > 0).all())
    odd = colors(torch.tensor([[0.0, 0.5, 50.0]]), torch.tensor([[False, True, True]]))[0]
    assert odd[0].tolist() == [UNKNOWN_DEPTH_GREY] * 3
    torch.testing.assert_close(odd[1:], torch.tensor([INFERNO_COLORS[-1], INFERNO_COLORS[0]]))


def test_depth_colours_of_a_video_share_one_scale() -> None:
    scene = box_before_wall(near=2.0, far=6.0)
    base = scene.base()
    path = trajectory_cameras(
        "rotate-forward", scene.camera, 0.3, DepthRange.of(base, is_metric=True), 5
    )
    scale = DepthColorScale.over(base, path)
    assert (scale.near, scale.far) == pytest.approx((2.0, 6.0), rel=0.25)
    film = FrameMaker.of(VideoOptions(show="depth"), base, path, Path("x"))
    for camera in path:
        frame = film.frame([CpuRenderer().render(base, camera)])
        assert float(frame[36, 48].sum()) > float(frame[2, 48].sum()) + 1  # the box, and a corner
    with pytest.raises(ValueError, match="in view"):
        DepthColorScale.over(base, [CAMERA.looking(torch.zeros(3), torch.tensor([0.0, 0.0, -1.0]))])
