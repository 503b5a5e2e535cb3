"""Sharing from the page: videos in three shapes and two kinds, a page with a caption, a link."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import pytest
from helpers.browser import opened, settled
from helpers.patient_work import BriefWork
from helpers.photos import write_pair
from helpers.web_client import served
from PIL import Image

from spackle.core.camera import Camera
from spackle.web.guard import MAX_UPLOAD_BYTES
from spackle.web.shared_videos import SHARED_SECONDS, shared_video_options

# A phone's menu for sending, which keeps what it was given.
SEND_MENU = """
    window.sent = [];
    navigator.canShare = ({files}) => files.length === 1;
    navigator.share = async ({files}) => {
      sent.push([files[0].name, files[0].type, files[0].size]);
      if (sent.length === 1) throw new DOMException("too late", "NotAllowedError");
    };"""

# Writes down what the dialog says while a file is made.
NOTE_PROGRESS = """() => {
  Object.assign(window, { shares: [], lines: [] });
  const dialog = document.getElementById("sharing");
  const bar = dialog.querySelector("progress");
  const line = dialog.querySelector(".line");
  new MutationObserver(() => bar.hasAttribute("value") && shares.push(bar.value))
    .observe(bar, { attributes: true, attributeFilter: ["value"] });
  new MutationObserver(() => lines.push(line.textContent)).observe(line, { childList: true });
}"""


@pytest.fixture(scope="module", params=[2.0, pytest.param(5.0, marks=pytest.mark.slow)])
def seconds(request: pytest.FixtureRequest) -> float:
    """The length of a video for sharing: less than people get, and in slow tests what they get."""
    length: float = request.param
    return length


@pytest.fixture(scope="module")
def page(browser: Any, tmp_path_factory: pytest.TempPathFactory, seconds: float) -> Iterator[Any]:
    """The page of a server with a small scene, and its dialog open."""
    folder = tmp_path_factory.mktemp("share")
    photo, depth = write_pair(folder / "pair")
    work = BriefWork(default_options={"frames": 8}, shared_seconds=seconds)
    with served(folder / "scenes", work=work, max_bytes=MAX_UPLOAD_BYTES) as server:
        address = f"http://127.0.0.1:{server.port}{server.root}/"
        found = opened(browser, address)
        page = found.page
        page.add_init_script(SEND_MENU)
        page.reload()
        page.locator("#choices summary").click()
        page.locator("[name=depth]").set_input_files(depth)
        page.locator("#file").set_input_files(photo)
        page.locator("#notice").wait_for(state="hidden")
        settled(page, "spackle.ready")
        page.get_by_role("button", name="Share").click()
        yield page
        assert found.said == []
        page.context.close()


def choose(page: Any, label: str) -> None:
    page.locator("#sharing").get_by_text(label, exact=True).click()


def saved(page: Any) -> tuple[str, bytes]:
    """The name and content of the file that the button saves."""
    with page.expect_download() as download:
        page.locator("#sharing").get_by_role("button", name="Save").click()
    content = Path(download.value.path()).read_bytes()
    page.get_by_text("Saved: ").wait_for()
    return download.value.suggested_filename, content


@pytest.mark.parametrize(
    ("label", "shape", "size"),
    [
        pytest.param("Story", "story", (720, 1280), marks=pytest.mark.slow),
        pytest.param("Square", "square", (720, 720), marks=pytest.mark.slow),
        pytest.param("Wide", "wide", (1280, 720), marks=pytest.mark.slow),
    ],
)
def test_a_video_has_the_shape_of_where_it_goes_and_its_length(
    page: Any, seconds: float, label: str, shape: str, size: tuple[int, int]
) -> None:
    choose(page, label)
    choose(page, "Video (MP4)")
    name, content = saved(page)
    assert name.endswith(f"-{shape}.mp4")
    with av.open(io.BytesIO(content)) as video:
        stream = video.streams.video[0]
        assert (stream.width, stream.height) == size
        assert float(stream.duration * stream.time_base) == pytest.approx(seconds, abs=0.05)


def test_people_get_five_seconds() -> None:
    assert SHARED_SECONDS == 5


def test_a_gif_has_the_shape_and_plays_for_ever(page: Any, seconds: float) -> None:
    choose(page, "Story")
    choose(page, "GIF, small")
    page.evaluate(NOTE_PROGRESS)
    name, content = saved(page)
    shares, lines = page.evaluate("[shares, lines]")
    assert shares, "nobody could see how far it was"
    assert shares == sorted(shares)
    assert all(0 <= share <= 1 for share in shares)
    assert any(re.fullmatch(r"Making the video: \d+ %", line) for line in lines)
    assert name.endswith("-story.gif")
    with Image.open(io.BytesIO(content)) as gif:
        assert gif.format == "GIF"
        assert gif.size == (270, 480)
        assert gif.info["loop"] == 0
        lengths = []
        for index in range(gif.n_frames):
            gif.seek(index)
            lengths.append(gif.info["duration"])
    # A GIF counts hundredths of a second.
    assert sum(lengths) / 1000 == pytest.approx(seconds, rel=0.08)


def test_a_page_is_saved_with_its_caption_and_sent_at_the_second_press(
    page: Any, browser: Any, tmp_path: Path
) -> None:
    choose(page, "Page")
    caption = 'Grandma\'s "best" <hat> & $& coat'
    page.locator("[name=caption]").fill(caption)
    name, content = saved(page)
    (tmp_path / name).write_bytes(content)
    gift = opened(browser, (tmp_path / name).as_uri())
    settled(gift.page, "spackle.ready")
    assert gift.page.locator("#caption").inner_text() == caption
    assert not gift.page.locator("#share").is_visible()  # no server makes its videos
    assert gift.said == []
    gift.page.context.close()

    # A menu that comes too late for the browser's rules is opened by another press, at once.
    send = page.locator("#sharing").get_by_role("button", name="Send")
    send.click()
    page.get_by_text("press Send once more").wait_for()
    send.click()
    page.get_by_text("Sent.").wait_for()
    assert page.evaluate("sent")[1] == [name, "text/html", len(content)]


def test_a_link_is_offered_where_others_can_open_it_alone(page: Any) -> None:
    assert not page.locator("#sharing [value=link]").is_visible()  # 127.0.0.1 is everybody's own


def test_a_picture_is_cropped_only_if_most_of_it_stays() -> None:
    portrait = Camera.from_focal(1000, 900, 1200)
    landscape = Camera.from_focal(1000, 1600, 1200)
    fits = {
        (camera.width, name): options.fit
        for camera in (portrait, landscape)
        for name in ("story.mp4", "square.gif", "wide.mp4")
        if (options := shared_video_options(name, camera)) is not None
    }
    assert fits == {
        (900, "story.mp4"): "crop",
        (900, "square.gif"): "crop",
        (900, "wide.mp4"): "blur",
        (1600, "story.mp4"): "blur",
        (1600, "square.gif"): "crop",
        (1600, "wide.mp4"): "crop",
    }
    assert shared_video_options("swipe.mp4", portrait) is None
