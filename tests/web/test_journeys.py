"""What a person does with the page, from the photo to what is sent on, in a real browser."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any

import pytest
from helpers.browser import Opened, opened, settled
from helpers.patient_work import PatientWork
from helpers.web_client import PHOTO, Served, eventually, served

from spackle.web.guard import MAX_UPLOAD_BYTES


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("scenes")
    with served(folder, work=PatientWork(), max_bytes=MAX_UPLOAD_BYTES) as server:
        yield server


@pytest.fixture
def visit(browser: Any, server: Served) -> Iterator[Opened]:
    """The empty page, on whose console nothing is said but that the server refuses a photo."""
    found = opened(browser, address(server))
    settled(found.page, "spackle.ready")
    yield found
    assert [line for line in found.said if "415" not in line] == []
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
