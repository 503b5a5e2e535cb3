"""Write depth maps as NumPy arrays, 16-bit PNG or OpenEXR."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic

Metres = NDArray[np.float32]


def check_depth_name(path: str | os.PathLike[str]) -> Callable[[Metres], bytes]:
    """The encoder of depth maps for a file name's suffix; InputError for an unknown suffix."""
    if (encode := ENCODERS.get(Path(path).suffix.lower())) is None:
        raise InputError(
            f"{path}: not a name for a depth map: end the name with {', '.join(ENCODERS)}"
        )
    return encode


def save_depth(depth: Tensor, path: str | os.PathLike[str]) -> None:
    """Write depth in metres [H, W], 0 where unknown: .npy and .exr as float32, .png as millimetres in 16 bits."""
    write_atomic(path, check_depth_name(path)(depth.cpu().numpy().astype(np.float32)))


def _npy(depth: Metres) -> bytes:
    np.save(file := io.BytesIO(), depth)
    return file.getvalue()


def _png(depth: Metres) -> bytes:
    millimetres = np.clip(np.round(depth * 1000), 0, 65_535).astype(np.uint16)  # 65.5 m at most
    Image.fromarray(millimetres).save(file := io.BytesIO(), format="PNG")
    return file.getvalue()


def _exr(depth: Metres) -> bytes:
    encoder = av.CodecContext.create("exr", "w")
    assert isinstance(encoder, VideoCodecContext)
    encoder.height, encoder.width = depth.shape
    encoder.pix_fmt, encoder.time_base = "grayf32le", Fraction(1)
    packets = [
        *encoder.encode(av.VideoFrame.from_ndarray(depth, format="grayf32le")),
        *encoder.encode(None),
    ]
    return b"".join(map(bytes, packets))


ENCODERS: dict[str, Callable[[Metres], bytes]] = {".npy": _npy, ".png": _png, ".exr": _exr}
