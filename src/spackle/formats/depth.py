"""Write depth maps as NumPy arrays, 16-bit PNG or OpenEXR."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.errors import InputError
from spackle.files import write_whole

Metres = NDArray[np.float32]


def check_depth_name(path: str | os.PathLike[str]) -> Callable[[Metres], bytes]:
    """The encoder of depth maps for a file name's suffix; InputError for an unknown suffix."""
    if (encode := ENCODERS.get(Path(path).suffix.lower())) is None:
        raise InputError(f"{path}: not a name for a depth map: end it with {', '.join(ENCODERS)}")
    return encode


def save_depth(depth: Tensor, path: str | os.PathLike[str]) -> None:
    """Write depth in metres [H, W], 0 where unknown: .npy and .exr as float32, .png as millimetres in 16 bits."""
    write_whole(path, check_depth_name(path)(depth.cpu().numpy().astype(np.float32)))


def _npy(depth: Metres) -> bytes:
    np.save(file := io.BytesIO(), depth)
    return file.getvalue()


def _png(depth: Metres) -> bytes:
    millimetres = np.clip(np.round(depth * 1000), 0, 65_535).astype(np.uint16)  # 65.5 m at most
    Image.fromarray(millimetres).save(file := io.BytesIO(), format="PNG")
    return file.getvalue()


def _exr(depth: Metres) -> bytes:
    """Encode scan lines of one float32 channel Y, without compression (file layout: openexr.com)."""
    height, width = depth.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes: list[tuple[bytes, bytes, Any]] = [
        (b"channels", b"chlist", b"Y\0" + struct.pack("<iB3x2i", 2, 0, 1, 1) + b"\0"),  # 2: float
        (b"compression", b"compression", b"\0"),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0, 0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    ]
    head = struct.pack("<2I", 20000630, 2)
    head += (
        b"".join(b"%s\0%s\0" % (name, kind) + struct.pack("<i", len(value)) + value for name, kind, value in attributes)
        + b"\0"
    )
    size = 4 * width
    lines = [struct.pack("<2i", y, size) + row.astype("<f4").tobytes() for y, row in enumerate(depth)]
    first = len(head) + 8 * height
    return head + struct.pack(f"<{height}Q", *(first + y * (8 + size) for y in range(height))) + b"".join(lines)


ENCODERS: dict[str, Callable[[Metres], bytes]] = {".npy": _npy, ".png": _png, ".exr": _exr}
