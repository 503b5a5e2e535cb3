"""The page in a real browser: views, controls, and no requests to other hosts."""

from __future__ import annotations

import base64
import dataclasses
import functools
import hashlib
import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import ROOT
from helpers.browser import Opened, drag_moves_the_eye, opened, pixels, settled
from helpers.photos import metres, write_depth, write_pair
from helpers.scenes import box_before_wall, psnr, random_harmonics
from helpers.web_client import eventually, served
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    SHARP_TRAJECTORIES,
    TrajectoryKind,
    trajectory_cameras,
)
from spackle.formats import load_ply
from spackle.formats.html import PageScene, page_scene, read_page_file, single_html
from spackle.pipeline import complete
from spackle.render import CpuRenderer
from spackle.runtime.errors import InputError
from spackle.scene import Scene
from spackle.views import PathOptions
from spackle.web.guard import MAX_UPLOAD_BYTES
from spackle.web.work import SceneWork

WEB = ROOT / "web"
CPU = CpuRenderer()
VIEW = ("swipe", 0.3, 1.0)  # far to the right, where there are holes


@functools.cache
def box() -> Scene:
    """A small scene, completed by initial Gaussians."""
    prediction = box_before_wall(width=64, height=48, focal=53).lift()
    depths = prediction.depth_range
    return complete(
        prediction,
        trajectory_cameras("swipe", prediction.camera.even(), 0.35, depths, 4),
        network=None,
    )


@functools.cache
def page_of_box(name: str = "Box") -> PageScene:
    return page_scene(name, box().base, box().aux, box().camera, 0.35, is_metric=box().is_metric)


def test_the_page_looks_where_the_video_of_a_swipe_looks() -> None:
    scene = dataclasses.replace(box(), disparity=0.35)
    usual = scene.depth_range.focus
    framing = PathOptions(trajectory="swipe").choose_framing(
        scene.base, scene.camera, scene.depth_range, 0.35, CPU
    )
    assert framing.focus > usual  # else the test would show nothing
    page = scene.page("Box").description
    assert page["focus"] == framing.focus
    wanted = scene.camera.zoomed(1 + max(framing.overscan, DEFAULT_OVERSCAN))
    lens: Any = page["camera"]
    assert lens["K"] == wanted.K.tolist()
    # What is edited later keeps its framing, and a scene of another program has none.
    former = {**page, "focus": 1.25}
    assert scene.page("Box", viewed_as=former).description["focus"] == 1.25
    assert box().page("Box").description["focus"] == usual


@pytest.mark.parametrize("disparity", [None, 0.35])
def test_a_scene_behind_the_camera_is_refused_by_its_name(disparity: float | None) -> None:
    means = box().base.means * torch.tensor([1.0, 1.0, -1.0])
    base = dataclasses.replace(box().base, means=means)
    behind = dataclasses.replace(box(), base=base, disparity=disparity)
    with pytest.raises(InputError, match=r"^Box: no Gaussian lies in front .* shown$"):
        behind.page("Box")


def test_the_built_page_belongs_to_its_sources() -> None:
    if not WEB.is_dir():
        pytest.skip("web/ is not here: this is no checkout")
    sources = [
        *(WEB / name for name in ("build.mjs", "package-lock.json", "package.json")),
        *(WEB / "src").iterdir(),
    ]
    digest = hashlib.sha256()
    for path in sorted(sources, key=lambda path: path.relative_to(WEB).as_posix()):
        digest.update(f"{path.relative_to(WEB).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    assert digest.hexdigest() in read_page_file("viewer.js")[:200].decode(), "run `make viewer`"
    assert "http" not in (WEB / "package-lock.json").read_text(encoding="utf-8")
    wanted = json.loads((WEB / "package.json").read_text(encoding="utf-8"))["devDependencies"]
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", version) for version in wanted.values())
    for package, name in itertools.product(
        ("three", "@sparkjsdev/spark", "fflate"), ("licenses.txt", "viewer.js")
    ):
        assert f"\n{package} " in read_page_file(name)[:8000].decode()


@pytest.fixture(scope="module")
def shown(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    """The single file, opened from the disk."""
    file = tmp_path_factory.mktemp("page") / "box.html"
    file.write_bytes(single_html(page_of_box()))
    found = opened(browser, file.as_uri())
    settled(found.page, "spackle.ready")
    found.page.locator("#corner").click()  # the controls
    yield found
    assert found.said == []  # through all of the tests
    found.page.context.close()


@pytest.fixture
def page(shown: Opened) -> Any:
    """The page in its first state."""
    first = "spackle.setCompare(null), spackle.setHeat(false), "
    first += "spackle.setLayers('both'), spackle.setView(...view)"
    shown.page.evaluate(f"(view) => Promise.all([{first}])", list(VIEW))
    return shown.page


def picture(page: Any, width: int, height: int) -> Tensor:
    url: str = page.evaluate("([width, height]) => spackle.picture(width, height)", [width, height])
    return pixels(base64.b64decode(url.partition(",")[2]))


def canvas(page: Any) -> Tensor:
    """A screenshot of the canvas."""
    settled(page, "spackle.settled()")
    return pixels(page.locator("#view").screenshot())


def camera_of(page: Any, width: int, height: int) -> Camera:
    """A camera of Spackle at the position of the page's camera."""
    eye = torch.tensor(page.evaluate("spackle.pose().eye"))
    focus = torch.tensor([0.0, 0.0, box().depth_range.focus])
    return box().camera.resized(width, height).zoomed(1 + DEFAULT_OVERSCAN).looking(eye, focus)


def hole_and_rest(page: Any, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Two masks [H, W]: pixels inside the base's hole, and pixels outside, both without edges
    and rounded corners.
    """
    alpha = CPU.render(box().base, camera_of(page, width, height)).alpha[None, None]

    def pool(image: Tensor) -> Tensor:
        """[H, W]: the greatest value of each pixel's 9×9 neighbours."""
        return torch.nn.functional.max_pool2d(image, 9, 1, 4)[0, 0]

    inside = torch.zeros(height, width, dtype=torch.bool)
    inside[12:-12, 12:-12] = True
    hole, rest = (pool(alpha) < 0.5) & inside, (pool(1 - alpha) < 0.02) & inside
    assert hole.float().mean() > 0.03
    assert rest.float().mean() > 0.3
    return hole, rest


def test_the_single_file_opens_from_a_disk_and_asks_nobody(shown: Opened) -> None:
    assert shown.said == []
    assert [url.partition(":")[0] for url in shown.asked if not url.startswith("blob:")] == ["file"]
    assert shown.page.title() == "Box"
    assert all(shown.page.locator(name).is_hidden() for name in ("#open", "#notice", "#facts"))


@pytest.mark.parametrize("kind", SHARP_TRAJECTORIES)
def test_the_page_goes_where_the_trajectory_goes(page: Any, kind: TrajectoryKind) -> None:
    cameras = trajectory_cameras(kind, box().camera, 0.45, box().depth_range, 121)
    places = [0, 17, 60, 61, 103, 120]
    eyes = page.evaluate(
        "([kind, places]) => places.map((k) => spackle.eye(kind, 0.45, k / 120))", [kind, places]
    )
    for k, eye in zip(places, eyes, strict=True):
        np.testing.assert_allclose(eye, cameras[k].position.numpy(), atol=2e-6)
    page.evaluate("(kind) => spackle.setView(kind, 0.45, 17 / 120)", kind)
    axes = page.evaluate("spackle.pose().axes")
    np.testing.assert_allclose(axes, cameras[17].world_to_camera[:3, :3].numpy(), atol=2e-6)


def test_the_slider_opens_the_hole_and_only_the_hole_is_filled(page: Any) -> None:
    page.evaluate("spackle.setView('swipe', 0.05, 1)")
    page.locator("#disparity").fill("0.3")
    assert page.evaluate("spackle.pose().eye") == pytest.approx(
        page.evaluate("spackle.eye('swipe', 0.3, 1)")
    )
    filled = canvas(page)
    page.evaluate("spackle.setLayers('base')")
    base = canvas(page)
    hole, rest = hole_and_rest(page, *base.shape[:2])
    change = (filled - base).abs().amax(dim=-1)
    assert float(change[hole].quantile(0.05)) > 0.3
    assert float(change[rest].max()) < 0.04  # where the base lets 2 % through, no more
    assert (
        float(change[rest].mean()) < 0.004
    )  # and that around the hole, beneath whose rim the fill goes on
    assert float(base[hole].mean()) < 0.1
    # The heat map glows in the hole alone.
    page.evaluate("spackle.setLayers('both')")
    before = canvas(page)
    page.evaluate("spackle.setHeat(true)")
    after = canvas(page)
    rest[-50:, :220] = False  # the legend
    assert float((after - before).abs().amax(dim=-1)[rest].max()) <= 2.5 / 255
    glow = after[hole].mean(dim=0)
    assert glow[0] > 0.7 > 0.45 > glow[1]


def test_the_page_shows_what_our_renderer_shows(page: Any) -> None:
    for disparity in (0.0, 0.3):
        page.evaluate("(disparity) => spackle.setView('swipe', disparity, 1)", disparity)
        both = picture(page, 256, 192)
        assert psnr(both, CPU.render(box().gaussians, camera_of(page, 256, 192)).rgb) > 50
    page.evaluate("spackle.setLayers('base')")
    base = picture(page, 256, 192)
    page.evaluate("spackle.setLayers('both')")
    page.evaluate("spackle.setCompare(0.25)")
    divided = picture(page, 256, 192)  # the base before the divider
    torch.testing.assert_close(divided[:, :64], base[:, :64], rtol=0, atol=1.5 / 255)
    torch.testing.assert_close(divided[:, 64:], both[:, 64:], rtol=0, atol=1.5 / 255)


@pytest.mark.parametrize(
    "degree", [pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow), 3]
)
def test_colours_change_with_the_view_as_our_renderer_changes_them(
    browser: Any, tmp_path: Path, degree: int
) -> None:
    harmonics = random_harmonics(len(box().base), degree).clamp(-0.6, 0.6)
    # Constant parts beyond 0..1, which the harmonics bring back into it.
    colors = box().base.colors * 1.3 - 0.05
    shiny = dataclasses.replace(box(), base=dataclasses.replace(
        box().base, colors=colors, harmonics=harmonics))  # fmt: skip
    content = page_scene("Shiny", shiny.base, shiny.aux, shiny.camera, 0.35)
    assert content.description["note"] == ""
    (tmp_path / "shiny.html").write_bytes(single_html(content))
    page = (found := opened(browser, (tmp_path / "shiny.html").as_uri())).page
    settled(page, "spackle.ready")
    pictures = []
    for t in (0.0, 1.0):  # from the left, and from the right
        page.evaluate("(t) => spackle.setView('swipe', 0.3, t)", t)
        pictures.append(picture(page, 256, 192))
        camera = camera_of(page, 256, 192)
        assert psnr(pictures[-1], CPU.render(shiny.gaussians, camera).rgb) > 45
        # By constant colours alone it would be another picture.
        plain = CPU.render(shiny.gaussians.with_harmonics_count(0), camera).rgb
        assert psnr(pictures[-1], plain) < 30
    assert found.said == []
    page.context.close()


def test_hand_and_keys_move_the_eye_within_the_limit(page: Any) -> None:
    view = page.locator("#view")
    page.evaluate("spackle.setView('swipe', 0, 1)")
    middle = view.bounding_box()
    x, y = middle["x"] + middle["width"] / 2, middle["y"] + middle["height"] / 2
    unit = page.evaluate("spackle.description.orbit.unit")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 0.2 * middle["width"], y)
    assert page.evaluate("spackle.pose().eye[0]") == pytest.approx(0.32 * unit, rel=0.03)
    assert float(page.locator("#disparity").get_attribute("max")) == 0.35
    page.mouse.move(x - 5000, y)
    page.mouse.up()
    assert page.evaluate("spackle.pose().eye[0]") == pytest.approx(0.35 * unit)
    view.press("0")
    assert page.evaluate("spackle.pose().eye") == [0, 0, 0]
    view.press("ArrowDown")
    assert page.evaluate("spackle.pose().eye") == pytest.approx([0, 0.05 * unit, 0])


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
def test_the_whole_photo_and_every_control_has_room(page: Any, size: tuple[int, int]) -> None:
    before = page.viewport_size
    page.set_viewport_size({"width": size[0], "height": size[1]})
    inside = " && ".join(f"frame.client{side} <= area.client{side}" for side in ("Width", "Height"))
    eventually(lambda: page.evaluate(inside))
    for box in [
        each.bounding_box()
        for each in page.locator("button, select, #view").all()
        if each.is_visible()
    ]:
        assert (box["x"] >= 0, box["y"] >= 0) == (True, True)
        assert (box["x"] + box["width"] <= size[0], box["y"] + box["height"] <= size[1]) == (
            True,
            True,
        ), box
    photo = page.locator("#view").bounding_box()
    assert photo["width"] / photo["height"] == pytest.approx(64 / 48, rel=0.01)
    page.set_viewport_size(before)


@pytest.mark.slow
def test_a_photo_is_sent_to_the_server_watched_and_dragged(browser: Any, tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path / "first")
    nearest = metres().min()
    write_depth(depth, 100 * metres())  # in centimetres
    photo = photo.rename(tmp_path / "my photo.png")
    with served(tmp_path / "scenes", work=SceneWork(), max_bytes=MAX_UPLOAD_BYTES) as server:
        address = f"http://127.0.0.1:{server.port}{server.root}/"
        page = (found := opened(browser, address)).page
        page.locator("summary").click()
        page.locator("[name=depth]").set_input_files(depth)
        page.locator("[name=depth_kind]").select_option("near-white")
        assert not page.locator("[name=depth_unit]").is_visible()  # relative depth has no unit
        page.locator("[name=depth_kind]").select_option("metric")
        page.locator("[name=depth_unit]").fill("cm")
        with page.expect_file_chooser() as chooser:  # the system's own dialog, and no other one
            page.get_by_role("button", name="Choose photos…").click()
        assert chooser.value.is_multiple()
        chooser.value.set_files(photo)
        page.locator("#frame.waiting #photo").wait_for()  # the picture stands where the scene will
        page.get_by_role("heading", name="my photo.png").wait_for()
        page.locator("#notice").wait_for(state="hidden")
        (scene,) = (tmp_path / "scenes").rglob("scene.ply")
        depths = load_ply(scene).means[:, 2]
        assert float(depths.quantile(0.01)) == pytest.approx(nearest, rel=0.02)
        drag_moves_the_eye(page)
        for start, name in (
            (lambda: page.locator("#record").click(), "my-photo.mp4"),
            (lambda: page.locator("#download").select_option(".glb"), "my-photo.glb"),
        ):
            with page.expect_download() as download:
                start()
            assert download.value.suggested_filename == name
        page.reload()
        settled(page, "spackle.ready")
        assert page.title() == "my photo.png · Spackle"
        with page.expect_file_chooser() as chooser:
            page.get_by_role("button", name="Open photos").click(force=True)
        chooser.value.set_files(
            {"name": "rough.png", "mimeType": "image/png", "buffer": b"no photo"}
        )
        page.get_by_text("rough.png: not an image").wait_for()
        assert [line for line in found.said if "415" not in line] == []
        assert all(
            url.startswith((address, f"blob:http://127.0.0.1:{server.port}")) for url in found.asked
        )
        page.context.close()
