"""Photos with a depth map inside, in the layouts of Apple, GDepth and Dynamic Depth, and damaged
ones.
"""

from __future__ import annotations

import io
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from helpers import DATA


def _files() -> dict[str, bytes]:
    with tarfile.open(DATA / "portraits.tar.xz") as archive:
        return {entry.name: archive.extractfile(entry).read() for entry in archive}  # type: ignore[union-attr]


# each photo is `photos.picture`, each map `codes`, and "map.jpg" the map alone
PORTRAITS = _files()
PORTRAIT = PORTRAITS["Apple JPEG"]


def codes() -> NDArray[np.uint8]:
    """[24, 32]: a bright box in front of a dark slope; the corners differ, and 0 and 255 occur."""
    y, x = np.mgrid[:24, :32]
    slope = 20 + 2 * x + 3 * y
    slope[6:12, 10:16] = 200
    slope[0, 0], slope[-1, -1] = 0, 255
    return slope.astype(np.uint8)


def png(values: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    return file.getvalue()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
