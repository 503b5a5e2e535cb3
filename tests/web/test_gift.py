"""The page that a person sends on: picture and motion, tools behind a button, a phone's tilt."""

from __future__ import annotations

import functools
import itertools
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.browser import opened, settled
from helpers.firefox import firefox, screen
from helpers.scenes import box_before_wall
from helpers.web_client import eventually

from spackle.core.trajectories import trajectory_cameras
from spackle.pipeline import complete
from spackle.scene import Scene

CAPTION = 'On the <b>terrace</b>, "early"'
# Enough of a phone for its sensor: playwright turns no phone, so the events are sent by hand.
TURN = """([beta, gamma]) => dispatchEvent(
    new DeviceOrientationEvent("deviceorientation", {alpha: 0, beta, gamma}))"""
EYE = "spackle.pose().eye"
# Resolves when the page's script is unpacked and runs.
UNPACKED = """new Promise((resolve) => {
  const look = () => window.spackle ? resolve() : setTimeout(look, 20);
  look();
})"""
# A finger touches the middle of the picture twice. Every browser has a pointer 1.
DOUBLE_TAP = """() => {
  const canvas = document.getElementById("view");
  const box = canvas.getBoundingClientRect();
  const middle = {clientX: box.x + box.width / 2, clientY: box.y + box.height / 2};
  const finger = {pointerId: 1, pointerType: "touch", isPrimary: true, bubbles: true, ...middle};
  for (const kind of ["pointerdown", "pointerup", "pointerdown", "pointerup"])
    canvas.dispatchEvent(new PointerEvent(kind, finger));
}"""


@functools.cache
def box() -> Scene:
    """A small scene, completed by initial Gaussians for a disparity of 0.3."""
    prediction = box_before_wall(width=64, height=48, focal=53).lift()
    depths = prediction.depth_range
    cameras = trajectory_cameras("swipe", prediction.camera.even(), 0.3, depths, 3)
    return complete(prediction, cameras, network=None)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gift") / "gift.html"
    note = "Rough depth: a quick guess."  # for who made the page, not for who is sent it
    path.write_bytes(box().page_file("Our garden.jpg", note=note, caption=CAPTION))
    return path


@pytest.fixture
def phone(browser: Any, file: Path) -> Iterator[Any]:
    """The page on a phone whose owner likes motion; it must say nothing in the console."""
    screen = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    found = opened(browser, file.as_uri(), reduced_motion="no-preference", **screen)
    settled(found.page, "spackle.ready")
    yield found.page
    assert found.said == []
    found.page.context.close()


def test_the_page_shows_the_picture_and_its_caption_alone(browser: Any, file: Path) -> None:
    found = opened(browser, file.as_uri())
    page = found.page
    page.locator("#photo").wait_for()  # stands there before the scene is drawn
    settled(page, "spackle.ready")
    assert page.title() == "Our garden"
    assert page.locator("#caption").inner_text() == CAPTION
    controls = page.locator("button, input, select, #facts").all()
    visible = [each.get_attribute("id") for each in controls if each.is_visible()]
    assert visible == ["corner"]
    assert page.locator("#toast.shown").count() == 0
    page.locator("#corner").click()
    assert page.get_by_role("button", name="Save a picture").is_visible()
    assert not page.locator("#caption").is_visible()
    assert not page.locator("#choices").is_visible()  # for photos that a server takes
    page.keyboard.press("Escape")
    assert not page.get_by_role("button", name="Save a picture").is_visible()
    assert found.said == []
    page.context.close()


# All that a person can read with the tools unfolded: the visible text, the hints, and the names
# that a screen reader says.
READABLE = """() => [...document.body.querySelectorAll("*")]
  .filter((each) => each.checkVisibility() && !each.matches("script, style"))
  .flatMap((each) => [each.title, each.getAttribute("aria-label"),
    each.children.length ? "" : each.textContent])
  .map((text) => text?.trim()).filter(Boolean)"""
# The pairs of tools, the picture and the corner among them, that cover each other; and the tools
# that leave the window, or whose text leaves them.
CROWDED = """() => {
  const parts = [...document.querySelectorAll("#corner, #bar button, #bar input, #bar")]
    .filter((each) => each.checkVisibility());
  const boxes = parts.map((each) => [each, each.getBoundingClientRect()]);
  const name = (each) => each.textContent.trim() || each.id;
  const view = document.getElementById("view").getBoundingClientRect();
  const bar = document.getElementById("bar").getBoundingClientRect();
  const covers = (a, b) => a.left < b.right && b.left < a.right
    && a.top < b.bottom && b.top < a.bottom;
  const crowded = covers(view, bar) ? ["picture"] : [];
  for (const [each, box] of boxes) {
    const leaves = box.left < 0 || box.top < 0
      || box.right > innerWidth || box.bottom > innerHeight;
    if (leaves || each.scrollWidth > each.clientWidth + 1) crowded.push(name(each));
    for (const [other, otherBox] of boxes) {
      const isPart = each === other || each.contains(other) || other.contains(each);
      if (!isPart && covers(box, otherBox)) crowded.push(`${name(each)} and ${name(other)}`);
    }
  }
  return crowded;
}"""


def test_the_tools_have_plain_words_and_room(browser: Any, file: Path) -> None:
    found = opened(browser, file.as_uri(), viewport={"width": 1440, "height": 900})
    page = found.page
    settled(page, "spackle.ready")
    page.locator("#corner").click()
    buttons = [each for each in page.locator("#bar button").all() if each.is_visible()]
    assert [each.inner_text() for each in buttons] == [
        "",  # play, which a symbol says
        *("Side to side", "Sway", "Circle", "Forward"),
        *("Show what was filled in", "Before and after", "Save a picture", "Save a video"),
        *("Back to the start", "Full screen"),
    ]
    readable = "\n".join(page.evaluate(READABLE))
    assert "How far it moves" in readable
    workshop = r"(?i)\b(holes?|added|gaussians?|disparity|layers?|depth|\d+ (cm|m|%))\b|\.jpg"
    assert re.findall(workshop, readable) == []

    for width, height in ((1440, 900), (1024, 768), (390, 844), (320, 640), (844, 390)):
        page.set_viewport_size({"width": width, "height": height})
        eventually(lambda: page.evaluate(CROWDED) == [])
    assert found.said == []
    page.context.close()


def test_it_plays_at_once_and_glides_from_the_photos_own_eye(browser: Any, file: Path) -> None:
    # Written down while the page draws, because frames are gone before a test could ask.
    context = browser.new_context(viewport={"width": 300, "height": 225})
    page = context.new_page()
    page.set_default_timeout(300_000)
    page.add_init_script("""
        window.eyes = [];
        (function note() {
          if (window.spackle?.description) eyes.push(spackle.pose().eye);
          requestAnimationFrame(note);
        })()""")
    page.goto(file.as_uri())
    settled(page, "spackle.ready")
    unit = page.evaluate("spackle.description.orbit.unit")
    eventually(lambda: abs(page.evaluate(EYE)[0]) > 0.05 * unit)
    eyes = page.evaluate("eyes")
    assert eyes[0] == [0, 0, 0]
    steps = [
        max(abs(after[axis] - before[axis]) for axis in range(3)) / unit
        for before, after in itertools.pairwise(eyes)
    ]
    # However slow the machine, a frame advances by at most a quarter of a second.
    assert max(steps) < 0.1
    context.close()


@pytest.mark.slow
def test_who_likes_no_motion_gets_a_still_picture(browser: Any, file: Path) -> None:
    page = opened(browser, file.as_uri(), reduced_motion="reduce").page
    settled(page, "spackle.ready")
    for gamma in (0, 10, 15):
        page.evaluate(TURN, [45, gamma])
    assert page.evaluate(EYE) == [0, 0, 0]
    page.context.close()


@pytest.mark.slow
def test_the_eye_follows_a_turned_phone_within_the_filled_range(phone: Any) -> None:
    unit = phone.evaluate("spackle.description.orbit.unit")
    phone.evaluate("spackle.setView('swipe', 0, 0.5)")
    phone.evaluate(TURN, [45, 0])
    phone.evaluate(TURN, [46, 1])  # a hand is never quite still
    assert phone.evaluate(EYE) == [0, 0, 0]
    for step in range(8):  # to the right, in steps of a sensor
        phone.evaluate(TURN, [45, 2 * step])
        phone.wait_for_timeout(30)
    right = phone.evaluate(EYE)
    assert right[0] < -0.02 * unit  # one sees it from farther left
    for step in range(40):
        phone.evaluate(TURN, [45, min(14 + 4 * step, 85)])
        phone.wait_for_timeout(30)
    limit = phone.evaluate("spackle.description.orbit.limit")
    far = phone.evaluate(EYE)
    assert 0.25 * unit < abs(far[0]) <= limit * unit * (1 + 1e-9)
    # A sensor that flips its angles moves nothing.
    phone.evaluate(TURN, [-135, -85])
    assert phone.evaluate(EYE) == far


@pytest.mark.slow
def test_a_browser_that_asks_for_permission_is_asked_in_a_tap(browser: Any, file: Path) -> None:
    context = browser.new_context(has_touch=True, viewport={"width": 390, "height": 844})
    page = context.new_page()
    page.set_default_timeout(300_000)
    page.add_init_script("""
        window.asked = 0;
        DeviceOrientationEvent.requestPermission = async () => (window.asked++, "granted");""")
    page.goto(file.as_uri())
    settled(page, "spackle.ready")
    assert page.evaluate("asked") == 0
    for _ in range(2):
        page.locator("#view").tap()
        eventually(lambda: page.evaluate("asked") == 1)
    context.close()


def test_a_tap_stops_the_motion_and_two_go_back_to_the_photo(phone: Any) -> None:
    playing = "document.getElementById('play').classList.contains('on')"
    assert phone.evaluate(playing)
    phone.locator("#view").tap()
    eventually(lambda: not phone.evaluate(playing))
    phone.evaluate("spackle.setView('swipe', 0.2, 1)")
    assert phone.evaluate(EYE)[0] > 0
    phone.wait_for_timeout(400)  # ms, longer than lies between two taps that belong together
    # Both taps in one call: software may take longer to draw than lies between two taps.
    phone.evaluate(DOUBLE_TAP)
    assert phone.evaluate(EYE) == [0, 0, 0]
    assert not phone.evaluate(playing)


@pytest.mark.slow
def test_firefox_opens_the_file_from_the_disk_and_moves_it(file: Path, tmp_path: Path) -> None:
    program = shutil.which("firefox-esr") or shutil.which("firefox")
    if program is None:
        pytest.skip("no Firefox is installed: apt-get install firefox-esr")
    if shutil.which("Xvfb") is None:
        pytest.skip("no screen in memory for Firefox: apt-get install xvfb")
    with screen() as display, firefox(program, tmp_path, display) as window:
        window.open(file.as_uri())
        title = f"{UNPACKED}.then(() => spackle.ready).then(() => document.title)"
        assert window.run(title) == "Our garden"
        assert window.run("document.getElementById('caption').textContent") == CAPTION
        colors = """spackle.picture(32, 24).then((url) => createImageBitmap(
            new Blob([Uint8Array.from(atob(url.split(",")[1]), (c) => c.charCodeAt(0))])))
            .then((image) => {
              const context = new OffscreenCanvas(32, 24).getContext("2d");
              context.drawImage(image, 0, 0);
              return new Set(context.getImageData(0, 0, 32, 24).data).size;
            })"""
        assert window.run(colors) > 20  # a picture, not an empty canvas
        window.run("spackle.setView('swipe', 0.2, 1)")
        assert window.run(EYE)[0] > 0
