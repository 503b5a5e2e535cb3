"""Pages in a real browser, and what they show."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)


@dataclasses.dataclass(frozen=True)
class Opened:
    """A page, with console messages and requested addresses."""

    page: Any
    said: list[str]
    asked: list[str]


def opened(browser: Any, url: str, script: Path | None = None, **screen: Any) -> Opened:
    """A page at an address, before whose own scripts a `script` runs; `screen` may have its
    viewport, and whether it is a phone's.
    """
    usual = {
        "viewport": {"width": 740, "height": 490},
        "reduced_motion": "reduce",
        # Software draws: a quarter of the pixels takes a third of the time.
        "device_scale_factor": 0.5,
    }
    context = browser.new_context(**{**usual, **screen})
    page = context.new_page()
    page.set_default_timeout(300_000)  # ms; software draws slowly on a busy machine
    if script is not None:
        page.add_init_script(path=script)
    found = Opened(page, [], [])
    page.on("console", lambda message: found.said.append(message.text))
    page.on("pageerror", lambda error: found.said.append(str(error)))
    page.on("request", lambda request: found.asked.append(request.url))
    page.goto(url)
    return found


def settled(page: Any, promise: str) -> None:
    """Wait for a promise of the page, with a timeout (`evaluate` has none)."""
    # The script of a page that was sent is unpacked first.
    page.wait_for_function(f"window.spackle && {promise}.then(() => true)")


def pixels(png: bytes) -> Tensor:
    """[H, W, 3] in 0..1."""
    return torch.from_numpy(np.array(Image.open(io.BytesIO(png)).convert("RGB"))).float() / 255


def drag_moves_the_eye(page: Any) -> None:
    """Drag from the middle of the picture to the left, as a hand does; the eye must go to the
    right.
    """
    settled(page, "spackle.settled()")
    frame = page.locator("#frame").bounding_box()
    x, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
    start = page.evaluate("spackle.pose().eye[0]")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 0.1 * frame["width"], y)
    page.mouse.up()
    assert page.evaluate("spackle.pose().eye[0]") > start
