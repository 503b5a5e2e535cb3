"""Two eyes and their frame, and depth as colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box_before_wall

from spackle.camera import Camera
from spackle.camera_path import DepthRange
from spackle.color import INFERNO, UNKNOWN_GREY, DepthColors, linear_to_srgb, srgb_to_linear
from spackle.render import CpuRenderer
from spackle.stereo import DUBOIS_LEFT, DUBOIS_RIGHT, LAYOUTS, Stereo, anaglyph, default_ipd
from spackle.views import FrameMaker, VideoOptions, scene_path

CPU = CpuRenderer()
CAMERA = Camera.from_focal(60, 64, 48)


def parallax(stereo: Stereo, camera: Camera, point: Sequence[float]) -> tuple[float, float]:
    """How far to the right, and below, the left eye sees a point of where the right eye does, in pixels."""
    (left, _), (right, _) = (eye.project(torch.tensor(point)) for eye in stereo.eyes(camera))
    across, down = (left - right).tolist()
    return across, down


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
    near, far = (parallax(stereo, CAMERA, [x, y, factor * convergence])[0] for factor in (0.5, 2))
    assert near > 0 > far


def test_eyes_stand_beside_a_view_that_is_turned() -> None:
    camera = CAMERA.looking(torch.tensor([1.0, 0.5, 0.0]), torch.tensor([0.0, 0.0, 4.0]))
    left, right = Stereo("sbs", 0.2, float("inf")).eyes(camera)
    torch.testing.assert_close((left.position + right.position) / 2, camera.position)
    torch.testing.assert_close(right.position - left.position, 0.2 * camera.world_to_camera[0, :3])
    assert torch.equal(left.K, camera.K)  # parallel axes


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
    assert torch.equal(sbs, torch.cat([left, right], dim=1))
    assert torch.equal(ou, torch.cat([left, right], dim=0))
    half, low = Stereo("sbs-half", 0.06, 2.0).pack(left, right), Stereo("ou-half", 0.06, 2.0).pack(left, right)
    one, other = srgb_to_linear(left), srgb_to_linear(right)
    torch.testing.assert_close(half[:, 32:], linear_to_srgb((other[:, ::2] + other[:, 1::2]) / 2))
    torch.testing.assert_close(low[:24], linear_to_srgb((one[::2] + one[1::2]) / 2))


def test_an_anaglyph_of_grey_is_grey_and_each_eye_has_its_glass() -> None:
    grey = torch.linspace(0, 1, 64).repeat(3, 1).T
    torch.testing.assert_close(anaglyph(grey, grey), grey, atol=0.004, rtol=0)
    assert torch.tensor(DUBOIS_LEFT).sum(1) + torch.tensor(DUBOIS_RIGHT).sum(1) == pytest.approx([1, 1, 1], abs=0.0011)
    white, black = torch.ones(1, 3), torch.zeros(1, 3)
    assert anaglyph(white, black)[0].tolist() == pytest.approx([1, 0, 0], abs=1e-6)
    cyan = anaglyph(black, white)[0]
    assert cyan[0] == 0
    assert float(cyan[1:].min()) > 0.99


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
    path = scene_path(base, scene.camera, "rotate-forward", 0.3, 5)
    scale = DepthColors.over(base, path)
    assert (scale.near, scale.far) == pytest.approx((2.0, 6.0), rel=0.25)
    film = FrameMaker.of(VideoOptions(show="depth"), base, path, Path("x"))
    for camera in path:
        frame = film.frame([CPU.render(base, camera)])
        box, corner = frame[36, 48].sum(), frame[2, 48].sum()
        assert float(box) > float(corner) + 1
    with pytest.raises(ValueError, match="in view"):
        DepthColors.over(base, [CAMERA.looking(torch.zeros(3), torch.tensor([0.0, 0.0, -1.0]))])
