"""What a person does with the page, from the photo to what is sent on, in a real browser."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import Opened, drag_moves_the_eye, opened, settled
from helpers.patient_work import PatientWork, SlowStart
from helpers.photo_files import heic
from helpers.photos import metres, picture, write_photo
from helpers.portraits import PORTRAIT
from helpers.scenes import box_before_wall
from helpers.sites import serve
from helpers.systems import needs_posix_signals
from helpers.web_client import PATIENCE_S, PHOTO, Served, eventually, saved, served
from PIL import Image

import spackle
from spackle.formats import save_ply
from spackle.web.guard import MAX_UPLOAD_BYTES
from spackle.web.jobs import WARM_UP
from spackle.web.work import ROUGH_DEPTH_NOTE, SceneWork
from spackle.weights import PUBLISHED_WEIGHTS

SHORT = {"frames": 8}  # of each video, and of the path that is filled


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("scenes")
    work = PatientWork(default_options=SHORT)
    with served(folder, work=work, max_bytes=MAX_UPLOAD_BYTES) as server:
        yield server


@pytest.fixture
def visit(browser: Any, server: Served) -> Iterator[Opened]:
    """The empty page, on whose console nothing is said but that the server refuses a photo."""
    found = opened(browser, address(server))
    settled(found.page, "spackle.ready")
    yield found
    # The browser notes each refused photo.
    assert [line for line in found.said if not re.search("status of 4(00|15)", line)] == []
    found.page.context.close()


def address(server: Served, id: str = "") -> str:
    """The page's address, which may name a scene."""
    return f"http://127.0.0.1:{server.port}{server.root}/" + (f"#{id}" if id else "")


def photo(name: str, content: bytes = PHOTO, kind: str = "image/png") -> dict[str, Any]:
    """A file as Playwright takes it."""
    return {"name": name, "mimeType": kind, "buffer": content}


# Sends an event that carries files, each as {name, mimeType, base64}, as a hand would cause it.
GIVE = """([kind, files]) => {
  const transfer = new DataTransfer();
  for (const { name, mimeType, base64 } of files) {
    const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
    transfer.items.add(new File([bytes], name, { type: mimeType }));
  }
  const event = kind === "paste"
    ? new ClipboardEvent(kind, { clipboardData: transfer, bubbles: true, cancelable: true })
    : new DragEvent(kind, { dataTransfer: transfer, bubbles: true, cancelable: true });
  document.body.dispatchEvent(event);
}"""


def give(page: Any, kind: str, *files: dict[str, Any]) -> None:
    """Drop or paste files on the page."""
    texts = [
        {
            "name": file["name"],
            "mimeType": file["mimeType"],
            "base64": base64.b64encode(file["buffer"]).decode(),
        }
        for file in files
    ]
    page.evaluate(GIVE, [kind, texts])


def shown(page: Any, name: str) -> None:
    """Wait until the scene of a photo is on the page."""
    page.get_by_role("heading", name=name).wait_for()
    page.locator("#notice").wait_for(state="hidden")


def states(page: Any) -> list[str]:
    """The states of the photos in the queue."""
    items = page.locator("#queue li")
    classes: list[str] = items.evaluate_all("items => items.map((item) => item.className)")
    return classes


def test_several_photos_make_a_queue(visit: Opened) -> None:
    page = visit.page
    give(page, "drop", photo("one.png"), photo("slow.png"))
    shown(page, "one.png")
    eventually(lambda: states(page) == ["done", "working"])

    # What comes during the work waits, and nothing is lost without a word.
    give(page, "paste", photo("image.png"))
    page.locator("#file").set_input_files([photo("three.png"), photo("rough.png", b"no photo")])
    assert states(page) == ["done", "working", "waiting", "waiting", "waiting"]
    look = page.locator("#queue li > button:first-child")
    look.nth(2).click()
    page.get_by_text("Pasted picture.png: waiting for its turn").wait_for()
    page.get_by_role("button", name="Take three.png out").click()

    # A click on a photo in work shows its progress; a stop ends it, and brings the scene back.
    look.nth(1).click()
    page.get_by_role("heading", name="Filling what the photo hides").wait_for()
    page.get_by_role("button", name="Stop").click()
    page.get_by_text("Stopped", exact=True).wait_for()
    assert page.locator("#notice").is_hidden()
    eventually(lambda: states(page) == ["done", "done", "failed"])
    page.get_by_text("rough.png: not an image").wait_for()

    # A click on a finished one shows it.
    page.get_by_role("button", name="Pasted picture.png: done").click()
    shown(page, "Pasted picture.png")
    second = page.evaluate("location.hash")
    page.get_by_role("button", name="one.png: done").click()
    shown(page, "one.png")
    assert page.evaluate("location.hash") != second


def test_a_stop_leads_back_to_the_start(visit: Opened) -> None:
    page = visit.page
    page.locator("#file").set_input_files(photo("slow.png"))
    page.get_by_role("heading", name="Filling what the photo hides").wait_for()
    page.get_by_role("button", name="Stop").click()
    page.get_by_text("Stopped", exact=True).wait_for()
    page.get_by_role("heading", name="Step into your photo").wait_for()
    assert page.get_by_role("button", name="Choose photos…").is_visible()


@pytest.fixture(scope="module")
def foreign(server: Served, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The id of a scene that another program has made: nobody knows of a photo, or of metres."""
    file = tmp_path_factory.mktemp("foreign") / "garden.ply"
    save_ply(box_before_wall(width=64, height=48, focal=53).base(), file)
    with server.jobs.reserve_place() as folder:
        options = {"files": [], "fov": 62.0}
        job = server.jobs.add(folder, file.name, str(file), None, options)
    assert server.events(job.id)[-1]["error"] is None
    return job.id


# Opens a scene, and resolves to the eyes of the frames until the path's full range is reached.
FIRST_EYES = """(id) => new Promise((resolve) => {
  const eyes = [];
  location.hash = id;
  const look = () => {
    if (spackle.id === id) eyes.push(spackle.pose().eye);
    const range = spackle.id === id ? 0.9 * 0.3 * spackle.description.orbit.unit : 0;
    if (eyes.length > 2000 || eyes.some(([x, y]) => Math.hypot(x, y) > range)) resolve(eyes);
    else requestAnimationFrame(look);
  };
  look();
})"""


def test_a_scene_starts_at_the_photos_eye_and_glides(
    browser: Any, server: Served, foreign: str
) -> None:
    page = opened(browser, address(server), reduced_motion="no-preference").page
    settled(page, "spackle.ready")
    eyes = np.array(page.evaluate(FIRST_EYES, foreign))
    assert eyes[0].tolist() == [0, 0, 0]
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    # The greatest step that a slow machine may draw is a tenth of the opening.
    assert steps.max() < 0.25 * np.linalg.norm(eyes[-1])
    assert np.linalg.norm(eyes[-1][:2]) > 0
    page.context.close()


def test_keys_and_words_suit_the_scene(browser: Any, server: Served, foreign: str) -> None:
    page = (found := opened(browser, address(server, foreign))).page
    settled(page, "spackle.ready")
    assert page.evaluate("spackle.pose().eye") == [0, 0, 0]  # also where motion is not wanted
    assert page.get_by_role("button", name="What the photo shows").count() == 0
    assert page.get_by_role("button", name="The scene as it was").is_visible()
    view = page.get_by_role("application", name="The scene garden.ply")
    assert "arrow keys" in page.evaluate("document.querySelector('#how').textContent")
    assert view.get_attribute("aria-describedby") == "how"

    # Without metres, Move says how far the nearest thing shifts.
    page.locator("#disparity").fill("0.45")
    assert page.locator("output[for=disparity]").inner_text() == "45 %"
    unfold(page)
    page.get_by_role("button", name="Reset").click()
    assert page.locator("output[for=disparity]").inner_text() == "30 %"
    assert page.evaluate("spackle.pose().eye") == [0, 0, 0]

    # Space plays from anywhere, but where it presses a button.
    playing = "document.querySelector('#play').classList.contains('on')"
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Space")
    assert page.evaluate(playing)
    page.locator("#disparity").press("Space")
    assert not page.evaluate(playing)
    page.locator("#heat").press("Space")
    assert page.locator("#heat").get_attribute("aria-pressed") == "true"
    assert not page.evaluate(playing)
    assert found.said == []
    page.context.close()


# The visible controls that leave the window, or whose text leaves them.
CONTROLS = "header button, #bar button, #bar select, #bar summary"
TOO_LARGE = """(controls) => [...document.querySelectorAll(controls)]
  .filter((control) => control.checkVisibility())
  .filter((control) => {
    const { left, right, top, bottom } = control.getBoundingClientRect();
    const leaves = left < 0 || top < 0 || right > innerWidth || bottom > innerHeight;
    return leaves || control.scrollWidth > control.clientWidth + 1;
  })
  .map((control) => control.textContent.trim() || control.id)"""


def test_every_control_of_a_served_page_has_room(browser: Any, server: Served) -> None:
    scene = server.send(photo("box.png")["buffer"], "box.png").json["id"]
    server.events(scene)
    page = opened(browser, address(server, scene)).page
    settled(page, "spackle.ready")
    for size in ((1440, 900), (1380, 800), (1024, 768), (320, 640), (844, 390)):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        unfold(page)
        assert page.evaluate(TOO_LARGE, CONTROLS) == [], size

    # The buttons above the picture choose what is shown.
    for name in ("What the photo shows", "Both"):
        button = page.get_by_role("button", name=name, exact=True)
        button.click()
        assert button.get_attribute("aria-pressed") == "true"
    page.context.close()


def test_where_there_are_metres_move_says_centimetres(visit: Opened) -> None:
    page = visit.page
    page.locator("summary").click()
    page.locator("[name=depth]").set_input_files(
        {"name": "depth.npy", "mimeType": "", "buffer": npy(metres())}
    )
    page.locator("[name=depth_kind]").select_option("metric")
    page.locator("#file").set_input_files(photo("box.png"))
    shown(page, "box.png")
    page.locator("#disparity").press("End")
    move = page.evaluate("spackle.description.orbit.limit * spackle.description.orbit.unit")
    assert page.locator("output[for=disparity]").inner_text() == f"{100 * move:.0f} cm"
    assert page.locator("#photo").get_attribute("alt") == ""


def unfold(page: Any) -> None:
    """Show all controls, some of which a small screen hides."""
    if not page.locator("#rest").is_visible():
        page.locator("#more").click()


def npy(values: Any) -> bytes:
    """An array as the content of a .npy file."""
    np.save(file := io.BytesIO(), values)
    return file.getvalue()


def test_what_is_no_photo_says_so(visit: Opened) -> None:
    page = visit.page
    Image.new("1", (11000, 11000)).save(huge := io.BytesIO(), "PNG")
    whole = saved("JPEG")
    refusals = {
        "bill.pdf": (b"%PDF-1.7 anything", "application/pdf", "PDF"),
        "huge.png": (huge.getvalue(), "image/png", "121 megapixels (11000×11000) are too large"),
        "half.jpg": (whole[: len(whole) // 2], "image/jpeg", "damaged"),
        "clip.mp4": (b"anything", "video/mp4", "not a photo"),
        "empty.jpg": (b"", "image/jpeg", "the file is empty"),
    }
    for name, (content, kind, reason) in refusals.items():
        give(page, "drop", photo(name, content, kind))
        notice = page.locator("#notice p").first
        notice.filter(has_text=name).filter(has_text=reason).wait_for()
        line = notice.inner_text()
        assert "`" not in line, line  # no option, no command
    assert states(page) == ["failed"] * len(refusals)


@pytest.mark.slow
def test_a_phones_photos_become_scenes(visit: Opened) -> None:
    page = visit.page
    pixels = picture() / 255.0
    give(page, "drop", photo("phone.heic", heic(pixels, 1, 13), "image/heic"))
    shown(page, "phone.heic")  # no browser but Safari draws the file itself
    give(page, "drop", photo("portrait.jpg", PORTRAIT, "image/jpeg"))
    shown(page, "portrait.jpg")
    drag_moves_the_eye(page)


def test_a_first_photo_waits_for_the_warm_up(browser: Any, tmp_path: Path) -> None:
    go_on = tmp_path / "go-on"
    work = SlowStart(default_options=SHORT, go_on=go_on)
    with served(tmp_path / "scenes", work=work, max_bytes=MAX_UPLOAD_BYTES) as server:
        server.jobs.warm_up()
        page = opened(browser, address(server)).page
        page.locator("#file").set_input_files(photo("first.png"))
        page.get_by_role("heading", name="First photo: preparing, about half a minute").wait_for()
        go_on.touch()
        shown(page, "first.png")
        # No counts of Gaussians, no command: what a person wants to know.
        assert page.locator("#facts").inner_text() == ROUGH_DEPTH_NOTE
        page.context.close()


def test_a_warm_up_loads_the_base_of_the_first_photo() -> None:
    work = SceneWork()
    work(WARM_UP, pytest.fail)  # nobody hears of its progress
    assert work.pipeline is not None
    assert work.pipeline.options.base == work.base


def test_better_depth_is_fetched_with_its_progress(
    browser: Any, server: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    content = b"weights" * 600_000
    with serve(content) as site:
        made = dataclasses.replace(
            PUBLISHED_WEIGHTS["depth"],
            url=site.url,
            bytes=len(content),
            sha256=hashlib.sha256(content).hexdigest(),
        )
        monkeypatch.setitem(PUBLISHED_WEIGHTS, "depth", made)
        with served(tmp_path / "scenes", work=PatientWork()) as fresh:
            page = opened(browser, address(fresh)).page
            button = page.locator("#better")
            # The page asks the server what it offers, once it is loaded.
            page.get_by_role("button", name="Better depth (4 MB, MIT)").wait_for()
            assert page.evaluate("fetch('page.json').then((r) => r.json())")["upload"][
                "better_depth"
            ]

            site.status = 503  # as good as offline: one line says what went wrong
            button.click()
            page.get_by_text(
                "Better depth could not be fetched: the server answers HTTP 503"
            ).wait_for()
            assert button.is_enabled()

            site.status, site.hang_after = 200, len(content) // 2
            button.click()
            page.get_by_text(re.compile(r"Better depth: [1-9]\d? %")).wait_for()
            site.go_on.set()
            page.get_by_text("Better depth is here, for the photos that you add next.").wait_for()
            assert button.is_hidden()
            page.context.close()
    assert (tmp_path / "weights" / made.file).read_bytes() == content


def look_around(page: Any) -> None:
    """Drag, turn the wheel, pinch and double-click, as a person does; each moves what is seen."""
    drag_moves_the_eye(page)
    frame = page.locator("#frame").bounding_box()
    x, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
    page.mouse.move(x, y)
    page.mouse.wheel(0, -300)
    eventually(lambda: page.evaluate("spackle.pose().zoom.scale") > 1.2)
    page.mouse.dblclick(x, y)
    home = {"eye": [0, 0, 0], "zoom": {"scale": 1, "x": 0, "y": 0}}
    eventually(lambda: home.items() <= page.evaluate("spackle.pose()").items())

    # Two fingers, each `half` pixels from the middle.
    fingers = page.context.new_cdp_session(page)
    for kind, half in (("touchStart", 20), ("touchMove", 40), ("touchMove", 60), ("touchEnd", 0)):
        points = [{"x": x - half, "y": y, "id": 0}, {"x": x + half, "y": y, "id": 1}]
        touch = {"type": kind, "touchPoints": points if half else []}
        fingers.send("Input.dispatchTouchEvent", touch)
    eventually(lambda: page.evaluate("spackle.pose().zoom.scale") > 1.5)
    page.mouse.dblclick(x, y)
    eventually(lambda: home.items() <= page.evaluate("spackle.pose()").items())


def saved_by(page: Any, act: Callable[[], object], path: Path) -> bytes:
    """What a person gets who saves something; it is stored at `path`, too."""
    with page.expect_download() as download:
        act()
    download.value.save_as(path)
    return path.read_bytes()


def test_a_photo_is_dropped_explored_saved_and_opened_from_the_disk(
    browser: Any, visit: Opened, tmp_path: Path
) -> None:
    page = visit.page
    give(page, "drop", photo("box.png"))
    shown(page, "box.png")
    look_around(page)
    film = saved_by(page, lambda: page.locator("#record").click(), tmp_path / "box.mp4")
    assert film[4:8] == b"ftyp"
    choose = page.locator("#download").select_option
    saved_by(page, lambda: choose(".html"), tmp_path / "box.html")

    copy = opened(browser, (tmp_path / "box.html").as_uri())
    settled(copy.page, "spackle.ready")
    look_around(copy.page)
    assert copy.said == []
    assert not [url for url in copy.asked if url.startswith("http")]
    copy.page.context.close()


@pytest.mark.slow
def test_an_example_and_a_scene_are_explored(
    browser: Any, server: Served, visit: Opened, foreign: str
) -> None:
    page = visit.page
    page.goto(address(server, foreign))
    page.reload()
    settled(page, "spackle.ready")
    look_around(page)
    page.goto(address(server))
    page.reload()
    settled(page, "spackle.ready")
    page.get_by_role("button", name="a cat").click()
    shown(page, "cat.jpg")
    look_around(page)


@pytest.mark.slow
@needs_posix_signals
def test_the_page_of_a_command_is_explored(browser: Any, tmp_path: Path) -> None:
    write_photo(tmp_path / "holiday.png")
    environment = {**os.environ, "PYTHONPATH": str(Path(spackle.__file__).parents[1])}
    command = [sys.executable, "-m", "spackle", "view", str(tmp_path / "holiday.png"), "--no-open"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stderr is not None
            line = next(line for line in process.stderr if "http:" in line)
            page = opened(browser, line[line.index("http:") :].split()[0]).page
            shown(page, "holiday.png")
            look_around(page)
            page.context.close()
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE_S) == 130
        finally:
            process.kill()
