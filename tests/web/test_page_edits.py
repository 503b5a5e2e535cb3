"""The page in a real browser changes a scene: holes are filled, a painted thing is taken out."""

from __future__ import annotations

import base64
import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import Opened, opened, pixels, settled
from helpers.endless_edits import EndlessEdits
from helpers.photos import read_ply
from helpers.scenes import box_before_wall, psnr, wall
from helpers.web_client import Served, served
from helpers.web_scenes import ball_and_wall, opened_scene, scene_file
from torch import Tensor

from spackle.formats import load_ply, save_ply
from spackle.formats.camera_files import camera_from_json
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio
from spackle.web.guard import MAX_UPLOAD_BYTES
from spackle.web.work import SceneWork

CPU = CpuRenderer()
WINDOW = {"viewport": {"width": 800, "height": 520}}
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("scenes")
    with served(folder, work=SceneWork(), max_bytes=MAX_UPLOAD_BYTES) as server:
        yield server


@contextlib.contextmanager
def scene_on_page(browser: Any, server: Served, file: Path, screen: Any) -> Iterator[Opened]:
    """A page of a scene; nothing may be said on its console."""
    id = opened_scene(server, file)
    address = f"http://127.0.0.1:{server.port}{server.root}/#{id}"
    found = opened(browser, address, **screen)
    settled(found.page, "spackle.ready")
    unfold(found.page)
    yield found
    assert found.said == []
    found.page.context.close()


def unfold(page: Any) -> None:
    """Show all controls, some of which a small screen may hide."""
    if not page.locator("#rest").is_visible():
        page.locator("#more").click()


def seen(page: Any) -> Tensor:
    """The picture [H, W, 3] on the page."""
    settled(page, "spackle.settled()")
    return pixels(page.locator("#view").screenshot())


def changed(page: Any, button: str, id: str) -> str:
    """The id of the scene on the page when a button has replaced that of `id`."""
    page.locator(button).click()
    page.wait_for_function("(id) => location.hash !== `#${id}`", arg=id)
    page.wait_for_selector("#notice", state="hidden")
    new: str = page.evaluate("spackle.id")
    assert page.evaluate("location.hash") == f"#{new}"
    page.locator("#fill:enabled").wait_for(state="attached")
    return new


def hole_ratio(page: Any, server: Served) -> float:
    """The share of holes in the present view, by the server's scene and our renderer."""
    camera = camera_from_json(page.evaluate("spackle.camera()"), "camera")
    gaussians = load_ply(scene_file(server, page.evaluate("spackle.id")))
    return float(hole_area_ratio(CPU.render(gaussians, camera).alpha))


def test_what_a_person_sees_is_filled_and_undone(
    browser: Any, server: Served, tmp_path: Path
) -> None:
    box = box_before_wall(width=64, height=48, focal=53)
    save_ply(box.base(), tmp_path / "box.ply", camera=box.camera)
    with scene_on_page(browser, server, tmp_path / "box.ply", WINDOW) as found:
        page = found.page
        first: str = page.evaluate("spackle.id")
        # The camera that the server gets is the one of the picture.
        page.evaluate("spackle.setView('swipe', 0.3, 1)")
        camera = camera_from_json(page.evaluate("spackle.camera()"), "camera").resized(256, 192)
        url: str = page.evaluate("spackle.picture(256, 192)")
        drawn = pixels(base64.b64decode(url.partition(",")[2]))
        assert psnr(drawn, CPU.render(box.base(), camera).rgb) > 45
        for t in (0.0, 0.3, 0.6, 1.0, 0.9):  # a person looks around
            page.evaluate("(t) => spackle.setView('swipe', 0.5, t)", t)
        assert 5 <= len(page.evaluate("spackle.seen()")) <= 12
        assert hole_ratio(page, server) > 0.05
        before, pose = seen(page), page.evaluate("spackle.pose()")

        second = changed(page, "#fill", first)
        assert page.evaluate("spackle.pose()") == pose
        assert hole_ratio(page, server) < 0.002
        after = seen(page)
        assert float(((after - before).abs().amax(dim=-1) > 0.2).float().mean()) > 0.05
        for t in (0.0, 0.3, 1.0):
            page.evaluate("(t) => spackle.setView('swipe', 0.5, t)", t)
            assert hole_ratio(page, server) < 0.002
        page.evaluate("spackle.setView('swipe', 0.5, 0.9)")
        rows = read_ply(scene_file(server, second)).body
        assert rows.startswith(read_ply(scene_file(server, first)).body)

        assert changed(page, "#undo", second) == first
        assert psnr(seen(page), before) > 45
        page.locator("#view").press("Control+Shift+Z")
        page.wait_for_function("(id) => location.hash === `#${id}`", arg=second)
        assert psnr(seen(page), after) > 45


def paint(page: Any, radius: float) -> None:
    """Paint a disc in the picture's middle, with a brush that reaches beyond it by 0.075 of the
    picture's width; `radius` is a share of this width.
    """
    box = page.locator("#mask").bounding_box()
    x, y, r = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, radius * box["width"]
    page.locator("#brush-size").fill("20")
    page.mouse.move(x, y)
    page.mouse.down()
    for k in range(25):
        angle = 2 * math.pi * k / 12
        share = min(k / 12, 1)  # a turn outwards, and then a whole circle
        page.mouse.move(x + share * r * math.cos(angle), y + share * r * math.sin(angle))
    page.mouse.up()


@pytest.mark.parametrize(
    "screen",
    [
        pytest.param(WINDOW, id="window"),
        pytest.param(PHONE, id="phone", marks=pytest.mark.slow),
    ],
)
def test_a_painted_thing_is_taken_out_and_put_back(
    browser: Any, server: Served, tmp_path: Path, screen: Any
) -> None:
    ball, file = ball_and_wall(tmp_path)
    with scene_on_page(browser, server, file, screen) as found:
        page = found.page
        first: str = page.evaluate("spackle.id")
        page.evaluate("spackle.setView('swipe', 0, 0)")
        before = seen(page)
        page.locator("#remove").click()
        assert not page.locator("#brush-go").is_enabled()
        paint(page, 0.095)
        page.keyboard.press("Control+z")  # the stroke
        assert not page.locator("#brush-go").is_enabled()
        paint(page, 0.095)
        page.keyboard.press("Escape")  # leaves all as it is
        assert not page.locator("#mask").is_visible()
        page.locator("#remove").click()
        size = page.locator("#brush-size").input_value()
        page.locator("#mask").hover()
        page.mouse.wheel(0, -100)
        page.wait_for_function(f"document.getElementById('brush-size').value > {size}")
        paint(page, 0.095)
        inside = page.locator("#brush-go").bounding_box()
        assert inside["x"] >= 0
        assert inside["x"] + inside["width"] <= screen["viewport"]["width"]

        second = changed(page, "#brush-go", first)
        after = seen(page)
        height, width = after.shape[:2]
        middle = slice(height // 2 - 9, height // 2 + 9), slice(width // 2 - 9, width // 2 + 9)
        assert float(before[middle][..., 0].mean()) > 0.6  # the red ball
        red, _, blue = after[middle].mean(dim=(0, 1)).tolist()
        assert blue > red + 0.2  # the blue wall
        assert hole_ratio(page, server) < 0.002
        # The edit alone can be saved, and the edit with its patch.
        for value, name in (("removed.ply", "room-without-patch.ply"), (".ply", "room.ply")):
            with page.expect_download() as download:
                page.locator("#download").select_option(value)
            assert download.value.suggested_filename == name
            download.value.save_as(tmp_path / "saved" / name)
        alone, patched = (
            read_ply(tmp_path / "saved" / name) for name in ("room-without-patch.ply", "room.ply")
        )
        assert patched.body.startswith(alone.body)
        originals = rows_of(scene_file(server, first))
        assert rows_of(tmp_path / "saved" / "room-without-patch.ply") <= originals
        assert len(originals) - alone.count == pytest.approx(len(ball.thing), rel=0.05)

        assert changed(page, "#undo", second) == first
        assert psnr(seen(page), before) > 45
        # What can be done again outlives the page.
        page.reload()
        settled(page, "spackle.ready")
        unfold(page)
        assert changed(page, "#redo", first) == second
        page.evaluate("spackle.setView('swipe', 0, 0)")
        assert psnr(seen(page), after) > 45


def rows_of(file: Path) -> set[bytes]:
    ply = read_ply(file)
    return {row.tobytes() for row in np.frombuffer(ply.body, np.uint8).reshape(ply.count, -1)}


def test_where_nothing_is_open_nothing_is_made(
    browser: Any, server: Served, tmp_path: Path
) -> None:
    flat = wall(width=64, height=48)
    save_ply(flat.base(), tmp_path / "wall.ply", camera=flat.camera)
    with scene_on_page(browser, server, tmp_path / "wall.ply", WINDOW) as found:
        page = found.page
        page.locator("#reset").click()
        page.evaluate("spackle.forget()")
        first, jobs = page.evaluate("spackle.id"), set(server.jobs.by_id)
        page.locator("#fill").click()
        page.get_by_text("There is no hole in what you have looked at").wait_for()
        assert page.evaluate("spackle.id") == first
        assert set(server.jobs.by_id) == jobs


def test_work_can_be_stopped_and_nothing_changes(browser: Any, tmp_path: Path) -> None:
    _, file = ball_and_wall(tmp_path)
    with (
        served(tmp_path / "scenes", work=EndlessEdits(), max_bytes=MAX_UPLOAD_BYTES) as server,
        scene_on_page(browser, server, file, WINDOW) as found,
    ):
        page = found.page
        first = page.evaluate("spackle.id")
        page.locator("#fill").click()
        page.get_by_role("heading", name="Filling the holes that you have seen").wait_for()
        page.locator("#notice progress[value='0.25']").wait_for()
        assert not page.locator("#remove").is_enabled()
        page.locator("#stop").click()
        page.get_by_text("Stopped. Nothing has changed.").wait_for()
        assert page.evaluate("spackle.id") == first
        assert page.locator("#fill").is_enabled()
        assert [job.id for job in server.jobs.by_id.values()] == [first]
