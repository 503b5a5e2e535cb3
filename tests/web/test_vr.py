"""VR with a headset that nobody wears: what its two eyes are shown, from where, and how it ends."""

from __future__ import annotations

import base64
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import ROOT
from helpers.browser import Opened, opened, pixels, settled
from helpers.scenes import box_before_wall, psnr
from helpers.web_client import served
from helpers.web_scenes import opened_scene
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.trajectories import disparity_to_offset, trajectory_cameras
from spackle.formats.html import page_scene, single_html
from spackle.pipeline import complete
from spackle.render import CpuRenderer
from spackle.scene import Scene
from spackle.web.work import SceneWork

HEADSET = ROOT / "tests" / "helpers" / "headset.js"
CPU = CpuRenderer()
EYE_SIZE = (96, 72)  # pixels of an eye's picture, as in headset.js
EYE_FOCAL_PX = 80.0
HALF_EYE_DISTANCE_M = 0.032
DISPARITY = 0.35  # up to which the scene is filled
START = (0.3, 1.6, -0.5)  # where the head is when VR begins, in metres, y up
START_YAW = 0.7  # radians to the left


@functools.cache
def box() -> Scene:
    """A small scene in metres, completed by initial Gaussians."""
    prediction = box_before_wall(width=64, height=48, focal=53).lift()
    depths = prediction.depth_range
    cameras = trajectory_cameras("swipe", prediction.camera.even(), DISPARITY, depths, 4)
    return complete(prediction, cameras, network=None)


@pytest.fixture(scope="module")
def shown(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    """The page of a file, in a browser with a headset; it must say nothing in the console."""
    scene = page_scene("Box", box().base, box().aux, box().camera, DISPARITY, is_metric=True)
    file = tmp_path_factory.mktemp("vr") / "box.html"
    file.write_bytes(single_html(scene))
    small = {"width": 240, "height": 180}
    found = opened(browser, file.as_uri(), script=HEADSET, viewport=small)
    settled(found.page, "spackle.ready")
    yield found
    assert found.said == []  # through all of the tests
    found.page.context.close()


@pytest.fixture
def page(shown: Opened) -> Iterator[Any]:
    """The page outside of VR, whose headset refuses nothing."""
    yield shown.page
    shown.page.evaluate("headset.session?.end()")
    shown.page.evaluate("Object.assign(headset, {layers: false, refuses: null})")


def begin_vr(page: Any) -> None:
    """Press the button, and wait until the headset asks for a picture."""
    page.locator("#vr").click()
    page.wait_for_function("headset.session?.waiting.size > 0", timeout=60_000)  # ms


def eyes(
    page: Any, moved: tuple[float, float, float] = (0, 0, 0), turned: float = 0
) -> tuple[Tensor, Tensor]:
    """What the left and the right eye see, [H, W, 3] sRGB.

    Args:
        page: the page in VR.
        moved: how far the head has moved since VR began, in metres to the right, up and back, as
            seen by a head that has not turned.
        turned: how far it has turned to the left since, in radians.
    """
    right, up, back = moved
    cos, sin = np.cos(START_YAW), np.sin(START_YAW)
    x = START[0] + right * cos + back * sin
    z = START[2] - right * sin + back * cos
    position = (x, START[1] + up, z)
    pose = {"position": position, "yaw": START_YAW + turned}
    seen = page.evaluate("async (pose) => { headset.pose = pose; return headset.see(); }", pose)
    rgba = np.frombuffer(base64.b64decode(seen["rgba"]), np.uint8)
    rgba = rgba.reshape(seen["height"], seen["width"], 4)
    rgb = torch.from_numpy(rgba[..., :3].copy()).float() / 255
    left_eye, right_eye = rgb.split(EYE_SIZE[0], dim=1)
    return left_eye, right_eye


def canvas(page: Any) -> Tensor:
    """What the page itself shows, [H, W, 3] sRGB."""
    page.mouse.move(0, 179)  # a button above it looks otherwise where a pointer is
    settled(page, "spackle.settled()")
    return pixels(page.locator("#view").screenshot())


def rendered(right: float, down: float = 0, forward: float = 0, turned: float = 0) -> Tensor:
    """What our renderer shows through an eye's lens at a place of the scene, [H, W, 3] sRGB.

    `turned` is the angle in radians by which the view is turned to the left.
    """
    camera = Camera.from_focal(EYE_FOCAL_PX, *EYE_SIZE)
    eye = torch.tensor([right, down, forward])
    ahead = torch.tensor([-np.sin(turned), 0.0, np.cos(turned)], dtype=torch.float32)
    return CPU.render(box().gaussians, camera.looking(eye, eye + ahead)).rgb


def range_m() -> float:
    """How far the photo's eye may go to the side, in metres."""
    return disparity_to_offset(box().camera, DISPARITY, box().depth_range)


def test_the_button_is_there_where_a_headset_is(page: Any) -> None:
    button = page.locator("#vr")
    button.wait_for()
    for there, state in (("false", "hidden"), ("true", "visible")):
        page.evaluate(f"headset.there = {there}")
        page.evaluate("navigator.xr.dispatchEvent(new Event('devicechange'))")
        button.wait_for(state=state)


def test_each_eye_sees_the_scene_from_its_own_place_in_the_pages_colours(page: Any) -> None:
    begin_vr(page)
    # The head's first place is the photo's eye, and where it looks first is the photo's view.
    left_eye, right_eye = eyes(page)
    assert psnr(left_eye, rendered(-HALF_EYE_DISTANCE_M)) > 45
    assert psnr(right_eye, rendered(HALF_EYE_DISTANCE_M)) > 45
    assert psnr(left_eye, rendered(HALF_EYE_DISTANCE_M)) < 30

    # What is near is farther to the right for the left eye.
    def column_of_box(picture: Tensor) -> float:
        reddish = (picture[..., 0] - picture[..., 2]).clamp(min=0).sum(dim=0)
        return float((reddish * torch.arange(EYE_SIZE[0])).sum() / reddish.sum())

    nearest = box().depth_range.near
    shift = EYE_FOCAL_PX * 2 * HALF_EYE_DISTANCE_M / nearest
    assert column_of_box(left_eye) - column_of_box(right_eye) == pytest.approx(shift, abs=0.5)


def test_the_head_stays_where_the_scene_was_filled(page: Any) -> None:
    begin_vr(page)
    eyes(page)
    farthest = range_m() - HALF_EYE_DISTANCE_M
    # Two metres to the right: the right eye stands at the end of what was filled.
    left_eye, right_eye = eyes(page, (2, 0, 0))
    assert psnr(right_eye, rendered(range_m())) > 45
    assert psnr(left_eye, rendered(farthest - HALF_EYE_DISTANCE_M)) > 45
    # Standing up, and stepping back, from where holes would open.
    left_eye, _ = eyes(page, (0, 2, 2))
    assert psnr(left_eye, rendered(-HALF_EYE_DISTANCE_M, down=-farthest)) > 45
    # Within the range the scene stands still, whichever way the head is turned.
    left_eye, _ = eyes(page, (0.1, -0.05, -0.03), turned=0.2)
    across = HALF_EYE_DISTANCE_M * np.array([np.cos(0.2), np.sin(0.2)])
    place = (0.1 - across[0], 0.05, 0.03 - across[1])
    assert psnr(left_eye, rendered(*place, turned=0.2)) > 45


@pytest.mark.slow
def test_a_scene_has_its_own_size_or_a_comfortable_one(page: Any) -> None:
    orbit, nearest = page.evaluate("spackle.description.orbit"), box().depth_range.near
    begin_vr(page)
    # Of unknown size: the nearest thing is a metre away, so that a metre is `nearest` on the page.
    page.evaluate("spackle.description.isMetric = false")
    assert psnr(eyes(page)[0], rendered(-HALF_EYE_DISTANCE_M * nearest)) > 45
    # In metres, but shown in another unit of length.
    page.evaluate("Object.assign(spackle.description, {isMetric: true, lengthFactor: 1.5})")
    assert psnr(eyes(page)[0], rendered(-HALF_EYE_DISTANCE_M * 1.5)) > 45
    # Filled for 5 cm to each side only: 10 cm stand for them.
    page.evaluate("spackle.description.lengthFactor = 1")
    page.evaluate("spackle.description.orbit.limit = 0.05 / spackle.description.orbit.unit")
    assert psnr(eyes(page)[0], rendered(-HALF_EYE_DISTANCE_M / 2)) > 45
    page.evaluate("(limit) => (spackle.description.orbit.limit = limit)", orbit["limit"])


@pytest.mark.slow
def test_leaving_returns_to_the_page_as_it_was(page: Any) -> None:
    page.evaluate("Promise.all([spackle.setView('swipe', 0.2, 1), spackle.setHeat(true)])")
    size = "[document.getElementById('view').width, document.getElementById('view').height]"
    state = f"[spackle.pose(), {size}]"
    before, picture_before = page.evaluate(state), canvas(page)
    begin_vr(page)
    assert page.locator("#vr").get_attribute("aria-pressed") == "true"
    eyes(page, (0.5, 0, 0))
    page.set_viewport_size({"width": 300, "height": 180})  # somebody else is at the page
    page.set_viewport_size({"width": 240, "height": 180})
    page.locator("#vr").click()
    assert page.evaluate("headset.session") is None
    assert page.locator("#vr").get_attribute("aria-pressed") == "false"
    assert page.evaluate(state) == before
    assert psnr(canvas(page), picture_before) > 45

    # A press on the headset's own button ends it in the same way, and motion goes on.
    page.locator("#corner").click()
    page.locator("#play").click()
    page.locator("#corner").click()
    begin_vr(page)
    assert "on" not in page.locator("#play").get_attribute("class").split()
    page.evaluate("headset.session.end()")
    assert "on" in page.locator("#play").get_attribute("class").split()
    page.evaluate("spackle.setHeat(false), spackle.setView('swipe', 0.2, 1)")  # for the next test


@pytest.mark.slow
def test_a_headset_that_takes_layers_gets_them(page: Any) -> None:
    # three.js makes layers of the canvas's attributes, and refuses a canvas without depth.
    page.evaluate("headset.layers = true")
    begin_vr(page)
    assert psnr(eyes(page)[0], rendered(-HALF_EYE_DISTANCE_M)) > 45


def test_a_session_that_does_not_start_is_told_in_plain_words(shown: Opened, page: Any) -> None:
    page.evaluate("headset.refuses = 'NotAllowedError'")
    page.locator("#vr").click()
    toast = page.locator("#toast.shown")
    toast.get_by_text("VR did not start: the browser did not allow it.").wait_for()
    (line,) = shown.said  # by Spark, for developers
    assert line.startswith("Error requesting XR session")
    shown.said.clear()
    # A session that begins and gives no picture is ended, and the page is as before.
    size = "[document.getElementById('view').width, document.getElementById('view').height]"
    before = page.evaluate(size)
    page.evaluate("headset.refuses = 'picture'")
    page.locator("#vr").click()
    toast.get_by_text("VR did not start: the headset takes no picture of this page.").wait_for()
    assert page.evaluate("headset.session") is None
    assert page.evaluate(size) == before
    shown.said.clear()


@pytest.mark.slow
def test_the_page_of_a_server_has_vr_in_its_bar(browser: Any, tmp_path: Path) -> None:
    scene = tmp_path / "scene.ply"
    box().export(scene)
    with served(tmp_path / "scenes", work=SceneWork()) as server:
        address = f"http://127.0.0.1:{server.port}{server.root}/#{opened_scene(server, scene)}"
        found = opened(browser, address, script=HEADSET)
        settled(found.page, "spackle.ready")
        assert found.page.locator("#bar #vr").is_visible()
        begin_vr(found.page)
        assert psnr(eyes(found.page)[0], rendered(-HALF_EYE_DISTANCE_M)) > 45
        assert found.said == []
        found.page.context.close()
