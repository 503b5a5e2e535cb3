"""Pictures within the page: as many bytes as a page can take."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence

from PIL import Image

from spackle.evaluation.sheets import TRUTH

SIDE = 960  # pixels of a picture's longer side at most
SMALLER = (720, 540, 400)  # where they would be too many bytes
BUDGET = 7_500_000  # characters of all pictures of a page
QUALITY = 85
FORMAT = "WEBP"
# A slider has the first of these that there are: all methods of all images would make a page too large.
ORDER = ("base", "spackle", TRUTH, "inpaint2d", "seeds", "direct-ft", "spackle-scene", "dense")
MOST = 6


def encode(image: Image.Image) -> bytes:
    """As WebP; the same picture gives the same bytes."""
    file = io.BytesIO()
    image.save(file, format=FORMAT, quality=QUALITY, method=4)
    return file.getvalue()


def chosen(pictures: Mapping[str, bytes]) -> dict[str, bytes]:
    """What a slider can show."""
    return {name: pictures[name] for name in [name for name in ORDER if name in pictures][:MOST]}


def fitting(cases: Sequence[Mapping[str, bytes]]) -> list[dict[str, bytes]]:
    """The same pictures, all of them smaller where they are too many bytes together."""
    fits = [dict(case) for case in cases]
    for side in SMALLER:
        if _size(fits) <= BUDGET:
            break
        fits = [{name: _shrunk(data, side) for name, data in case.items()} for case in cases]
    return fits


def _size(cases: Sequence[Mapping[str, bytes]]) -> int:
    """Characters as data addresses."""
    return sum(len(data) * 4 // 3 for case in cases for data in case.values())


def _shrunk(data: bytes, side: int) -> bytes:
    with Image.open(io.BytesIO(data)) as image:
        small = image.convert("RGB")
    small.thumbnail((side, side))
    return encode(small)


def data_address(data: bytes) -> str:
    """A picture where an address is asked for."""
    return f"data:image/webp;base64,{base64.b64encode(data).decode()}"


def size_of(data: bytes) -> tuple[int, int]:
    """Width and height."""
    with Image.open(io.BytesIO(data)) as image:
        return image.width, image.height
